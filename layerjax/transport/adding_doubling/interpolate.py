"""Tables of evenly spaced entries, cubic between them, along any number of axes.

A look reads 4 entries an axis, 64 or 256 of each table. What XLA makes of it decides: entries are read one by one off a
flat table, 16 a step of a loop, whose weights are worked out in the step; arrays of weights take longer to load than to
compute.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax.channels import Channels

AXES_PER_STEP = 2
"""Axes whose entries a step of the loop reads. All three in one step are a little faster by themselves, but XLA then
does them again for each that uses the value, and a gradient takes five times as long.
"""


class Axis(NamedTuple):
    """Where looks lie along an axis. first: of four entries; place: from there, in [0, 3].

    stride: from one entry to the next in the flat table; period: entries after which they repeat, None if they do not.
    """

    first: Array
    place: Array
    stride: int
    period: int | None = None

    def offset(self, k: int | Array) -> Array:
        """Place of the k-th entry in the flat table."""
        entry = self.first + k
        return self.stride * (entry if self.period is None else entry % self.period)


def cubic(place: Array) -> tuple[Array, Array, Array, Array]:
    """Weights of values at 0, 1, 2, 3 in the cubic through them."""
    a, b, c, d = place, place - 1.0, place - 2.0, place - 3.0
    return b * c * d * (-1 / 6), a * c * d * 0.5, a * b * d * -0.5, a * b * c * (1 / 6)


def look_up(tables: Sequence[Array], start: Array, axes: Sequence[Axis]) -> Channels:
    """Values of tables that share their shape; start: added to the place in the flat table."""
    flat = [table.reshape(-1) for table in tables]
    outer, inner = axes[:-AXES_PER_STEP], axes[-AXES_PER_STEP:]
    shape = jnp.broadcast_shapes(start.shape, *(axis.place.shape for axis in axes))
    zero = jnp.zeros(shape, axes[0].place.dtype)

    def step(sums: Channels, which: Array) -> tuple[Channels, None]:
        place, weight = start, jnp.ones((), zero.dtype)
        for axis, k in zip(outer, which, strict=True):
            place = place + axis.offset(k)
            *others, last = cubic(axis.place)
            weight = weight * jnp.select([k == each for each in range(3)], others, last)
        found = (_sum_taps(entries, place, inner) for entries in flat)
        return tuple(total + weight * more for total, more in zip(sums, found, strict=True)), None

    every = np.asarray(list(itertools.product(range(4), repeat=len(outer))), np.int32)
    if not outer:
        return step((zero,) * len(flat), jnp.asarray(every[0]))[0]
    return jax.lax.scan(step, (zero,) * len(flat), jnp.asarray(every))[0]


def _sum_taps(entries: Array, place: Array, axes: Sequence[Axis]) -> Array:
    """Sum of the entries at a place and the offsets of all axes, times their weights."""
    if not axes:
        return entries.at[place].get(mode="promise_in_bounds")
    axis, *rest = axes
    parts = [w * _sum_taps(entries, place + axis.offset(k), rest) for k, w in enumerate(cubic(axis.place))]
    return (parts[0] + parts[1]) + (parts[2] + parts[3])
