"""Surface BSDFs, one a file: usable alone (``Stack([], base=surface)``) or as the base under layers.

In go parameters, and directions as components in the frame of the surface; out come BRDF values, directions drawn and
their densities, as `Surface` states. A dielectric `interface` is no `Surface`: light passes it, and a stack holds it
as a layer.
"""

from layerjax.surfaces.contract import Surface as Surface
from layerjax.surfaces.lambertian import Lambertian as Lambertian
from layerjax.surfaces.microfacet import Conductor as Conductor
from layerjax.surfaces.oren_nayar import OrenNayar as OrenNayar
from layerjax.surfaces.thin_film import ThinFilm as ThinFilm
from layerjax.surfaces.vmf_diffuse import VMFDiffuse as VMFDiffuse
