"""What the data say about the parameters at an optimum: errors, correlations, and the directions they do not identify.

All follow from the Fisher information A'A (see `Model.linear_parts`), with one column of A a parameter in units of
its box. A singular value s of A says that the parameters can move by 1 / s of their boxes along its direction before
the fit worsens by one standard deviation, priors and bounds apart. Along a curved valley the direction turns.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from fits.data.geometry import Booleans, Floats
from fits.optimise.levenberg_marquardt import evaluate_at
from fits.problem.problem import FittingProblem

ON_BOUND = 1e-6  # of the box
LEAST_GRADIENT = 1e-6  # of the log-posterior, over the whole box: what pushes less against a bound does not push
UNIDENTIFIED_BEYOND = 0.1  # boxes: a direction with a larger standard error is not resolved
UNCONSTRAINED_BEYOND = 1.0  # boxes: nor is this one held within its bounds
UNKNOWN_BEYOND = 1e3  # boxes: a larger error is reported as infinite
LARGEST_ERROR = 1e9  # boxes: stands for all larger ones, so that squares of it can be formed
CERTAIN_MEMBER = 0.05  # weight from which a parameter belongs to a direction
MEMBER, OWED = 0.01, 0.25  # weight from which it does so if it owes the direction this share of its variance


@dataclass(frozen=True)
class Direction:
    """A direction in parameter space that the data do not identify.

    Attributes:
        error: standard error along the direction from the data alone, in units of the range between the bounds;
            infinite if the data do not constrain it.
        weights: weights of its parameters by name, in the same units, the largest first; their squares sum to about 1.
        conditional_errors: standard error of each parameter when all others are fixed, in physical units.
    """

    error: float
    weights: dict[str, float]
    conditional_errors: dict[str, float]

    def error_of(self, name: str) -> float:
        """Standard error of one parameter along the direction, in units of its range; 0 if it has no weight."""
        return abs(self.weights[name]) * self.error if name in self.weights else 0.0

    def renamed(self, names: Mapping[str, str]) -> "Direction":
        """The same direction with parameters renamed."""
        members = {names[name]: name for name in self.weights if name in names}
        weights = {new: self.weights[name] for new, name in members.items()}
        errors = {new: self.conditional_errors[name] for new, name in members.items()}
        return Direction(self.error, weights, errors)

    @property
    def unconstrained(self) -> bool:
        """Whether the standard error exceeds the range between the bounds of the parameters (prior-dominated)."""
        return self.error > UNCONSTRAINED_BEYOND


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Errors at an optimum with P parameters, in physical units.

    at_bound: (P,) bool: the fit would go on improving beyond the bound. Errors, covariance and condition number are
    conditional on these values; their own errors are NaN and their rows of the covariance 0. standard_errors: (P,),
    infinite where nothing holds a parameter. unidentified: the combinations, of all parameters, that the data do not
    resolve. insensitive: names of those that the data say nothing about. predicted: (N, C), in 1/sr, there.
    """

    at_bound: Booleans
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
        nowhere, infinite = np.zeros(count, bool), np.full(count, np.inf)
        return Uncertainty(nowhere, infinite, np.zeros((count, count)), math.inf, (), (), found.predicted)
    unit_cost, width = scatter(problem, cost, problem.count), np.asarray(box.slope(jnp.asarray(vector)), float)
    root, prior_root = data_root / np.sqrt(unit_cost), np.asarray(box.prior_slopes(), float)
    least = LEAST_GRADIENT * unit_cost
    idle, at_bound, deviations, errors = errors_in_boxes(root, prior_root, unit, gradient, least)
    covariance = deviations.T @ deviations * np.outer(width, width)
    unidentified = unidentified_directions(root, problem.names, width)
    insensitive = tuple(name for name, none in zip(problem.names, idle, strict=True) if none)
    condition = condition_number(root[:, ~at_bound])
    return Uncertainty(at_bound, errors * width, covariance, condition, unidentified, insensitive, found.predicted)


def scatter(problem: FittingProblem, cost: Any, count: Any) -> Any:
    """What differences in cost count in, of fits to so many data: 1, or the residual variance of a named objective."""
    if problem.objective == "likelihood":
        return np.ones_like(cost)
    return np.maximum(2.0 * cost / np.maximum(count - len(problem.names), 1), np.finfo(np.float32).tiny)


