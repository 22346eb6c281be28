"""Where a process of model errors lives: angles of half vector and difference, and a grid of nodes over them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

STEP, LEAST_STEP = 10.0, 0.1
"""Of the grid of nodes, in degrees, where readings reach far, and at least."""

STEPS = 8
"""At least across readings that do not reach far."""

MOST_NODES, COARSER = 300, 1.25
"""Where there would be more, the grid is made so much coarser until there are not."""

TINY, FLAT = 1e-9, 1e-6


class Grid(NamedTuple):
    """Nodes are pairs of one of H in the half vector's angle and one of D in that of the difference.

    half: (H,), in degrees. difference: (D, 3), along and across in degrees, and the side. half_weights,
    difference_weights: (N, H) and (N, D), of a cubic from nodes to readings, to be multiplied. steps: (2,), in degrees.
    """

    half: Floats
    difference: Floats
    half_weights: Floats
    difference_weights: Floats
    steps: Floats


def grid(wi: ArrayLike, wo: ArrayLike) -> Grid:
    """Of readings along these directions, (N, 3) each."""
    where = places(wi, wo)
    spans = np.array([np.ptp(where[:, 0]), max(np.ptp(where[:, 1]), np.ptp(where[:, 2]))])
    steps = np.clip(spans / STEPS, LEAST_STEP, STEP)
    while True:
        half_weights, half = _touched(where[:, :1], steps[:1])
        difference_weights, difference = _touched(where[:, 1:], np.array([steps[1], steps[1], 0.0]))
        if len(half) * len(difference) <= MOST_NODES:
            return Grid(half[:, 0], difference, half_weights, difference_weights, steps)
        steps = COARSER * steps


def places(wi: ArrayLike, wo: ArrayLike) -> Floats:
    """Where pairs of directions (N, 3) lie, (N, 4), in degrees: angle of half vector and normal, that of light and
    viewer to it along the plane of both and across; and the side: 0 and 1 reflection above and below, 2 through.
    """
    wi, wo = np.asarray(wi, float), np.asarray(wo, float)
    side = np.where(wi[:, 2] * wo[:, 2] <= 0.0, 2.0, np.where(wi[:, 2] > 0.0, 0.0, 1.0))
    upright = np.array([1.0, 1.0, 0.0])
    first, second = (w * upright + np.abs(w) * (1.0 - upright) for w in (wi, wo))
    half = first + second
    length = np.linalg.norm(half, axis=-1, keepdims=True)
    half = np.where(length > TINY, half / np.maximum(length, TINY), [0.0, 0.0, 1.0])
    tilt = np.degrees(np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2]))
    apart = np.degrees(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(first - second, axis=-1), 0.0, 1.0))) / 2.0
    normal = np.array([0.0, 0.0, 1.0]) - half[:, 2:] * half  # in the plane of normal and half vector
    parts = [np.abs(np.sum(axis * (first - second), axis=-1)) for axis in (normal, np.cross(half, normal))]
    size = np.hypot(*parts)
    along, across = (
        np.where(size > TINY, part / np.maximum(size, TINY), one) for part, one in zip(parts, (1.0, 0.0), strict=True)
    )
    return np.stack([tilt, apart * along, apart * across, side], axis=-1)


def _touched(where: Floats, steps: Floats) -> tuple[Floats, Floats]:
    """Weights (N, R) from the nodes that readings (N, K) touch, and these, (R, K); a step of 0: labels, no angles."""
    entries: dict[tuple[int, ...], int] = {}
    rows, columns, values = [], [], []
    flat = (np.ptp(where, axis=0) < FLAT) | (steps == 0.0)
    scaled = np.where(flat, 0.0, where / np.where(flat, 1.0, steps))
    first = np.floor(scaled).astype(int)
    for offsets in np.ndindex(*(1 if level else 4 for level in flat)):
        offset = np.where(flat, 0, np.array(offsets) - 1)
        weight = np.prod(np.where(flat, 1.0, _cubic(scaled - first - offset)), axis=-1)
        for row in np.flatnonzero(weight):
            label = np.where(steps == 0.0, where[row], first[row] + offset)
            rows.append(int(row))
            columns.append(entries.setdefault(tuple(label.astype(int).tolist()), len(entries)))
            values.append(float(weight[row]))
    weights = np.zeros((len(where), len(entries)))
    np.add.at(weights, (rows, columns), values)
    keys = np.array(list(entries), float).reshape(len(entries), -1)
    return weights, np.where(flat & (steps != 0.0), where[0], keys * np.where(steps == 0.0, 1.0, steps))


def _cubic(x: Floats) -> Floats:
    """Cubic convolution (Keys 1981): what a node counts at a distance of x steps."""
    x = np.abs(x)
    near = 1.5 * x**3 - 2.5 * x**2 + 1.0
    far = -0.5 * x**3 + 2.5 * x**2 - 4.0 * x + 2.0
    return np.where(x < 1.0, near, np.where(x < 2.0, far, 0.0))
