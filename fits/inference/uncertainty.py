"""What the data say about the parameters at an optimum: errors, correlations, and the combinations they do not resolve.

All follow from the Fisher information A'A (see `Model.information_rows`), with one column of A a parameter in units of
its box.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.inference.identifiability import (
    UNKNOWN_BEYOND,
    Combination,
    floored,
    square,
    unresolved_combinations,
    without_influence,
)
from fits.problem.model import Model
from fits.problem.problem import Problem

ON_BOUND = 1e-6  # of the box
LEAST_PULL = 1e-6  # of the log-posterior, over the whole box: what pushes less against a bound does not push

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Errors at an optimum with P parameters, in physical units.

    at_bound: (P,) bool: the value lies on a bound and the fit would go on improving beyond it (one without influence
    lies where it happens to). Errors, covariance and
    condition number are conditional on these values; their own errors are NaN and their rows of the covariance 0.
    standard_errors: (P,), infinite where nothing holds a parameter.
    unresolved: the combinations that the data do not resolve, of all parameters, also those at a bound.
    without_influence: names of those that the data say nothing about at all.
    """

    at_bound: NDArray[np.bool_]
    standard_errors: Floats
    covariance: Floats
    condition_number: float
    unresolved: tuple[Combination, ...]
    without_influence: tuple[str, ...]


def uncertainty(problem: Problem, vector: Floats, cost: float) -> Uncertainty:
    """Errors at the optimum `vector` (P,) with this `cost`; a named objective's are scaled by its residual variance.

    Where the model is not finite nothing is known: all errors are infinite.
    """
    data_root, prior_root, gradient, unit = (np.asarray(x, float) for x in problem.call(_triangles, vector))
    count = len(vector)
    if not all(np.all(np.isfinite(part)) for part in (data_root, prior_root, gradient)):
        nowhere = np.zeros(count, bool)
        return Uncertainty(nowhere, np.full(count, np.inf), np.zeros((count, count)), float("inf"), (), ())
    scatter = 1.0  # what a difference in cost is measured in
    if problem.objective != "likelihood":
        scatter = max(2.0 * cost / max(problem.count - count, 1), np.finfo(float).tiny)
    data_root, pull = data_root / np.sqrt(scatter), LEAST_PULL * scatter
    idle = without_influence(data_root, problem.names)
    at_bound = ((unit <= ON_BOUND) & (gradient > pull)) | ((unit >= 1 - ON_BOUND) & (gradient < -pull))
    at_bound &= ~np.isin(problem.names, idle)
    free = np.flatnonzero(~at_bound)
    width = np.asarray(problem.model.box.slope(jnp.asarray(vector)), float)
    unresolved = unresolved_combinations(data_root, problem.names, width)
    data_root, prior_root = data_root[:, free], prior_root[:, free]
    errors, covariance = np.full(count, np.nan), np.zeros((count, count))
    if free.size:
        boxes = _inverse_information(np.vstack([data_root, prior_root]))
        spread = np.sqrt(np.diagonal(boxes))
        errors[free] = np.where(spread > UNKNOWN_BEYOND, np.inf, spread * width[free])
        covariance[np.ix_(free, free)] = boxes * np.outer(width[free], width[free])
    return Uncertainty(at_bound, errors, covariance, condition_number(data_root), unresolved, idle)


def local_information(problem: Problem, vector: Floats) -> tuple[Floats, Floats]:
    """Rows of A, of the data and the prior, (rows, P), at any `vector` (P,): A'A is the information in boxes^-2.

    And the gradient of the negative log-posterior there, (P,), in boxes^-1.
    """
    data_root, prior_root, gradient, _ = (np.asarray(x, float) for x in problem.call(_triangles, vector))
    return np.vstack([data_root, prior_root]), gradient


def condition_number(root: Floats) -> float:
    """Ratio of the extreme singular values once every column has unit length: infinite if one has no effect."""
    lengths = np.linalg.norm(root, axis=0)
    if not lengths.size:
        return 1.0
    if not np.all(lengths > 0):
        return float("inf")
    values = np.linalg.svd(square(root / lengths), compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 else float("inf")


def _triangles(model: Model, vector: Array) -> tuple[Array, Array, Array, Array]:
    # forward, as the rows are, and with them: reverse through a transport that iterates takes twice as long to compile
    data_rows, prior_rows, gradient = jax.jacfwd(model.information_rows)(vector)
    width, unit = model.box.slope(vector), model.box.to_unit(vector)
    # R of the QR decomposition has A's singular values without squaring its condition number
    return jnp.linalg.qr(data_rows * width, mode="r"), prior_rows * width, gradient * width, unit


def _inverse_information(root: Floats) -> Floats:
    """(A'A)^-1 by singular values."""
    _, values, directions = np.linalg.svd(square(root))
    scaled = directions / floored(values)[:, None]
    return scaled.T @ scaled