def held_by_bounds(unit: Floats, gradient: Floats, least: Any = LEAST_GRADIENT) -> Booleans:
    """Which parameters lie on a bound of the unit box and would go beyond it; least: gradient that counts."""
    return ((unit <= ON_BOUND) & (gradient > least)) | ((unit >= 1.0 - ON_BOUND) & (gradient < -least))


def errors_in_boxes(
    root: Floats, prior: Floats, unit: Floats, gradient: Floats, least: Any
) -> tuple[Booleans, Booleans, Floats, Floats]:
    """At an optimum, or at each of many: which parameters the data say nothing about, and which a bound holds,
    (..., P); D, (..., rows, P), whose D'D is the covariance; and standard errors, (..., P), NaN at a bound, infinite
    where nothing holds a parameter. root, prior: rows A of the data and the prior, (..., rows, P); least: as above.
    """
    # whatever is known of the other parameters: the column of A is all but 0
    insensitive = np.linalg.norm(root, axis=-2) * UNKNOWN_BEYOND < 1.0
    at_bound = held_by_bounds(unit, gradient, least) & ~insensitive
    rows = np.where(at_bound[..., None, :], 0.0, np.concatenate([root, prior], axis=-2))
    _, values, directions = np.linalg.svd(rows, full_matrices=False)
    deviations = np.where(at_bound[..., None, :], 0.0, directions / floored(values)[..., None])
    errors = np.linalg.norm(deviations, axis=-2)
    errors = np.where(errors > UNKNOWN_BEYOND, np.inf, errors)
    return insensitive, at_bound, deviations, np.where(at_bound, np.nan, errors)


def local_information(problem: FittingProblem, unit: Floats) -> tuple[Floats, Floats, float]:
    """Rows of A, of the data and the prior, (rows, P), anywhere in the unit box: A'A is the information in boxes^-2;
    the gradient of the negative log-posterior there, (P,), in boxes^-1; and this itself up to a constant."""
    found = evaluate_at(problem, unit)
    rows = np.vstack([found.root, np.asarray(problem.model.box.prior_slopes(), float)])
    return rows, found.gradient, float(found.cost)


def condition_number(root: Floats) -> float:
    """Ratio of the extreme singular values once every column has unit length: infinite if one has no effect."""
    lengths = np.linalg.norm(root, axis=0)
    if not (lengths.size and np.all(lengths > 0)):
        return math.inf if lengths.size else 1.0
    return float(np.linalg.cond(square(root / lengths)))


def unidentified_directions(root: Floats, names: tuple[str, ...], width: Floats) -> tuple[Direction, ...]:
    """Directions known to no better than a tenth of the box, worst first.

    root: rows A of the data alone, (rows, P), in units of the boxes. width: of the boxes, (P,), in physical units.
    Members move along a direction by more than a twentieth of its length, or a hundredth where they owe it a quarter of
    their variance (Belsley, Kuh and Welsch 1980, variance proportions).
    """
    _, values, directions = np.linalg.svd(square(root))
    errors = 1.0 / floored(values)
    variance = (directions * errors[:, None]) ** 2
    share = variance / np.sum(variance, axis=0)
    lengths = np.linalg.norm(root, axis=0)
    alone = np.divide(width, lengths, out=np.full(len(names), math.inf), where=lengths > 0)
    found = []
    for error, direction, owed in zip(errors[::-1], directions[::-1], share[::-1], strict=True):
        if error <= UNIDENTIFIED_BEYOND:
            break
        direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
        size, least = np.abs(direction), np.where(owed > OWED, MEMBER, CERTAIN_MEMBER)
        members = [index for index in np.argsort(-size, kind="stable") if size[index] > least[index]]
        found.append(
            Direction(
                error=float(error) if error < UNKNOWN_BEYOND else math.inf,
                weights={names[index]: float(direction[index]) for index in members},
                conditional_errors={names[index]: float(alone[index]) for index in members},
            )
        )
    return tuple(found)


def floored(values: Floats) -> Floats:
    """Singular values, those lost in rounding as the smallest that are not: their inverses are large, never wrong."""
    rounding = np.finfo(values.dtype).eps * values.shape[-1] * values[..., :1]
    return np.maximum(values, np.maximum(rounding, 1.0 / LARGEST_ERROR))


def square(root: Floats) -> Floats:
    """Zero rows below a matrix with fewer rows than columns, so that every direction has its singular value."""
    missing = max(root.shape[1] - root.shape[0], 0)
    return np.vstack([root, np.zeros((missing, root.shape[1]))])
