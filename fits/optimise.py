"""Fitting: many starts through one compiled program, then what the best minimum is worth."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array
from numpy.typing import ArrayLike, NDArray
from scipy.stats import qmc

from fits.bounded import minimise_in_box
from fits.fit_result import Fit, Minimum
from fits.levenberg_marquardt import BoxLevenbergMarquardt
from fits.likelihood import Noise, Objective, total_sigma
from fits.measurements import Measurements
from fits.parameters import Free
from fits.problem import Model, Problem, Transport
from fits.progress import Progress
from fits.uncertainty import Uncertainty, uncertainty

Solver = Literal["least_squares", "bounded"]
Floats = NDArray[np.float64]

BATCH = 8
MOST_STEPS = 200
PROMISE = 1e-8
"""A likelihood fit stops when a full step promises less than this in the log-posterior: 1e-4 standard errors."""
SAME_BOX, SAME_ERRORS, SAME_AT_MOST = 1e-3, 0.5, 0.05
"""Ends of two starts are one minimum if no parameter differs by more than a thousandth of its box plus half its
standard error, the error counted up to a twentieth of the box."""
EQUALLY_WELL = 2.0
"""Minima explain the data equally well if their log-posteriors differ by less than this, times the reduced chi-square
where that is above 1."""


class Ends(NamedTuple):
    """Where K starts ended: physical vectors (K, P), cost (K,), steps (K,), and whether each converged (K,)."""

    vectors: Floats
    cost: Floats
    steps: NDArray[np.int64]
    converged: NDArray[np.bool_]


class Repeats(NamedTuple):
    """Fits of K data sets: vectors and standard errors (K, P), cost and convergence (K,)."""

    vectors: Floats
    standard_errors: Floats
    cost: Floats
    converged: NDArray[np.bool_]


def fit(
    stack: Any,
    data: Measurements,
    *,
    transport: Transport = "auto",
    noise: Noise | None = None,
    scale: float | Free | None = None,
    objective: Objective = "likelihood",
    starts: int = 32,
    seed: int = 0,
    solver: Solver = "least_squares",
    progress: Progress | None = None,
) -> Fit:
    """Find the parameters of `stack` that explain `data` best, and how well the data determine them.

    Args:
        stack: holds `Free` where a number is to be fitted.
        data: only the samples that its mask leaves in are used.
        transport, noise, scale, objective: see `Problem`.
        starts: at least 1: the `Free.start` values, then scrambled Sobol points of the box (in the logarithm for
            parameters with a `LogNormal` or `LogUniform` prior), drawn with `seed`.
        solver: "least_squares" (Levenberg-Marquardt, checked with L-BFGS-B where a parameter ends on a bound), or
            "bounded" (L-BFGS-B throughout).
        progress: called with ("fit", starts done, starts, note).

    Raises:
        ValueError: as `Problem`; starts < 1; an unknown solver.
    """
    problem = Problem(stack, data, transport, Noise() if noise is None else noise, scale, objective)
    return fit_problem(problem, starts=starts, seed=seed, solver=solver, progress=progress)


def fit_problem(
    problem: Problem,
    *,
    starts: int = 32,
    seed: int = 0,
    solver: Solver = "least_squares",
    progress: Progress | None = None,
) -> Fit:
    """`fit` for a problem that is already put together."""
    if starts < 1:
        raise ValueError(f"starts is {starts}; it must be at least 1")
    if solver not in get_args(Solver):
        raise ValueError(f"solver is {solver!r}; it must be one of {', '.join(get_args(Solver))}")
    points = start_points(problem, starts, seed)
    run = _least_squares if solver == "least_squares" else _bounded
    ends = run(problem, points, progress or _silent)
    best = _lowest(ends)
    vector, cost = ends.vectors[best], float(ends.cost[best])
    notes: list[str] = []
    found = uncertainty(problem, vector, cost)
    if solver == "least_squares" and (found.at_bound.any() or not ends.converged[best]):
        vector, cost, improved = _check_with_bounded(problem, vector, cost)
        notes += ["L-BFGS-B improved on Levenberg-Marquardt"] if improved else []
        found = uncertainty(problem, vector, cost) if improved else found
        ends.cost[best] = cost
        ends.converged[best] |= improved
    vector = _on_bounds(problem, vector, found.at_bound)
    ends.vectors[best] = vector
    minima = _minima(problem, ends, found)
    at_bound = tuple(name for name, held in zip(problem.names, found.at_bound, strict=True) if held)
    converged = bool(ends.converged[best])
    result = Fit(
        problem=problem,
        vector=vector,
        errors=found.standard_errors,
        covariance=found.covariance,
        cost=cost,
        at_bound=at_bound,
        converged=converged,
        status=_status(problem, ends, minima, at_bound, converged, found, notes),
        iterations=int(ends.steps[best]),
        condition_number=found.condition_number,
        unresolved=found.unresolved,
        minima=minima,
        alternatives=(),
    )
    slack = EQUALLY_WELL * max(1.0, result.reduced_chi_square if result.degrees_of_freedom > 0 else 1.0)
    if not result.is_posterior:  # in units of the residual variance
        slack = EQUALLY_WELL * 2.0 * cost / max(result.degrees_of_freedom, 1)
    return replace(result, alternatives=tuple(minimum for minimum in minima[1:] if minimum.cost - cost < slack))


def fit_many(problem: Problem, values: ArrayLike, *, starts: int = 1, seed: int = 0) -> Repeats:
    """Fit K data sets (K, N, C) in the place of the problem's used values, in one compiled program.

    Each is the best of `starts` starts, as in `fit`. Standard errors are those of the unbounded optimum: they mean
    nothing for parameters that end on a bound.
    """
    values = np.asarray(values, float)
    expected = problem.model.values.shape
    if values.ndim != 3 or values.shape[1:] != expected:
        raise ValueError(f"values has shape {values.shape}; it must be (K, {expected[0]}, {expected[1]})")
    points = start_points(problem, starts, seed)
    # a fit keeps one core busy: equal shares (the last one padded) of one program, the first of which compiles it
    workers = max(1, min(os.cpu_count() or 1, len(values)))
    share = -(-len(values) // (4 * workers)) if workers > 1 else len(values)
    firsts = range(0, len(values), share)

    def solve(first: int) -> list[NDArray[Any]]:
        part = values[first : first + share]
        padded = np.concatenate([part, np.repeat(part[-1:], share - len(part), axis=0)])
        return [np.asarray(result)[: len(part)] for result in problem.call(_solve_repeats, points, padded)]

    with ThreadPoolExecutor(workers) as pool:
        shares = [solve(firsts[0]), *pool.map(solve, firsts[1:])]
    return Repeats(*map(np.concatenate, zip(*shares, strict=True)))


def start_points(problem: Problem, starts: int, seed: int) -> Floats:
    """The problem's own start and `starts - 1` scrambled Sobol points, (starts, P), in the unit box."""
    own = np.asarray(problem.model.box.to_unit(jnp.asarray(problem.start)), float)[None]
    sequence = qmc.Sobol(own.shape[1], scramble=True, rng=np.random.default_rng(seed))
    return np.concatenate([own, sequence.random_base2(max(starts - 1, 1).bit_length())[: starts - 1]])


