"""Parameters that all texels of a map have in common: found from the pilot texels together, and held from then on.

The information of all texels about all parameters has the form of an arrow: what is a texel's own is eliminated texel
by texel (a Schur complement), and a Gauss-Newton step of what is common solves a system of its size (variable
projection, Golub and Pereyra 1973).
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.maps.descent import Texels, model_of
from fits.maps.options import MapOptions
from fits.maps.search import Fits, search, solve, starts_at, to_units
from fits.optimise.levenberg_marquardt import COST_TOLERANCE, descend
from fits.optimise.multi_start import start_points
from fits.optimise.uncertainty import LARGEST_ERROR, ON_BOUND, UNKNOWN_BEYOND
from fits.problem.discrepancy import Discrepancy
from fits.problem.model import Model
from fits.problem.parameters import is_free, is_law, split
from fits.problem.problem import Problem
from layerjax._parameters import plain_name

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FIRST = 8
"""Texels of the pilot that are fitted from all starts; the rest of it begins where these ended."""

MOST_ROUNDS, HALVINGS = 30, 8
"""Gauss-Newton steps, and how often one that does not help is halved."""

CLOSE = 0.01
"""Standard errors that a last step may be long."""


class Common(NamedTuple):
    """Common parameters: values and standard errors by name (NaN at a bound, infinite where the pilot says nothing),
    and whether the joint fit converged."""

    values: dict[str, float]
    errors: dict[str, float]
    converged: bool


# ---- which they are, and the problem without them ----


def common_names(problem: Problem) -> tuple[str, ...]:
    """Names of what is `same_for_all_texels`, in the order of the problem; one a channel where numbers are."""
    noise, instrument = problem.noise, problem.instrument
    parts = {"": problem.stack, "scale": problem.scale, "noise.relative": noise.relative, "noise.floor": noise.floor}
    if isinstance(noise.discrepancy, Discrepancy):
        parts |= {f"noise.discrepancy.{one.name}": getattr(noise.discrepancy, one.name) for one in fields(Discrepancy)}
    if instrument is not None:
        parts["instrument.tilt"] = instrument.tilt
        if instrument.floor is not None:  # it stands in for that of the noise
            parts["noise.floor"] = instrument.floor
    marked = set()
    for where, part in parts.items():
        template, names, free = split(part, lambda path, where=where: plain_name(where + path))
        ends = [*(offset for _, offset, _ in template.slots), len(names)]
        marked |= {
            name for k, one in enumerate(free) if one.same_for_all_texels for name in names[ends[k] : ends[k + 1]]
        }
    return tuple(name for name in problem.names if name in marked)


def with_common(problem: Problem, values: Mapping[str, float]) -> Problem:
    """The problem with its common parameters held at these values."""
    levels: dict[str, Any] = {
        name: values[f"noise.{name}"] for name in ("relative", "floor") if f"noise.{name}" in values
    }
    return replace(
        problem,
        stack=hold(problem.stack, values),
        scale=values.get("scale", problem.scale),
        noise=replace(problem.noise, **levels),
    )


def hold(stack: Any, values: Mapping[str, float]) -> Any:
    """The stack (or any pytree) with numbers in place of its common `Free`, an array where one was a channel.

    Raises:
        ValueError: a common parameter has no value, or one that is not finite.
    """

    def number(name: str) -> float:
        if name not in values:
            raise ValueError(f"values has no {name!r}, which is common; it has {', '.join(values) or 'none'}")
        if not np.isfinite(values[name]):
            raise ValueError(f"values[{name!r}] is {values[name]}; it must be finite")
        return float(values[name])

    def lawful(leaf: Any) -> Any:  # numbers of each channel in place of a power law in which nothing is free any more
        known = is_law(leaf) and not any(map(is_free, (leaf.amplitude, leaf.exponent)))
        return leaf.values() if known else leaf

    leaves, structure = jax.tree.flatten(stack, is_leaf=is_free)
    template, names, _ = split(stack, plain_name)
    for leaf, offset, shape in template.slots:
        if leaves[leaf].same_for_all_texels:
            own = names[offset : offset + leaves[leaf].arrays()[0].size]
            leaves[leaf] = jnp.asarray(np.reshape([number(name) for name in own], shape))
    return jax.tree.map(
        lawful, jax.tree.unflatten(structure, leaves), is_leaf=lambda leaf: is_law(leaf) or is_free(leaf)
    )


# ---- fits from all starts ----


def fit_first(problem: Problem, points: Floats, pilot: Texels, size: int) -> Fits:
    """The lowest fits of a few of the pilot texels, from all of the points (starts, P) of the unit box."""
    rows = pilot.rows(np.unique(np.linspace(0, pilot.number - 1, min(FIRST, pilot.number)).astype(int)))
    best, *others = (solve(problem, np.tile(point, (rows.number, 1)), rows, size) for point in points)
    for found in others:
        better = np.flatnonzero(best.better(found, slice(None)))
        best.put(better, found.rows(better))
    return best


def distinct(found: Fits) -> Floats:
    """Where fits ended that can be begun from, (K, P): converged ones, or if there are none all that are finite."""
    good = found.finite & found.converged
    vectors = found.vector[good if good.any() else found.finite]
    if not len(vectors):
        raise ValueError("values: no texel of the pilot has a finite fit; are they in 1/sr?")
    return np.unique(vectors, axis=0)


# ---- the joint fit ----


def fit_common(problem: Problem, pilot: Texels, options: MapOptions) -> tuple[Problem, Common]:
    """The problem with its common parameters held where they suit the whole pilot best.

    problem: a prototype with `Free` numbers that are common, and others that are not.
    """
    size, places = options.chunk_size, np.flatnonzero(np.isin(problem.names, common_names(problem)))
    own = np.setdiff1d(np.arange(len(problem.names)), places)
    low, high = problem.low[places], problem.high[places]

    def held_at(at: Floats) -> Problem:
        return with_common(problem, {problem.names[k]: float(value) for k, value in zip(places, at, strict=True)})

    # begin at the mean of what a few texels say of them, weighted by its error
    points = start_points(problem, options.starts, options.seed)
    first = fit_first(problem, points, pilot, size)
    error = np.nan_to_num(first.errors[:, places] / (high - low), nan=1.0, posinf=1e3)
    at = np.average(first.vector[:, places], axis=0, weights=1.0 / np.maximum(error, 1e-6) ** 2)
    at = np.clip(at, low, high)
    held = held_at(at)
    starts = starts_at(
        held, distinct(fit_first(held, points[:, own], pilot, size)), points[1:, own], pilot.wi is not None, size
    )
    vectors = search(held, starts, pilot, size, options).fits.vector

    arrow, converged = _arrow(problem, places, own, pilot, at, vectors), False
    for _ in range(MOST_ROUNDS):
        step, error, width = _step(problem, places, arrow, at)
        if np.all(np.abs(step) <= np.nan_to_num(CLOSE * error)):
            converged = True
            break
        for halving in range(HALVINGS):
            trial = np.clip(at + 0.5**halving * step * width, low, high)
            held = held_at(trial)
            there = solve(held, to_units(held, vectors), pilot, size, fresh=False).vector
            tried = _arrow(problem, places, own, pilot, trial, there)
            if tried.cost < arrow.cost:
                break
        else:
            converged = bool(np.all(np.abs(step) <= np.nan_to_num(error)))  # rounding ends all progress
            break
        at, vectors, arrow = trial, there, tried
    _, error, width = _step(problem, places, arrow, at)
    names = [problem.names[place] for place in places]
    values, errors = (dict(zip(names, map(float, part), strict=True)) for part in (at, error * width))
    return held_at(at), Common(values, errors, converged)


class _Arrow(NamedTuple):
    """The joint problem with what is a texel's own eliminated, of S common parameters in the unit box.

    cost: of all texels. gradient: (S,). information: (S, S).
    """

    cost: float
    gradient: Floats
    information: Floats


def _arrow(problem: Problem, places: Integers, own: Integers, pilot: Texels, at: Floats, vectors: Floats) -> _Arrow:
    whole = np.empty((pilot.number, len(problem.names)))
    whole[:, places], whole[:, own] = at, vectors
    cost, gradient, root, units = (np.array(part, float) for part in problem.call(_information, whole, pilot))
    box, count = problem.model.box, pilot.number
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


def _step(problem: Problem, places: Integers, arrow: _Arrow, at: Floats) -> tuple[Floats, Floats, Floats]:
    """A Gauss-Newton step and standard errors, in boxes, with the width of these: 0 and NaN for what a bound holds, 0
    and infinite for what the data do not know."""
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


def _information(model: Model, vectors: Array, pilot: Texels) -> tuple[Any, ...]:
    """Cost, gradient and root of the information of each texel at its vector (M, P), and where that lies in the box."""

    def one(row: tuple[Array, Texels]) -> tuple[Any, ...]:
        own, unit = model_of(model, row[1]), model.box.to_unit(row[0])
        found = descend(own, unit, jnp.asarray(False), jnp.asarray(1), jnp.asarray(COST_TOLERANCE))
        return found.cost, found.gradient, found.root, unit

    return jax.lax.map(one, (vectors, pilot))
