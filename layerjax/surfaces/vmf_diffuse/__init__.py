"""Rough and porous diffuse reflection by Lambertian flakes with von Mises-Fisher normals (d'Eon & Weidlich 2024).

In go the albedo of a flake and a roughness; out comes a BRDF: the fit of the `paper`, or, in `all_orders`, a table of
what such `flakes` reflect. `surface` is the class that offers both.
"""

from layerjax.surfaces.vmf_diffuse.surface import VMFDiffuse as VMFDiffuse