def _least_squares(problem: Problem, points: Floats, progress: Progress) -> Ends:
    size = min(BATCH, len(points))
    batches = []
    for first in range(0, len(points), size):
        batch = points[first : first + size]
        padded = np.concatenate([batch, np.repeat(batch[-1:], size - len(batch), axis=0)])
        ends = problem.call(_solve_batch, padded)
        batches.append([np.asarray(part)[: len(batch)] for part in ends])
        done = first + len(batch)
        progress("fit", done, len(points), f"best cost {np.nanmin([np.nanmin(b[1]) for b in batches]):.6g}")
    vectors, cost, steps, converged = (np.concatenate(parts) for parts in zip(*batches, strict=True))
    return Ends(vectors.astype(float), cost.astype(float), steps, converged)


def _bounded(problem: Problem, points: Floats, progress: Progress) -> Ends:
    ends = []
    for done, point in enumerate(points, start=1):
        ends.append(minimise_in_box(problem, point))
        progress("fit", done, len(points), f"best cost {min(end[1] for end in ends):.6g}")
    units, cost, steps, converged = (np.asarray(part) for part in zip(*ends, strict=True))
    vectors = jax.vmap(problem.model.box.from_unit)(jnp.asarray(units))
    return Ends(np.array(vectors, float), np.where(np.isfinite(cost), cost, np.inf), steps, converged)


def _solve(model: Model, start: Array) -> tuple[Array, Array, Array, Array]:
    likelihood = model.objective == "likelihood"
    varying = likelihood and model.varying
    solver = BoxLevenbergMarquardt(atol=PROMISE if likelihood else 0.0)
    options = {"logarithmic": (2,)} if varying else {}

    def stage(unit: Array, fixed_sigma: Array) -> tuple[Array, tuple[Array, Array, Array]]:
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
        return solution.value, (success, solution.stats["num_steps"], solution.stats["cost"])

    stages = jnp.full((1, 1, 1), jnp.nan)
    if varying:  # far from the data, a noise level grows until everything fits: go near it first, with sigma held
        parts = model.build(model.box.from_unit(start))
        typical = jnp.mean(jnp.abs(model.values))  # a tenth of it keeps readings near 0 from outweighing all others
        held = total_sigma(jnp.abs(model.values) + 0.1 * typical, model.variance, parts.relative, parts.floor)
        stages = jnp.stack([held, jnp.full_like(held, jnp.nan)])
    unit, (success, steps, costs) = jax.lax.scan(stage, start, stages)
    cost = costs[-1]
    return (
        model.box.from_unit(unit),
        jnp.where(jnp.isfinite(cost), cost, jnp.inf),
        jnp.sum(steps),
        success[-1] & jnp.isfinite(cost),
    )


