"""Makers of the tables that `layerjax.tables` ships: ``python -m layerjax.precompute NAME``. Nothing imports them."""

NAMES = ("microsurface", "energies", "diffuse_interface", "streams", "spongecake", "vmf_diffuse")
