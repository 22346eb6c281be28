"""The starts of a fit: where they begin, and where each of them ends.

A start that runs out of steps goes on for as long as that is worth something: the number of steps says nothing about
how good its end is.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array
from scipy.stats import qmc

from fits.inference.bounded import minimise_in_box
from fits.inference.levenberg_marquardt import BoxLevenbergMarquardt
from fits.inference.starts_file import End, Floats, Solver, StartsFile
from fits.problem.likelihood import total_sigma
from fits.problem.model import Model
from fits.problem.problem import Problem
from fits.progress import Progress

MOST_STEPS = 200
MOST_ROUNDS = 20
PROMISE = 1e-8
"""A likelihood fit stops when a full step promises less than this in the log-posterior: 1e-4 standard errors."""
WORTH = 1e-3
"""A start that ran out of steps goes on while a round of them gains this in the log-posterior."""
WORTH_OF_COST = 1e-6
"""The same for a named objective, as a share of the cost."""


def start_points(problem: Problem, starts: int, seed: int) -> Floats:
    """The problem's own start and `starts - 1` scrambled Sobol points, (starts, P), in the unit box."""
    own = np.asarray(problem.model.box.to_unit(jnp.asarray(problem.start)), float)[None]
    sequence = qmc.Sobol(own.shape[1], scramble=True, rng=np.random.default_rng(seed))
    return np.concatenate([own, sequence.random_base2(max(starts - 1, 1).bit_length())[: starts - 1]])


def run_starts(
    problem: Problem, points: Floats, solver: Solver, progress: Progress, kept: StartsFile | None = None
) -> list[End]:
    """Where each of the points (starts, P) in the unit box ends; those that a file has `kept` are not run again."""
    solve = least_squares_end if solver == "least_squares" else _bounded_end
    ends: list[End] = []
    for index, point in enumerate(points):
        end = None if kept is None else kept.ends.get(index)
        if end is None:
            end = solve(problem, point)
            if kept is not None:
                kept.add(index, end)
        ends.append(end)
        progress("fit", len(ends), len(points), f"best cost {min(end.cost for end in ends):.6g}")
    return ends


def least_squares_end(problem: Problem, point: Floats, fresh: bool = True) -> End:
    """Levenberg-Marquardt from a point (P,) in the unit box. Not `fresh`: near a minimum, with sigma free at once."""
    steps = 0
    end = End(point, np.inf, 0, False, True)
    for _ in range(MOST_ROUNDS):
        before = end.cost
        found = problem.call(solve_start, point, np.asarray(fresh))
        vector, cost, taken, converged, unfinished = (np.asarray(part) for part in found)
        steps += int(taken)
        end = End(vector.astype(float), float(cost), steps, bool(converged), bool(unfinished))
        worth = WORTH if problem.objective == "likelihood" else WORTH_OF_COST * end.cost
        if not end.unfinished or not before - end.cost > worth:
            break
        point, fresh = np.asarray(problem.model.box.to_unit(jnp.asarray(end.vector)), float), False
    return end


def _bounded_end(problem: Problem, point: Floats) -> End:
    unit, cost, steps, converged = minimise_in_box(problem, point)
    vector = np.asarray(problem.model.box.from_unit(jnp.asarray(unit)), float)
    return End(vector, cost if np.isfinite(cost) else np.inf, steps, converged, False)


def polished(problem: Problem, end: End) -> tuple[End, bool]:
    """The end, or what L-BFGS-B and then Levenberg-Marquardt make of it if that is lower; and whether it is.

    A check on what lies on a bound or has not converged: the two share nothing but the objective. An end that neither
    of them improves has converged if one of them says so.
    """
    unit = np.asarray(problem.model.box.to_unit(jnp.asarray(end.vector)), float)
    point, _, _, settled = minimise_in_box(problem, unit)
    other = least_squares_end(problem, point, fresh=False)
    if other.cost < end.cost - max(PROMISE, 1e-9 * abs(end.cost)):
        return other._replace(converged=other.converged or settled, steps=end.steps + other.steps), True
    return end._replace(converged=end.converged or other.converged or settled), False


def solve_start(model: Model, start: Array, fresh: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Physical vector, cost, steps, whether it converged and whether it ran out of steps, from `start` (P,)."""
    likelihood = model.objective == "likelihood"
    varying = likelihood and model.varying
    solver = BoxLevenbergMarquardt(atol=PROMISE if likelihood else 0.0)
    options = {"logarithmic": (2,)} if varying else {}

    def stage(unit: Array, fixed_sigma: Array) -> tuple[Array, tuple[Array, Array, Array, Array]]:
        solution: Any = optx.least_squares(
            lambda s, fixed: model.residuals(model.box.from_unit(s), fixed if varying else None),
            solver,
            unit,
            args=fixed_sigma,
            options=options,
            max_steps=MOST_STEPS,
            throw=False,
        )
        success = jnp.asarray(solution.result == optx.RESULTS.successful)
        unfinished = jnp.asarray(solution.result == optx.RESULTS.nonlinear_max_steps_reached)
        return solution.value, (success, unfinished, solution.stats["num_steps"], solution.stats["cost"])

    stages = jnp.full((1, 1, 1), jnp.nan)
    if varying:  # far from the data, a noise level grows until everything fits: go near it first, with sigma held
        parts = model.build(model.box.from_unit(start))
        typical = jnp.mean(jnp.abs(model.values))  # a tenth of it keeps readings near 0 from outweighing all others
        held = total_sigma(jnp.abs(model.values) + 0.1 * typical, model.variance, parts.relative, parts.floor)
        free = jnp.full_like(held, jnp.nan)
        stages = jnp.stack([jnp.where(fresh, held, free), free])
    unit, (success, unfinished, steps, costs) = jax.lax.scan(stage, start, stages)
    finite = jnp.isfinite(costs[-1])
    return (
        model.box.from_unit(unit),
        jnp.where(finite, costs[-1], jnp.inf),
        jnp.sum(steps),
        success[-1] & finite,
        unfinished[-1] & finite,
    )
