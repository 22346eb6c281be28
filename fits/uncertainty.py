"""What the data say about the parameters at an optimum: errors, correlations, and the directions they leave open.

All follow from the Fisher information A'A (see `Model.information_root`), with one column of A a parameter in units of
its box. A singular value s of A's data rows means that the parameters can move by 1 / s of their boxes along its
direction before the fit worsens by one standard deviation: for s < 1 they cross the whole box, and the direction is
*open*.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.bounded import cost as cost_at
from fits.problem import Model, Problem

OPEN_BELOW = 1.0
UNKNOWN_BEYOND = 1e3  # boxes: a larger error is reported as infinite
ON_BOUND = 1e-6  # of the box
SMALLEST_WEIGHT = 0.05

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Errors at an optimum with P parameters, in physical units.

    at_bound: (P,) bool: the value lies on a bound and the fit would go on improving beyond it. Everything else is
    conditional on these values; their own errors are NaN and their rows of the covariance 0.
    standard_errors: (P,), infinite where nothing holds a parameter.
    open_directions: pairs of a singular value relative to the largest and the direction's weights in units of the
    boxes.
    """

    at_bound: NDArray[np.bool_]
    standard_errors: Floats
    covariance: Floats
    condition_number: float
    open_directions: tuple[tuple[float, dict[str, float]], ...]


def uncertainty(problem: Problem, vector: Floats, cost: float) -> Uncertainty:
    """Errors at the optimum `vector` (P,) with this `cost`; a named objective's are scaled by its residual variance.

    Where the model is not finite nothing is known: all errors are infinite.
    """
    data_root, prior_root, gradient, unit = (np.asarray(x, float) for x in problem.call(_triangles, vector))
    count = len(vector)
    if not all(np.all(np.isfinite(part)) for part in (data_root, prior_root, gradient)):
        nowhere = np.zeros(count, bool)
        return Uncertainty(nowhere, np.full(count, np.inf), np.zeros((count, count)), float("inf"), ())
    at_bound = ((unit <= ON_BOUND) & (gradient > 0)) | ((unit >= 1 - ON_BOUND) & (gradient < 0))
    free = np.flatnonzero(~at_bound)
    width = np.asarray(problem.model.box.slope(jnp.asarray(vector)), float)
    if problem.objective != "likelihood":
        data_root = data_root / np.sqrt(max(2.0 * cost / max(problem.count - count, 1), np.finfo(float).tiny))
    data_root, prior_root = data_root[:, free], prior_root[:, free]
    errors, covariance = np.full(count, np.nan), np.zeros((count, count))
    if free.size:
        boxes = _inverse_information(np.vstack([data_root, prior_root]))
        spread = np.sqrt(np.diagonal(boxes))
        errors[free] = np.where(spread > UNKNOWN_BEYOND, np.inf, spread * width[free])
        covariance[np.ix_(free, free)] = boxes * np.outer(width[free], width[free])
    names = [problem.names[index] for index in free]
    return Uncertainty(at_bound, errors, covariance, condition_number(data_root), open_directions(data_root, names))


def open_directions(root: Floats, names: list[str]) -> tuple[tuple[float, dict[str, float]], ...]:
    """Directions along which the parameters cross their boxes at less than one standard deviation, most open first."""
    if not names:
        return ()
    _, values, directions = np.linalg.svd(_square(root))
    largest = max(values[0], np.finfo(float).tiny)
    found = []
    for value, direction in zip(values[::-1], directions[::-1], strict=True):
        if value < OPEN_BELOW:
            sign = np.sign(direction[np.argmax(np.abs(direction))])
            weights = {
                name: float(sign * weight)
                for name, weight in zip(names, direction, strict=True)
                if abs(weight) > SMALLEST_WEIGHT
            }
            found.append((float(value / largest), weights))
    return tuple(found)


def condition_number(root: Floats) -> float:
    """Ratio of the extreme singular values once every column has unit length: infinite if one has no effect."""
    lengths = np.linalg.norm(root, axis=0)
    if not lengths.size:
        return 1.0
    if not np.all(lengths > 0):
        return float("inf")
    values = np.linalg.svd(_square(root / lengths), compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 else float("inf")


def _triangles(model: Model, vector: Array) -> tuple[Array, Array, Array, Array]:
    data_rows, prior_rows = model.information_root(vector)
    width, unit = model.box.slope(vector), model.box.to_unit(vector)
    # forward, as the rows are: reverse through a transport that iterates takes twice as long to compile
    gradient = jax.jacfwd(partial(cost_at, model))(unit)
    # R of the QR decomposition has A's singular values without squaring its condition number
    return jnp.linalg.qr(data_rows * width, mode="r"), prior_rows * width, gradient, unit


def _inverse_information(root: Floats) -> Floats:
    """(A'A)^-1 by singular values; those lost in rounding count as the smallest that are not, never as infinite."""
    _, values, directions = np.linalg.svd(_square(root))
    floor = np.finfo(float).eps * len(values) * max(values[0], np.finfo(float).tiny)
    scaled = directions / np.maximum(values, floor)[:, None]
    return scaled.T @ scaled


def _square(root: Floats) -> Floats:
    """Zero rows below a matrix with fewer rows than columns, so that every direction has its singular value."""
    missing = max(root.shape[1] - root.shape[0], 0)
    return np.vstack([root, np.zeros((missing, root.shape[1]))])
