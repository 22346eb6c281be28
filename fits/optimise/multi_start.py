"""The starts of a fit: where they begin, and where each of them ends.

A start that reaches the maximum of steps is continued while it gains something: the number of steps says nothing
about how good its outcome is.
"""

from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

import layerjax
from fits.optimise.bounded import TOLERANCE, cost_and_gradient, minimise_in_box
from fits.optimise.descent import COST_TOLERANCE, ROUGH_TOLERANCE, descent, evaluate_at
from fits.problem.compilation import cores
from fits.problem.problem import FittingProblem
from fits.progress import Progress
from fits.store import Store, fingerprint

Solver = Literal["least_squares", "bounded"]
Floats = NDArray[np.float64]

MOST_STEPS = 200
MOST_ROUNDS = 20
EARLY, FRONT = 20, 3
"""Steps, with sigma held and with it free, after which starts are screened, and how many of them are continued."""
LEAST_GAIN = 1e-3
"""A start that reached the maximum of steps is continued while a round of them gains this in the log-posterior."""
LEAST_STEP_GAIN = 1e-5
"""The check by L-BFGS-B ends where a step of it gains less than this in the log-posterior."""
LEAST_RELATIVE_GAIN = 1e-6
"""The same for a named objective, as a share of the cost."""


class StartOutcome(NamedTuple):
    """Where one start ended: physical vector (P,), cost, steps, whether it converged, whether it reached the maximum of
    steps."""

    vector: Floats
    cost: float
    steps: int
    converged: bool
    max_steps_reached: bool


def start_points(problem: FittingProblem, starts: int, seed: int) -> Floats:
    """The problem's own start and `starts - 1` scrambled Sobol points, (starts, P), in the unit box."""
    own = np.asarray(problem.model.box.to_unit(jnp.asarray(problem.start)), float)[None]
    sequence = qmc.Sobol(own.shape[1], scramble=True, rng=np.random.default_rng(seed))
    return np.concatenate([own, sequence.random_base2(max(starts - 1, 1).bit_length())[: starts - 1]])


def multi_start(
    problem: FittingProblem, points: Floats, solver: Solver, progress: Progress, store: Store | None = None
) -> list[StartOutcome]:
    """Where each of the points (starts, P) in the unit box ends, roughly; those that are in the store are not run."""
    solve = rough_descent if solver == "least_squares" else bounded_descent
    ends: dict[int, StartOutcome] = {}

    def ended(index: int, end: StartOutcome, new: bool = True) -> None:
        ends[index] = end
        if store is not None and new:
            store.put(f"start {index}", end._asdict())
        progress("fit", len(ends), len(points), f"best cost {min(end.cost for end in ends.values()):.6g}")

    for index in range(len(points)):
        if store is not None and (stored := store.get(f"start {index}")) is not None:
            ended(index, StartOutcome(**stored), new=False)
    left = [index for index in range(len(points)) if index not in ends]
    for index in left[:1]:  # alone: it compiles the program, which keeps one core busy
        ended(index, solve(problem, points[index]))
    pool = ThreadPoolExecutor(cores())
    try:
        running = {pool.submit(solve, problem, points[index]): index for index in left[1:]}
        for future in as_completed(running):
            ended(running[future], future.result())
    finally:
        pool.shutdown(cancel_futures=True)
    return [ends[index] for index in range(len(points))]


def starts_store(
    checkpoint: str | Path, problem: FittingProblem, points: Floats, solver: Solver
) -> AbstractContextManager[Store]:
    """The store of the starts of a fit; starts of another fit that are there are thrown away."""
    arrays, static = problem.split_model
    whose = fingerprint(
        version=layerjax.__version__,
        solver=solver,
        starts=points,
        parameters=problem.names,
        model=static.tree,
        data=jax.tree.leaves(arrays),
        # a transport of the user's own may have changed its body under the same name
        predicted=evaluate_at(problem, points[0]).predicted,
    )
    return Store.open(checkpoint, whose, replace=True)


