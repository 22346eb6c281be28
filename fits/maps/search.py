"""The best fit of each of many texels: from the likeliest of known starts, and from others where that fit is poor.

A texel is fitted again, from other starts, only where its chi-square says that it ended poorly: a second minimum that
fits as well is not looked for.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jax import Array
from scipy import stats

from fits.data.geometry import Booleans, Floats, Integers
from fits.maps.options import MapOptions
from fits.maps.texels import Fits, Linearisation, Texels, fit_texels, linearise_at, to_units
from fits.problem.model import Model
from fits.problem.problem import Problem

FIRST = 8  # texels of the pilot that are fitted from all starts; the rest of it begins where these ended

MOST_PREDICTED = 4  # starts that are compared for every texel, where each has directions of its own


@dataclass(frozen=True)
class Starts:
    """Where fits begin.

    vectors, units: K, physical and in the unit box, (K, P). known: the model there, (K, ...); None where every texel
    has directions of its own. explained: a reduced chi-square that is not poor, whatever the noise says.
    """

    vectors: Floats
    units: Floats
    known: Linearisation | None
    explained: float = 0.0


def starts_at(problem: Problem, vectors: Floats, own_directions: bool, size: int, explained: float = 0.0) -> Starts:
    """The starts at these vectors (K, P); own_directions: of each texel; size: of the program."""
    vectors = vectors[:MOST_PREDICTED] if own_directions else vectors
    units = to_units(problem, vectors)
    return Starts(vectors, units, None if own_directions else linearise_at(problem, units, size), explained)


def fit_first(problem: Problem, points: Floats, pilot: Texels, size: int) -> Fits:
    """The lowest fits of a few of the pilot texels, from all of the points (starts, P) of the unit box."""
    rows = pilot.rows(np.unique(np.linspace(0, pilot.number - 1, min(FIRST, pilot.number)).astype(int)))
    best, *others = (fit_texels(problem, np.tile(point, (rows.number, 1)), rows, size) for point in points)
    for other in others:
        best.improve(np.arange(rows.number), other)
    return best


def fit_pilot_texels(problem: Problem, points: Floats, texels: Texels, options: MapOptions) -> Fits:
    """The best fits of a pilot: of a few texels from all of the points, of the others from where these ended."""
    first = fit_first(problem, points, texels, options.chunk_size)
    starts = starts_at(problem, first.distinct(), texels.wi is not None, options.chunk_size)
    return search(problem, starts, texels, options)[0]


def search(problem: Problem, starts: Starts, texels: Texels, options: MapOptions) -> tuple[Fits, Booleans, Booleans]:
    """The fits of M texels, and which of them are poor or were fitted again, (M,) each."""
    size = options.chunk_size
    order = likeliest(problem, starts, texels, size, options.restarts + 1)
    which = None if starts.known is None else order[:, 0]
    best = fit_texels(problem, starts.units[order[:, 0]], texels, size, known=starts.known, which=which, fresh=False)
    restarted = np.zeros(texels.number, bool)

    # the reduced chi-square that noise and the pilot explain
    limit = np.full(texels.number, starts.explained or np.inf)
    if problem.objective == "likelihood" and problem.noise.tails == "gaussian":
        freedom = np.maximum(texels.measurements - len(problem.names), 1)
        limit = np.maximum(starts.explained, stats.chi2.isf(options.poor_probability, freedom) / freedom)

    def poor() -> Booleans:
        """Which fits are worse than noise and pilot explain, or have not converged."""
        return ~((reduced_chi_square(best, texels) <= limit) & best.converged)

    for place in range(1, order.shape[1]):
        if len(rows := np.flatnonzero(poor())):
            restarted[rows] = True
            best.improve(rows, fit_texels(problem, starts.units[order[rows, place]], texels.rows(rows), size))
    return best, poor() & best.converged, restarted


def reduced_chi_square(fits: Fits, texels: Texels) -> Floats:
    """Chi-square over degrees of freedom, (M,)."""
    return np.asarray(fits.chi_square) / np.maximum(texels.measurements - fits.vector.shape[1], 1)


def likeliest(problem: Problem, starts: Starts, texels: Texels, size: int, most: int) -> Integers:
    """The starts that suit each texel best, (M, at most `most`), best first.

    By minus twice the log-likelihood, with noise as the problem's own values have it, as matrix products; or by the
    cost, where each texel has directions of its own.
    """
    if starts.known is None:
        units = (np.tile(unit, (texels.number, 1)) for unit in starts.units)
        costs = [fit_texels(problem, unit, texels, size, fresh=False, most_steps=1).cost for unit in units]
        return np.argsort(np.stack(costs, axis=1), axis=1, kind="stable")[:, :most]
    predicted = np.asarray(starts.known.values, float)
    sigma = sigmas(problem, starts.vectors, predicted)
    with np.errstate(all="ignore"):
        terms = (
            (np.square(texels.values), sigma**-2.0),
            (texels.values, -2.0 * predicted / sigma**2),
            (texels.used, (predicted / sigma) ** 2 + 2.0 * np.log(sigma)),
        )
        misfit = sum(one.reshape(len(one), -1).astype(float) @ other.reshape(len(other), -1).T for one, other in terms)
    misfit = np.nan_to_num(misfit, nan=np.inf, posinf=np.inf)
    return np.argsort(misfit, axis=1, kind="stable")[:, :most]


def sigmas(problem: Problem, vectors: Floats, predicted: Floats) -> Floats:
    """Standard deviations of the data with vectors (K, P) that predict these values, (K, N, C), in 1/sr."""
    return np.asarray(problem.call(_sigmas, vectors, predicted), float)


def _sigmas(model: Model, vectors: Array, predicted: Array) -> Array:
    return jax.vmap(model.sigma_at)(vectors, predicted)
