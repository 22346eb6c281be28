"""Which transport a stack gets when none is named."""

from layerjax.stack import Interface, Medium, Stack, is_known, media_of
from layerjax.surfaces import Lambertian
from layerjax.transport.adding_doubling import AddingDoubling
from layerjax.transport.contract import Transport
from layerjax.transport.single_scattering import SingleScattering
from layerjax.transport.statistical import Statistical


def automatic(given: Stack, simplified: Stack) -> Transport:
    """The rule of ``transport="auto"``, see `layerjax.prepare`. What is traced counts as not known.

    An interface counts where it was given, though its index may be known to be that of what lies above it: a fit that
    passes through that index stays with one transport.
    """
    faces = [layer for layer in given.layers if isinstance(layer, Interface)]
    if not faces:
        return SingleScattering()
    closed = len(faces) == 1 and faces[0].distribution == "ggx" and isinstance(given.base, Lambertian)
    if closed and all(map(_only_absorbs, media_of(simplified))):
        return Statistical(microfacets="single")
    return AddingDoubling()


def _only_absorbs(medium: Medium) -> bool:
    """In a way that `Statistical` carries."""
    return is_known(medium.albedo, 0.0) and medium.phase.forward_lobe is not None and medium.f0 is None