def screened_starts(problem: FittingProblem, points: Floats) -> list[StartOutcome]:
    """Where the points (starts, P) in the unit box end if only those go on that are lowest after a few steps."""

    def early(point: Floats) -> StartOutcome:
        found = descent(problem, point, True, EARLY, ROUGH_TOLERANCE)
        return StartOutcome(
            found.vector, float(found.cost), int(found.steps), bool(found.converged), bool(found.max_steps_reached)
        )

    def onward(end: StartOutcome) -> StartOutcome:
        if not end.max_steps_reached:
            return end
        further = rough_descent(problem, unit_of(problem, end.vector), fresh=False)
        return further._replace(steps=end.steps + further.steps)

    first = early(points[0])  # alone: it compiles the program, which keeps one core busy
    with ThreadPoolExecutor(cores()) as pool:
        ends = [first, *pool.map(early, points[1:])]
        front = np.argsort([end.cost for end in ends])[:FRONT]
        for place, end in zip(front, pool.map(onward, [ends[place] for place in front]), strict=True):
            ends[place] = end
    return ends


def least_squares_descent(
    problem: FittingProblem, point: Floats, fresh: bool = True, tolerance: float = COST_TOLERANCE
) -> StartOutcome:
    """Levenberg-Marquardt from a point (P,) in the unit box. Not `fresh`: near a minimum, with sigma free at once."""
    steps = 0
    end = StartOutcome(point, np.inf, 0, False, True)
    for _ in range(MOST_ROUNDS):
        before = end.cost
        found = descent(problem, point, fresh, MOST_STEPS, tolerance)
        steps += int(found.steps)
        end = StartOutcome(found.vector, float(found.cost), steps, bool(found.converged), bool(found.max_steps_reached))
        least_gain = LEAST_GAIN if problem.objective == "likelihood" else LEAST_RELATIVE_GAIN * end.cost
        if not end.max_steps_reached or not before - end.cost > least_gain:
            break
        point, fresh = unit_of(problem, end.vector), False
    return end


def rough_descent(problem: FittingProblem, point: Floats, fresh: bool = True) -> StartOutcome:
    """As `least_squares_descent`, so near a minimum that it is distinguished from others."""
    return least_squares_descent(problem, point, fresh, ROUGH_TOLERANCE)


def unit_of(problem: FittingProblem, vector: Floats) -> Floats:
    """The point of the unit box, (P,), where a physical vector (P,) lies."""
    return np.asarray(problem.model.box.to_unit(jnp.asarray(vector)), float)


def bounded_descent(problem: FittingProblem, point: Floats, fresh: bool = True) -> StartOutcome:
    """L-BFGS-B from a point (P,) in the unit box."""
    unit, cost, steps, converged = minimise_in_box(lambda s: problem.call(cost_and_gradient, s), point)
    vector = np.asarray(problem.model.box.from_unit(jnp.asarray(unit)), float)
    return StartOutcome(vector, cost if np.isfinite(cost) else np.inf, steps, converged, False)


def lbfgsb_polish(problem: FittingProblem, end: StartOutcome) -> tuple[StartOutcome, bool]:
    """The end, or what L-BFGS-B and then Levenberg-Marquardt make of it if that is lower; and whether it is.

    A check on what lies on a bound or has not converged: the two share nothing but the objective. An end that neither
    of them improves has converged if one of them says so.
    """

    def value_and_gradient(unit: Floats) -> tuple[Floats, Floats]:  # the gradient in reverse would be compiled for this
        found = evaluate_at(problem, unit)
        return found.cost, found.gradient

    enough = LEAST_STEP_GAIN / max(abs(end.cost), 1.0) if problem.objective == "likelihood" else TOLERANCE
    point, _, _, settled = minimise_in_box(value_and_gradient, unit_of(problem, end.vector), enough)
    other = least_squares_descent(problem, point, fresh=False)
    if other.cost < end.cost - max(COST_TOLERANCE, 1e-9 * abs(end.cost)):
        return other._replace(converged=other.converged or settled, steps=end.steps + other.steps), True
    return end._replace(converged=end.converged or other.converged or settled), False
