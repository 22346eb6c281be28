"""Numbers that all texels share, fitted jointly with the others of a sample of texels.

The information of all texels about all numbers has the form of an arrow: what is a texel's own can be eliminated texel
by texel (a Schur complement), and a Gauss-Newton step of what is shared solves a system of its size (variable
projection, Golub and Pereyra 1973).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.maps.pilot import FIRST, distinct, from_all
from fits.maps.searching import search, starts_at
from fits.maps.shared import hold, shared_names
from fits.maps.solving import solve
from fits.maps.texels import Texels, model_of
from fits.optimise.descent import COST_TOLERANCE, descend
from fits.optimise.identifiability import LARGEST_ERROR, UNKNOWN_BEYOND
from fits.optimise.multi_start import start_points
from fits.optimise.uncertainty import ON_BOUND
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]

MOST_ROUNDS, HALVINGS = 30, 8
"""Gauss-Newton steps, and how often one that does not help is halved."""

CLOSE = 0.01
"""Standard errors that a last step may be long."""


class Shared(NamedTuple):
    """Shared numbers: values and standard errors by name (NaN at a bound, infinite where the sample says nothing), and
    whether the joint fit converged."""

    values: dict[str, float]
    errors: dict[str, float]
    converged: bool


class _Arrow(NamedTuple):
    """The joint problem with what is a texel's own eliminated, S shared numbers in the unit box.

    cost: of all texels. gradient: (S,). information: (S, S).
    """

    cost: float
    gradient: Floats
    information: Floats


def fit_shared(problem: Problem, sample: Texels, *, starts: int, seed: int, size: int) -> tuple[Problem, Shared]:
    """The problem with its shared numbers held where they suit the whole sample best.

    Args:
        problem: a prototype with `Free` numbers that are shared, and others that are not.
        sample: of the map's texels.
        starts, seed, size: see `fits.maps.pilot.fly`.
    """
    places = np.flatnonzero(np.isin(problem.names, shared_names(problem)))
    own = np.setdiff1d(np.arange(len(problem.names)), places)
    low, high = problem.low[places], problem.high[places]
    at, vectors = _opening(problem, places, own, sample, starts, seed, size)
    vectors = _solved(_held(problem, places, at), sample, vectors, size)
    arrow, converged = _arrow(problem, places, own, sample, at, vectors), False
    for _ in range(MOST_ROUNDS):
        step, error, width = _step(problem, places, arrow, at)
        if np.all(np.abs(step) <= np.nan_to_num(CLOSE * error)):
            converged = True
            break
        for halving in range(HALVINGS):
            trial = np.clip(at + 0.5**halving * step * width, low, high)
            there = _solved(_held(problem, places, trial), sample, vectors, size)
            tried = _arrow(problem, places, own, sample, trial, there)
            if tried.cost < arrow.cost:
                break
        else:
            converged = bool(np.all(np.abs(step) <= np.nan_to_num(error)))  # rounding ends all progress
            break
        at, vectors, arrow = trial, there, tried
    _, error, width = _step(problem, places, arrow, at)
    names = [problem.names[place] for place in places]
    values, errors = (dict(zip(names, map(float, part), strict=True)) for part in (at, error * width))
    return _held(problem, places, at), Shared(values, errors, converged)


def held(problem: Problem, values: dict[str, float]) -> Problem:
    """The problem with its shared numbers held at these values."""
    levels: dict[str, Any] = {
        name: values[f"noise.{name}"] for name in ("relative", "floor") if f"noise.{name}" in values
    }
    return replace(
        problem,
        stack=hold(problem.stack, values),
        scale=values.get("scale", problem.scale),
        noise=replace(problem.noise, **levels),
    )


def _held(problem: Problem, places: NDArray[np.int64], at: Floats) -> Problem:
    return held(problem, {problem.names[place]: float(value) for place, value in zip(places, at, strict=True)})


def _opening(
    problem: Problem,
    places: NDArray[np.int64],
    own: NDArray[np.int64],
    sample: Texels,
    starts: int,
    seed: int,
    size: int,
) -> tuple[Floats, Floats]:
    """Where the joint fit begins: the mean of what few texels say of the shared numbers alone, weighted by its error,
    and what is each texel's own, (M, P - S)."""
    first = np.unique(np.linspace(0, sample.number - 1, min(FIRST, sample.number)).astype(int))
    points = start_points(problem, starts, seed)
    found = from_all(problem, points, sample.rows(first), size)
    width = problem.high[places] - problem.low[places]
    error = np.nan_to_num(found.errors[:, places] / width, nan=1.0, posinf=1e3)
    weight = 1.0 / np.maximum(error, 1e-6) ** 2
    at = np.clip(np.average(found.vector[:, places], axis=0, weights=weight), problem.low[places], problem.high[places])
    held = _held(problem, places, at)
    begun = from_all(held, points[:, own], sample.rows(first), size)
    starts_of_all = starts_at(held, distinct(begun), points[1:, own], sample.wi is not None, size)
    ends = search(held, starts_of_all, sample, size)
    return at, ends.found.vector


