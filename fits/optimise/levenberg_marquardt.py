"""Levenberg-Marquardt within a box, on the normal equations, as an optimistix solver; and through a model.

optimistix has no bounds, and a transform to an unconstrained space sends a parameter whose best value lies on its bound
to infinity, where gradients vanish. Here the iterate stays in the box: parameters that push against a bound are held
there, the others take a damped Gauss-Newton step, and what would leave the box is put on its face (projected
Levenberg-Marquardt, Kanzow, Yamashita and Fukushima 2004). The few columns of the Jacobian are carried forward together
and only J'J and J'r are kept, which is several times faster than a QR decomposition of J when there are many more
residuals than parameters. Columns are scaled to unit length first, so that units do not matter to the damping (after
Marquardt 1963; its update after Nielsen 1999).

To compile the Jacobian of a costly transport takes longer than most fits take to run. So it is a program by itself,
which fits with and without discrepancy share, and the others see the model as linear at a trial (`Problem.linearise`).
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from fits.data.geometry import Floats
from fits.problem.compilation import one_thread
from fits.problem.model import Linearisation
from fits.problem.problem import FittingProblem

COST_TOLERANCE = 1e-8  # converged: a full step would gain less in the log-posterior, 1e-4 standard errors
RELATIVE_TOLERANCE = 1e-10  # or without a likelihood less than this share of the cost
ROUGH_TOLERANCE = 1e-4  # a hundredth of a standard error: distinguishes minima, after about a third of the steps

NEARBY = 1e-4  # damping near a minimum: a step is all but a full one
FIRST_DAMPING = 1e-2
FIRST_GROWTH = 4.0
SMALLEST_DAMPING = 128.0  # units of rounding: keeps a singular matrix positive definite
LARGEST_DAMPING = 1e12
SMALLEST_RATIO = 1e-4
SHORTEST = 1e-7  # column of the Jacobian, of the longest one: shorter ones are damped like this
PASSES = 3


class State(eqx.Module):
    """Where a descent in the unit box [0, 1]^P has come to after `steps` trials.

    point: (P,), the best so far, with what is known there: cost, gradient (P,) and normal matrix (P, P), the auxiliary
    output of the residuals, and the Jacobian of what is watched, a leading axis for the parameters.
    trial: (P,), what is tried next, to gain `predicted` in the cost; full_decrease: more cannot be gained.
    ended: nothing is left to gain, or no step gains anything; failed: no step does though something is left, or the
    start has residuals that are not finite.
    """

    steps: Array
    point: Array
    trial: Array
    cost: Array
    gradient: Array
    normal: Array
    predicted: Array
    full_decrease: Array
    damping: Array
    growth: Array
    auxiliary: Any
    watched: Any
    ended: Array
    failed: Array


def first_state(point: Array, damping: Array, auxiliary: Any, watched: Any = None) -> State:
    """Before the first trial, which is the point itself; auxiliary, watched: of the shapes that they will have."""
    zero, no = jnp.zeros((), point.dtype), jnp.array(False)
    return State(
        steps=jnp.zeros((), int),
        point=point,
        trial=point,
        cost=zero + jnp.inf,
        gradient=jnp.zeros_like(point),
        normal=jnp.eye(point.size, dtype=point.dtype),
        predicted=zero,
        full_decrease=zero + jnp.inf,
        damping=zero + damping,
        growth=zero + FIRST_GROWTH,
        auxiliary=auxiliary,
        watched=watched,
        ended=no,
        failed=no,
    )


def step(
    residuals: Callable[[Array], tuple[Any, Any, Any]],
    state: State,
    tolerance: Array | float | None = None,
    logarithmic: tuple[int, ...] = (),
) -> State:
    """Evaluate the trial, accept or refuse it, and propose the next one.

    residuals: of a point, a tree of arrays, half whose sum of squares is the cost; an auxiliary output; and one whose
        Jacobian is kept, or None.
    tolerance: it ends when a full Gauss-Newton step is predicted to gain less; None: `RELATIVE_TOLERANCE` of the cost.
    logarithmic: places among the leaves of the residuals of those that have logarithms L of noise levels as half their
        squares: dL'dL takes the place of their J'J, which makes the sum the Fisher information (J'J alone would
        overshoot up to twofold at every step).
    """
    first = state.steps == 0
    at_trial = _normal_equations(residuals, state.trial, logarithmic)
    cost, gradient, normal = at_trial[:3]
    finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(gradient)) & jnp.all(jnp.isfinite(normal))
    ratio = (state.cost - cost) / jnp.where(state.predicted > 0, state.predicted, 1.0)
    accept = finite & (first | (ratio > SMALLEST_RATIO))

    shrink = jnp.maximum(1.0 / 9.0, 1.0 - (2.0 * jnp.clip(ratio, 0.0, 1.0) - 1.0) ** 3)
    next_damping = jnp.where(accept, state.damping * shrink, state.damping * state.growth)
    epsilon = jnp.finfo(cost.dtype).eps
    least = jnp.asarray(SMALLEST_DAMPING * epsilon, cost.dtype)
    damping = jnp.maximum(jnp.where(first, state.damping, next_damping), least)

    before = state.point, state.cost, state.gradient, state.normal, state.auxiliary, state.watched
    point, cost, gradient, normal, auxiliary, watched = jax.tree.map(
        lambda new, old: jnp.where(accept, new, old), (state.trial, *at_trial), before
    )
    trial, predicted, full_decrease = _projected_step(point, gradient, normal, damping, least)

    enough = RELATIVE_TOLERANCE * cost if tolerance is None else tolerance
    converged = full_decrease <= jnp.maximum(enough, 4 * epsilon * cost)
    lost = ~accept & (predicted > 0) & (predicted <= 4 * epsilon * cost)  # too small a decrease to be seen
    stalled = lost & (full_decrease > jnp.sqrt(epsilon) * cost)
    hopeless = stalled | (damping > LARGEST_DAMPING) | (first & ~finite)
    return State(
        steps=state.steps + 1,
        point=point,
        trial=trial,
        cost=cost,
        gradient=gradient,
        normal=normal,
        predicted=predicted,
        full_decrease=full_decrease,
        damping=damping,
        growth=jnp.where(accept, FIRST_GROWTH, 2.0 * state.growth),
        auxiliary=auxiliary,
        watched=watched,
        ended=converged | lost | hopeless,
        failed=hopeless & ~converged,
    )


class BoxLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """`step` as a solver of optimistix, for vectors in the unit box.

    The auxiliary output of the function is a pair; of its second part the Jacobian is kept, in the state.
    Its options are the arguments of `step`, "damping" at the start, and "most_steps". A start that is not finite, or a
    stall away from a minimum, gives `optx.RESULTS.nonlinear_divergence`. Statistics have the last `State` as "state".
    """

    rtol: float = RELATIVE_TOLERANCE
    atol: float = 0.0
    norm: Callable[[Any], Array] = optx.max_norm

    def init(self, fn: Any, y: Array, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> State:
        """State before the first evaluation."""
        auxiliary = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), aux_struct)
        watched = jax.tree.map(lambda leaf: jnp.zeros((y.size, *leaf.shape), leaf.dtype), aux_struct[1])
        return first_state(y, options.get("damping", FIRST_DAMPING), auxiliary, watched)

    def step(self, fn: Any, y: Array, args: Any, options: Any, state: State, tags: Any) -> tuple[Array, State, Any]:
        """One evaluation, at the trial."""

        def residuals(point: Array) -> tuple[Any, Any, Any]:
            found, auxiliary = fn(point, args)
            return found, auxiliary, auxiliary[1]

        state = step(residuals, state, options.get("tolerance"), options.get("logarithmic", ()))
        return state.point, state, state.auxiliary

    def terminate(
        self, fn: Any, y: Array, args: Any, options: Any, state: State, tags: Any
    ) -> tuple[Array, optx.RESULTS]:
        """Whether to stop, and why."""
        running = ~(state.ended | (state.steps >= options.get("most_steps", jnp.inf)))
        short = optx.RESULTS.where(state.ended, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached)
        result = optx.RESULTS.where(state.failed, optx.RESULTS.nonlinear_divergence, short)
        return ~running, optx.RESULTS.where(running, optx.RESULTS.successful, result)

    def postprocess(
        self, fn: Any, y: Array, aux: Any, args: Any, options: Any, state: State, tags: Any, result: Any
    ) -> tuple[Array, Any, dict[str, Any]]:
        """The solution, and what is known there."""
        return y, state.auxiliary, {"state": state}


def _normal_equations(
    residuals_of: Callable[[Array], tuple[Any, Any, Any]], y: Array, logarithmic: tuple[int, ...]
) -> tuple[Array, Array, Array, Any, Any]:
    """Cost, J'r and J'J at y, the auxiliary output, and the Jacobian of what is watched; see `step`."""

    def push(tangent: Array) -> tuple[Any, Any, Any, Any]:
        (residuals, auxiliary, _), (tangents, _, moved) = jax.jvp(residuals_of, (y,), (tangent,))
        return residuals, auxiliary, tangents, moved

    residuals, auxiliary, columns, watched = jax.vmap(push, out_axes=(None, None, 0, 0))(jnp.eye(y.size, dtype=y.dtype))
    cost, gradient, normal = jnp.zeros((), y.dtype), jnp.zeros_like(y), jnp.zeros((y.size, y.size), y.dtype)
    for index, (residual, column) in enumerate(zip(jax.tree.leaves(residuals), jax.tree.leaves(columns), strict=True)):
        flat, rows = residual.reshape(-1), column.reshape(y.size, -1)
        cost += 0.5 * jnp.vdot(flat, flat)
        gradient += rows @ flat
        if index in logarithmic:  # half the square of r is a logarithm L, whose derivative is r dr
            rows = rows * flat
        normal += rows @ rows.T
    return cost, gradient, normal, auxiliary, watched


def _projected_step(
    y: Array, gradient: Array, normal: Array, damping: Array, least: Array
) -> tuple[Array, Array, Array]:
    """The next trial in the box, the decrease that the quadratic model predicts there, and the most that can be gained.

    The last belongs to the undamped step of all parameters that are not held, as if there were no box, but is no more
    than the slope gives on the way to the faces of the box.
    """
    length = jnp.sqrt(jnp.diagonal(normal))
    # a parameter of hardly any influence would take a step as wide as the box for next to no gain, however damped
    short = length < SHORTEST * jnp.max(length)
    length = jnp.where(short, SHORTEST * jnp.max(length), length)
    scale = jnp.where(length > 0, 1.0 / jnp.where(length > 0, length, 1.0), 1.0)
    matrix = normal * scale[:, None] * scale[None, :]
    slope = gradient * scale
    held = ((y <= 0) & (gradient >= 0)) | ((y >= 1) & (gradient <= 0))
    none = jnp.zeros_like(y)
    weak = held | short
    full_decrease = -0.5 * jnp.vdot(jnp.where(weak, 0.0, slope), _damped_solve(matrix, slope, none, weak, least))
    slack = jnp.where(held, 0.0, jnp.abs(gradient) * jnp.where(gradient > 0, y, 1.0 - y))
    full_decrease = jnp.minimum(full_decrease + jnp.sum(jnp.where(short, slack, 0.0)), jnp.sum(slack))
    stopped, inside = held, none
    for _ in range(PASSES):  # what leaves the box stops at its face; the others are solved for again with that known
        step = _damped_solve(matrix, slope, inside / scale, stopped, damping) * scale
        inside = jnp.clip(y + step, 0.0, 1.0) - y
        stopped = stopped | (inside != step)
    step = jnp.clip(y + step, 0.0, 1.0) - y
    return y + step, -(jnp.vdot(gradient, step) + 0.5 * step @ normal @ step), full_decrease


def _damped_solve(matrix: Array, slope: Array, known: Array, fixed: Array, damping: Array) -> Array:
    """Minimiser of the damped quadratic model over the entries that are not fixed; the fixed ones are `known`."""
    known = jnp.where(fixed, known, 0.0)
    free = ~fixed
    reduced = jnp.where(free[:, None] & free[None, :], matrix, 0.0)
    reduced = reduced + jnp.diag(jnp.where(fixed, 1.0, damping + jnp.where(jnp.diagonal(matrix) > 0, 0.0, 1.0)))
    target = jnp.where(free, -(slope + matrix @ known), known)
    return jax.scipy.linalg.solve(reduced, target, assume_a="pos")


# ---- through a model ----


class Descent(NamedTuple):
    """Where a descent ended, and what is known there of a model with P parameters.

    vector: physical, (P,). cost: infinite where the model has no finite value and Jacobian. steps: in all.
    gradient: of the cost in the unit box, (P,). root: (P, P), its root' root is the information in the data, in
    boxes^-2. predicted: (N, C), in 1/sr, NaN with an infinite cost. These are None of an end that was stored.
    """

    vector: Floats
    cost: float
    steps: int
    converged: bool
    max_steps_reached: bool
    gradient: Any = None
    root: Any = None
    predicted: Any = None


def descent(
    problem: FittingProblem, start: Floats, fresh: bool, most_steps: int, tolerance: float = COST_TOLERANCE
) -> Descent:
    """Levenberg-Marquardt from `start` (P,) in the unit box, until a full step is predicted to gain less than
    `tolerance` in the log-posterior. Not `fresh`: near a minimum, all levels free. Numbers in double precision."""
    with one_thread():  # over all steps: to set it takes longer than to count it
        state, vector, sigma = problem.call(_initial, start, np.asarray(fresh))
        known, steps = problem.linearise(vector), 0
        # far from the data, a level grows until everything fits: go near it first, with sigma held
        rough = fresh and _varying(problem.model)
        while True:
            trial = state.trial
            state, vector, next_vector = problem.call(
                _advance, state, known, sigma, np.asarray(rough), np.asarray(tolerance)
            )
            if not (state.ended or int(state.steps) >= most_steps):
                known = problem.linearise(next_vector)
                continue
            steps += int(state.steps)
            if not rough:
                return _end(state, vector, steps)
            rough = False
            if not np.array_equal(state.point, trial):
                known = problem.linearise(vector)
            state, *_ = problem.call(_initial, state.point, np.asarray(fresh))


def _varying(model: Any) -> bool:
    """Whether levels of noise are fitted."""
    return model.objective == "likelihood" and bool(model.logarithmic)


def _initial(model: Any, unit: Array, fresh: Array) -> tuple[State, Array, Array]:
    """Before the first step from a point, the physical vector (P,) there, and the sigma that is held on the way from
    it; NaN: its own."""
    vector = model.box.from_unit(unit)
    held = model.objective == "likelihood" and model.varying
    predicted, rows = jax.eval_shape(model.linearised(model.nothing_known).linear_parts, vector)[1]
    auxiliary = jnp.zeros(predicted.shape, predicted.dtype), jnp.zeros(rows.shape, rows.dtype)
    watched = jnp.zeros((unit.size, *rows.shape), rows.dtype)
    state = first_state(unit, jnp.where(fresh, FIRST_DAMPING, NEARBY), auxiliary, watched)
    return state, vector, model.initial_sigma(vector) if held else jnp.full((1, 1), jnp.nan)


def _advance(
    model: Any, state: State, known: list[Linearisation], sigma: Array, rough: Array, tolerance: Array
) -> tuple[State, Array, Array]:
    """A step by what is known at its trial; and the physical vectors, (P,), of the best point and the next trial."""
    near, varying = model.linearised(known), _varying(model)
    first_step = (jnp.where(rough, sigma, jnp.nan), jnp.where(rough, 0.0, 1.0)) if varying else None
    options = {
        "tolerance": tolerance if model.objective == "likelihood" else None,
        "logarithmic": model.logarithmic if varying else (),
    }

    def residuals(unit: Array, _: None) -> Any:
        return near.linear_parts(model.box.from_unit(unit), first_step)

    _, state, _ = BoxLevenbergMarquardt().step(residuals, state.point, None, options, state, frozenset())
    return state, model.box.from_unit(state.point), model.box.from_unit(state.trial)


def _end(state: State, vector: Array, steps: int) -> Descent:
    """What is known where a descent ended, at a physical vector (P,)."""
    finite = bool(np.isfinite(state.cost))
    predicted = np.asarray(state.auxiliary[0], float)
    return Descent(
        vector=np.asarray(vector, float),
        cost=float(state.cost) if finite else math.inf,
        steps=steps,
        converged=bool(state.ended) and not state.failed and finite,
        max_steps_reached=not state.ended and finite,
        gradient=np.asarray(state.gradient, float),
        # R of the QR decomposition has A's singular values without squaring its condition number
        root=np.linalg.qr(np.asarray(state.watched, float).T, mode="r"),
        predicted=predicted if finite else np.full(predicted.shape, math.nan),
    )


def evaluate_at(problem: FittingProblem, unit: Floats) -> Descent:
    """What is known at a point (P,) of the unit box; its vector is this point."""
    return descent(problem, unit, False, 1)
