"""Laplace's approximations of a posterior about the minima of a fit, and the posterior itself at many points.

A parameter at a bound lies at an exponentially distributed distance from it, by the slope of the posterior there; the
others follow the information at the minimum.
"""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy.special import logit

from fits.data.geometry import Floats
from fits.optimise.multi_start import least_squares_descent, unit_of
from fits.optimise.result import Fit
from fits.optimise.uncertainty import local_information, square, uncertainty
from fits.problem.compilation import cores, in_shares
from fits.problem.model import Model
from fits.problem.problem import FittingProblem, Problem
from fits.sampling.mixture import NARROWEST, Mixture
from fits.sampling.options import SamplerOptions

WIDEST = 2.0  # in log-odds, where a uniform density over the box has a standard deviation of 1.8
WIDEST_IN_BOX = 0.3
INSIDE = 1e-9  # of the box
OPEN = 0.1  # boxes: a direction in which the posterior is wider is open
OPEN_SHARE = 0.01  # of the squared length of an open direction: a parameter at a bound that has more lies along it,
PRESSED = 10.0  # unless the log-posterior falls by more than this from the bound across the box
APART = 3.0  # standard deviations: minima that are closer are one mode
MOST_MODES = 8
LOWEST_MINIMUM = 8.0  # in the log-posterior, below the best: what lies lower holds next to nothing, however broad it is


def initial_mixture(fit: Fit, share: int, smallest_mode: float = SamplerOptions.smallest_mode) -> Mixture:
    """About those minima of a fit that hold a share of its posterior, each a mode; share: see `log_posteriors`."""
    problem = fit.problem
    found = [_about(problem, fit.vector, np.isin(problem.names, fit.at_bound), share)]
    for vector in other_minima(fit):
        end = least_squares_descent(problem, unit_of(problem, vector), fresh=False)
        position = logit(np.clip(unit_of(problem, end.vector), INSIDE, 1.0 - INSIDE))[None]
        near = any(np.min(one.squared_distance(position)) < APART**2 for one in found)
        if near or end.cost >= fit.cost + LOWEST_MINIMUM:
            continue
        found.append(_about(problem, end.vector, uncertainty(problem, end.vector, end.cost).at_bound, share))
    mass = np.concatenate([one.log_weight for one in found])
    kept = [one for one, its in zip(found, mass, strict=True) if its > np.max(mass) + np.log(smallest_mode)]
    return Mixture.of_modes(kept)


def _about(problem: Problem, vector: Floats, at_bound: NDArray[np.bool_], share: int) -> Mixture:
    """About a minimum (P,), by the information there; its weight is the logarithm of its mass of posterior.

    Where a direction is unidentified, the covariance of a fit has lost the others.
    """
    unit = unit_of(problem, vector)
    rows, gradient, _ = local_information(problem, unit)
    if at_bound.any():
        along = np.sum(open_directions(rows) ** 2, axis=0)
        at_bound = at_bound & ((along < OPEN_SHARE) | (np.abs(gradient) > PRESSED))
    # no closer to a bound than half a deviation, that of the others given: there is no slope in log-odds next to it
    within = np.minimum(0.5 / np.maximum(np.linalg.norm(rows, axis=0), 0.5 / WIDEST_IN_BOX), 0.5)
    within = np.where(at_bound, INSIDE, within)
    point = np.clip(unit, within, 1.0 - within)
    free, count = np.flatnonzero(~at_bound), len(vector)
    in_log_odds = (rows * (point * (1.0 - point)))[:, free]
    _, values, directions = np.linalg.svd(
        np.concatenate([in_log_odds, np.eye(len(free)) / WIDEST]), full_matrices=False
    )
    root = np.zeros((count, count))
    root[np.ix_(free, free)] = directions.T / values
    distance = np.clip(1.0 / np.maximum(np.abs(gradient), INSIDE), INSIDE, WIDEST_IN_BOX)
    found = Mixture(logit(point)[None], root[None], at_bound[None], distance[None], np.zeros(1), np.zeros(1, int))
    height = log_posteriors(problem, found.centre, share) - found.log_density(found.centre)
    return replace(found, log_weight=np.where(np.isfinite(height), height, -np.inf))


def open_directions(rows: Floats) -> Floats:
    """Directions in the box, (number, F), in which a posterior with these rows of information (R, F) is wide."""
    _, values, directions = np.linalg.svd(square(rows))
    return directions[values * OPEN < 1.0]


def normal_draws(fit: Fit, count: int, generator: np.random.RandomState) -> Floats:
    """Draws (count, P) by the covariance of a fit, without a look at its posterior."""
    unit = np.clip(unit_of(fit.problem, fit.vector), INSIDE, 1.0 - INSIDE)
    at_bound = np.isin(fit.problem.names, fit.at_bound)
    free = np.flatnonzero(~at_bound)
    slope = np.asarray(fit.problem.model.box.slope(jnp.asarray(fit.vector)), float) * unit * (1.0 - unit)
    values, directions = np.linalg.eigh((fit.covariance / np.outer(slope, slope))[np.ix_(free, free)])
    spread = np.clip(np.sqrt(np.maximum(values, 0.0)), NARROWEST, WIDEST)
    drawn = np.tile(logit(unit), (count, 1))
    drawn[:, free] += generator.standard_normal((count, len(free))) @ (directions * spread).T
    if at_bound.any():
        gradient = np.abs(local_information(fit.problem, unit)[1])
        mean = np.clip(1.0 / np.maximum(gradient, INSIDE), INSIDE, WIDEST_IN_BOX)
        distance = np.clip(generator.exponential(mean, (count, len(unit))), INSIDE, 1.0 - INSIDE)
        drawn = np.where(at_bound, np.where(unit < 0.5, 1.0, -1.0) * logit(distance), drawn)
    return drawn


def other_minima(fit: Fit) -> list[Floats]:
    """The minima of a fit, (P,) each, beside the best, that its posterior may have a mode at."""
    close = [one for one in fit.minima[1:] if one.cost < fit.cost + LOWEST_MINIMUM]
    return [np.array([one.values[name] for name in fit.problem.names]) for one in close[: MOST_MODES - 1]]


def log_posteriors(problem: FittingProblem, positions: Floats, share: int, compiled: bool = False) -> Floats:
    """Log-posterior (count,) at positions (count, P) in unconstrained coordinates, on all cores: one program, for so
    many at a time, whatever their number. compiled: see `in_shares`."""
    (found,) = in_shares(lambda part: [problem.call(_log_posteriors, part)], positions, share, compiled)
    return found


def share_of(walkers: int) -> int:
    """Half of an ensemble moves together: what each core has of it."""
    return max(1, walkers // (2 * cores()))


def _log_posteriors(model: Model, positions: Array) -> Array:
    return jax.lax.map(model.log_posterior_unconstrained, positions)  # one walker fits the cache: twice as fast as vmap


def first_positions(
    mixture: Mixture, log_posterior: Callable[[Floats], Floats], walkers: int, generator: np.random.RandomState
) -> Floats:
    """Draws (walkers, P), all of finite posterior; closer to the centres if that is needed, else ValueError."""
    for shrink in 0.5 ** np.arange(12):
        positions = mixture.draw(generator, walkers, float(shrink))
        if np.all(np.isfinite(log_posterior(positions))):
            return positions
    raise ValueError("sampling: the posterior next to the optimum is zero; the model gives values that are not finite")
