"""SpongeCake, exact single scattering in stacks of media over a substrate (Wang et al. 2022, Sec. 4).

Symbols: tau thickness, sigma projected area of the flakes, c = |cos|, a = tau sigma(wi)/ci, b = tau sigma(wo)/co. Both
the reflection and the transmission of a layer are, in a form without cancellation or overflow,

    f = gamma F D/4 * tau/(ci co) * exp(-m) * exprel(y),    exprel(y) = (1 - exp(-y)) / y

with (m, y) = (0, a + b) on the same side and (min(a, b), |a - b|) on opposite sides (Eqs. 12 and 16, the sign of Eq. 15
put right), times the attenuation of the layers that lie between it and wi, and between it and wo. Where either side is
possible it is evaluated as (exp(-p) - exp(-q)) / (q - p), which is smooth at a = b: (p, q) = (0, a + b) or (a, b).
"""

from collections.abc import Sequence
from itertools import accumulate
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax import channels, fresnel
from layerjax._numerics import absorb, clamp_min, horizon, mean_decay, one_minus_exp, safe_div
from layerjax.channels import Channels, count, largest, map_channels, mean, multiply, per_channel, pick, total
from layerjax.directions import Vector, half_vector, is_above, sanitise, select
from layerjax.quadrature import Nodes
from layerjax.stack import Interface, Medium, Stack, is_known, media_of, optical_depths
from layerjax.surfaces import Surface
from layerjax.transport.contract import TEXELS, DeterministicTransport, Side, refuse_smooth

BASE = -1
"""Stands for the base among the indices of layers."""

WEIGHT_FLOOR = 1e-14
"""Below any sigma(wi) co + sigma(wo) ci of unit vectors in the box: vectors that are not keep finite derivatives."""


class Media(eqx.Module):
    """A stack that holds media alone, without what is known to be absent."""

    media: tuple[Medium, ...]
    base: Surface | None


