"""The starts of a fit: where they begin, where each of them ends, and the lowest followed to its very minimum.

Levenberg-Marquardt follows them, and continues a start that reaches the maximum of steps while it gains something.
L-BFGS-B of scipy, by jaxopt, shares the objective alone: it checks a minimum on a bound, or that has not converged.
"""

import warnings
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

import layerjax
from fits.data.geometry import Floats
from fits.optimise.levenberg_marquardt import COST_TOLERANCE, ROUGH_TOLERANCE, Descent, descent, evaluate_at
from fits.optimise.uncertainty import Uncertainty, scatter, uncertainty
from fits.problem.compilation import as_finished, on_all_cores
from fits.problem.model import Model
from fits.problem.problem import FittingProblem
from fits.progress import Progress
from fits.store import Store, fingerprint

MOST_STEPS, MOST_ROUNDS = 200, 20  # steps of a start in a round; and rounds, while each gains the next
LEAST_GAIN, LEAST_RELATIVE_GAIN = 1e-3, 1e-6  # in the log-posterior; for a named objective, as a share of the cost
EARLY, FRONT = 20, 3  # steps with sigma held, and free, after which starts are screened; how many are continued
LBFGSB_STEPS = 500  # after which the check by L-BFGS-B ends, or where
LEAST_STEP_GAIN = 1e-5  # a step gains less than this in the log-posterior, or
LBFGSB_TOLERANCE = 1e-12  # the gradient of a named objective is below this


def start_points(problem: FittingProblem, starts: int, seed: int) -> Floats:
    """The problem's own start and `starts - 1` scrambled Sobol points, (starts, P), in the unit box."""
    own = np.asarray(problem.model.box.to_unit(jnp.asarray(problem.start)), float)[None]
    sequence = qmc.Sobol(own.shape[1], scramble=True, rng=np.random.default_rng(seed))
    return np.concatenate([own, sequence.random_base2(max(starts - 1, 1).bit_length())[: starts - 1]])


def multi_start(
    problem: FittingProblem, points: Floats, progress: Progress, store: Store | None = None
) -> list[Descent]:
    """Where each of the points (starts, P) in the unit box ends, roughly; those that are in the store are not run."""
    every = range(len(points))
    stored = {} if store is None else {index: found for index in every if (found := store.get(f"start {index}"))}
    ends = {index: Descent(**found) for index, found in stored.items()}
    left = [index for index in every if index not in ends]
    for place, end in as_finished(partial(rough_descent, problem), points[left]):
        index = left[place]
        ends[index] = end
        if store is not None:
            store.put(f"start {index}", end._replace(gradient=None, root=None, predicted=None)._asdict())
        progress("fit", len(ends), len(points), f"best cost {min(end.cost for end in ends.values()):.6g}")
    return [ends[index] for index in every]


def starts_store(
    checkpoint: str | Path | None, problem: FittingProblem, points: Floats
) -> AbstractContextManager[Store | None]:
    """The store of the starts of a fit, if there is a path; starts of another fit that are there are thrown away."""
    if checkpoint is None:
        return nullcontext()
    arrays, static = problem.split_model
    whose = fingerprint(
        version=layerjax.__version__,
        starts=points,
        parameters=problem.names,
        model=static.tree,
        data=jax.tree.leaves(arrays),
        # a transport of the user's own may have changed its body under the same name
        predicted=evaluate_at(problem, points[0]).predicted,
    )
    return Store.open(checkpoint, whose, replace=True)


def screened_starts(problem: FittingProblem, points: Floats) -> list[Descent]:
    """Where the points (starts, P) in the unit box end if only those go on that are lowest after a few steps."""

    def early(point: Floats) -> Descent:
        return descent(problem, point, True, EARLY, ROUGH_TOLERANCE)

    def onward(end: Descent) -> Descent:
        if not end.max_steps_reached:
            return end
        further = rough_descent(problem, unit_of(problem, end.vector), fresh=False)
        return further._replace(steps=end.steps + further.steps)

    ends = [early(points[0]), *on_all_cores(early, points[1:])]  # the first alone: it compiles the program
    front = np.argsort([end.cost for end in ends])[:FRONT]
    for place, end in zip(front, on_all_cores(onward, [ends[place] for place in front]), strict=True):
        ends[place] = end
    return ends


def least_squares_descent(
    problem: FittingProblem, point: Floats, fresh: bool = True, tolerance: float = COST_TOLERANCE
) -> Descent:
    """Levenberg-Marquardt from a point (P,) in the unit box. Not `fresh`: near a minimum, with sigma free at once."""
    end = Descent(point, np.inf, 0, False, True)
    for _ in range(MOST_ROUNDS):
        before, end = end, descent(problem, point, fresh, MOST_STEPS, tolerance)
        end = end._replace(steps=before.steps + end.steps)
        least_gain = LEAST_GAIN if problem.objective == "likelihood" else LEAST_RELATIVE_GAIN * end.cost
        if not end.max_steps_reached or not before.cost - end.cost > least_gain:
            break
        point, fresh = unit_of(problem, end.vector), False
    return end


def rough_descent(problem: FittingProblem, point: Floats, fresh: bool = True) -> Descent:
    """As `least_squares_descent`, so near a minimum that it is distinguished from others."""
    return least_squares_descent(problem, point, fresh, ROUGH_TOLERANCE)


