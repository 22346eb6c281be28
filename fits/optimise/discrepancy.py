"""Whether a fit counts errors of the model that neighbouring readings share, where that is left to the residuals.

The rule: the stack is fitted with noise that readings do not share; where residuals of neighbours along the scans are
correlated by more than `LEAST`, and by more than `CLEAR` standard errors, it is fitted again with errors that they do.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fits.data.neighbours import alike, neighbours
from fits.data.totals import Totals
from fits.optimise.multi_start import start_points, unit_of
from fits.optimise.result import Alone, Fit
from fits.problem.base import Posed
from fits.problem.problem import Problem

LEAST, CLEAR = 0.2, 3.0

MOST_STARTS = 8
"""Minima of the fit without that the fit with them starts from; of its other starts half as many."""


def left_open(problem: Problem) -> bool:
    """Whether it is left to the residuals, and could be counted."""
    noise = problem.noise
    if isinstance(problem.data, Totals):
        return False  # they have no neighbours
    return noise.correlated is None and noise.tails == "gaussian" and problem.objective == "likelihood"


def alone(fit: Fit) -> Alone:
    """What is to be said of a fit without shared errors."""
    pairs = neighbours(fit.problem.data.used(), fit.residuals)
    return Alone(
        values=fit.values,
        errors=fit.standard_errors,
        chi_square=fit.chi_square,
        degrees_of_freedom=fit.degrees_of_freedom,
        log_likelihood=fit.log_likelihood,
        alike=alike(*pairs),
        pairs=pairs[0].size,
    )


def are_shared(found: Alone) -> bool:
    """Whether residuals of neighbours are alike, by the rule above."""
    return found.alike > LEAST and found.alike * math.sqrt(found.pairs) > CLEAR


def sharing(fit: Fit) -> dict[str, Alone]:
    """The measurements of which errors are to be counted that readings share, by the rule, as fitted without."""
    problems = fit.problem.problems.items()
    found = {name: alone(fit.part(name)) for name, problem in problems if left_open(problem)}
    return {name: one for name, one in found.items() if are_shared(one)}


def counting(problem: Problem) -> Problem:
    """The problem with errors that readings share."""
    return replace(problem, noise=replace(problem.noise, correlated=True))


def points(problem: Posed, fit: Fit, starts: int, seed: int) -> NDArray[np.float64]:
    """Where to start from, (K, P) in the unit box of a problem with shared errors, after a fit without: its minima, and
    some of as many starts as it had.
    """
    found = []
    for minimum in fit.minima[:MOST_STARTS]:
        named = dict(zip(problem.names, problem.start, strict=True)) | minimum.values
        found.append(unit_of(problem, np.array([named[name] for name in problem.names])))
    return np.concatenate([found, start_points(problem, min(starts, MOST_STARTS // 2), seed)])
