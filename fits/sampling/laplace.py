"""The posterior as a fit sees it: a heavy-tailed approximation, in unconstrained coordinates, to draw proposals from.

Proposals drawn from it do not depend on where a walker stands, so where it is good a chain forgets its past in a few
steps; where it is poor they are refused, the ensemble's stretch moves carry the chain, and an approximation learned
from what they have seen takes over. Metropolis' rule keeps every step exact.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit, gammaln, logit

from fits.optimise.levenberg_marquardt import evaluate_at
from fits.optimise.result import Fit
from fits.problem.problem import Problem

DEGREES_OF_FREEDOM = 6.0
WIDEST = 2.0  # in log-odds, where a uniform density over the box has a standard deviation of 1.8
NARROWEST = 1e-9
WIDEST_REACH = 0.3  # of the box
INSIDE = 1e-9

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Approximation:
    """A density over the unconstrained vectors of a problem with P parameters.

    Parameters that are not at a bound follow a multivariate Student-t about the optimum, with its covariance; a
    parameter at a bound lies at an exponentially distributed distance from it, cut off at the other bound. lower: (P,)
    bool: which bound that is. reach: (P,): the mean of that distance in boxes.
    """

    centre: Floats
    root: Floats
    held: NDArray[np.bool_]
    lower: NDArray[np.bool_]
    reach: Floats

    @classmethod
    def of(cls, fit: Fit) -> "Approximation":
        """The approximation by a fit's optimum, its covariance, and the posterior's slope at the bounds it lies on."""
        box = fit.problem.model.box
        vector = jnp.asarray(fit.vector)
        unit = np.clip(np.asarray(box.to_unit(vector), float), INSIDE, 1.0 - INSIDE)
        held = np.isin(fit.problem.names, fit.at_bound)
        slope = slope_at_bounds(fit.problem, unit, held)
        stretch = np.asarray(box.slope(vector), float) * unit * (1.0 - unit)  # d physical / d log-odds
        free = np.ix_(~held, ~held)
        values, directions = np.linalg.eigh((fit.covariance / np.outer(stretch, stretch))[free])
        spread = np.clip(np.sqrt(np.maximum(values, 0.0)), NARROWEST, WIDEST)
        reach = np.clip(1.0 / np.maximum(slope, INSIDE), INSIDE, WIDEST_REACH)
        return cls(logit(unit), directions * spread, held, unit < 0.5, reach)

    @classmethod
    def learned(cls, positions: Floats) -> "Approximation":
        """The approximation with the mean and covariance of samples (count, P) of the posterior."""
        count = positions.shape[1]
        values, directions = np.linalg.eigh(np.atleast_2d(np.cov(positions.T)))
        spread = np.sqrt(np.maximum(values, NARROWEST**2))
        nowhere = np.zeros(count, bool)
        return cls(positions.mean(axis=0), directions * spread, nowhere, nowhere, np.ones(count))

    def mean_log_density(self, positions: Floats) -> float:
        """Mean log-density over samples of the posterior: the higher, the closer the approximation is to it."""
        return float(np.mean(self.log_density(positions)))

    def draw(self, generator: np.random.RandomState, count: int, shrink: float = 1.0) -> Floats:
        """(count, P) independent draws, `shrink` times closer to the optimum."""
        drawn = np.empty((count, len(self.centre)))
        free = ~self.held
        drawn[:, free] = self.centre[free] + shrink * student_draws(generator, count, int(free.sum())) @ self.root.T
        uniform = generator.random_sample((count, int(self.held.sum())))
        reach = self.reach[self.held]
        distance = -reach * np.log1p(uniform * np.expm1(-1.0 / reach))
        distance = np.clip(shrink * distance, INSIDE, 1.0 - INSIDE)
        log_odds = logit(distance)
        drawn[:, self.held] = np.where(self.lower[self.held], log_odds, -log_odds)
        return drawn

    def log_density(self, positions: Floats) -> Floats:
        """Log-density of the draws at unconstrained `positions` (count, P)."""
        free = ~self.held
        total = student(self.centre[free], self.root, positions[:, free])
        log_odds = np.where(self.lower[self.held], positions[:, self.held], -positions[:, self.held])
        logistic = stats.logistic.logpdf(log_odds)  # d distance / d log-odds
        reach = self.reach[self.held]
        exponential = -expit(log_odds) / reach - np.log(-reach * np.expm1(-1.0 / reach))
        return total + np.sum(logistic + exponential, axis=1)

    def propose(self, positions: Floats, generator: np.random.RandomState) -> tuple[Floats, Floats]:
        """Independent proposals for `emcee.moves.MHMove`, and the log-ratio of densities it asks for."""
        drawn = self.draw(generator, len(positions))
        return drawn, self.log_density(positions) - self.log_density(drawn)


def slope_at_bounds(problem: Problem, unit: Floats, held: NDArray[np.bool_]) -> Floats:
    """How steeply the log-posterior falls in the box, (P,), where a parameter is held by a bound; 0 if none is.

    The Jacobian of a costly model is not compiled for nothing.
    """
    if not held.any():
        return np.zeros(len(unit))
    return np.abs(evaluate_at(problem, unit).gradient)


def first_positions(
    draw: Callable[[np.random.RandomState, int, float], Floats],
    finite: Callable[[Floats], bool],
    walkers: int,
    generator: np.random.RandomState,
) -> Floats:
    """Draws of an approximation, (walkers, P), all of finite posterior; closer to the optimum if that is needed.

    Raises ValueError if even a narrow cloud holds points of posterior zero.
    """
    for shrink in 0.5 ** np.arange(12):
        positions = draw(generator, walkers, float(shrink))
        if finite(positions):
            return positions
    raise ValueError(
        "sampling: points next to the optimum have posterior zero; the model gives values that are not finite"
    )


def student(centre: Floats, root: Floats, positions: Floats) -> Floats:
    """Log-density at positions (count, F) of a Student-t about centre (F,); its covariance is root by its transpose."""
    dimension = len(centre)
    if not dimension:
        return np.zeros(len(positions))
    whitened = np.linalg.solve(root, (positions - centre).T)
    freedom = 0.5 * (DEGREES_OF_FREEDOM + dimension)
    tails = freedom * np.log1p(np.sum(whitened**2, axis=0) / DEGREES_OF_FREEDOM)
    return student_peak(dimension) - np.linalg.slogdet(root)[1] - tails


def student_peak(dimension: int) -> float:
    """Log-density of a Student-t of unit width at its centre."""
    freedom = 0.5 * (DEGREES_OF_FREEDOM + dimension)
    return float(
        gammaln(freedom) - gammaln(0.5 * DEGREES_OF_FREEDOM) - 0.5 * dimension * np.log(DEGREES_OF_FREEDOM * np.pi)
    )


def student_draws(generator: np.random.RandomState, count: int, dimension: int) -> Floats:
    """Draws (count, dimension) from a Student-t about 0 of unit width."""
    normal = generator.standard_normal((count, dimension))
    return normal * np.sqrt(DEGREES_OF_FREEDOM / generator.chisquare(DEGREES_OF_FREEDOM, (count, 1)))
