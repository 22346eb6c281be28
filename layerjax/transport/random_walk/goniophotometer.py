"""A virtual goniophotometer: where the light goes that falls on a stack, by an analog random walk.

Unlike values of the BSDF, energies need no direction to aim at: paths are followed until they leave and counted where
they do. What is counted is exact on average, bin by bin and order by order.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from layerjax._checks import require_choice, require_count, require_key
from layerjax._numerics import allow_broadcasting, horizon
from layerjax._parameters import cast_arrays
from layerjax._shapes import channel_count, require_single
from layerjax.directions import read_directions, split
from layerjax.stack import Stack, require_numbers, simplify
from layerjax.transport.random_walk.batches import Record, follow, kahan_add, quotas, replace_invalid, standard_error
from layerjax.transport.random_walk.random_numbers import key_words
from layerjax.transport.random_walk.scene import Scene
from layerjax.transport.random_walk.state import Step
from layerjax.transport.random_walk.walk import Walk


class Goniogram(eqx.Module):
    """Shares of the incident power, with standard errors; the channel axis is last.

    ============================== ================================= =================================================
    field                          shape                             meaning
    ============================== ================================= =================================================
    energy, energy_error           (..., 2, polar, azimuth, C)       scattered into each bin, on wi's side and on the
                                                                     other
    orders, orders_error           (..., 2, orders, C)               by order 1, 2, ... of scattering; the last holds
                                                                     all higher orders too
    albedo, albedo_error           (..., 2, C)                       scattered to wi's side and to the other
    unscattered, unscattered_error (..., C)                          passed without an event
    cosines                        (polar + 1,)                      edges of the bins in cos(theta) >= 0, from 0 to 1
    azimuths                       (azimuth + 1,)                    edges of the bins in phi, from 0 to 2 pi
    ============================== ================================= =================================================

    What is missing from 1 was absorbed, or lost to masking. A bin's mean of f |cos| is its energy over its solid angle.
    """

    energy: Array
    energy_error: Array
    orders: Array
    orders_error: Array
    albedo: Array
    albedo_error: Array
    unscattered: Array
    unscattered_error: Array
    cosines: Array
    azimuths: Array


@allow_broadcasting
def goniophotometer(
    stack: Stack,
    wi: ArrayLike,
    *,
    key: Array,
    paths: int = 1 << 17,
    polar: int = 10,
    azimuth: int = 24,
    orders: int = 8,
    facet_multiple_scattering: bool = False,
    batch_size: int = 4096,
) -> Goniogram:
    """Energies that leave a stack, lit along wi.

    Args:
        stack: the layered material.
        wi: unit directions towards the light, shape ``(..., 3)``; below-horizon light falls on the stack from below (on
            an opaque base: nothing comes back).
        key: a JAX random key; the same key gives the same result.
        paths: number of paths for each wi, >= 2.
        polar, azimuth: number of bins, equal in |cos(theta)| and in phi.
        orders: number of orders that are distinguished.
        facet_multiple_scattering: see `RandomWalk`.
        batch_size: number of paths that are under way at a time.

    Raises:
        ValueError: a count is too small, or the stack holds a placeholder.
    """
    if not isinstance(stack, Stack):
        raise ValueError("stack: goniophotometer takes a Stack; of a Mixture take the mean over its parts")
    require_numbers(stack)
    require_single(stack, "goniophotometer")
    require_count("paths", paths, 2)
    for name, value in (("polar", polar), ("azimuth", azimuth), ("orders", orders), ("batch_size", batch_size)):
        require_count(name, value, 1)
    require_choice("facet_multiple_scattering", facet_multiple_scattering, (False, True))
    require_key(key)
    (wi,) = read_directions(wi=wi)
    slim = cast_arrays(simplify(stack), wi.dtype)
    counts = (paths, polar, azimuth, orders, min(batch_size, paths))
    return _measure(slim, wi, channel_count(stack), key, counts, facet_multiple_scattering)


@eqx.filter_jit
def _measure(
    stack: Stack,
    wi: Array,
    channels: int,
    key: Array,
    counts: tuple[int, int, int, int, int],
    facet_multiple_scattering: bool,
) -> Goniogram:
    paths, polar, azimuth, orders, batch_size = counts
    dtype, batch = wi.dtype, wi.shape[:-1]
    scene = Scene(stack, channels, dtype)
    words = key_words(key)
    bins = 2 * polar * azimuth
    quota, record = quotas(paths, batch_size), _recorder(polar, azimuth, orders)

    def one(question: tuple[Array, Array]) -> tuple[Array, Array]:
        index, direction = question
        w = split(direction)
        edge = horizon(dtype)
        valid = w[2] > edge if stack.base is not None else jnp.abs(w[2]) > edge
        w = replace_invalid(w, valid)
        spread = jnp.full(batch_size, w[0]), jnp.full(batch_size, w[1]), jnp.full(batch_size, w[2])
        walk = Walk(scene, spread, None, facet_multiple_scattering, count_orders=True)
        empty = [(jnp.zeros((rows, 2 * channels), dtype),) * 2 for rows in (bins, 2 * (orders + 1))]
        walker = index.astype(jnp.uint32) * jnp.uint32(batch_size) + jnp.arange(batch_size, dtype=jnp.uint32)
        remaining = jnp.where(valid, quota, 0)
        (cells, _), (slots, _) = follow(walk, record, tuple(empty), walker, remaining, words, dtype)
        shaped = cells.reshape(2, polar, azimuth, channels, 2), slots.reshape(2, orders + 1, channels, 2)
        # the side of the light comes first
        near_cells, near_slots = (jnp.where(w[2] > 0, x, x[::-1]) for x in shaped)
        return near_cells, near_slots

    flat = wi.reshape(-1, 3)
    cells, slots = jax.lax.map(one, (jnp.arange(math.prod(batch)), flat))
    cells, slots = cells.reshape(*batch, *cells.shape[1:]), slots.reshape(*batch, *slots.shape[1:])

    def estimate(sums: Array) -> tuple[Array, Array]:
        mean = sums[..., 0] / paths
        return mean, standard_error(mean, sums[..., 1], paths)

    energy, by_order = estimate(cells), estimate(slots[..., 1:, :, :])
    albedo = estimate(slots[..., 1:, :, :].sum(axis=-3))
    ballistic = estimate(slots[..., 0, :, :].sum(axis=-3))
    cosines = jnp.linspace(0.0, 1.0, polar + 1, dtype=dtype)
    azimuths = jnp.linspace(0.0, 2.0 * jnp.pi, azimuth + 1, dtype=dtype)
    return Goniogram(*energy, *by_order, *albedo, *ballistic, cosines, azimuths)


def _recorder(polar: int, azimuth: int, orders: int) -> Record:
    """What adds light that leaves to sums of it and of its square, by direction and by number of events."""
    bins = 2 * polar * azimuth

    def record(result: Any, step: Step, active: Array) -> Any:
        by_direction, by_order = result
        counted = step.escapes & active
        x, y, z = step.direction
        side = (z < 0).astype(jnp.int32)
        ring = jnp.minimum((jnp.abs(z) * polar).astype(jnp.int32), polar - 1)
        turn = jnp.arctan2(y, x) / (2.0 * jnp.pi)
        sector = jnp.minimum((jnp.where(turn < 0, turn + 1.0, turn) * azimuth).astype(jnp.int32), azimuth - 1)
        assert step.order is not None
        order = jnp.minimum(step.order, orders)
        rows = jnp.stack([value for w in step.weight for value in (w, w * w)], axis=-1)
        # what is not counted falls outside, and is dropped; so does light without an event, among the directions
        cell = jnp.where(counted & (order > 0), (side * polar + ring) * azimuth + sector, bins)
        slot = jnp.where(counted, side * (orders + 1) + order, 2 * (orders + 1))

        def counted_in(running: tuple[Array, Array], place: Array) -> tuple[Array, Array]:
            sums, excess = running
            # where there are more places than paths at a time, each is met too seldom for its sum to lose anything
            if sums.shape[0] > active.size:
                return sums.at[place].add(rows, mode="drop"), excess
            return kahan_add(running, jnp.zeros_like(sums).at[place].add(rows, mode="drop"))

        return counted_in(by_direction, cell), counted_in(by_order, slot)

    return record
