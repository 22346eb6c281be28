"""Fits of many texels in one compiled program: a start for each, descents, and what the data say where these end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.maps.descending import BESIDE, End, Known, descents, first_mapped, linear
from fits.maps.texels import Texels, chi_square, model_of
from fits.optimise.descent import COST_TOLERANCE
from fits.optimise.identifiability import LARGEST_ERROR, UNIDENTIFIED_BEYOND, UNKNOWN_BEYOND
from fits.optimise.uncertainty import LEAST_GRADIENT, ON_BOUND
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]

TOGETHER = 64
"""Starts that a program takes, or a multiple of that."""


class Found(NamedTuple):
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

    def rows(self, places: Any) -> "Found":
        """Some of the texels."""
        return Found(*(part[places] for part in self))

    def better(self, other: "Found", rows: Any) -> NDArray[np.bool_]:
        """Where another one, of these rows, is lower by more than is left to gain, (len(rows),) bool."""
        return np.asarray(other.cost < self.cost[rows] - 10.0 * COST_TOLERANCE)

    def put(self, rows: Any, other: "Found") -> None:
        """Take over another one at these rows."""
        for mine, theirs in zip(self, other, strict=True):
            mine[rows] = theirs


def solve(problem: Problem, units: Floats, texels: Texels, size: int, fresh: bool = True) -> Found:
    """Fits of M texels from a start each, (M, P) in the unit box, by a program for up to `size` of them at a time.

    Not `fresh`: the starts lie near minima.
    """
    if texels.wi is not None:  # what is known somewhere is each texel's own
        return _all_solved(problem, units, None, np.arange(texels.number), texels, size, fresh)
    distinct, which = np.unique(units, axis=0, return_inverse=True)
    parts, order = [], []
    for first in range(0, len(distinct), TOGETHER):
        some = distinct[first : first + TOGETHER]
        rows = np.flatnonzero((which >= first) & (which < first + TOGETHER))
        known = all_known(problem, some, texels, size)
        parts.append(solve_near(problem, some, known, which[rows] - first, texels.rows(rows), size, fresh))
        order.append(rows)
    back = np.argsort(np.concatenate(order))
    return Found(*(np.concatenate(part)[back] for part in zip(*parts, strict=True)))


def solve_near(
    problem: Problem,
    units: Floats,
    known: Known,
    which: NDArray[np.int64],
    texels: Texels,
    size: int,
    fresh: bool = False,
) -> Found:
    """Fits of M texels from starts (K, P), of which is known what the model says there, (K, ...).

    which: start of each texel, (M,).
    """
    return _all_solved(problem, padded(units), Known(*map(padded, known)), which, texels, size, fresh)


def all_known(problem: Problem, units: Floats, texels: Texels, size: int) -> Known:
    """What the model says at K points (K, P) of the unit box; by the program that fits such texels, which is there."""
    count, shape, together = len(units), problem.model.values.shape, min(TOGETHER, size)
    every, which, rows = padded(units), np.arange(count), texels.rows(np.zeros(count, int))
    nothing = Known(np.zeros((len(every), *shape)), np.zeros((*every.shape, *shape)))
    parts = []
    for first in range(0, count, together):
        _, seen = _called(problem, every, nothing, which, rows, which[first : first + together], size, look=True)
        parts.append(seen)
    return Known(*map(np.concatenate, zip(*parts, strict=True)))


def padded(array: Floats) -> Floats:
    """With its last row repeated, so that there are few numbers of rows, and programs for them."""
    return np.concatenate([array, np.repeat(array[-1:], -len(array) % TOGETHER, axis=0)])


def filled(count: int, size: int) -> NDArray[np.int64]:
    """Places of so many rows, the last of them again and again: as many as a program for `size` of them takes."""
    return np.minimum(np.arange(-(-size // BESIDE) * BESIDE), count - 1)


def by_size(call: Callable[[NDArray[np.int64], int], Any], count: int, size: int) -> Any:
    """What `call` makes of `count` rows, arrays (count, ...), by one program whatever their number.

    Args:
        call: given places of rows, as many each time, and how many of them are to be looked at.
        size: of the program: rows at a time.
    """
    parts = []
    for first in range(0, count, size):
        some = min(size, count - first)
        found = call(first + filled(some, size), some)
        parts.append(jax.tree.map(lambda part, some=some: np.asarray(part)[:some], found))
    return jax.tree.map(lambda *each: np.concatenate(each), *parts)


def _all_solved(
    problem: Problem,
    units: Floats,
    known: Known | None,
    which: NDArray[np.int64],
    texels: Texels,
    size: int,
    fresh: bool,
) -> Found:
    every = np.arange(texels.number)
    parts = []
    for first in range(0, texels.number, size):
        found, _ = _called(problem, units, known, which, texels, every[first : first + size], size, fresh)
        parts.append(found)
    return Found(*map(np.concatenate, zip(*parts, strict=True)))


def _called(
    problem: Problem,
    units: Floats,
    known: Known | None,
    which: NDArray[np.int64],
    texels: Texels,
    some: NDArray[np.int64],
    size: int,
    fresh: bool = False,
    look: bool = False,
) -> tuple[Found, Known]:
    """Fits of some of the texels, at most `size`, and what is known at the ends of the first `TOGETHER` of them."""
    count = len(some)
    places = some[filled(count, size)]
    starts, begun = (units, which[places]) if known is not None else (units[places], np.arange(len(places)))
    given = (starts, known, begun, texels.rows(places), *map(np.asarray, (count, fresh, look)))
    found, seen = problem.call(_solved, *given)
    return Found(*(np.asarray(part)[:count] for part in found)), Known(*(np.asarray(part)[:count] for part in seen))


def _solved(
    model: Model,
    units: Array,
    known: Known | None,
    which: Array,
    texels: Texels,
    number: Array,
    fresh: Array,
    look: Array,
) -> tuple[Found, Known]:
    """Fits of the first `number` of the texels; of others whatever."""
    ends = descents(model, texels, number, fresh, look, units, known, which)
    found = first_mapped(lambda row: _found(model, *row), (ends, texels), number)
    return found, jax.tree.map(lambda part: part[:TOGETHER], ends.known)


def _found(model: Model, end: End, texel: Texels) -> Found:
    own, vector, predicted = model_of(model, texel), model.box.from_unit(end.unit), end.known.values
    near = linear(own, end.known, vector)
    finite = jnp.isfinite(end.cost)
    squares = chi_square(own, texel, vector, predicted)
    scatter = jnp.ones_like(end.cost)
    if model.objective != "likelihood":
        freedom = jnp.maximum(jnp.sum(texel.used) - vector.size, 1)
        scatter = jnp.maximum(2.0 * end.cost / freedom, jnp.finfo(end.cost.dtype).tiny)
    rows = jax.jacfwd(lambda unit: near.linear_parts(model.box.from_unit(unit))[1][1])(end.unit)
    # R of the QR decomposition has its singular values without squaring its condition number
    root = jnp.linalg.qr(rows, mode="r")
    errors, held, unidentified = _errors(own, end, root, scatter)
    return Found(
        vector=vector,
        errors=errors,
        cost=jnp.where(finite, end.cost, jnp.inf),
        chi_square=squares,
        converged=(end.converged > 0.5) & finite,
        unidentified=unidentified,
        at_bound=held,
        predicted=jnp.where(finite, predicted, jnp.nan),
    )


def _errors(model: Model, end: End, root: Array, scatter: Array) -> tuple[Array, Array, Array]:
    """As `fits.optimise.uncertainty`, for a compiled program."""
    box, unit, count = model.box, end.unit, end.unit.size
    root, pull = root / jnp.sqrt(scatter), LEAST_GRADIENT * scatter
    known = jnp.isfinite(end.cost) & jnp.all(jnp.isfinite(root))
    root = jnp.where(known, root, 0.0)
    idle = jnp.linalg.norm(root, axis=0) * UNKNOWN_BEYOND < 1.0
    held = ((unit <= ON_BOUND) & (end.gradient > pull)) | ((unit >= 1.0 - ON_BOUND) & (end.gradient < -pull))
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


def nearest(
    problem: Problem, vectors: Floats, predicted: Floats, texels: Texels, most: int, size: int
) -> NDArray[np.int64]:
    """Which of K vectors (K, P), with what they predict (K, N, C), suit each texel best: (M, most), best first."""
    given = padded(vectors), padded(predicted)
    misfit = by_size(lambda rows, _: problem.call(_misfit, *given, texels.rows(rows)), texels.number, size)
    misfit = misfit[:, : len(vectors)]
    most = min(most, len(vectors))
    best = np.sort(np.argpartition(misfit, most - 1, axis=1)[:, :most], axis=1)
    order = np.argsort(np.take_along_axis(misfit, best, axis=1), axis=1, kind="stable")
    return np.take_along_axis(best, order, axis=1)


def _misfit(model: Model, vectors: Array, predicted: Array, texels: Texels) -> Array:
    """By the log-likelihood with noise as the problem's own readings have it, as matrix products."""
    sigma = jax.vmap(model.sigma_at)(vectors, predicted)
    weight = 1.0 / sigma**2
    used = texels.used.astype(weight.dtype)
    values = jnp.where(texels.used, texels.values, 0.0)

    def product(readings: Array, of: Array) -> Array:
        return readings.reshape(len(readings), -1) @ of.reshape(len(of), -1).T

    squares = product(values**2, weight) - 2.0 * product(values, weight * predicted)
    squares += product(used, weight * predicted**2 + 2.0 * jnp.log(sigma))
    return jnp.where(jnp.isnan(squares), jnp.inf, squares)
