"""Which transport a stack gets when none is named."""

from layerjax.stack import Interface, Stack, is_known, media_of
from layerjax.transport.adding_doubling import AddingDoubling
from layerjax.transport.contract import Transport
from layerjax.transport.single_scattering import SingleScattering
from layerjax.transport.specular import is_smooth


def automatic(stack: Stack, simplified: Stack) -> Transport:
    """The rule of ``transport="auto"``, see `layerjax.prepare`. What is traced counts as not known.

    An interface counts where it was given, though its index may be known to be that of what lies above it: a fit that
    passes through that index stays with one transport.
    """
    if any(isinstance(layer, Interface) for layer in stack.layers) or is_smooth(stack.base):
        return AddingDoubling()
    # of light that meets nothing twice one event is the whole; thin media do not count: a share of 1e-4 along the
    # normal is a hundredth at grazing angles
    if all(is_known(medium.albedo, 0.0) for medium in media_of(simplified)):
        return SingleScattering()
    return AddingDoubling()
