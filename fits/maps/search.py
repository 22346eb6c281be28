"""The best fit of each of many texels: from the likeliest of known starts, and from others where that ended poorly.

A texel is begun again, from other starts, from its neighbours' values and from points all over the bounds, only where
its chi-square says that it ended poorly: a second minimum that fits as well is not looked for.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import stats

from fits.maps.descent import (
    LANES,
    Ending,
    Linearisation,
    Texels,
    blank_texel,
    chi_square,
    descents,
    first_mapped,
    linear,
    model_of,
)
from fits.maps.options import MapOptions
from fits.optimise.levenberg_marquardt import COST_TOLERANCE
from fits.optimise.uncertainty import LARGEST_ERROR, LEAST_GRADIENT, ON_BOUND, UNIDENTIFIED_BEYOND, UNKNOWN_BEYOND
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Truths = NDArray[np.bool_]

TOGETHER = 64
"""Starts that a program takes, or a multiple of that."""

MOST_PREDICTED = 8
"""Starts whose values are computed for every texel, where each has directions of its own."""

NEIGHBOUR, RANDOM = -1, -2
"""Where a texel's best fit began, if not at a start of the list."""


# ---- fits from a start each ----


class Fits(NamedTuple):
    """What is found of M texels with P parameters.

    vector, errors: physical, (M, P); an error is NaN where a bound holds the parameter, infinite where nothing does.
    cost, chi_square: (M,); an infinite cost where there is no finite value. converged, unidentified: (M,) bool.
    at_bound: (M, P) bool. predicted: (M, N, C), in 1/sr.
    """

    vector: Any
    errors: Any
    cost: Any
    chi_square: Any
    converged: Any
    unidentified: Any
    at_bound: Any
    predicted: Any

    @property
    def finite(self) -> Truths:
        """Which have a value."""
        return np.isfinite(self.cost) & np.all(np.isfinite(self.vector), axis=1)

    def rows(self, places: Any) -> "Fits":
        """Some of the texels."""
        return Fits(*(part[places] for part in self))

    def better(self, other: "Fits", rows: Any) -> Truths:
        """Where another one, of these rows, is lower by more than is left to gain, (len(rows),) bool."""
        return np.asarray(other.cost < self.cost[rows] - 10.0 * COST_TOLERANCE)

    def put(self, rows: Any, other: "Fits") -> None:
        """Take over another one at these rows."""
        for mine, theirs in zip(self, other, strict=True):
            mine[rows] = theirs


def solve(problem: Problem, units: Floats, texels: Texels, size: int, fresh: bool = True) -> Fits:
    """Fits of M texels from a start each, (M, P) in the unit box, by a program for up to `size` of them at a time.

    Not `fresh`: the starts lie near minima.
    """
    if texels.wi is not None:  # what is known of a start is each texel's own
        return solve_near(problem, units, None, np.arange(texels.number), texels, size, fresh)
    distinct, which = np.unique(units, axis=0, return_inverse=True)
    parts, order = [], []
    for first in range(0, len(distinct), TOGETHER):
        some = distinct[first : first + TOGETHER]
        rows = np.flatnonzero((which >= first) & (which < first + TOGETHER))
        known = linearise_all(problem, some, texels, size)
        parts.append(solve_near(problem, some, known, which[rows] - first, texels.rows(rows), size, fresh))
        order.append(rows)
    back = np.argsort(np.concatenate(order))
    return Fits(*(np.concatenate(part)[back] for part in zip(*parts, strict=True)))


def solve_near(
    problem: Problem,
    units: Floats,
    known: Linearisation | None,
    which: Integers,
    texels: Texels,
    size: int,
    fresh: bool = False,
) -> Fits:
    """Fits of M texels from starts (K, P) whose linearisation is known, (K, ...); which: start of each texel, (M,).

    Where nothing is known, a start each.
    """
    every = np.arange(texels.number)
    if known is not None:
        units, known = padded(units), Linearisation(*map(padded, known))
    parts = [
        _call(problem, units, known, which, texels, every[first : first + size], size, fresh)[0]
        for first in range(0, texels.number, size)
    ]
    return Fits(*map(np.concatenate, zip(*parts, strict=True)))


def linearise_all(problem: Problem, units: Floats, texels: Texels, size: int) -> Linearisation:
    """The model at K points (K, P) of the unit box, by the program that fits such texels: it is compiled already."""
    count, shape, together = len(units), problem.model.values.shape, min(TOGETHER, size)
    every, which, rows = padded(units), np.arange(count), texels.rows(np.zeros(count, int))
    nothing = Linearisation(np.zeros((len(every), *shape)), np.zeros((*every.shape, *shape)))
    parts = []
    for first in range(0, count, together):
        _, seen = _call(problem, every, nothing, which, rows, which[first : first + together], size, only_evaluate=True)
        parts.append(seen)
    return Linearisation(*map(np.concatenate, zip(*parts, strict=True)))


