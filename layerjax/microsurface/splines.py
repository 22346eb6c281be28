"""Uniform cubic splines in a few variables: smooth tables that are cheap to read at every texel, and to differentiate.

A table is read tap by tap from a flat array, which XLA does fast on a CPU (rows of several numbers take four times as
long), in a loop that is compiled for four taps alone, and its partial derivatives come in the same pass: nothing is
differentiated through the look-up. Values have continuous second derivatives.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import allow_broadcasting, clamp_max, clamp_min, horner, unstack

BASIS = np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]) / 6.0
"""Weights of the four coefficients that count at a place: of each the polynomial in how far it is beyond the first."""

SLOPES = BASIS[:, 1:] * np.arange(1, 4)
"""The same of their derivatives."""


def design(places: np.ndarray, count: int) -> np.ndarray:
    """Values of the splines at places in [0, 1], (places, count)."""
    first, offset, _ = taps(jnp.asarray(places), count)
    matrix = np.zeros((places.size, count))
    columns = np.asarray(first)[:, None] + np.arange(4)
    np.add.at(matrix, (np.arange(places.size)[:, None], columns), np.asarray(jnp.stack(weights(offset), axis=-1)))
    return matrix


def fit_splines(values: np.ndarray, counts: Sequence[int]) -> np.ndarray:
    """Coefficients (counts) of the splines that come nearest to values on a grid, uniform on [0, 1] along each axis."""
    for axis, count in enumerate(counts):
        inverse = np.linalg.pinv(design(np.linspace(0.0, 1.0, values.shape[axis]), count))
        values = np.moveaxis(np.tensordot(inverse, values, (1, axis)), 0, axis)
    return values


def taps(place: Array, count: Array | int) -> tuple[Array, Array, Array]:
    """The first of the four coefficients that count at a place in [0, 1], how far the place is after it, and the steps.

    The distance is in steps, so many of which the axis has.
    """
    steps = jnp.asarray(count - 3, place.dtype)
    x = clamp_max(clamp_min(place, 0.0), 1.0) * steps
    first = clamp_max(jnp.floor(x), steps - 1.0)
    return first.astype(jnp.int32), x - first, steps


def weights(offset: Array) -> list[Array]:
    """Weights of the four coefficients at a place, by its distance from the first of them."""
    return [horner(powers, offset) for powers in BASIS.tolist()]


def read(
    flat: np.ndarray | Array,
    start: Array | int,
    counts: Sequence[Array | int],
    places: Sequence[Array],
    columns: int = 1,
    column_stride: int = 0,
) -> list[Array]:
    """Splines at places along each of their axes, all of one shape: a value for each column.

    Args:
        flat: coefficients of one table or several.
        start: where the first table begins in it.
        counts: coefficients along each axis. Both may differ from place to place.
        places: in [0, 1]; what lies outside counts as the end.
        columns: tables that are read at the same places, with a `column_stride` of so many coefficients.
    """
    dtype = places[0].dtype
    sizes = [jnp.asarray(count, jnp.int32) for count in counts]
    reader = _reader(len(places), columns, column_stride)
    found = reader(jnp.asarray(flat, dtype), jnp.asarray(start, jnp.int32), *sizes, *places)
    return unstack(found) if columns > 1 else [found]


@functools.cache
def _reader(axes: int, columns: int, column_stride: int) -> Callable[..., Array]:
    @jax.custom_jvp
    def value(flat: Array, start: Array, *rest: Array) -> Array:
        return _sum_taps(flat, start, rest[:axes], rest[axes:], columns, column_stride, sloped=False)[0]

    @value.defjvp
    @allow_broadcasting
    def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
        flat, start, *rest = primals
        found, *slopes = _sum_taps(flat, start, rest[:axes], rest[axes:], columns, column_stride, sloped=True)
        return found, _dot(slopes, tangents[2 + axes :])

    return value


def _sum_taps(
    flat: Array,
    start: Array,
    counts: Sequence[Array],
    places: Sequence[Array],
    columns: int,
    column_stride: int,
    sloped: bool,
) -> list[Array]:
    """Values, (columns, ...) if there are several, and (if `sloped`) their derivatives along each axis."""
    found = [taps(place, count) for place, count in zip(places, counts, strict=True)]
    strides = [jnp.ones_like(counts[0])]
    for count in reversed(counts[1:]):
        strides.insert(0, strides[0] * count)
    corner = start + sum(first * stride for (first, _, _), stride in zip(found, strides, strict=True))
    corner = jnp.broadcast_to(corner, jnp.broadcast_shapes(*(place.shape for place in places)))
    if columns > 1:
        corner = corner + column_stride * jnp.arange(columns, dtype=corner.dtype).reshape(-1, *(1,) * corner.ndim)
    *outer, last = (offset for _, offset, _ in found)

    def step(sums: list[Array], along_axes: tuple[Array, ...]) -> tuple[list[Array], None]:
        tap, basis, sloping = along_axes
        place = corner + sum(tap[axis] * strides[axis] for axis in range(len(outer)))
        row = [flat.at[place + k].get(mode="promise_in_bounds", wrap_negative_indices=False) for k in range(4)]
        along = _dot(weights(last), row)
        weight = [horner(basis[axis], offset) for axis, offset in enumerate(outer)]
        added = [math.prod(weight) * along]
        if sloped:
            for axis, offset in enumerate(outer):
                slope = horner(sloping[axis], offset)
                added.append(math.prod([slope, *weight[:axis], *weight[axis + 1 :]]) * along)
            slopes = [horner(powers, last) for powers in SLOPES.tolist()]
            added.append(math.prod(weight) * _dot(slopes, row))
        return [before + more for before, more in zip(sums, added, strict=True)], None

    # all axes but the last in a loop: else XLA copies the whole look-up into every use of it
    taken = np.array([*itertools.product(range(4), repeat=len(outer))], int).reshape(4 ** len(outer), len(outer))
    powers = [jnp.asarray(table[taken], last.dtype) for table in (BASIS, SLOPES)]
    zero = jnp.zeros_like(corner, last.dtype)
    sums = [zero] * (1 + len(found) if sloped else 1)
    value, *slopes = jax.lax.scan(step, sums, (jnp.asarray(taken, jnp.int32), *powers))[0]
    return [value, *(slope * steps for slope, (_, _, steps) in zip(slopes, found, strict=False))]


def _dot(weights: Sequence[Array], values: Sequence[Array]) -> Array:
    return sum((w * v for w, v in zip(weights[1:], values[1:], strict=True)), weights[0] * values[0])