class SingleScattering(DeterministicTransport):
    """Exact single scattering: reflection and transmission, light from both sides, any number of media.

    Supports `Medium` layers over any surface or none. Light of the base is attenuated by the media, without
    inter-reflection.
    """

    texel_batch: ClassVar[int] = TEXELS

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        refuse_smooth(stack, names, "SingleScattering")
        for name, layer in zip(names, stack.layers, strict=True):
            if isinstance(layer, Interface):
                raise ValueError(
                    f"{name}: SingleScattering carries no Interface (media over a base only); "
                    "AddingDoubling and RandomWalk do"
                )

    def prepare(self, stack: Stack) -> Media:
        return Media(tuple(media_of(stack)), stack.base)

    def evaluate(self, state: Media, wi: Vector, wo: Vector, side: Side) -> Channels:
        return total(list(layer_lobes(state, wi, wo, side).values()), jnp.zeros_like(wi[2] * wo[2]))

    def sample(self, state: Media, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        return draw(choices(state, wi), wi, uniforms)

    def pdf(self, state: Media, wi: Vector, wo: Vector) -> Array:
        return density(choices(state, wi), wi, wo)

    def albedo(self, state: Media, wi: Vector, nodes: int) -> tuple[Channels, Channels]:
        near, far = [], []
        spread: Vector = (wi[0][..., None], wi[1][..., None], wi[2][..., None])
        for index in _scattering_indices(state):
            same_side, other_side = state.media[index].phase.rule(wi, nodes)
            near.append(_integral(layer_lobes(state, spread, same_side[0], "all")[index], same_side))
            if state.base is None:
                far.append(_integral(layer_lobes(state, spread, other_side[0], "all")[index], other_side))
        if state.base is not None:
            upper = state.base.rule(sanitise(wi), nodes)
            near.append(_integral(layer_lobes(state, spread, upper[0], "reflection")[BASE], upper))
        zero = jnp.zeros_like(wi[2])
        return total(near, zero), total(far, zero)


def _scattering_indices(slab: Media) -> list[int]:
    """Indices of the media that scatter at all."""
    return [k for k, medium in enumerate(slab.media) if not is_known(medium.albedo, 0.0)]


def layer_lobes(slab: Media, wi: Vector, wo: Vector, side: Side) -> dict[int, Channels]:
    """BSDF of each medium that scatters, by its index, and of the base, by `BASE`."""
    opaque = slab.base is not None
    if opaque and side == "transmission":
        return {}
    valid = is_valid_pair(wi, wo, side, opaque)
    if opaque or side == "reflection":
        lobes = _lobes_from_above(slab, sanitise(wi), sanitise(wo))
    else:
        edge = horizon(wi[2].dtype)
        inside_i, inside_o = (sanitise(w, jnp.abs(w[2]) > edge) for w in (wi, wo))
        lobes = _lobes_from_any_side(slab, inside_i, inside_o, side)
    return {k: channels.select(valid, lobe) for k, lobe in lobes.items()}


def is_valid_pair(wi: Vector, wo: Vector, side: Side, opaque: bool) -> Array:
    """Whether a pair is among the requested ones: no direction in the tangent plane, and none below an opaque base."""
    edge = horizon(wi[2].dtype)
    if opaque or side == "reflection":
        return (wi[2] > edge) & (wo[2] > edge)
    valid = (jnp.abs(wi[2]) > edge) & (jnp.abs(wo[2]) > edge)
    return valid & (wi[2] * wo[2] < 0) if side == "transmission" else valid


def _lobes_from_above(slab: Media, wi: Vector, wo: Vector) -> dict[int, Channels]:
    """wi and wo above: each layer is seen through those over it, exp(-sum (a_j + b_j)), as a running product."""
    if not slab.media:
        return {} if slab.base is None else {BASE: slab.base.evaluate(wi, wo)}
    lobes: dict[int, Channels] = {}
    scattering = _scattering_indices(slab)
    last = len(slab.media) - 1
    half = half_vector(wi, wo, same_side=True) if _uses_half_vector(slab) else None
    inverse = 1.0 / (wi[2] * wo[2])
    through: Channels | None = None
    for k, medium in enumerate(slab.media):
        weight = medium.phase.cross_section(wi) * wo[2] + medium.phase.cross_section(wo) * wi[2]
        weight = clamp_min(weight, WEIGHT_FLOOR)
        # exp(-x) and 1 - exp(-x) of Eq. (12): x = tau (sigma_i/c_i + sigma_o/c_o)
        shares = [absorb(tau * (weight * inverse)) for tau in per_channel(medium.thickness)]
        if k in scattering:
            lost = tuple(share / weight for _, share in shares)  # G / (c_i c_o), Eqs. (11) and (12)
            lobes[k] = multiply(_collision(medium, wi, wo, half), lost if through is None else multiply(through, lost))
        if k < last or slab.base is not None:
            transmitted = tuple(share for share, _ in shares)
            through = transmitted if through is None else multiply(through, transmitted)
    if slab.base is not None and through is not None:
        lobes[BASE] = multiply(through, slab.base.evaluate(wi, wo))  # Sec. 4.5
    return lobes


def _lobes_from_any_side(slab: Media, wi: Vector, wo: Vector, side: Side) -> dict[int, Channels]:
    """Any sides, no base: a direction above crosses the layers over k, one below those under it."""
    lobes: dict[int, Channels] = {}
    scattering = _scattering_indices(slab)
    if not scattering:
        return lobes
    half = half_vector(wi, wo) if _uses_half_vector(slab) else None
    inverse = 1.0 / jnp.abs(wi[2] * wo[2])
    depths_i, depths_o = optical_depths(slab.media, wi), optical_depths(slab.media, wo)
    paths_i, paths_o = _paths(depths_i, wi), _paths(depths_o, wo)
    same_side = wi[2] * wo[2] > 0

    def gain(thickness: Array, into: Array, out: Array, path_i: Array, path_o: Array) -> Array:
        if side == "all":
            into, out = jnp.where(same_side, 0.0, into), jnp.where(same_side, into + out, out)
        if len(slab.media) > 1:  # Sec. 4.4
            path = path_i + path_o
            into, out = into + path, out + path
        return thickness * inverse * mean_decay(into, out)  # G / (c_i c_o) of Eqs. (12) and (16)

    for k in scattering:
        medium = slab.media[k]
        gains = map_channels(gain, per_channel(medium.thickness), depths_i[k], depths_o[k], paths_i[k], paths_o[k])
        lobes[k] = multiply(_collision(medium, wi, wo, half), gains)
    return lobes


def _paths(depths: Sequence[Channels], w: Vector) -> list[Channels]:
    """Optical depth that a ray along w crosses between outside and each layer (Sec. 4.4); as many channels for all."""
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
    """Whether any collision needs one: a phase function of flakes does, and so does a Fresnel term."""
    scattering = (slab.media[k] for k in _scattering_indices(slab))
    return any(medium.phase.uses_half_vector or medium.f0 is not None for medium in scattering)


def _collision(medium: Medium, wi: Vector, wo: Vector, half: tuple[Vector, Array] | None) -> Channels:
    """gamma F D/4 (Eqs. 4 and 5), or gamma times the phase function: what a collision sends from wi to wo."""
    strength: Channels = (medium.phase.kernel(wi, wo, None if half is None else half[0]),)
    if half is not None and medium.f0 is not None:
        levels = (0.0,) if is_known(medium.f0, 0.0) else per_channel(medium.f0)
        strength = tuple(strength[0] * fresnel.schlick(half[1], f0) for f0 in levels)
    return strength if is_known(medium.albedo, 1.0) else multiply(per_channel(medium.albedo), strength)


def choices(slab: Media, wi: Vector) -> list[tuple[Array, Any]]:
    """Probability of each lobe and the lobe: first collision in that layer (Sec. 4.6) times the share that survives it.

    The base is the last choice; without one the light that collides nowhere is omitted, and the rest normalised.
    """
    edge = horizon(wi[2].dtype)
    valid = wi[2] > edge if slab.base is not None else jnp.abs(wi[2]) > edge
    wi = sanitise(wi, valid)
    depths = optical_depths(slab.media, wi)
    paths = _paths(depths, wi)
    events: list[tuple[Array, Any]] = []
    for k in _scattering_indices(slab):
        medium = slab.media[k]
        collides = mean(multiply(tuple(jnp.exp(-path) for path in paths[k]), tuple(map(one_minus_exp, depths[k]))))
        survives = 1.0 if is_known(medium.albedo, 1.0) else largest(per_channel(medium.albedo))
        events.append((collides * survives, medium.phase))
    if slab.base is not None:
        reached = jnp.ones_like(wi[2])
        for depth in depths:
            reached = reached * mean(tuple(jnp.exp(-d) for d in depth))
        events.append((reached, slab.base))
    total = sum((weight for weight, _ in events), jnp.zeros_like(wi[2]))
    return [(jnp.where(valid, safe_div(weight, total), 0.0), lobe) for weight, lobe in events]


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
    off_plane = sanitise(wi, jnp.abs(wi[2]) > horizon(wi[2].dtype))  # of others, zeros too, all probabilities are 0
    for probability, lobe in choices:
        if isinstance(lobe, Surface):
            above = jnp.where(is_above(wo), lobe.pdf(sanitise(wi), sanitise(wo)), 0.0)
            total = total + probability * above
        else:
            total = total + probability * lobe.pdf(off_plane, wo)
    return total


def _integral(lobe: Channels, nodes: Nodes) -> Channels:
    wo, weight = nodes
    return tuple(jnp.sum(value * jnp.abs(wo[2]) * weight, axis=-1) for value in lobe)