def _solve_batch(model: Model, starts: Array) -> tuple[Array, Array, Array, Array]:
    return jax.lax.map(lambda start: _solve(model, start), starts)


def _solve_repeats(model: Model, starts: Array, values: Array) -> tuple[Array, Array, Array, Array]:
    def one(row: Array) -> tuple[Array, Array, Array, Array]:
        repeat = eqx.tree_at(lambda m: m.values, model, row)
        vectors, costs, _, success = _solve_batch(repeat, starts)
        best = jnp.argmin(jnp.where(success, costs, jnp.inf))
        vector, cost, converged = vectors[best], costs[best], success[best]
        rows, prior_rows, _ = jax.jacfwd(repeat.information_rows)(vector)
        width = model.box.slope(vector)
        rows, prior_rows = rows * width, prior_rows * width
        covariance = jnp.linalg.pinv(rows.T @ rows + prior_rows.T @ prior_rows, hermitian=True)
        if model.objective != "likelihood":
            covariance = covariance * 2.0 * cost / max(rows.shape[0] - vector.size, 1)
        return vector, jnp.sqrt(jnp.diagonal(covariance)) * width, cost, converged

    return jax.lax.map(one, values)


def _lowest(ends: Ends) -> int:
    """The cheapest start that converged; failing any, the cheapest."""
    cost = np.where(ends.converged, ends.cost, np.inf)
    return int(np.argmin(cost if np.isfinite(cost).any() else ends.cost))


def _check_with_bounded(problem: Problem, vector: Floats, cost: float) -> tuple[Floats, float, bool]:
    unit = np.asarray(problem.model.box.to_unit(jnp.asarray(vector)), float)
    point, _, _, _ = minimise_in_box(problem, unit)
    vectors, costs, _, converged = (np.asarray(part) for part in problem.call(_solve_batch, point[None]))
    if converged[0] and costs[0] < cost - max(PROMISE, 1e-9 * abs(cost)):
        return vectors[0], float(costs[0]), True
    return vector, cost, False


def _on_bounds(problem: Problem, vector: Floats, held: NDArray[np.bool_]) -> Floats:
    """Exact bounds where the solver ended on them."""
    nearest = np.where(vector - problem.low < problem.high - vector, problem.low, problem.high)
    return np.where(held, nearest, np.clip(vector, problem.low, problem.high))


def _minima(problem: Problem, ends: Ends, found: Uncertainty) -> tuple[Minimum, ...]:
    """The distinct ends of the starts that converged (of all, if none did), best first."""
    kept = np.flatnonzero(ends.converged if ends.converged.any() else np.isfinite(ends.cost))
    kept = kept if kept.size else np.array([_lowest(ends)])
    kept = kept[np.argsort(ends.cost[kept], kind="stable")]
    units = np.asarray(jax.vmap(problem.model.box.to_unit)(jnp.asarray(ends.vectors)))
    width = np.asarray(problem.model.box.slope(jnp.asarray(ends.vectors[kept[0]])))
    spread = np.nan_to_num(found.standard_errors / width, nan=0.0, posinf=SAME_AT_MOST)
    same = SAME_BOX + SAME_ERRORS * np.minimum(spread, SAME_AT_MOST)
    leaders: list[int] = []
    counts: list[int] = []
    for index in kept:
        near = [place for place, other in enumerate(leaders) if np.all(np.abs(units[index] - units[other]) <= same)]
        if near:
            counts[near[0]] += 1
        else:
            leaders.append(int(index))
            counts.append(1)
    return tuple(
        Minimum(
            values=dict(zip(problem.names, map(float, ends.vectors[leader]), strict=True)),
            cost=float(ends.cost[leader]),
            count=count,
            stack=problem.build(ends.vectors[leader]).stack,
        )
        for leader, count in zip(leaders, counts, strict=True)
    )


def _status(
    problem: Problem,
    ends: Ends,
    minima: tuple[Minimum, ...],
    at_bound: tuple[str, ...],
    converged: bool,
    found: Uncertainty,
    notes: list[str],
) -> str:
    total, good = len(ends.cost), int(ends.converged.sum())
    words = [
        f"converged; {minima[0].count} of {total} starts reached this minimum"
        if converged
        else f"not converged: none of {total} starts did; these are the best values seen"
    ]
    if converged and good < total:
        words.append(f"{total - good} of {total} starts failed")
    if at_bound:
        words.append(f"at a bound: {', '.join(at_bound)}; the errors of the others hold with them kept there")
    if found.unresolved:
        words.append(f"the data leave {len(found.unresolved)} direction(s) unresolved")
    if problem.objective != "likelihood":
        words.append(
            f"objective {problem.objective} is no likelihood: the errors are scaled by its scatter, no posterior"
        )
    return "; ".join(words + notes)


def _silent(stage: str, done: int, total: int | None = None, info: str = "") -> None:
    pass