def unit_of(problem: FittingProblem, vector: Floats) -> Floats:
    """The point of the unit box, (P,), where a physical vector (P,) lies."""
    return np.asarray(problem.model.box.to_unit(jnp.asarray(vector)), float)


def lbfgsb_polish(problem: FittingProblem, end: Descent) -> tuple[Descent, bool]:
    """The end, or what L-BFGS-B and then Levenberg-Marquardt make of it if that is lower; and whether it is.

    An end that neither of them improves has converged if one of them says so.
    """

    def value_and_gradient(unit: Floats) -> tuple[float, Floats]:  # the gradient in reverse would be compiled for this
        found = evaluate_at(problem, unit)
        return found.cost, found.gradient

    enough = LEAST_STEP_GAIN / max(abs(end.cost), 1.0) if problem.objective == "likelihood" else LBFGSB_TOLERANCE
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        from jaxopt import ScipyBoundedMinimize

    solver = ScipyBoundedMinimize(
        fun=value_and_gradient,
        method="l-bfgs-b",
        value_and_grad=True,
        jit=False,  # the function is compiled already, and for all problems of this structure
        tol=enough,
        maxiter=LBFGSB_STEPS,
    )
    begin = jnp.clip(jnp.asarray(unit_of(problem, end.vector)), 0.0, 1.0)
    point, info = solver.run(begin, bounds=(jnp.zeros_like(begin), jnp.ones_like(begin)))
    settled = bool(info.success) and bool(np.isfinite(info.fun_val))
    other = least_squares_descent(problem, np.asarray(point, float), fresh=False)
    if other.cost < end.cost - max(COST_TOLERANCE, 1e-9 * abs(end.cost)):
        return other._replace(converged=other.converged or settled, steps=end.steps + other.steps), True
    return end._replace(converged=end.converged or other.converged or settled), False


# ---- the lowest end, at its very minimum ----


class Optimum(NamedTuple):
    """The outcomes of all starts, the place of the lowest among them, and what is known there.

    improved: by L-BFGS-B. predicted: (N, C), in 1/sr. excess: what differences in cost count in, see `FitOptions`.
    """

    problem: FittingProblem
    ends: list[Descent]
    best: int
    uncertainty: Uncertainty
    improved: bool
    predicted: Floats
    excess: float

    @property
    def lowest(self) -> Descent:
        """The lowest end, exactly on the bounds that hold it."""
        return self.ends[self.best]


def polish(
    problem: FittingProblem, ends: list[Descent], *, check: bool = True, tolerance: float = COST_TOLERANCE
) -> Optimum:
    """The lowest of the ends, followed to its very minimum, and checked by L-BFGS-B where it has not converged.

    check: also where a parameter lies on a bound or has no influence. It takes a hundred steps: what begins at a
    minimum that was checked goes without. tolerance: how far it is followed, see `descent`.
    """
    best, improved = int(np.argmin([end.cost for end in ends])), False
    lowest, likelihood = ends[best], problem.objective == "likelihood"
    # 1. closer to its minimum
    if likelihood and lowest.converged and tolerance < ROUGH_TOLERANCE:
        closer = least_squares_descent(problem, unit_of(problem, lowest.vector), False, tolerance)
        if closer.cost <= lowest.cost:
            lowest = closer._replace(steps=lowest.steps + closer.steps)
    found = uncertainty(problem, lowest.vector, lowest.cost)
    # 2. no step leads off a plateau, where every start may end though another minimum is far lower: insensitive
    # parameters and those at a bound begin anew
    if check and found.insensitive:
        stuck = np.isin(problem.names, found.insensitive) | found.at_bound
        point = np.where(stuck, unit_of(problem, problem.start), unit_of(problem, lowest.vector))
        other = least_squares_descent(problem, point, tolerance=tolerance)
        if other.cost < lowest.cost - (ROUGH_TOLERANCE if likelihood else LEAST_RELATIVE_GAIN * lowest.cost):
            lowest = other._replace(steps=lowest.steps + other.steps)
            found = uncertainty(problem, lowest.vector, lowest.cost)
    # 3. checked by L-BFGS-B
    if (check and found.at_bound.any()) or not lowest.converged:
        lowest, improved = lbfgsb_polish(problem, lowest)
        found = uncertainty(problem, lowest.vector, lowest.cost) if improved else found
    # 4. exactly on the bounds that hold it
    low, high, held, vector = problem.low, problem.high, found.at_bound, lowest.vector
    nearest = np.where(vector - low < high - vector, low, high)
    lowest = lowest._replace(vector=np.where(held, nearest, np.clip(vector, low, high)))
    predicted = evaluate_at(problem, unit_of(problem, lowest.vector)).predicted if held.any() else found.predicted
    # 5. the reduced chi-square where it is above 1; of a named objective, the residual variance
    freedom, excess = problem.count - len(lowest.vector), float(scatter(problem, lowest.cost, problem.count))
    if likelihood and freedom > 0:
        residuals = np.asarray(problem.call(Model.whitened_residuals_at, lowest.vector, predicted))
        excess = max(1.0, float(np.sum(residuals**2)) / freedom)
    return Optimum(problem, [*ends[:best], lowest, *ends[best + 1 :]], best, found, improved, predicted, excess)