def to_units(problem: Problem, vectors: Floats) -> Floats:
    """Vectors (K, P) in the unit box."""
    units = np.asarray(jax.vmap(problem.model.box.to_unit)(jnp.asarray(padded(vectors))), float)
    return np.clip(units[: len(vectors)], 0.0, 1.0)


def padded(array: Floats) -> Floats:
    """An array with its last row repeated, so that there are few numbers of rows, and programs for them."""
    return np.concatenate([array, np.repeat(array[-1:], -len(array) % TOGETHER, axis=0)])


def by_size(call: Callable[[Integers, int], Any], count: int, size: int) -> Any:
    """What `call` makes of `count` rows, arrays (count, ...), by one program for `size` rows whatever their number.

    call: given places of rows, as many each time, and how many of them are to be looked at.
    """
    parts = []
    for first in range(0, count, size):
        some = min(size, count - first)
        found = call(first + _filled(some, size), some)
        parts.append(jax.tree.map(lambda part, some=some: np.asarray(part)[:some], found))
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def _filled(count: int, size: int) -> Integers:
    """Places of so many rows, the last of them again and again: as many as a program for `size` of them takes."""
    return np.minimum(np.arange(-(-size // LANES) * LANES), count - 1)


def _call(
    problem: Problem,
    units: Floats,
    known: Linearisation | None,
    which: Integers,
    texels: Texels,
    some: Integers,
    size: int,
    fresh: bool = False,
    only_evaluate: bool = False,
) -> tuple[Fits, Linearisation]:
    """Fits of some of the texels, at most `size`, and the model where the first `TOGETHER` of them ended."""
    count = len(some)
    places = some[_filled(count, size)]
    starts, begun = (units, which[places]) if known is not None else (units[places], np.arange(len(places)))
    given = (starts, known, begun, texels.rows(places), *map(np.asarray, (count, fresh, only_evaluate)))
    found, seen = problem.call(_program, *given)
    return (
        Fits(*(np.asarray(part)[:count] for part in found)),
        Linearisation(*(np.asarray(part)[:count] for part in seen)),
    )


def _program(
    model: Model,
    units: Array,
    known: Linearisation | None,
    which: Array,
    texels: Texels,
    number: Array,
    fresh: Array,
    only_evaluate: Array,
) -> tuple[Fits, Linearisation]:
    """Fits of the first `number` of the texels; of others whatever."""
    ends = descents(model, texels, number, fresh, only_evaluate, units, known, which)
    found = first_mapped(lambda row: _fit_at(model, *row), (ends, texels), number)
    return found, jax.tree.map(lambda part: part[:TOGETHER], ends.known)


def _fit_at(model: Model, end: Ending, texel: Texels) -> Fits:
    own, vector, predicted = model_of(model, texel), model.box.from_unit(end.unit), end.known.values
    near = linear(own, end.known, vector)
    finite = jnp.isfinite(end.cost)
    scatter = jnp.ones_like(end.cost)
    if model.objective != "likelihood":
        freedom = jnp.maximum(jnp.sum(texel.used) - vector.size, 1)
        scatter = jnp.maximum(2.0 * end.cost / freedom, jnp.finfo(end.cost.dtype).tiny)
    rows = jax.jacfwd(lambda unit: near.linear_parts(model.box.from_unit(unit))[1][1])(end.unit)
    # R of the QR decomposition has its singular values without squaring its condition number
    root = jnp.linalg.qr(rows, mode="r")
    errors, held, unidentified = _errors(own, end, root, scatter)
    return Fits(
        vector=vector,
        errors=errors,
        cost=jnp.where(finite, end.cost, jnp.inf),
        chi_square=chi_square(own, texel, vector, predicted),
        converged=(end.converged > 0.5) & finite,
        unidentified=unidentified,
        at_bound=held,
        predicted=jnp.where(finite, predicted, jnp.nan),
    )


def _errors(model: Model, end: Ending, root: Array, scatter: Array) -> tuple[Array, Array, Array]:
    """As `fits.optimise.uncertainty`, for a compiled program."""
    box, unit, count = model.box, end.unit, end.unit.size
    root, least_gradient = root / jnp.sqrt(scatter), LEAST_GRADIENT * scatter
    known = jnp.isfinite(end.cost) & jnp.all(jnp.isfinite(root))
    root = jnp.where(known, root, 0.0)
    idle = jnp.linalg.norm(root, axis=0) * UNKNOWN_BEYOND < 1.0
    held = ((unit <= ON_BOUND) & (end.gradient > least_gradient)) | (
        (unit >= 1.0 - ON_BOUND) & (end.gradient < -least_gradient)
    )
    held &= ~idle & known
    data = jnp.linalg.svd(jnp.concatenate([root, jnp.zeros((count, count))]), compute_uv=False)
    unidentified = (data[-1] < 1.0 / UNIDENTIFIED_BEYOND) | ~known
    rows = jnp.where(held, 0.0, jnp.concatenate([root, box.prior_slopes()]))
    _, sizes, directions = jnp.linalg.svd(rows, full_matrices=False)
    least = jnp.maximum(jnp.finfo(sizes.dtype).eps * count * sizes[0], 1.0 / LARGEST_ERROR)
    spread = jnp.linalg.norm(directions / jnp.maximum(sizes, least)[:, None], axis=0)
    errors = jnp.where(spread > UNKNOWN_BEYOND, jnp.inf, spread * box.slope(box.from_unit(unit)))
    errors = jnp.where(known, errors, jnp.inf)
    return jnp.where(held, jnp.nan, errors), held, unidentified


# ---- which start, and when to start again ----


@dataclass(frozen=True)
class Starts:
    """Where fits begin.

    vectors, units: K, physical and in the unit box, (K, P). known: the model there, (K, ...); None where every texel
    has directions of its own. random: further points of the unit box, (R, P).
    explained: a reduced chi-square that is not poor, whatever the noise says.
    """

    vectors: Floats
    units: Floats
    known: Linearisation | None
    random: Floats
    explained: float = 0.0


class Results(NamedTuple):
    """What is found of M texels: fits, where each began, and which are poor or were started again, (M,) each."""

    fits: Fits
    start: Integers
    poor: Truths
    restarted: Truths


def starts_at(
    problem: Problem, vectors: Floats, random: Floats, own: bool, size: int, explained: float = 0.0
) -> Starts:
    """The starts at these vectors (K, P); own: texels have directions of their own; size: of the program."""
    if own:
        vectors = vectors[:MOST_PREDICTED]
        return Starts(vectors, to_units(problem, vectors), None, random, explained)
    units = to_units(problem, vectors)
    known = linearise_all(problem, units, blank_texel(problem.model.values.shape), size)
    return Starts(vectors, units, known, random, explained)


def search(
    problem: Problem, starts: Starts, texels: Texels, size: int, options: MapOptions, beside: Integers | None = None
) -> Results:
    """Fit each texel.

    Args:
        size: of the program: texels at a time.
        beside: the neighbours of each, (M, ...), by their places; -1 where there is none.
    """
    order = likeliest(problem, starts, texels, size, options.restarts + 1)
    if starts.known is None:
        found = solve(problem, starts.units[order[:, 0]], texels, size, fresh=False)
    else:
        found = solve_near(problem, starts.units, starts.known, order[:, 0], texels, size)
    start, restarted = order[:, 0].copy(), np.zeros(texels.number, bool)
    limit = _limit(problem, starts, texels, options)

    def again(rows: Integers, units: Floats, begun: Integers) -> None:
        if not len(rows):
            return
        restarted[rows] = True
        other = solve(problem, units, texels.rows(rows), size)
        improved = found.better(other, rows)
        found.put(rows[improved], other.rows(improved))
        start[rows[improved]] = begun[improved]

    for place in range(1, order.shape[1]):
        rows = np.flatnonzero(_poor(found, texels, limit))
        again(rows, starts.units[order[rows, place]], order[rows, place])
    for _ in range(options.restarts if beside is not None else 0):
        rows, vectors = _neighbours_of_poor(found, _poor(found, texels, limit), beside)
        again(rows, to_units(problem, vectors) if len(rows) else vectors, np.full(len(rows), NEIGHBOUR))
    for point in starts.random:
        rows = np.flatnonzero(_poor(found, texels, limit))
        again(rows, np.broadcast_to(point, (len(rows), point.size)), np.full(len(rows), RANDOM))
    return Results(found, start, _poor(found, texels, limit) & found.converged, restarted)


def reduced_chi_square(found: Fits, texels: Texels) -> Floats:
    """Chi-square over degrees of freedom, (M,)."""
    return np.asarray(found.chi_square) / _freedom(texels, found.vector.shape[1])


def _freedom(texels: Texels, parameters: int) -> Floats:
    return np.maximum(texels.measurements - parameters, 1).astype(float)


def _limit(problem: Problem, starts: Starts, texels: Texels, options: MapOptions) -> Floats:
    """The reduced chi-square that noise and the pilot explain, (M,)."""
    limit = np.full(texels.number, starts.explained)
    if problem.objective == "likelihood" and problem.noise.tails == "gaussian":
        freedom, where = np.unique(_freedom(texels, len(problem.names)), return_inverse=True)
        limit = np.maximum(limit, (stats.chi2.isf(options.poor_probability, freedom) / freedom)[where])
    elif not starts.explained:
        limit[:] = np.inf
    return limit


def _poor(found: Fits, texels: Texels, limit: Floats) -> Truths:
    """Whether a fit is worse than that, or has not converged."""
    return ~((reduced_chi_square(found, texels) <= limit) & found.converged)


def _neighbours_of_poor(found: Fits, poor: Truths, beside: Integers | None) -> tuple[Integers, Floats]:
    """Poor texels that have a neighbour which is not, and where the best of those ended."""
    assert beside is not None
    good = np.append(~poor, False)  # the place -1 is none
    cost = np.append(np.asarray(found.cost), np.inf)
    rows = np.flatnonzero(poor & np.any(good[beside], axis=1))
    choice = np.argmin(np.where(good[beside[rows]], cost[beside[rows]], np.inf), axis=1)
    return rows, found.vector[beside[rows, choice]]


def likeliest(problem: Problem, starts: Starts, texels: Texels, size: int, most: int) -> Integers:
    """The starts that suit each texel best, (M, at most `most`), best first."""
    most = min(most, len(starts.vectors))
    if starts.known is None:
        misfit = by_size(
            lambda rows, count: problem.call(_costs, starts.vectors, texels.rows(rows), np.asarray(count)),
            texels.number,
            size,
        )
        return np.argsort(misfit, axis=1)[:, :most]
    given = padded(starts.vectors), padded(starts.known.values)
    misfit = by_size(lambda rows, _: problem.call(_misfit, *given, texels.rows(rows)), texels.number, size)
    misfit = misfit[:, : len(starts.vectors)]
    best = np.sort(np.argpartition(misfit, most - 1, axis=1)[:, :most], axis=1)
    order = np.argsort(np.take_along_axis(misfit, best, axis=1), axis=1, kind="stable")
    return np.take_along_axis(best, order, axis=1)


def _misfit(model: Model, vectors: Array, predicted: Array, texels: Texels) -> Array:
    """Minus twice the log-likelihood with noise as the problem's own values have it, as matrix products, (M, K)."""
    sigma = jax.vmap(model.sigma_at)(vectors, predicted)
    weight = 1.0 / sigma**2
    used = texels.used.astype(weight.dtype)
    values = jnp.where(texels.used, texels.values, 0.0)

    def product(measured: Array, of: Array) -> Array:
        return measured.reshape(len(measured), -1) @ of.reshape(len(of), -1).T

    squares = product(values**2, weight) - 2.0 * product(values, weight * predicted)
    squares += product(used, weight * predicted**2 + 2.0 * jnp.log(sigma))
    return jnp.where(jnp.isnan(squares), jnp.inf, squares)


def _costs(model: Model, vectors: Array, texels: Texels, number: Array) -> Array:
    """Of every vector (K, P) for the first `number` of the texels, each along its own directions: (M, K)."""

    def one(row: Texels) -> Array:
        own = model_of(model, row)
        return jax.lax.map(lambda vector: own.cost_at(vector, own.predict(vector)), vectors)

    return first_mapped(one, texels, number)


def predict_all(problem: Problem, vectors: Floats) -> Floats:
    """What vectors (K, P) predict, (K, N, C), in 1/sr."""
    return np.asarray(problem.call(_predict_all, vectors), float)


def _predict_all(model: Model, vectors: Array) -> Array:
    return jax.lax.map(model.predict, vectors)


def neighbours(shape: tuple[int, ...]) -> Integers:
    """The places of those beside each texel of a block of this shape, (M, 2 rank); -1 beyond its edge."""
    places = np.pad(np.arange(int(np.prod(shape))).reshape(shape), 1, constant_values=-1)
    inner = [slice(1, -1)] * len(shape)
    columns = []
    for axis in range(len(shape)):
        for moved in (slice(0, -2), slice(2, None)):
            columns.append(places[(*inner[:axis], moved, *inner[axis + 1 :])].reshape(-1))
    return np.stack(columns, axis=1)
