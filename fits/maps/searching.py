"""The best fit of each of many texels: from the likeliest of known starts, and from others where that ended poorly."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import stats

from fits.maps.descending import Known, first_mapped
from fits.maps.solving import Found, all_known, by_size, nearest, padded, solve, solve_near
from fits.maps.texels import Texels, blank, model_of
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

OTHERS = 3
"""Further starts, and neighbours, that a texel which ended poorly is tried from."""

MOST_PREDICTED = 8
"""Starts whose values are computed for every texel, where each has directions of its own."""

CHANCE = 1e-6
"""A chi-square that noise exceeds less often is poor, unless those of the sample are as large."""

NEIGHBOUR, RANDOM = -1, -2
"""Where a texel's best end began, if not at a start of the list."""


@dataclass(frozen=True)
class Starts:
    """Where fits begin.

    vectors, units: K, physical and in the unit box, (K, P). known: what the model says there, (K, ...); None where
    every texel has directions of its own. random: further points of the unit box, (R, P).
    expected: a reduced chi-square that is not poor, whatever the noise says.
    """

    vectors: Floats
    units: Floats
    known: Known | None
    random: Floats
    expected: float = 0.0

    @property
    def predicted(self) -> Floats | None:
        """What they predict, (K, N, C), in 1/sr."""
        return None if self.known is None else self.known.values


class Ends(NamedTuple):
    """What is found of M texels: fits, where each began, and which are poor or were begun again, (M,) each."""

    found: Found
    start: Integers
    poor: NDArray[np.bool_]
    restarted: NDArray[np.bool_]


def starts_at(problem: Problem, vectors: Floats, random: Floats, own: bool, size: int, expected: float = 0.0) -> Starts:
    """The starts at these vectors (K, P); own: texels have directions of their own; size: of the program."""
    if own:
        vectors = vectors[:MOST_PREDICTED]
    units = np.asarray(jax.vmap(problem.model.box.to_unit)(jnp.asarray(vectors)), float)
    units = np.clip(units, 0.0, 1.0)
    if own:
        return Starts(vectors, units, None, random, expected)
    known = all_known(problem, units, blank(problem.model.values.shape), size)
    return Starts(vectors, units, known, random, expected)


def search(problem: Problem, starts: Starts, texels: Texels, size: int, beside: Integers | None = None) -> Ends:
    """Fit each texel.

    Args:
        size: of the program: texels at a time.
        beside: the neighbours of each, (M, ...), by their places; -1 where there is none.
    """
    order = _likeliest(problem, starts, texels, size)
    if starts.known is None:
        found = solve(problem, starts.units[order[:, 0]], texels, size, fresh=False)
    else:
        found = solve_near(problem, starts.units, starts.known, order[:, 0], texels, size)
    start = order[:, 0].copy()
    restarted = np.zeros(texels.number, bool)

    limit = _limit(problem, starts, texels)

    def again(rows: Integers, units: Floats, begun: Integers) -> None:
        if not len(rows):
            return
        restarted[rows] = True
        other = solve(problem, units, texels.rows(rows), size)
        improved = found.better(other, rows)
        found.put(rows[improved], other.rows(improved))
        start[rows[improved]] = begun[improved]

    for place in range(1, min(OTHERS, order.shape[1] - 1) + 1):
        rows = np.flatnonzero(_poor(found, texels, limit))
        again(rows, starts.units[order[rows, place]], order[rows, place])
    for _ in range(OTHERS if beside is not None else 0):
        rows, units = _beside(problem, found, _poor(found, texels, limit), beside)
        again(rows, units, np.full(len(rows), NEIGHBOUR))
    for point in starts.random:
        rows = np.flatnonzero(_poor(found, texels, limit))
        again(rows, np.broadcast_to(point, (len(rows), point.size)), np.full(len(rows), RANDOM))
    return Ends(found, start, _poor(found, texels, limit) & found.converged, restarted)


