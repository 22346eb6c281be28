"""Surface BSDFs, one a file: usable alone (``Stack([], base=surface)``) or as the base under layers."""

from layerjax.surfaces.contract import Surface as Surface
from layerjax.surfaces.lambertian import Lambertian as Lambertian
from layerjax.surfaces.microfacet import Conductor as Conductor
from layerjax.surfaces.oren_nayar import OrenNayar as OrenNayar
from layerjax.surfaces.vmf_diffuse.surface import VMFDiffuse as VMFDiffuse
