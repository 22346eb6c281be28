"""SpongeCake, exact single scattering in stacks of media over a substrate (Wang et al. 2022, Sec. 4).

Symbols: tau thickness, sigma projected area of the flakes, c = |cos|, a = tau sigma(wi)/ci, b = tau sigma(wo)/co. Both
the reflection and the transmission of a layer are, in a form without cancellation or overflow,

    f = gamma F D/4 * tau/(ci co) * exp(-m) * exprel(y),    exprel(y) = (1 - exp(-y)) / y

with (m, y) = (0, a + b) on the same side and (min(a, b), |a - b|) on opposite sides (Eqs. 12 and 16, the sign of Eq. 15
put right), times the attenuation of the layers that lie between it and wi, and between it and wo. Where either side is
asked for it is evaluated as (exp(-p) - exp(-q)) / (q - p), which is smooth at a = b: (p, q) = (0, a + b) or (a, b).
"""

from collections.abc import Sequence
from functools import reduce
from itertools import accumulate
from operator import add
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._numerics import absorb, at_least, decay_between, horizon, one_minus_exp, safe_div
from layerjax.channels import Channels, count, largest, mean, per_channel, pick
from layerjax.directions import Vector, half_vector, select
from layerjax.phase import SGGX
from layerjax.quadrature import Nodes
from layerjax.stack import Interface, Medium, Stack, is_known, media_of, optical_depths, simplify
from layerjax.surfaces import Surface
from layerjax.transport.contract import Side, Transport

BASE = -1
"""Stands for the base among the indices of layers."""

WEIGHT_FLOOR = 1e-14
"""Below any sigma(wi) co + sigma(wo) ci of unit vectors in the box: vectors that are not keep finite derivatives."""


class Media(eqx.Module):
    """A stack that holds media alone, without what is known to be absent."""

    media: tuple[Medium, ...]
    base: Surface | None