def reduced_chi_square(found: Found, texels: Texels) -> Floats:
    """Chi-square over degrees of freedom, (M,)."""
    return np.asarray(found.chi_square) / _freedom(texels, found.vector.shape[1])


def _freedom(texels: Texels, parameters: int) -> Floats:
    return np.maximum(texels.readings - parameters, 1).astype(float)


def _limit(problem: Problem, starts: Starts, texels: Texels) -> Floats:
    """The reduced chi-square that noise and the sample explain, (M,)."""
    limit = np.full(texels.number, starts.expected)
    if problem.objective == "likelihood" and problem.noise.tails == "gaussian":
        freedom, where = np.unique(_freedom(texels, len(problem.names)), return_inverse=True)
        limit = np.maximum(limit, (stats.chi2.isf(CHANCE, freedom) / freedom)[where])
    elif not starts.expected:
        limit[:] = np.inf
    return limit


def _poor(found: Found, texels: Texels, limit: Floats) -> NDArray[np.bool_]:
    """Whether a fit is worse than that, or has not converged."""
    return ~((reduced_chi_square(found, texels) <= limit) & found.converged)


def _beside(
    problem: Problem, found: Found, poor: NDArray[np.bool_], beside: Integers | None
) -> tuple[Integers, Floats]:
    """Poor texels that have a neighbour which is not, and where the best of those ended."""
    assert beside is not None
    good = np.append(~poor, False)  # the place -1 is none
    cost = np.append(np.asarray(found.cost), np.inf)
    rows = np.flatnonzero(poor & np.any(good[beside], axis=1))
    choice = np.argmin(np.where(good[beside[rows]], cost[beside[rows]], np.inf), axis=1)
    vectors = found.vector[beside[rows, choice]]
    if not len(rows):
        return rows, vectors
    units = np.asarray(jax.vmap(problem.model.box.to_unit)(jnp.asarray(padded(vectors))), float)[: len(rows)]
    return rows, np.clip(units, 0.0, 1.0)


def _likeliest(problem: Problem, starts: Starts, texels: Texels, size: int) -> Integers:
    """Starts in the order in which they suit each texel, (M, ...)."""
    if starts.predicted is not None:
        return nearest(problem, starts.vectors, starts.predicted, texels, OTHERS + 1, size)
    costs = by_size(
        lambda rows, count: problem.call(_costs, starts.vectors, texels.rows(rows), np.asarray(count)),
        texels.number,
        size,
    )
    return np.argsort(costs, axis=1)[:, : OTHERS + 1]


def all_predicted(problem: Problem, vectors: Floats) -> Floats:
    """What vectors (K, P) predict, (K, N, C), in 1/sr."""
    return np.asarray(problem.call(_all_predicted, vectors), float)


def _all_predicted(model: Model, vectors: Array) -> Array:
    return jax.lax.map(model.predict, vectors)


def _costs(model: Model, vectors: Array, texels: Texels, number: Array) -> Array:
    """Of every vector (K, P) for the first `number` of the texels, each along its own directions: (M, K)."""

    def one(row: Texels) -> Array:
        own = model_of(model, row)
        return jax.lax.map(lambda vector: own.cost_at(vector, own.predict(vector)), vectors)

    return first_mapped(one, texels, number)


def neighbours(shape: tuple[int, ...]) -> Integers:
    """The places of those beside each texel of a block of this shape, (M, 2 rank); -1 beyond its edge."""
    places = np.arange(int(np.prod(shape))).reshape(shape)
    columns = []
    for axis in range(len(shape)):
        for step in (1, -1):
            moved = np.roll(places, step, axis)
            edge = [slice(None)] * len(shape)
            edge[axis] = slice(0, 1) if step == 1 else slice(-1, None)
            moved[tuple(edge)] = -1
            columns.append(moved.reshape(-1))
    return np.stack(columns, axis=1)
