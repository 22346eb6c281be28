"""SpongeCake with multiple scattering (Wang et al. 2022, Sec. 5): single scattering, a second lobe, and a constant."""

from collections.abc import Mapping, Sequence
from functools import cache, partial
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax._shapes import map_shape
from layerjax.channels import Channels, total
from layerjax.compiling import is_traced
from layerjax.directions import Vector
from layerjax.stack import Interface, Stack, is_known, media_of
from layerjax.tables import load
from layerjax.transport.contract import TEXELS, DeterministicTransport, Side, refuse_smooth
from layerjax.transport.known_directions import DirectionLookup
from layerjax.transport.single_scattering import Media, SingleScattering, choices, density, draw
from layerjax.transport.spongecake.energy_correction import correction_network
from layerjax.transport.spongecake.layers import MOST_MEDIA, pair_of
from layerjax.transport.spongecake.lobes import (
    Hemisphere,
    SecondLobe,
    evaluate_second,
    has_learned,
    second_albedo,
    second_lobe,
)
from layerjax.transport.spongecake.mapping import network, unpack

Proposal = Literal["first", "both"]


SECOND_SHARE = 1.0 / 3.0
"""How often what is drawn comes from the second lobe or the constant, where `proposal` has both."""


class SpongeCakeState(eqx.Module):
    """A stack, and its second lobe, None where nothing scatters."""

    first: Media
    second: SecondLobe | None
    opaque: bool = eqx.field(static=True)


class SpongeCake(DeterministicTransport):
    """Exact single scattering, with multiple scattering as a second lobe and a constant (Wang et al. 2022).

    Supports `Medium` layers over any surface or none. A network that was trained on `AddingDoubling` for one and two
    media gives the parameters of the second lobe (``python -m layerjax.precompute spongecake``). For the multiple
    scattering of more than two media, neighbours are merged into a pair first. Which are merged depends on their
    values, so more than two media with traced parameters (under ``jit`` or ``grad``) are refused. Light of the base is
    attenuated by the media, without inter-reflection. In addition to the paper, a factor of both directions corrects
    the energy of the second lobe; for media that do not absorb it has a network of its own.

    Relative L2 error of the BSDF over random materials: 2 % for one medium and 4 % for two (median), 9 % and 22 % (95th
    percentile), largest for narrow fibers (`benchmarks/results/spongecake.md`). Albedos of lossless slabs have errors
    of 0.1 % and 0.7 % (median), 2 % and 6 % (95th percentile). Values are reciprocal and finite for all parameters, but
    inaccurate at the ends of the ranges: for lossless stacks with half of their parameters at an end (abs(g) 0.999,
    alpha 1e-4, thickness 1e-6 or 1e4) and light at up to 80 degrees, the 95th percentile is 10 % for one haze, 20 % for
    flakes and 50 % for two hazes; some reflect 1.6 times the incident light, and sharp flakes at grazing incidence many
    times as much. Within abs(g) < 0.9, alpha > 0.1 and thickness 0.01 to 10 it is 1 %, 5 % and 16 %. `AddingDoubling`
    has no such limits.

    Args:
        proposal: density that `lj.sample` draws from: ``"first"``, the first order only, as in the paper, or both lobes
            and the constant.
    """

    texel_batch: ClassVar[int] = TEXELS

    proposal: Proposal = eqx.field(static=True, default="first")

    def __check_init__(self) -> None:
        if self.proposal not in get_args(Proposal):
            allowed = ", ".join(map(repr, get_args(Proposal)))
            raise ValueError(f"SpongeCake.proposal: {self.proposal!r} is not one of {allowed}")

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        refuse_smooth(stack, names, "SpongeCake")
        for name, layer in zip(names, stack.layers, strict=True):
            if isinstance(layer, Interface):
                raise ValueError(
                    f"{name}: SpongeCake carries no Interface (media over a base only); "
                    "AddingDoubling and RandomWalk do"
                )
            if not has_learned(layer.phase):
                raise ValueError(
                    f"{name}: SpongeCake has learned no {type(layer.phase).__name__} medium (HenyeyGreenstein and SGGX "
                    "only); SingleScattering, AddingDoubling and RandomWalk carry it"
                )
        media = tuple(media_of(stack))
        if len(media) > MOST_MEDIA and (is_traced(media) or map_shape(stack)):
            raise ValueError(
                f"layers: SpongeCake puts {len(media)} media together to {MOST_MEDIA} by their numbers, which are "
                "traced here, or differ from texel to texel; prepare the stack outside jit, grad and vmap, or take "
                "SingleScattering or AddingDoubling"
            )

    def prepare(self, stack: Stack) -> SpongeCakeState:
        first = SingleScattering().prepare(stack)
        scatters = any(not is_known(medium.albedo, 0.0) for medium in first.media)
        second = _second(pair_of(first.media), networks(), correction_networks()) if scatters else None
        return SpongeCakeState(first, second, first.base is not None)

    def traceable_equivalent(self, stack: Stack, known: DirectionLookup) -> "SpongeCake | None":
        """Itself, but of more media than can be traced."""
        return self if len(media_of(stack)) <= MOST_MEDIA else None

    def evaluate(self, state: SpongeCakeState, wi: Vector, wo: Vector, side: Side) -> Channels:
        values = SingleScattering().evaluate(state.first, wi, wo, side)
        if state.second is None or (state.opaque and side == "transmission"):
            return values
        # the three lobes of Sec. 5
        return total([values, evaluate_second(state.second, wi, wo, side, state.opaque)])

    def sample(self, state: SpongeCakeState, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        return draw(self._choices(state, wi), wi, uniforms)

    def pdf(self, state: SpongeCakeState, wi: Vector, wo: Vector) -> Array:
        return density(self._choices(state, wi), wi, wo)

    def albedo(self, state: SpongeCakeState, wi: Vector, nodes: int) -> tuple[Channels, Channels]:
        first = SingleScattering().albedo(state.first, wi, nodes)
        if state.second is None:
            return first
        second = second_albedo(state.second, wi, nodes, state.opaque)
        return total([first[0], second[0]]), total([first[1], second[1]])

    def _choices(self, state: SpongeCakeState, wi: Vector) -> list[tuple[Array, Any]]:
        """Lobes to draw from, with their probabilities."""
        first = choices(state.first, wi)
        if self.proposal == "first" or state.second is None:  # Sec. 4.6
            return first
        levels = [Hemisphere(False)] if state.opaque else [Hemisphere(False), Hemisphere(True)]
        share = 0.5 * SECOND_SHARE
        return [
            *((probability * (1.0 - SECOND_SHARE), lobe) for probability, lobe in first),
            *((probability * share, lobe) for probability, lobe in choices(state.second.slab, wi)),
            *((jnp.full_like(wi[2], share / len(levels)), level) for level in levels),
        ]


@cache
def networks() -> Mapping[int, eqx.nn.MLP]:
    """The trained networks that are shipped, by the number of media."""
    table = load("spongecake")
    return {media: unpack(table, str(media), partial(network, media)) for media in range(1, MOST_MEDIA + 1)}


@cache
def correction_networks() -> Mapping[int, eqx.nn.MLP]:
    """The shipped networks of `layerjax.transport.spongecake.energy_correction`, by the number of media."""
    table = load("spongecake")
    return {
        media: unpack(table, f"{media}-bend", partial(correction_network, media)) for media in range(1, MOST_MEDIA + 1)
    }


_second = eqx.filter_jit(second_lobe)
