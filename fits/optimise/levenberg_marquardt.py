"""Levenberg-Marquardt within a box, on the normal equations, as an optimistix solver; and through a model.

optimistix has no bounds, and a transform to an unconstrained space sends a parameter whose best value lies on its bound
to infinity, where gradients vanish. Here the iterate stays in the box: parameters that push against a bound are held
there, the others take a damped Gauss-Newton step, and what would leave the box is put on its face (projected
Levenberg-Marquardt, Kanzow, Yamashita and Fukushima 2004). The few columns of the Jacobian are carried forward together
and only J'J and J'r are kept, which is several times faster than a QR decomposition of J when there are many more
residuals than parameters. Columns are scaled to unit length first, so that units do not matter to the damping (after
Marquardt 1963; its update after Nielsen 1999).

To compile the Jacobian of a costly transport takes longer than most fits take to run. So whatever needs it, at one
point or along many steps, calls `descend`: a descent of a single step says what is known where it begins.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array
from numpy.typing import NDArray

from fits.problem.model import Model
from fits.problem.problem import FittingProblem

Floats = NDArray[np.float64]

COST_TOLERANCE = 1e-8
"""A likelihood fit has converged when a full step is predicted to gain less than this in the log-posterior: 1e-4
standard errors."""

NEARBY = 1e-4
"""Damping near a minimum: a step is all but a full one."""

ROUGH_TOLERANCE = 1e-4
"""A hundredth of a standard error: distinguishes minima, after about a third of the steps where these gain least."""

FIRST_DAMPING = 1e-2
FIRST_GROWTH = 4.0
SMALLEST_DAMPING = 128.0  # units of rounding: keeps a singular matrix positive definite
LARGEST_DAMPING = 1e12
SMALLEST_RATIO = 1e-4
SHORTEST = 1e-7  # column of the Jacobian, of the longest one: shorter ones are damped like this
PASSES = 3


class _State(eqx.Module):
    steps: Array
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
    terminate: Array
    failed: Array


class BoxLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Minimises half the sum of squared residuals over vectors in [0, 1]^P.

    The residuals are a tree of arrays. Those whose place among its leaves is in `options["logarithmic"]` have
    logarithms L of noise levels as half their squares: dL'dL takes the place of their J'J, which makes the sum the
    Fisher information (J'J alone would overshoot up to twofold at every step).

    It stops when a full Gauss-Newton step is predicted to gain less than `options["tolerance"]` (default: `atol + rtol
    cost`), when rounding ends all progress, or after `options["most_steps"]`; it begins with `options["damping"]`. All
    of these may be traced. A start whose residuals are not finite, or a stall away from a minimum, gives
    `optx.RESULTS.nonlinear_divergence`.

    The solution has the auxiliary output at the solution, and statistics have the "cost" and its "gradient" there; as
    "watched" the Jacobian, a leading axis for the P parameters, of the part of it that `options["watch"]` picks.
    """

    rtol: float = 1e-10
    atol: float = 0.0
    norm: Callable[[Any], Array] = optx.max_norm

    def init(self, fn: Any, y: Array, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> _State:
        """State before the first evaluation."""
        zero = jnp.zeros((), y.dtype)
        auxiliary = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), aux_struct)
        watched = jax.tree.map(lambda leaf: jnp.zeros((y.size, *leaf.shape), leaf.dtype), _watch(options)(aux_struct))
        return _State(
            steps=jnp.zeros((), int),
            trial=y,
            cost=zero + jnp.inf,
            gradient=jnp.zeros_like(y),
            normal=jnp.eye(y.size, dtype=y.dtype),
            predicted=zero,
            full_decrease=zero + jnp.inf,
            damping=zero + options.get("damping", FIRST_DAMPING),
            growth=zero + FIRST_GROWTH,
            auxiliary=auxiliary,
            watched=watched,
            terminate=jnp.asarray(options.get("most_steps", 1)) < 1,
            failed=jnp.array(False),
        )

    def step(self, fn: Any, y: Array, args: Any, options: Any, state: _State, tags: Any) -> tuple[Array, _State, Any]:
        """Evaluate the trial, accept or refuse it, and propose the next one."""
        first = state.steps == 0
        cost, gradient, normal, auxiliary, watched = _normal_equations(fn, state.trial, args, options)
        finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(gradient)) & jnp.all(jnp.isfinite(normal))
        ratio = (state.cost - cost) / jnp.where(state.predicted > 0, state.predicted, 1.0)
        accept = finite & (first | (ratio > SMALLEST_RATIO))

        shrink = jnp.maximum(1.0 / 9.0, 1.0 - (2.0 * jnp.clip(ratio, 0.0, 1.0) - 1.0) ** 3)
        step_damping = jnp.where(accept, state.damping * shrink, state.damping * state.growth)
        epsilon = jnp.finfo(y.dtype).eps
        least = jnp.asarray(SMALLEST_DAMPING * epsilon, y.dtype)
        damping = jnp.maximum(jnp.where(first, state.damping, step_damping), least)
        growth = jnp.where(accept, FIRST_GROWTH, 2.0 * state.growth)

        y = jnp.where(accept, state.trial, y)
        cost, gradient, normal = (
            jnp.where(accept, new, old)
            for new, old in ((cost, state.cost), (gradient, state.gradient), (normal, state.normal))
        )
        auxiliary, watched = jax.tree.map(
            lambda new, old: jnp.where(accept, new, old), (auxiliary, watched), (state.auxiliary, state.watched)
        )
        trial, predicted, full_decrease = _projected_step(y, gradient, normal, damping, least)

        enough = options.get("tolerance", self.atol + self.rtol * cost)
        converged = full_decrease <= jnp.maximum(enough, 4 * epsilon * cost)
        lost = ~accept & (predicted > 0) & (predicted <= 4 * epsilon * cost)  # too small a decrease to be seen
        stalled = lost & (full_decrease > jnp.sqrt(epsilon) * cost)
        hopeless = stalled | (damping > LARGEST_DAMPING) | (first & ~finite)
        new_state = _State(
            steps=state.steps + 1,
            trial=trial,
            cost=cost,
            gradient=gradient,
            normal=normal,
            predicted=predicted,
            full_decrease=full_decrease,
            damping=damping,
            growth=growth,
            auxiliary=auxiliary,
            watched=watched,
            terminate=converged | lost | hopeless,
            failed=hopeless & ~converged,
        )
        return y, new_state, auxiliary

    def terminate(
        self, fn: Any, y: Array, args: Any, options: Any, state: _State, tags: Any
    ) -> tuple[Array, optx.RESULTS]:
        """Whether to stop, and why."""
        out_of_steps = state.steps >= options.get("most_steps", jnp.inf)
        short = optx.RESULTS.where(state.terminate, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached)
        result = optx.RESULTS.where(state.failed, optx.RESULTS.nonlinear_divergence, short)
        running = ~(state.terminate | out_of_steps)
        return ~running, optx.RESULTS.where(running, optx.RESULTS.successful, result)

    def postprocess(
        self, fn: Any, y: Array, aux: Any, args: Any, options: Any, state: _State, tags: Any, result: Any
    ) -> tuple[Array, Any, dict[str, Any]]:
        """The solution, and what is known there."""
        return y, state.auxiliary, {"cost": state.cost, "gradient": state.gradient, "watched": state.watched}


def _watch(options: Any) -> Callable[[Any], Any]:
    """What picks the part of the auxiliary output whose Jacobian is kept: nothing by default."""
    return options.get("watch", lambda auxiliary: None)


def _normal_equations(fn: Any, y: Array, args: Any, options: Any) -> tuple[Array, Array, Array, Any, Any]:
    """Cost, J'r and J'J at y, with J'J replaced for the `logarithmic` arrays of residuals; the auxiliary output, and
    the Jacobian of what is watched of it."""
    logarithmic, watch = options.get("logarithmic", ()), _watch(options)

    def push(tangent: Array) -> tuple[Any, Any, Any, Any]:
        (residuals, auxiliary), (tangents, moved) = jax.jvp(lambda z: fn(z, args), (y,), (tangent,))
        return residuals, auxiliary, tangents, watch(moved)

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
    """The next trial in the box, the decrease that the quadratic model predicted decrease there, and the most it could
    predicted decrease.

    The last belongs to the undamped step of all parameters that are not held, as if there were no box, but no more than
    the slope gives on the way to the faces of the box: it bounds what is left to gain.
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