def _solved(held: Problem, sample: Texels, vectors: Floats, size: int) -> Floats:
    """What is each texel's own, (M, P - S), from where it was."""
    units = np.asarray(jax.vmap(held.model.box.to_unit)(jnp.asarray(vectors)), float)
    return solve(held, np.clip(units, 0.0, 1.0), sample, size, fresh=False).vector


def _arrow(
    problem: Problem, places: NDArray[np.int64], own: NDArray[np.int64], sample: Texels, at: Floats, vectors: Floats
) -> _Arrow:
    whole = np.empty((sample.number, len(problem.names)))
    whole[:, places], whole[:, own] = at, vectors
    cost, gradient, root, units = (np.array(part, float) for part in problem.call(_informed, whole, sample))
    box, count = problem.model.box, sample.number
    slopes = np.array(box.prior_slopes(), float)
    residual = np.asarray(box.prior_residuals(jnp.asarray(whole[0])), float)
    of_prior = np.abs(slopes[:, places]).sum(axis=1) > 0  # once in all, not once a texel
    prior = slopes[of_prior][:, places]
    gradient[:, places] -= (count - 1) / count * prior.T @ residual[of_prior]
    slopes[of_prior] /= np.sqrt(count)
    information = np.einsum("mki,mkj->mij", root, root) + slopes.T @ slopes
    unit = units[:, own]
    held = ((unit <= ON_BOUND) & (gradient[:, own] > 0)) | ((unit >= 1.0 - ON_BOUND) & (gradient[:, own] < 0))
    inner = np.where(held[:, :, None] | held[:, None, :], 0.0, information[:, own[:, None], own])
    beside = np.where(held[:, :, None], 0.0, information[:, own[:, None], places])
    slope = np.where(held, 0.0, gradient[:, own])
    solved = np.linalg.pinv(inner, hermitian=True) @ np.concatenate([beside, slope[:, :, None]], axis=2)
    reduced = np.einsum("mis,mit->st", beside, solved[:, :, :-1])
    across = np.einsum("mis,mi->s", beside, solved[:, :, -1])
    total = float(cost.sum()) - (count - 1) * 0.5 * float(residual[of_prior] @ residual[of_prior])
    return _Arrow(
        total, gradient[:, places].sum(axis=0) - across, information[:, places[:, None], places].sum(axis=0) - reduced
    )


def _step(problem: Problem, places: NDArray[np.int64], arrow: _Arrow, at: Floats) -> tuple[Floats, Floats, Floats]:
    """A Gauss-Newton step and standard errors, in boxes, with the width of these: 0 and NaN for what a bound holds, 0
    and infinite for what the readings do not know."""
    whole = problem.start.copy()
    whole[places] = at
    unit = np.asarray(problem.model.box.to_unit(jnp.asarray(whole)), float)[places]
    width = np.asarray(problem.model.box.slope(jnp.asarray(whole)), float)[places]
    held = ((unit <= ON_BOUND) & (arrow.gradient > 0)) | ((unit >= 1.0 - ON_BOUND) & (arrow.gradient < 0))
    free = np.flatnonzero(~held)
    step, error = np.zeros(len(places)), np.full(len(places), np.nan)
    if free.size:
        sizes, directions = np.linalg.eigh(arrow.information[np.ix_(free, free)])
        known = sizes > np.finfo(float).eps * free.size * max(sizes[-1], 0.0)
        spread = np.where(known, 1.0 / np.sqrt(np.where(known, sizes, 1.0)), LARGEST_ERROR)
        step[free] = -directions @ (np.where(known, spread**2, 0.0) * (directions.T @ arrow.gradient[free]))
        widths = np.linalg.norm(directions * spread, axis=1)
        error[free] = np.where(widths > UNKNOWN_BEYOND, np.inf, widths)
    return step, error, width


def _informed(model: Model, vectors: Array, sample: Texels) -> tuple[Any, ...]:
    """Cost, gradient and root of the information of each texel at its vector (M, P), and where that lies in the box."""

    def one(row: tuple[Array, Texels]) -> tuple[Any, ...]:
        own, unit = model_of(model, row[1]), model.box.to_unit(row[0])
        found = descend(own, unit, jnp.asarray(False), jnp.asarray(1), jnp.asarray(COST_TOLERANCE))
        return found.cost, found.gradient, found.root, unit

    return jax.lax.map(one, (vectors, sample))
