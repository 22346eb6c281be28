"""Layers between diffuse light by few streams, added up from the base: see `layerjax.transport.statistical.streams`.

As in `layerjax.transport.adding_doubling`, of one Fourier mode. A slab that scatters is Z = tanh(h sqrt(Q P)) sqrt(Q
P)^-1 Q and W, the same with P and Q changed over, h half its thickness: net flux over its sum where the two sides are
lit equally, and the inverse where they are lit with opposite signs. Both are doubled from a thin slab, Z <- 2 (1
+ Z W)^-1 Z: sums of what is positive, nothing cancels, in single precision either.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import allow_broadcasting
from layerjax.channels import per_channel
from layerjax.stack import Interface, Medium, is_known
from layerjax.transport.statistical.streams import (
    DIFFUSE,
    NODES,
    STREAMS,
    WEIGHTS,
    InterfaceMatrices,
    dot,
    interface_matrices,
    matmul,
    matvec,
)

STEPS = 18
"""Doublings of a slab: from one thinner than 0.02 to half of the thickest medium of the box, 1e4."""

MOMENTS = 2 * STREAMS
"""Moments of a phase function that are used; the rest of it counts as ballistic light (delta-M)."""


class LowerLayers(NamedTuple):
    """What lies under a level of a stack, over a base that absorbs. Leading axes: channels or 1.

    arrival: share of each stream that falls on it that arrives at the base, (C or 1, STREAMS). reflected: what it sends
    back, (C or 1, STREAMS, STREAMS), None if nothing. returned: share of diffuse light from the base that comes back to
    it, (C or 1,). ratio: index at this level over that above the base, squared.
    """

    arrival: Array
    reflected: Array | None
    returned: Array
    ratio: Array


def black_base(dtype: Any) -> LowerLayers:
    """The base itself, as black."""
    zero, whole = jnp.zeros(1, dtype), jnp.asarray(DIFFUSE, dtype)[None]
    return LowerLayers(whole, None, zero, jnp.ones((), dtype))


def add_interface(below: LowerLayers, what: InterfaceMatrices, ior: Array) -> LowerLayers:
    """An interface on top. ior: index below it over that above."""
    return _add(below, what, below.ratio / (ior * ior))


def add_medium(below: LowerLayers, medium: Medium) -> LowerLayers:
    """A medium on top."""
    dtype = below.arrival.dtype
    if is_known(medium.albedo, 0.0):
        passed = ballistic(collisions(medium, dtype))
        reflected = None if below.reflected is None else passed[:, :, None] * below.reflected * passed[:, None, :]
        return below._replace(arrival=below.arrival * passed, reflected=reflected)
    reflected, passed = _slab_of(medium, dtype)
    return _add(below, InterfaceMatrices(passed, passed, reflected, reflected), below.ratio)


def add_layers(below: LowerLayers, layers: Sequence[Interface | Medium]) -> tuple[LowerLayers, Array]:
    """All these layers on top, and the index above what they lie on."""
    dtype = below.arrival.dtype
    interfaces = [layer for layer in layers if isinstance(layer, Interface)]
    indices = [jnp.ones((), dtype), *(jnp.asarray(layer.ior, dtype) for layer in interfaces)]
    ratios = [behind / before for before, behind in pairwise(indices)]
    together = interface_matrices(
        jnp.stack([jnp.asarray(layer.alpha, dtype) for layer in interfaces]), jnp.stack(ratios)
    )
    k = len(interfaces)
    for layer in reversed(layers):
        if isinstance(layer, Medium):
            below = add_medium(below, layer)
        else:
            k -= 1
            below = add_interface(below, InterfaceMatrices(*(part[k] for part in together)), ratios[k])
    return below, indices[-1]


def collisions(medium: Medium, dtype: Any) -> Array:
    """Optical depth but for the ballistic part of forward peaks, by channels."""
    thickness = _channels(medium.thickness, dtype)
    if is_known(medium.albedo, 0.0):
        return thickness
    albedo, g = (_channels(value, dtype) for value in (medium.albedo, medium.phase.forward_lobe))
    return thickness * (1.0 - albedo * g**MOMENTS)


def ballistic(depth: Array) -> Array:
    """Share of each stream that meets nothing in an optical depth, by channels."""
    return jnp.exp(-depth[:, None] / jnp.asarray(NODES, depth.dtype))


def _slab_of(medium: Medium, dtype: Any) -> tuple[Array, Array]:
    return slab(*(_channels(value, dtype) for value in (medium.thickness, medium.albedo, medium.phase.forward_lobe)))


def _channels(value: Any, dtype: Any) -> Array:
    return jnp.stack(per_channel(jnp.asarray(value, dtype)))


def _add(below: LowerLayers, what: InterfaceMatrices, ratio: Array) -> LowerLayers:
    met = inter_reflection(below, what.bottom)
    reflected = what.top
    if below.reflected is not None:
        reflected = reflected + matmul(what.up, matmul(below.reflected, matmul(met.turns, what.down)))
    return LowerLayers(matvec(jnp.swapaxes(what.down, -1, -2), met.arrival), reflected, met.returned, ratio)


class InterReflection(NamedTuple):
    """What lies under a level, and what is above it and turns light back.

    arrival: share of each stream down there that arrives at the base, at once or later. second_arrival: of each stream
    up there. returned: of diffuse light from the base what comes back. turns: of light down there to all that ever goes
    down.
    """

    arrival: Array
    second_arrival: Array
    returned: Array
    turns: Array


def inter_reflection(below: LowerLayers, bottom: Array) -> InterReflection:
    """bottom: what is above sends back of light from below, (C or 1, STREAMS, STREAMS)."""
    turns = jnp.asarray(np.eye(STREAMS), bottom.dtype)
    arrival = below.arrival
    if below.reflected is not None:
        turns = inverse(turns - matmul(bottom, below.reflected))
        arrival = matvec(jnp.swapaxes(turns, -1, -2), arrival)
    second_arrival = matvec(jnp.swapaxes(bottom, -1, -2), arrival)
    emitted = below.arrival * below.ratio  # of diffuse light from the base, by reciprocity
    return InterReflection(arrival, second_arrival, below.returned + dot(second_arrival, emitted), turns)


class UpperLayers(NamedTuple):
    """An interface, and media under it. bottom: what they send back of light from below; inside: of light just behind
    the interface what falls on what lies under the media. (C or 1, STREAMS, STREAMS) each.
    """

    bottom: Array
    inside: Array


def first_interface(what: InterfaceMatrices) -> UpperLayers:
    """The interface alone."""
    return UpperLayers(what.bottom[None], jnp.asarray(np.eye(STREAMS), what.bottom.dtype)[None])


def append_medium(above: UpperLayers, medium: Medium) -> UpperLayers:
    """A medium more under it."""
    dtype = above.bottom.dtype
    if is_known(medium.albedo, 0.0):
        passed = ballistic(collisions(medium, dtype))
        return UpperLayers(passed[:, :, None] * above.bottom * passed[:, None, :], passed[:, :, None] * above.inside)
    reflected, passed = _slab_of(medium, dtype)
    turns = inverse(jnp.asarray(np.eye(STREAMS), dtype) - matmul(above.bottom, reflected))
    falling = matmul(passed, turns)
    return UpperLayers(reflected + matmul(falling, matmul(above.bottom, passed)), matmul(falling, above.inside))


def slab(thickness: Array, albedo: Array, g: Array) -> tuple[Array, Array]:
    """Reflection and transmission of a medium with a Henyey-Greenstein phase function; arrays by channels, (C or 1,).

    Diffuse fluxes are within 3e-4 of those of 24 nodes.
    """
    peak = g**MOMENTS
    through = 1.0 - albedo * peak
    thickness, absorbed = jnp.broadcast_arrays(thickness * through, (1.0 - albedo) / through)
    kept = [(g**order - peak) / (1.0 - peak) for order in range(MOMENTS)]
    removed = jnp.asarray(1.0 / NODES, thickness.dtype)

    def rate(parity: int) -> Array:
        scattered = sum(
            kept[order][:, None, None] * jnp.asarray(_HARMONICS[order], g.dtype) for order in range(parity, MOMENTS, 2)
        )
        return jnp.diag(removed) - (1.0 - absorbed)[:, None, None] * scattered

    def doubled(carried: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        net, sums, taken = carried
        turns = 2.0 * inverse(one + matmul(net, sums))
        taken = matvec(turns, taken)
        return (_conserve_diffuse(matmul(turns, net), taken), matmul(jnp.swapaxes(turns, -1, -2), sums), taken), None

    one = jnp.asarray(np.eye(STREAMS), thickness.dtype)
    thin = (thickness * 0.5 ** (STEPS + 1))[:, None]
    taken = thin * absorbed[:, None] * removed * jnp.asarray(DIFFUSE, thickness.dtype)
    begin = _conserve_diffuse(thin[..., None] * rate(0), taken), thin[..., None] * rate(1), taken
    (net, sums, _), _ = jax.lax.scan(doubled, begin, None, length=STEPS)
    even, odd = inverse(one + net), inverse(one + sums)
    return even - odd, even + odd - one


def _conserve_diffuse(net: Array, taken: Array) -> Array:
    """Z, with what it takes of diffuse light known by itself: rounding would absorb light in the thickest media."""
    diffuse = jnp.asarray(DIFFUSE, net.dtype)
    remainder = taken - matvec(net, diffuse)
    mean = dot(remainder, diffuse)[..., None, None]
    sides = remainder[..., :, None] * diffuse
    return net + sides + jnp.swapaxes(sides, -1, -2) - mean * diffuse[:, None] * diffuse


_HARMONICS = [
    (2 * order + 1) * np.outer(*[np.sqrt(WEIGHTS / NODES) * np.polynomial.Legendre.basis(order)(NODES)] * 2)
    for order in range(MOMENTS)
]
"""What the moments of a phase function scatter from stream to stream."""


@jax.custom_jvp
def inverse(matrix: Array) -> Array:
    """Inverse of (..., STREAMS, STREAMS) matrices that need no pivoting, by Gauss-Jordan elimination.

    That of adding-doubling goes by blocks of 8 and by products: it would do several times the work at every texel.
    """
    for k in range(STREAMS):  # as a loop of the program it takes three times as long
        here = np.arange(STREAMS) == k
        pivot = 1.0 / matrix[..., k, k][..., None]
        row = jnp.where(here, pivot, pivot * matrix[..., k, :])
        rest = jnp.where(here, 0.0, matrix) - matrix[..., :, k, None] * row[..., None, :]
        matrix = jax.lax.optimization_barrier(jnp.where(here[:, None], row[..., None, :], rest))
    return matrix


@inverse.defjvp
@allow_broadcasting
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    result = inverse(*primals)
    return result, -matmul(result, matmul(tangents[0], result))
