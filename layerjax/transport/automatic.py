"""Which transport a stack gets when none is named."""

from layerjax.phase import HenyeyGreenstein
from layerjax.stack import Interface, Medium, Stack, is_known, media_of, place_of_vmf, simplify
from layerjax.surfaces import Lambertian
from layerjax.transport.adding_doubling import AddingDoubling
from layerjax.transport.contract import Transport
from layerjax.transport.single_scattering import SingleScattering
from layerjax.transport.statistical import Statistical


def automatic(stack: Stack) -> Transport:
    """The rule of ``transport="auto"``, see `layerjax.prepare`. What is traced counts as not known."""
    interfaces = sum(isinstance(layer, Interface) for layer in stack.layers)
    if not interfaces:
        return SingleScattering()
    closed = interfaces == 1 and isinstance(stack.base, Lambertian) and place_of_vmf(stack) is None
    if closed and all(map(_only_absorbs, media_of(simplify(stack)))):
        return Statistical(microfacets="single")
    return AddingDoubling()


def _only_absorbs(medium: Medium) -> bool:
    return is_known(medium.albedo, 0.0) and isinstance(medium.phase, HenyeyGreenstein) and medium.f0 is None
