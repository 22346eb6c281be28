"""What the data say about the parameters at an optimum: errors, correlations, and the combinations they do not resolve.

All follow from the Fisher information A'A (see `Model.linear_parts`), with one column of A a parameter in units of
its box.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from fits.optimise.descent import evaluate_at
from fits.optimise.identifiability import (
    UNKNOWN_BEYOND,
    Direction,
    floored,
    insensitive,
    square,
    unidentified_directions,
)
from fits.problem.problem import FittingProblem

ON_BOUND = 1e-6  # of the box
LEAST_GRADIENT = 1e-6  # of the log-posterior, over the whole box: what pushes less against a bound does not push

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Errors at an optimum with P parameters, in physical units.

    at_bound: (P,) bool: the value lies on a bound and the fit would go on improving beyond it (an insensitive one lies
    where it happens to). Errors, covariance and condition number are conditional on these values; their own errors are
    NaN and their rows of the covariance 0.
    standard_errors: (P,), infinite where nothing holds a parameter.
    unidentified: the combinations that the data do not resolve, of all parameters, also those at a bound.
    insensitive: names of those that the data say nothing about at all.
    predicted: the model at the optimum, (N, C), in 1/sr.
    """

    at_bound: NDArray[np.bool_]
    standard_errors: Floats
    covariance: Floats
    condition_number: float
    unidentified: tuple[Direction, ...]
    insensitive: tuple[str, ...]
    predicted: Floats


def uncertainty(problem: FittingProblem, vector: Floats, cost: float) -> Uncertainty:
    """Errors at the optimum `vector` (P,) with this `cost`; a named objective's are scaled by its residual variance.

    Where the model is not finite nothing is known: all errors are infinite.
    """
    box, count = problem.model.box, len(vector)
    unit = np.asarray(box.to_unit(jnp.asarray(vector)), float)
    found = evaluate_at(problem, unit)
    data_root, gradient = found.root, found.gradient
    if not (np.isfinite(found.cost) and np.all(np.isfinite(data_root))):
        nowhere = np.zeros(count, bool)
        infinite = np.full(count, np.inf)
        return Uncertainty(nowhere, infinite, np.zeros((count, count)), float("inf"), (), (), found.predicted)
    scatter = 1.0  # what a difference in cost is measured in
    if problem.objective != "likelihood":
        scatter = max(2.0 * cost / max(problem.count - count, 1), np.finfo(float).tiny)
    data_root, least_gradient = data_root / np.sqrt(scatter), LEAST_GRADIENT * scatter
    idle = insensitive(data_root, problem.names)
    at_bound = ((unit <= ON_BOUND) & (gradient > least_gradient)) | (
        (unit >= 1 - ON_BOUND) & (gradient < -least_gradient)
    )
    at_bound &= ~np.isin(problem.names, idle)
    free = np.flatnonzero(~at_bound)
    width = np.asarray(box.slope(jnp.asarray(vector)), float)
    unidentified = unidentified_directions(data_root, problem.names, width)
    data_root, prior_root = data_root[:, free], _prior_root(problem)[:, free]
    errors, covariance = np.full(count, np.nan), np.zeros((count, count))
    if free.size:
        boxes = _inverse_information(np.vstack([data_root, prior_root]))
        spread = np.sqrt(np.diagonal(boxes))
        errors[free] = np.where(spread > UNKNOWN_BEYOND, np.inf, spread * width[free])
        covariance[np.ix_(free, free)] = boxes * np.outer(width[free], width[free])
    return Uncertainty(at_bound, errors, covariance, condition_number(data_root), unidentified, idle, found.predicted)


def local_information(problem: FittingProblem, unit: Floats) -> tuple[Floats, Floats, float]:
    """Rows of A, of the data and the prior, (rows, P), anywhere in the unit box: A'A is the information in boxes^-2.

    And the gradient of the negative log-posterior there, (P,), in boxes^-1, and this itself up to a constant.
    """
    found = evaluate_at(problem, unit)
    return np.vstack([found.root, _prior_root(problem)]), found.gradient, float(found.cost)


def condition_number(root: Floats) -> float:
    """Ratio of the extreme singular values once every column has unit length: infinite if one has no effect."""
    lengths = np.linalg.norm(root, axis=0)
    if not lengths.size:
        return 1.0
    if not np.all(lengths > 0):
        return float("inf")
    values = np.linalg.svd(square(root / lengths), compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 else float("inf")


def _prior_root(problem: FittingProblem) -> Floats:
    """Rows (P + Q, P) of the prior's information, in boxes^-1."""
    return np.asarray(problem.model.box.prior_slopes(), float)


def _inverse_information(root: Floats) -> Floats:
    """(A'A)^-1 by singular values."""
    _, values, directions = np.linalg.svd(square(root))
    scaled = directions / floored(values)[:, None]
    return scaled.T @ scaled