class SingleScattering(Transport):
    """Every path with one collision: reflection and transmission, light from above and from below, any number of media.

    Supports `Medium` layers over any surface or none; a base is seen through the media, without inter-reflection.
    """

    def check(self, stack: Stack) -> None:
        for index, layer in enumerate(stack.layers):
            if isinstance(layer, Interface):
                raise ValueError(
                    f"layers[{index}]: SingleScattering carries no Interface (media over a base only); "
                    "AddingDoubling and RandomWalk do"
                )

    def prepare(self, stack: Stack) -> Media:
        slim = simplify(stack)
        return Media(tuple(media_of(slim)), slim.base)

    def evaluate(self, state: Media, wi: Vector, wo: Vector, side: Side) -> Channels:
        return _total(list(layer_lobes(state, wi, wo, side).values()), jnp.zeros_like(wi[2] * wo[2]))

    def sample(self, state: Media, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        return draw(choices(state, wi), wi, uniforms)

    def pdf(self, state: Media, wi: Vector, wo: Vector) -> Array:
        return density(choices(state, wi), wi, wo)

    def albedo(self, state: Media, wi: Vector, nodes: int) -> tuple[Channels, Channels]:
        near, far = [], []
        spread: Vector = (wi[0][..., None], wi[1][..., None], wi[2][..., None])
        for index in _scattering(state):
            same_side, other_side = state.media[index].phase.rule(wi, nodes)
            near.append(_integral(layer_lobes(state, spread, same_side[0], "all")[index], same_side))
            if state.base is None:
                far.append(_integral(layer_lobes(state, spread, other_side[0], "all")[index], other_side))
        if state.base is not None:
            upper = state.base.rule(_lifted(wi), nodes)
            near.append(_integral(layer_lobes(state, spread, upper[0], "reflection")[BASE], upper))
        zero = jnp.zeros_like(wi[2])
        return _total(near, zero), _total(far, zero)


def _scattering(slab: Media) -> list[int]:
    """Indices of the media that scatter at all."""
    return [k for k, medium in enumerate(slab.media) if not is_known(medium.albedo, 0.0)]


def layer_lobes(slab: Media, wi: Vector, wo: Vector, side: Side) -> dict[int, Channels]:
    """BSDF of each medium that scatters, by its index, and of the base, by `BASE`."""
    opaque = slab.base is not None
    if opaque and side == "transmission":
        return {}
    valid = is_valid_pair(wi, wo, side, opaque)
    if opaque or side == "reflection":
        lobes = _from_above(slab, _lifted(wi), _lifted(wo))
    else:
        edge = horizon(wi[2].dtype)
        inside_i, inside_o = ((w[0], w[1], jnp.where(jnp.abs(w[2]) > edge, w[2], 0.5)) for w in (wi, wo))
        lobes = _from_any_side(slab, inside_i, inside_o, side)
    return {k: tuple(jnp.where(valid, value, 0.0) for value in lobe) for k, lobe in lobes.items()}


def is_valid_pair(wi: Vector, wo: Vector, side: Side, opaque: bool) -> Array:
    """Whether a pair is one that is asked for: no direction in the tangent plane, and none below an opaque base."""
    edge = horizon(wi[2].dtype)
    if opaque or side == "reflection":
        return (wi[2] > edge) & (wo[2] > edge)
    valid = (jnp.abs(wi[2]) > edge) & (jnp.abs(wo[2]) > edge)
    return valid & (wi[2] * wo[2] < 0) if side == "transmission" else valid


def _from_above(slab: Media, wi: Vector, wo: Vector) -> dict[int, Channels]:
    """wi and wo above: each layer is seen through those over it, exp(-sum (a_j + b_j)), as a running product."""
    if not slab.media:
        return {} if slab.base is None else {BASE: slab.base.evaluate(wi, wo)}
    lobes: dict[int, Channels] = {}
    scattering = _scattering(slab)
    last = len(slab.media) - 1
    half = half_vector(wi, wo, same_side=True) if _uses_half_vector(slab) else None
    inverse = 1.0 / (wi[2] * wo[2])
    through: Channels | None = None
    for k, medium in enumerate(slab.media):
        weight = medium.phase.cross_section(wi) * wo[2] + medium.phase.cross_section(wo) * wi[2]
        weight = at_least(weight, WEIGHT_FLOOR)
        shares = [absorb(tau * (weight * inverse)) for tau in per_channel(medium.thickness)]
        if k in scattering:
            lost = tuple(share / weight for _, share in shares)
            lobes[k] = _times(_collision(medium, wi, wo, half), lost if through is None else _times(through, lost))
        if k < last or slab.base is not None:
            transmitted = tuple(share for share, _ in shares)
            through = transmitted if through is None else _times(through, transmitted)
    if slab.base is not None and through is not None:
        lobes[BASE] = _times(through, slab.base.evaluate(wi, wo))
    return lobes


def _from_any_side(slab: Media, wi: Vector, wo: Vector, side: Side) -> dict[int, Channels]:
    """Any sides, no base: a direction above crosses the layers over k, one below those under it."""
    lobes: dict[int, Channels] = {}
    scattering = _scattering(slab)
    if not scattering:
        return lobes
    half = half_vector(wi, wo) if _uses_half_vector(slab) else None
    inverse = 1.0 / jnp.abs(wi[2] * wo[2])
    depths_i, depths_o = optical_depths(slab.media, wi), optical_depths(slab.media, wo)
    paths_i, paths_o = _paths(depths_i, wi), _paths(depths_o, wo)
    same_side = wi[2] * wo[2] > 0
    for k in scattering:
        medium = slab.media[k]
        gains = []
        for c in range(count(*paths_i, depths_i[k])):
            into, out = pick(depths_i[k], c), pick(depths_o[k], c)
            if side == "all":
                into, out = jnp.where(same_side, 0.0, into), jnp.where(same_side, into + out, out)
            if len(slab.media) > 1:
                path = pick(paths_i[k], c) + pick(paths_o[k], c)
                into, out = into + path, out + path
            gains.append(pick(per_channel(medium.thickness), c) * inverse * decay_between(into, out))
        lobes[k] = _times(_collision(medium, wi, wo, half), tuple(gains))
    return lobes


def _paths(depths: Sequence[Channels], w: Vector) -> list[Channels]:
    """Optical depth that a ray along w crosses between the outside and each layer; one channel count for all layers."""
    above = w[2] > 0
    zero = jnp.zeros_like(w[2])
    per_channel_paths = []
    for c in range(count(*depths)):
        layers = [pick(depth, c) for depth in depths]
        over = list(accumulate(layers[:-1], initial=zero))
        under = list(accumulate(layers[:0:-1], initial=zero))[::-1]
        per_channel_paths.append([jnp.where(above, *pair) for pair in zip(over, under, strict=True)])
    return list(zip(*per_channel_paths, strict=True)) if depths else []


def _uses_half_vector(slab: Media) -> bool:
    """Whether any collision needs one: flakes do, and so does a Fresnel term."""
    scattering = (slab.media[k] for k in _scattering(slab))
    return any(isinstance(medium.phase, SGGX) or medium.f0 is not None for medium in scattering)


def _collision(medium: Medium, wi: Vector, wo: Vector, half: tuple[Vector, Array] | None) -> Channels:
    """gamma F D/4 (Eq. 4), or gamma times the phase function: what a collision sends from wi to wo."""
    strength: Channels = (medium.phase.kernel(wi, wo, None if half is None else half[0]),)
    if half is not None and medium.f0 is not None:
        levels = (0.0,) if is_known(medium.f0, 0.0) else per_channel(medium.f0)
        strength = tuple(strength[0] * fresnel.schlick(half[1], f0) for f0 in levels)
    return strength if is_known(medium.albedo, 1.0) else _times(per_channel(medium.albedo), strength)


def choices(slab: Media, wi: Vector) -> list[tuple[Array, Any]]:
    """Probability of each lobe and the lobe: first collision in that layer (Sec. 4.6) times the share that survives it.

    The base is the last choice; without one the light that collides nowhere is left out, and the rest normalised.
    """
    edge = horizon(wi[2].dtype)
    valid = wi[2] > edge if slab.base is not None else jnp.abs(wi[2]) > edge
    wi = (wi[0], wi[1], jnp.where(valid, wi[2], 0.5))
    depths = optical_depths(slab.media, wi)
    paths = _paths(depths, wi)
    found: list[tuple[Array, Any]] = []
    for k in _scattering(slab):
        medium = slab.media[k]
        collides = mean(_times(tuple(jnp.exp(-path) for path in paths[k]), tuple(map(one_minus_exp, depths[k]))))
        survives = 1.0 if is_known(medium.albedo, 1.0) else largest(per_channel(medium.albedo))
        found.append((collides * survives, medium.phase))
    if slab.base is not None:
        reached = jnp.ones_like(wi[2])
        for depth in depths:
            reached = reached * mean(tuple(jnp.exp(-d) for d in depth))
        found.append((reached, slab.base))
    total = sum((weight for weight, _ in found), jnp.zeros_like(wi[2]))
    return [(jnp.where(valid, safe_div(weight, total), 0.0), lobe) for weight, lobe in found]


def draw(choices: list[tuple[Array, Any]], wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
    """A direction from one of the lobes, picked by their probabilities; the normal, if these are all 0."""
    u, u1, u2 = uniforms
    wo: Vector = (jnp.zeros_like(u1), jnp.zeros_like(u1), jnp.ones_like(u1))
    edge = jnp.zeros_like(u)
    for probability, lobe in choices:
        chosen = (u >= edge) & (probability > 0)
        wo = select(chosen, lobe.sample(wi, u1, u2), wo)
        edge = edge + probability
    return wo


def density(choices: list[tuple[Array, Any]], wi: Vector, wo: Vector) -> Array:
    """The density of `draw`, 1/sr."""
    total = jnp.zeros_like(wi[2] * wo[2])
    for probability, lobe in choices:
        if isinstance(lobe, Surface):
            above = jnp.where(wo[2] > horizon(wo[2].dtype), lobe.pdf(_lifted(wi), _lifted(wo)), 0.0)
            total = total + probability * above
        else:
            total = total + probability * lobe.pdf(wi, wo)
    return total


def _lifted(w: Vector) -> Vector:
    """w, with the cosine of one that is not above the horizon replaced by an interior stand-in."""
    return (w[0], w[1], jnp.where(w[2] > horizon(w[2].dtype), w[2], 0.5))


def _times(a: Channels, b: Channels) -> Channels:
    return tuple(pick(a, c) * pick(b, c) for c in range(count(a, b)))


def _total(lobes: Sequence[Channels], zero: Array) -> Channels:
    if not lobes:
        return (zero,)
    return tuple(reduce(add, (pick(lobe, c) for lobe in lobes)) for c in range(count(*lobes)))


def _integral(lobe: Channels, nodes: Nodes) -> Channels:
    wo, weight = nodes
    return tuple(jnp.sum(value * jnp.abs(wo[2]) * weight, axis=-1) for value in lobe)
