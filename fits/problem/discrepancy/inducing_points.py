"""Inducing points of the model discrepancy: places in half and difference angle, chosen among the measurements."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fits.problem.discrepancy.kernel import correlation

Floats = NDArray[np.float64]

SHORTEST, LEAST_SHORTEST = 5.0, 0.05
"""Shortest length scale in degrees that inducing points carry where measurements reach far, and at least."""

REACHES = 16
"""At least across measurements that do not reach far."""

FEWEST_NODES, SOME_NODES, MOST_NODES = 80, 160, 250
"""Inducing points at most: the first with many channels, the last with many measurements."""

A_NODE, MOST_ROWS = 50, 400
"""Measurements that one more inducing point is for; and the most rows of the matrix, points times channels."""

LOST, LONGER = 0.02, 1.25
"""Where the points leave more of the variance at a measurement, the shortest length scale grows by this factor."""

CANDIDATES = 4000
"""Places of measurements that inducing points are chosen from, at most."""

SAME = 6
"""Decimals of a degree in which places are the same."""

TYPICAL = 2.0
"""Measurements are regressed on the points with so many times the shortest length scale."""

TINY, ROUNDING = 1e-9, 1e-10


class InducingPoints(NamedTuple):
    """R places among those of N measurements.

    where: (R, 4), see `places`. weights: (N, R), from inducing points to measurements. shortest: (2,), what errors
    reach at least, in degrees of half vector and difference, so that inducing points carry them.
    """

    where: Floats
    weights: Floats
    shortest: Floats


def inducing_points(wi: ArrayLike, wo: ArrayLike, channels: int = 1) -> InducingPoints:
    """Of measurements along these directions, (N, 3) each: all of their places, where these are few.

    Else those that a pivoted Cholesky decomposition takes first (Fine & Scheinberg 2001): of what errors vary by given
    those at the inducing points before, the place where it is most. The other measurements are regressed on them.
    """
    where = places(wi, wo)
    _, first = np.unique(np.round(where, SAME), axis=0, return_index=True)
    those = where[np.sort(first)]
    those = those[:: -(-len(those) // CANDIDATES)]
    most = min(SOME_NODES + len(where) // A_NODE, MOST_NODES)
    most = max(FEWEST_NODES, min(most, MOST_ROWS // channels))
    spans = np.array([np.ptp(where[:, 0]), max(np.ptp(where[:, 1]), np.ptp(where[:, 2]))])
    shortest = np.clip(spans / REACHES, LEAST_SHORTEST, SHORTEST)
    chosen, lost = _pivots(those, shortest, most)
    while lost > LOST:
        shortest = LONGER * shortest
        chosen, lost = _pivots(those, shortest, most)
    among = those[chosen]
    typical = TYPICAL * shortest
    own = correlation(among, among, *typical) + ROUNDING * np.eye(len(among))
    weights = np.linalg.solve(own, correlation(among, where, *typical)).T
    return InducingPoints(among, weights, shortest)


def _pivots(where: Floats, reach: Floats, most: int) -> tuple[list[int], float]:
    """Indices of so many places (N, 4) at most, as they are chosen; and the most that they leave of the variance."""
    rows, left, chosen = np.zeros((most, len(where))), np.ones(len(where)), list[int]()
    for row in range(min(most, len(where))):
        pivot = int(np.argmax(left))
        if left[pivot] < ROUNDING:
            break
        rest = correlation(where[pivot : pivot + 1], where, *reach)[0] - rows[:row, pivot] @ rows[:row]
        rows[row] = rest / np.sqrt(left[pivot])
        left = np.maximum(left - rows[row] ** 2, 0.0)
        left[pivot] = 0.0
        chosen.append(pivot)
    return chosen, float(np.max(left))


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
