"""Whether a fit needs a model discrepancy, where that is left to the residuals.

The rule: the stack is fitted with independent noise; where residuals of neighbours along the scans are correlated by
more than `FitOptions` allow, it is fitted again with a discrepancy.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fits.data.neighbours import correlation, neighbours
from fits.data.totals import Totals
from fits.optimise.multi_start import start_points, unit_of
from fits.optimise.options import DEFAULT, FitOptions
from fits.optimise.result import Fit, WithoutDiscrepancy
from fits.problem.problem import FittingProblem, Problem

MOST_STARTS = 8
"""Minima of the fit without that the fit with them starts from; of its other starts half as many."""


def undecided(problem: Problem) -> bool:
    """Whether it is left to the residuals, and could be counted."""
    noise = problem.noise
    if isinstance(problem.data, Totals):
        return False  # they have no neighbours
    return noise.discrepancy is None and noise.tails == "gaussian" and problem.objective == "likelihood"


def without_discrepancy(fit: Fit) -> WithoutDiscrepancy:
    """What is to be said of a fit without model discrepancy."""
    pairs = neighbours(fit.problem.data.used(), fit.residuals)
    return WithoutDiscrepancy(
        values=fit.values,
        errors=fit.standard_errors,
        chi_square=fit.chi_square,
        degrees_of_freedom=fit.degrees_of_freedom,
        log_likelihood=fit.log_likelihood,
        residual_autocorrelation=correlation(*pairs),
        pairs=pairs[0].size,
    )


def needs_discrepancy(found: WithoutDiscrepancy, options: FitOptions = DEFAULT) -> bool:
    """Whether residuals of neighbours are correlated, by the rule above."""
    correlation = found.residual_autocorrelation
    clear = correlation * math.sqrt(found.pairs) > options.autocorrelation_errors
    return clear and correlation > options.autocorrelation


def datasets_with_discrepancy(fit: Fit, options: FitOptions = DEFAULT) -> dict[str, WithoutDiscrepancy]:
    """The data sets that need a model discrepancy by the rule above, as fitted without."""
    problems = fit.problem.problems.items()
    found = {name: without_discrepancy(fit.part(name)) for name, problem in problems if undecided(problem)}
    return {name: one for name, one in found.items() if needs_discrepancy(one, options)}


def with_discrepancy(problem: Problem) -> Problem:
    """The problem with model discrepancy."""
    return replace(problem, noise=replace(problem.noise, discrepancy=True))


def start_points_with_discrepancy(problem: FittingProblem, fit: Fit, starts: int, seed: int) -> NDArray[np.float64]:
    """Where to start from, (K, P) in the unit box of a problem with model discrepancy, after a fit without: its minima,
    and some of as many starts as it had.
    """
    found = []
    for minimum in fit.minima[:MOST_STARTS]:
        named = dict(zip(problem.names, problem.start, strict=True)) | minimum.values
        found.append(unit_of(problem, np.array([named[name] for name in problem.names])))
    return np.concatenate([found, start_points(problem, min(starts, MOST_STARTS // 2), seed)])
