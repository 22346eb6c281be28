"""The best outcome of all starts, followed to its very minimum, with its uncertainties."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fits.optimise.descent import COST_TOLERANCE, ROUGH_TOLERANCE, evaluate_at
from fits.optimise.multi_start import (
    LEAST_RELATIVE_GAIN,
    Solver,
    StartOutcome,
    lbfgsb_polish,
    least_squares_descent,
    unit_of,
)
from fits.optimise.uncertainty import Uncertainty, uncertainty
from fits.problem.model import Density
from fits.problem.problem import FittingProblem

Floats = NDArray[np.float64]


class Optimum(NamedTuple):
    """The outcomes of all starts, the place of the lowest among them, and what is known there.

    improved: whether L-BFGS-B found what Levenberg-Marquardt had not. predicted: (N, C), in 1/sr. excess: what
    differences in cost count in, see `FitOptions`.
    """

    problem: FittingProblem
    ends: list[StartOutcome]
    best: int
    found: Uncertainty
    improved: bool
    predicted: Floats
    excess: float

    @property
    def lowest(self) -> StartOutcome:
        """The lowest end, exactly on the bounds that hold it."""
        return self.ends[self.best]


def polish(
    problem: FittingProblem,
    ends: list[StartOutcome],
    solver: Solver,
    *,
    check: bool = True,
    tolerance: float = COST_TOLERANCE,
) -> Optimum:
    """The lowest of the ends, followed to its very minimum, and checked by L-BFGS-B where it has not converged.

    check: also where a parameter lies on a bound or has no influence. It takes a hundred steps: what begins at a
    minimum that was checked goes without. tolerance: how far it is followed, see `descend`.
    """
    best = int(np.argmin([end.cost for end in ends]))
    lowest, improved = ends[best], False
    if (
        solver == "least_squares"
        and lowest.converged
        and tolerance < ROUGH_TOLERANCE
        and problem.objective == "likelihood"
    ):
        lowest = _closer(problem, lowest, tolerance)
    found = uncertainty(problem, lowest.vector, lowest.cost)
    if solver == "least_squares" and check and found.insensitive:
        lowest, lower = _leave_plateau(problem, lowest, found, tolerance)
        found = uncertainty(problem, lowest.vector, lowest.cost) if lower else found
    if solver == "least_squares" and ((check and found.at_bound.any()) or not lowest.converged):
        lowest, improved = lbfgsb_polish(problem, lowest)
        found = uncertainty(problem, lowest.vector, lowest.cost) if improved else found
    lowest = lowest._replace(vector=_on_bounds(problem, lowest.vector, found.at_bound))
    held = found.at_bound.any()
    predicted = evaluate_at(problem, unit_of(problem, lowest.vector)).predicted if held else found.predicted
    ends = [*ends[:best], lowest, *ends[best + 1 :]]
    return Optimum(problem, ends, best, found, improved, predicted, _excess(problem, lowest, predicted))


def _closer(problem: FittingProblem, end: StartOutcome, tolerance: float) -> StartOutcome:
    """The end, closer to its minimum."""
    closer = least_squares_descent(problem, unit_of(problem, end.vector), False, tolerance)
    return closer._replace(steps=end.steps + closer.steps) if closer.cost <= end.cost else end


def _leave_plateau(
    problem: FittingProblem, end: StartOutcome, found: Uncertainty, tolerance: float
) -> tuple[StartOutcome, bool]:
    """The outcome, or a lower one from where insensitive parameters and those at a bound begin anew; and whether it is.

    No step leads off a plateau: every start may end on one though another minimum is far lower.
    """
    stuck = np.isin(problem.names, found.insensitive) | found.at_bound
    point = np.where(stuck, unit_of(problem, problem.start), unit_of(problem, end.vector))
    other = least_squares_descent(problem, point, tolerance=tolerance)
    lower = other.cost < end.cost - (
        ROUGH_TOLERANCE if problem.objective == "likelihood" else LEAST_RELATIVE_GAIN * end.cost
    )
    return (other._replace(steps=end.steps + other.steps) if lower else end), lower


def _on_bounds(problem: FittingProblem, vector: Floats, held: NDArray[np.bool_]) -> Floats:
    """Exact bounds where the solver ended on them."""
    nearest = np.where(vector - problem.low < problem.high - vector, problem.low, problem.high)
    return np.where(held, nearest, np.clip(vector, problem.low, problem.high))


def _excess(problem: FittingProblem, lowest: StartOutcome, predicted: Floats) -> float:
    """The reduced chi-square where it is above 1; of a named objective, the residual variance."""
    freedom = problem.count - len(lowest.vector)
    if problem.objective != "likelihood":
        return 2.0 * lowest.cost / max(freedom, 1)
    chi_square = float(problem.call(Density.chi_square_at, lowest.vector, predicted))
    return max(1.0, chi_square / freedom if freedom > 0 else 1.0)
