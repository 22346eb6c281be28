"""The best fit of each of many texels: from the likeliest of known starts, and from others where that ended poorly.

A texel is begun again, from other starts, from its neighbours' values and from points all over the bounds, only where
its chi-square says that it ended poorly: a second minimum that fits as well is not looked for.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import stats

from fits.maps.options import MapOptions
from fits.maps.texels import (
    Fits,
    Integers,
    Linearisation,
    Texels,
    Truths,
    fit_texels,
    linearise_at,
    to_units,
)
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]

FIRST = 8
"""Texels of the pilot that are fitted from all starts; the rest of it begins where these ended."""

MOST_PREDICTED = 4
"""Starts that are compared for every texel, where each has directions of its own."""

NEIGHBOUR, RANDOM = -1, -2
"""Where a texel's best fit began, if not at a start of the list."""


@dataclass(frozen=True)
class Starts:
    """Where fits begin.

    vectors, units: K, physical and in the unit box, (K, P). known: the model there, (K, ...); None where every texel
    has directions of its own. random: further points of the unit box, (R, P).
    explained: a reduced chi-square that is not poor, whatever the noise says.
    """

    vectors: Floats
    units: Floats
    known: Linearisation | None
    random: Floats
    explained: float = 0.0


class Results(NamedTuple):
    """What is found of M texels: fits, where each began, and which are poor or were started again, (M,) each."""

    fits: Fits
    start: Integers
    poor: Truths
    restarted: Truths


def starts_at(
    problem: Problem, vectors: Floats, random: Floats, own: bool, size: int, explained: float = 0.0
) -> Starts:
    """The starts at these vectors (K, P); own: texels have directions of their own; size: of the program."""
    vectors = vectors[:MOST_PREDICTED] if own else vectors
    units = to_units(problem, vectors)
    known = None if own else linearise_at(problem, units, size)
    return Starts(vectors, units, known, random, explained)


def fit_first(problem: Problem, points: Floats, pilot: Texels, size: int) -> Fits:
    """The lowest fits of a few of the pilot texels, from all of the points (starts, P) of the unit box."""
    rows = pilot.rows(np.unique(np.linspace(0, pilot.number - 1, min(FIRST, pilot.number)).astype(int)))
    best, *others = (fit_texels(problem, np.tile(point, (rows.number, 1)), rows, size) for point in points)
    for found in others:
        better = np.flatnonzero(best.better(found, slice(None)))
        best.put(better, found.rows(better))
    return best


def search(
    problem: Problem, starts: Starts, texels: Texels, size: int, options: MapOptions, beside: Integers | None = None
) -> Results:
    """Fit each texel.

    Args:
        size: of the program: texels at a time.
        beside: the neighbours of each, (M, ...), by their places; -1 where there is none.
    """
    order = likeliest(problem, starts, texels, size, options.restarts + 1)
    start, restarted = order[:, 0].copy(), np.zeros(texels.number, bool)
    which = None if starts.known is None else start.copy()
    found = fit_texels(problem, starts.units[start], texels, size, known=starts.known, which=which, fresh=False)
    limit = explained_chi_square(problem, starts, texels, options)

    def poor() -> Truths:
        """Which fits are worse than noise and pilot explain, or have not converged."""
        return ~((reduced_chi_square(found, texels) <= limit) & found.converged)

    def again(rows: Integers, units: Floats, begun: Integers) -> None:
        if not len(rows):
            return
        restarted[rows] = True
        other = fit_texels(problem, units, texels.rows(rows), size)
        improved = found.better(other, rows)
        found.put(rows[improved], other.rows(improved))
        start[rows[improved]] = begun[improved]

    for place in range(1, order.shape[1]):
        rows = np.flatnonzero(poor())
        again(rows, starts.units[order[rows, place]], order[rows, place])
    for _ in range(options.restarts if beside is not None else 0):
        rows, vectors = _neighbours_of_poor(found, poor(), beside)
        again(rows, to_units(problem, vectors), np.full(len(rows), NEIGHBOUR))
    for point in starts.random:
        rows = np.flatnonzero(poor())
        again(rows, np.tile(point, (len(rows), 1)), np.full(len(rows), RANDOM))
    return Results(found, start, poor() & found.converged, restarted)


