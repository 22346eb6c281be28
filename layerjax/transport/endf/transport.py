"""Thin rough coats by extended normal distributions (Guo, Qian & Pan 2015).

What a beam becomes that is refracted, reflected and refracted again at rough surfaces is one microfacet lobe of wider
normals, which follow from the roughnesses in closed form: see `layerjax.transport.endf.warping` for one event,
`chains` for the coat, `slab` for light that passes, and `sampling` for the sampler.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import channels
from layerjax.channels import Channels, per_channel, total
from layerjax.directions import Vector, flip, is_above, sanitise, select
from layerjax.normals.vmf import Masking, concentration
from layerjax.stack import Interface, Medium, Stack, is_known, media_of
from layerjax.surfaces import Conductor
from layerjax.transport.contract import (
    TEXELS,
    DeterministicTransport,
    Side,
    refuse_anisotropic,
    refuse_film,
    refuse_smooth,
    refuse_student,
)
from layerjax.transport.endf import sampling
from layerjax.transport.endf.chains import Coat, Form, LowerSide, Options, UpperSide, reflections
from layerjax.transport.endf.slab import transmissions

MOST_BOUNCES = 16
"""Each bounce is a lobe of its own in the program."""


class Sides(eqx.Module):
    """A stack as light from above meets it, and (None over a base) as light from below does, turned up."""

    upper: Coat
    lower: Coat | None


class ENDF(DeterministicTransport):
    """Extended normal distribution functions: one microfacet lobe per bounce, for a coat on metal or a slab (Guo et al.
    2015).

    Supports one `Interface` over a `Conductor`; a slab, that is two `Interface` layers of which the second leads back
    into the surroundings of the stack; one `Interface` alone; a bare `Conductor`; and `Medium` layers that only absorb
    between the two sides. All normals are von Mises-Fisher; a GGX width counts as kappa = 2 / alpha^2. An albedo of 0
    and an index of 1 must be known while tracing: make the stack outside `jit`, and insert traced numbers with
    `equinox.tree_at`.

    Compared with a Monte Carlo of the same facets, one bounce under a coat of index 1.5 or 2 on a mirror (light up to
    85 degrees) has these errors in form "reciprocal": energy 0.002 at kappa = 1e4, 0.023 from kappa = 100 on, and 0.11
    too much at kappa = 10; shape (sum of differences over sum) within the noise of 0.04 at 1e4, 0.15 from 100 on, and
    0.44 at worst at 10. Form "paper" omits total internal reflection: its energy is up to 3.5 times too large, and
    accurate only where light inside stays far from the critical angle (up to 30 degrees and kappa >= 100 below).
    Through a slab the energy of the reciprocal form is within 0.06. See ``python -m benchmarks endf``.

    From the second bounce on, both forms underestimate rough surfaces, where total internal reflection traps light
    (kappa 1e3 over 10 along the normal: 0.016 and 0.023 instead of 0.148). On a mirror, the albedo of the reciprocal
    form with four bounces exceeds 1 by at most 0.04 for indices above 1 (300 stacks, kappa 0.01 to 2e6), and by 0.21
    for indices down to 0.5; that of the paper's form reaches 2.2 at grazing light.

    Args:
        bounces: number of reflections at the lower side, 0 to 16. 0: the surface only (and, through a slab, direct
            transmission). The second and later ones are not in the paper.
        form: ``"reciprocal"``, lobes about the half vector below the surface: reciprocal, exact for a smooth coat, and
            not in the paper; or ``"paper"``, the paper's lobes with its misprints corrected, which follow wi and are
            not reciprocal (the paper traces from the viewer: exchange wi and wo for that).
        masking: fit of the masking: ``"normal"``, accurate to 0.03 from kappa = 2 on, or ``"paper"``, Eq. (8).

    Raises:
        ValueError: an option has an unknown value.
    """

    texel_batch: ClassVar[int] = TEXELS

    bounces: int = eqx.field(static=True, default=1)
    form: Form = eqx.field(static=True, default="reciprocal")
    masking: Masking = eqx.field(static=True, default="normal")

    def __check_init__(self) -> None:
        if not (isinstance(self.bounces, int) and 0 <= self.bounces <= MOST_BOUNCES):
            raise ValueError(f"ENDF.bounces: {self.bounces!r} is not a whole number from 0 to {MOST_BOUNCES}")
        for name, choices in (("form", Form), ("masking", Masking)):
            value = getattr(self, name)
            if value not in get_args(choices):
                allowed = ", ".join(map(repr, get_args(choices)))
                raise ValueError(f"ENDF.{name}: {value!r} is not one of {allowed}")

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        refuse_smooth(stack, names, "ENDF")
        refuse_anisotropic(stack, names, "ENDF")
        refuse_student(stack, names, "ENDF")
        sides = [index for index, layer in enumerate(stack.layers) if isinstance(layer, Interface)]
        most = 2 if stack.base is None else 1
        for index, (name, layer) in enumerate(zip(names, stack.layers, strict=True)):
            if isinstance(layer, Medium):
                if not is_known(layer.albedo, 0.0):
                    raise ValueError(
                        f"{name}: ENDF carries no Medium that scatters (its albedo must be known to be 0, not "
                        "traced); AddingDoubling and RandomWalk do"
                    )
                if sides and not (sides[0] < index and (stack.base is not None or index < sides[-1])):
                    raise ValueError(
                        f"{name}: ENDF carries a Medium only between the two sides of a coat or slab; "
                        "Statistical, AddingDoubling and RandomWalk carry others"
                    )
            elif index in sides[most:]:
                raise ValueError(
                    f"{name}: ENDF carries one Interface over a base, and two without; Statistical, "
                    "AddingDoubling and RandomWalk carry more"
                )
            elif index in sides[1:] and not _is_one(layer.ior):
                raise ValueError(
                    f"{name}.ior: ENDF carries a slab only in one surrounding (this must be known to be 1, "
                    "not traced); Statistical, AddingDoubling and RandomWalk do"
                )
        if not (stack.base is None or isinstance(stack.base, Conductor)):
            raise ValueError(
                f"base: ENDF carries no {type(stack.base).__name__} (a Conductor, or no base); Statistical, "
                "AddingDoubling and RandomWalk do"
            )
        refuse_film(stack, names, "ENDF")

    def prepare(self, stack: Stack) -> Sides:
        faces = [layer for layer in stack.layers if isinstance(layer, Interface)]
        media = tuple(media_of(stack))
        if not faces:
            return Sides(Coat(None, media, _metal(stack.base, 1.0)), None)
        top = UpperSide(faces[0].ior, concentration(faces[0].alpha))
        if stack.base is not None:
            return Sides(Coat(top, media, _metal(stack.base, top.ior)), None)
        inverse = 1.0 / top.ior
        if len(faces) == 1:
            return Sides(Coat(top, (), None), Coat(UpperSide(inverse, top.kappa), (), None))
        bottom = UpperSide(top.ior, concentration(faces[1].alpha))
        upper, lower = (
            Coat(one, media, LowerSide(other.kappa, (inverse,), None)) for one, other in ((top, bottom), (bottom, top))
        )
        return Sides(upper, lower)

    def evaluate(self, state: Sides, wi: Vector, wo: Vector, side: Side) -> Channels:
        coat = state.upper
        if side != "reflection":
            coat, wi, wo = _orient(state, wi, wo)
        lit, up, down = is_above(wi), is_above(wo), is_above(flip(wo))
        # both kinds of lobe share what depends on how steep wo is, not on its side
        wi, over = sanitise(wi), sanitise(wo if side == "reflection" else select(down, flip(wo), wo))
        parts: list[Channels] = [(jnp.zeros_like(wi[2] * wo[2]),)]
        if side != "transmission":
            lobes = reflections(coat, self._options(), wi, over)
            parts += [channels.select(lit & up, lobe) for lobe in lobes]
        if side != "reflection" and state.lower is not None:
            lobes = transmissions(coat, self._options(), wi, over)
            parts += [channels.select(lit & down, lobe) for lobe in lobes]
        return total(parts)

    def sample(self, state: Sides, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        coat, up, _ = _orient(state, wi, wi)
        wo = sampling.draw(coat, self._options(), up, uniforms, state.lower is None)
        return wo if state.lower is None else select(wi[2] > 0, wo, flip(wo))

    def pdf(self, state: Sides, wi: Vector, wo: Vector) -> Array:
        coat, wi, wo = _orient(state, wi, wo)
        return sampling.density(coat, self._options(), wi, wo, state.lower is None)

    def albedo(self, state: Sides, wi: Vector, nodes: int) -> tuple[Channels, Channels]:
        """By quadrature, every lobe with a rule of its own: 32 nodes give 1e-4, 2e-3 near the critical angle."""
        coat, wi, _ = _orient(state, wi, wi)
        return sampling.energies(coat, self._options(), wi, nodes, state.lower is None)

    def _options(self) -> Options:
        return Options(self.bounces, self.form, self.masking)


def _orient(state: Sides, wi: Vector, wo: Vector) -> tuple[Coat, Vector, Vector]:
    """The coat as wi meets it, and both directions turned with it so that wi comes from above."""
    if state.lower is None:
        return state.upper, wi, wo
    above = wi[2] > 0
    upper, lower = ((coat.top, coat.base) for coat in (state.upper, state.lower))
    top, base = jax.tree.map(lambda one, other: jnp.where(above, one, other), upper, lower)
    coat = Coat(top, state.upper.media, base, ~above)
    return coat, select(above, wi, flip(wi)), select(above, wo, flip(wo))


def _metal(base: Any, above: Any) -> LowerSide | None:
    """The base under a medium of that index."""
    if base is None:
        return None
    ior, k = (tuple(value / above for value in per_channel(part)) for part in (base.ior, base.k))
    return LowerSide(concentration(base.alpha), ior, k)


def _is_one(index: Any) -> bool:
    return not isinstance(index, jax.core.Tracer) and bool(np.all(np.asarray(index) == 1.0))
