"""Uniform cubic splines in a few variables: smooth tables that are cheap to read at every texel, and to differentiate.

A table is read tap by tap from a flat array, which XLA does fast on a CPU (rows of several numbers take four times as
long), and its partial derivatives come in the same pass: nothing is differentiated through the look-up. Values have
continuous second derivatives.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import at_least, at_most


def design(places: np.ndarray, count: int) -> np.ndarray:
    """Values of the splines at places in [0, 1], (places, count)."""
    first, weights, _ = taps(jnp.asarray(places), count)
    matrix = np.zeros((places.size, count))
    columns = np.asarray(first)[:, None] + np.arange(4)
    np.add.at(matrix, (np.arange(places.size)[:, None], columns), np.asarray(jnp.stack(weights, axis=-1)))
    return matrix


def fitted(values: np.ndarray, counts: Sequence[int]) -> np.ndarray:
    """Coefficients (counts) of the splines that come nearest to values on a grid, uniform on [0, 1] along each axis."""
    for axis, count in enumerate(counts):
        inverse = np.linalg.pinv(design(np.linspace(0.0, 1.0, values.shape[axis]), count))
        values = np.moveaxis(np.tensordot(inverse, values, (1, axis)), 0, axis)
    return values


def taps(place: Array, count: Array | int) -> tuple[Array, tuple[Array, ...], tuple[Array, ...]]:
    """First of the four coefficients that count at a place in [0, 1], their weights, and the slopes of these."""
    intervals = jnp.asarray(count - 3, place.dtype)
    x = at_most(at_least(place, 0.0), 1.0) * intervals
    first = at_most(jnp.floor(x), intervals - 1.0)
    f = x - first
    g = 1.0 - f
    weights = (g * g * g, 4.0 - 3.0 * f * f * (1.0 + g), 4.0 - 3.0 * g * g * (1.0 + f), f * f * f)
    slopes = (-3.0 * g * g, f * (9.0 * f - 12.0), g * (12.0 - 9.0 * g), 3.0 * f * f)
    sixth = intervals / 6.0
    return first.astype(jnp.int32), tuple(w / 6.0 for w in weights), tuple(s * sixth for s in slopes)


def read(
    flat: np.ndarray | Array,
    start: Array | int,
    counts: Sequence[Array | int],
    places: Sequence[Array],
    columns: int = 1,
    apart: int = 0,
) -> list[Array]:
    """Splines at places along each of their axes, all of one shape: a value for each column.

    Args:
        flat: coefficients of one table or several.
        start: where the first table begins in it.
        counts: coefficients along each axis. Both may differ from place to place.
        places: in [0, 1]; what lies outside counts as the end.
        columns: tables that are read at the same places, so many coefficients `apart`.
    """
    dtype = places[0].dtype
    sizes = [jnp.asarray(count, jnp.int32) for count in counts]
    reader = _reader(len(places), columns, apart)
    return list(reader(jnp.asarray(flat, dtype), jnp.asarray(start, jnp.int32), *sizes, *places))


@functools.cache
def _reader(axes: int, columns: int, apart: int) -> Callable[..., tuple[Array, ...]]:
    @jax.custom_jvp
    def value(flat: Array, start: Array, *rest: Array) -> tuple[Array, ...]:
        found = _summed(flat, start, rest[:axes], rest[axes:], columns, apart, sloped=False)
        return tuple(column[0] for column in found)

    @value.defjvp
    def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        flat, start, *rest = primals
        found = _summed(flat, start, rest[:axes], rest[axes:], columns, apart, sloped=True)
        changes = tuple(_dot(column[1:], tangents[2 + axes :]) for column in found)
        return tuple(column[0] for column in found), changes

    return value


def _summed(
    flat: Array,
    start: Array,
    counts: Sequence[Array],
    places: Sequence[Array],
    columns: int,
    apart: int,
    sloped: bool,
) -> list[list[Array]]:
    """Of each column the value, and (if `sloped`) its derivative along each axis, summed from the last axis on."""
    found = [taps(place, count) for place, count in zip(places, counts, strict=True)]
    strides = [jnp.ones_like(counts[0])]
    for count in reversed(counts[1:]):
        strides.insert(0, strides[0] * count)
    base = start + sum(first * stride for (first, _, _), stride in zip(found, strides, strict=True))

    def along(axis: int, place: Array) -> list[Array]:
        """Sums over this axis and those behind it: the value, then its derivative along each of these."""
        if axis == len(found):
            return [flat.at[place].get(mode="promise_in_bounds")]
        _, weights, slopes = found[axis]
        inner = [along(axis + 1, place + k * strides[axis]) for k in range(4)]
        total = [_dot(weights, part) for part in zip(*inner, strict=True)]
        return [total[0], _dot(slopes, [part[0] for part in inner]), *total[1:]] if sloped else total

    _, weights, slopes = (jnp.stack(part) if isinstance(part, tuple) else part for part in found[0])

    def step(k: Array, sums: list[list[Array]]) -> list[list[Array]]:
        after = []
        for column, total in enumerate(sums):
            inner = along(1, base + k * strides[0] + column * apart)
            added = [weights[k] * part for part in inner]
            if sloped:
                added.insert(1, slopes[k] * inner[0])
            after.append([before + more for before, more in zip(total, added, strict=True)])
        return after

    # the first axis in a loop: else XLA copies the whole look-up into every use of it
    zero = jnp.zeros(jnp.broadcast_shapes(*(p.shape for p in places)), places[0].dtype)
    begin = [[zero] * (1 + len(found) if sloped else 1) for _ in range(columns)]
    return jax.lax.fori_loop(0, 4, step, begin)


def _dot(weights: Sequence[Array], values: Sequence[Array]) -> Array:
    return sum((w * v for w, v in zip(weights[1:], values[1:], strict=True)), weights[0] * values[0])