def reduced_chi_square(found: Fits, texels: Texels) -> Floats:
    """Chi-square over degrees of freedom, (M,)."""
    return np.asarray(found.chi_square) / _freedom(texels, found.vector.shape[1])


def _freedom(texels: Texels, parameters: int) -> Floats:
    return np.maximum(texels.measurements - parameters, 1).astype(float)


def explained_chi_square(problem: Problem, starts: Starts, texels: Texels, options: MapOptions) -> Floats:
    """The reduced chi-square that noise and the pilot explain, (M,)."""
    limit = np.full(texels.number, starts.explained)
    if problem.objective == "likelihood" and problem.noise.tails == "gaussian":
        freedom, where = np.unique(_freedom(texels, len(problem.names)), return_inverse=True)
        limit = np.maximum(limit, (stats.chi2.isf(options.poor_probability, freedom) / freedom)[where])
    elif not starts.explained:
        limit[:] = np.inf
    return limit


def _neighbours_of_poor(found: Fits, poor: Truths, beside: Integers | None) -> tuple[Integers, Floats]:
    """Poor texels that have a neighbour which is not, and where the best of those ended."""
    assert beside is not None
    good = np.append(~poor, False)  # the place -1 is none
    cost = np.append(np.asarray(found.cost), np.inf)
    rows = np.flatnonzero(poor & np.any(good[beside], axis=1))
    choice = np.argmin(np.where(good[beside[rows]], cost[beside[rows]], np.inf), axis=1)
    return rows, found.vector[beside[rows, choice]]


def likeliest(problem: Problem, starts: Starts, texels: Texels, size: int, most: int) -> Integers:
    """The starts that suit each texel best, (M, at most `most`), best first."""
    if starts.known is None:  # the cost of each along the texel's own directions
        units = (np.tile(unit, (texels.number, 1)) for unit in starts.units)
        costs = [fit_texels(problem, unit, texels, size, fresh=False, most_steps=1).cost for unit in units]
        misfit = np.stack(costs, axis=1)
    else:
        misfit = _misfit(problem, starts, texels)
    return np.argsort(misfit, axis=1, kind="stable")[:, :most]


def _misfit(problem: Problem, starts: Starts, texels: Texels) -> Floats:
    """Minus twice the log-likelihood of known starts with noise as the problem's own values have it, as matrix
    products, (M, K)."""
    assert starts.known is not None
    predicted = np.asarray(starts.known.values, float)
    sigma = np.asarray(sigmas(problem, starts.vectors, predicted))
    with np.errstate(all="ignore"):
        parts = (
            (np.square(texels.values), sigma**-2.0),
            (texels.values, -2.0 * predicted / sigma**2),
            (texels.used, (predicted / sigma) ** 2 + 2.0 * np.log(sigma)),
        )
        squares = sum(
            measured.reshape(texels.number, -1).astype(float) @ of.reshape(len(of), -1).T for measured, of in parts
        )
    return np.nan_to_num(squares, nan=np.inf, posinf=np.inf)


def sigmas(problem: Problem, vectors: Floats, predicted: Floats) -> Floats:
    """Standard deviations of the data with vectors (K, P) that predict these values, (K, N, C), in 1/sr."""
    return np.asarray(problem.call(_sigmas, vectors, predicted), float)


def _sigmas(model: Model, vectors: Array, predicted: Array) -> Array:
    return jax.vmap(model.sigma_at)(vectors, predicted)


def neighbours(shape: tuple[int, ...]) -> Integers:
    """The places of those beside each texel of a block of this shape, (M, 2 rank); -1 beyond its edge."""
    places = np.pad(np.arange(int(np.prod(shape))).reshape(shape), 1, constant_values=-1)
    inner = tuple(slice(1, -1) for _ in shape)
    moved = [np.roll(places, step, axis)[inner] for axis in range(len(shape)) for step in (1, -1)]
    return np.stack([one.reshape(-1) for one in moved], axis=1)
