"""Levenberg-Marquardt through a model, as the one compiled program that all uses of its Jacobian share.

To compile the Jacobian of a costly transport takes longer than most fits take to run. So whatever needs it, at one
point or along many steps, calls `descend`: a descent of a single step says what is known where it begins.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array
from numpy.typing import NDArray

from fits.optimise.levenberg_marquardt import FIRST_DAMPING, BoxLevenbergMarquardt
from fits.problem.model import Model
from fits.problem.problem import FittingProblem

COST_TOLERANCE = 1e-8
"""A likelihood fit has converged when a full step is predicted to gain less than this in the log-posterior: 1e-4
standard errors."""

NEARBY = 1e-4
"""Damping near a minimum: a step is all but a full one."""

ROUGH_TOLERANCE = 1e-4
"""A hundredth of a standard error: distinguishes minima, after about a third of the steps where these gain least."""

Floats = NDArray[np.float64]


class Descent(NamedTuple):
    """Where a descent ended, and what is known there of a model with P parameters: arrays of JAX or of numpy.

    vector: physical, (P,). cost: infinite where the model has no finite value and Jacobian. steps: in all. converged,
    max_steps_reached: whether it did, and whether it reached the maximum of steps. gradient: of the cost in the unit
    box, (P,). root: (P, P), its root' root is the information in the data, in boxes^-2. predicted: (N, C), in 1/sr, NaN
    with an infinite cost.
    """

    vector: Any
    cost: Any
    steps: Any
    converged: Any
    max_steps_reached: Any
    gradient: Any
    root: Any
    predicted: Any


def descend(model: Model, start: Array, fresh: Array, most_steps: Array, tolerance: Array) -> Descent:
    """Levenberg-Marquardt from `start` (P,) in the unit box, until a full step is predicted to gain less than
    `tolerance` in the log-posterior. Not `fresh`: near a minimum, all levels free."""
    likelihood = model.objective == "likelihood"
    varying = likelihood and bool(model.logarithmic)
    solver, damping = BoxLevenbergMarquardt(), jnp.where(fresh, FIRST_DAMPING, NEARBY)
    options = {
        "watch": lambda auxiliary: auxiliary[1],
        "damping": damping,
        **({"tolerance": tolerance} if likelihood else {}),
    }
    options |= {"logarithmic": model.logarithmic} if varying else {}

    def residuals(unit: Array, first_step: tuple[Array, Array]) -> Any:
        return model.linear_parts(model.box.from_unit(unit), first_step if varying else None)

    def stage(unit: Array, held: tuple[Array, Array, Array]) -> tuple[Array, Descent]:
        *first_step, most = held
        solution: Any = optx.least_squares(
            residuals,
            solver,
            unit,
            args=tuple(first_step),
            has_aux=True,
            options={**options, "most_steps": most},
            max_steps=None,
            throw=False,
        )
        found = Descent(
            vector=model.box.from_unit(solution.value),
            cost=solution.stats["cost"],
            steps=solution.stats["num_steps"],
            converged=jnp.asarray(solution.result == optx.RESULTS.successful),
            max_steps_reached=jnp.asarray(solution.result == optx.RESULTS.nonlinear_max_steps_reached),
            gradient=solution.stats["gradient"],
            # R of the QR decomposition has A's singular values without squaring its condition number
            root=jnp.linalg.qr(solution.stats["watched"].T, mode="r"),
            predicted=solution.aux[0],
        )
        return solution.value, found

    sigmas, most, shared = jnp.full((1, 1, 1), jnp.nan), most_steps[None], jnp.ones(1)
    if varying:  # far from the data, a level grows until everything fits: go near it first, with sigma held
        sigmas, most, shared = (
            jnp.stack([sigmas[0]] * 2),
            jnp.stack([jnp.where(fresh, most_steps, 0), most_steps]),
            jnp.arange(2.0),
        )
    if likelihood and model.varying:
        held = model.initial_sigma(model.box.from_unit(start))
        sigmas = jnp.stack([held, jnp.full_like(held, jnp.nan)])
    _, stages = jax.lax.scan(stage, start, (sigmas, shared, most))
    last = jax.tree.map(lambda part: part[-1], stages)
    finite = jnp.isfinite(last.cost)
    return last._replace(
        cost=jnp.where(finite, last.cost, jnp.inf),
        steps=jnp.sum(stages.steps),
        converged=last.converged & finite,
        max_steps_reached=last.max_steps_reached & finite,
        predicted=jnp.where(finite, last.predicted, jnp.nan),
    )


def descent(
    problem: FittingProblem, start: Floats, fresh: bool, most_steps: int, tolerance: float = COST_TOLERANCE
) -> Descent:
    """`descend`, compiled once for all problems of this structure; numbers in double precision."""
    found = problem.call(descend, start, np.asarray(fresh), np.asarray(most_steps), np.asarray(tolerance))
    return Descent(*(np.asarray(part, float if jnp.issubdtype(part.dtype, jnp.floating) else None) for part in found))


def evaluate_at(problem: FittingProblem, unit: Floats) -> Descent:
    """What is known at a point (P,) of the unit box; its vector is this point."""
    return descent(problem, unit, False, 1)
