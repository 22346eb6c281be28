"""What earlier results mean, where what they say means something else by now."""

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import layerjax as lj
from layerjax.stack import is_known, media_of, with_known

if TYPE_CHECKING:
    from fits.problem.noise import Noise

DEFAULTS = {"nodes": 32, "modes": 48, "ordinates": (10, 24)}
"""The resolution of an `AddingDoubling` that was given none."""


def transport_meant(stack: lj.Stack, given: lj.Transport | Literal["auto"]) -> lj.Transport:
    """The transport of a result of 0.1.0: what "auto" was for the stack, and the resolution that was the default."""
    transport = _automatic(stack) if given == "auto" else given
    if not isinstance(transport, lj.AddingDoubling) or transport.tolerance is not None:
        return transport
    left_open: dict[str, Any] = {name: value for name, value in DEFAULTS.items() if getattr(transport, name) is None}
    return replace(transport, **left_open)


def noise_meant(given: "Noise", names: Collection[str]) -> "Noise":
    """The noise of a result with these parameters: errors that readings share once did not grow towards grazing."""
    from fits.problem.discrepancy.parameters import Correlated

    shared = given.correlated
    if not isinstance(shared, Correlated) or shared.growth is not None or "noise.correlated.growth" in names:
        return given
    return replace(given, correlated=replace(shared, growth=0.0))


def _automatic(stack: lj.Stack) -> lj.Transport:
    faces = [layer for layer in stack.layers if isinstance(layer, lj.Interface)]
    if not faces:
        return lj.SingleScattering()
    media: list[Any] = media_of(with_known(stack))
    clear = all(is_known(m.albedo, 0.0) and m.phase.forward_lobe is not None and m.f0 is None for m in media)
    if clear and len(faces) == 1 and faces[0].distribution == "ggx" and isinstance(stack.base, lj.Lambertian):
        return lj.Statistical(microfacets="single")
    return lj.AddingDoubling()
