"""Fits of many texels in one compiled program: a start for each, Levenberg-Marquardt, and what the data say there."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.inference.descent import PROMISE, descend
from fits.inference.identifiability import LARGEST_ERROR, UNKNOWN_BEYOND, UNRESOLVED_BEYOND
from fits.inference.starts import MOST_STEPS
from fits.inference.uncertainty import LEAST_PULL, ON_BOUND
from fits.maps.texels import Texels, blocks, chi_square, model_of
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]

TOGETHER = 4
"""Texels that take their steps side by side: more keep each other waiting."""


class Found(NamedTuple):
    """What is found of M texels with P parameters.

    vector, errors: physical, (M, P); an error is NaN where a bound holds the parameter, infinite where nothing does.
    cost, chi_square: (M,); an infinite cost where there is no finite value. converged, unresolved: (M,) bool.
    at_bound: (M, P) bool. predicted: (M, N, C), in 1/sr.
    """

    vector: Any
    errors: Any
    cost: Any
    chi_square: Any
    converged: Any
    unresolved: Any
    at_bound: Any
    predicted: Any

    def rows(self, places: Any) -> "Found":
        """Some of the texels."""
        return Found(*(part[places] for part in self))

    def better(self, other: "Found", rows: Any) -> NDArray[np.bool_]:
        """Where another one, of these rows, is lower by more than is left to gain, (len(rows),) bool."""
        return np.asarray(other.cost < self.cost[rows] - 10.0 * PROMISE)

    def put(self, rows: Any, other: "Found") -> None:
        """Take over another one at these rows."""
        for mine, theirs in zip(self, other, strict=True):
            mine[rows] = theirs


def solve(problem: Problem, units: Floats, texels: Texels, size: int, fresh: bool = True) -> Found:
    """Fits of M texels from a start each, (M, P) in the unit box, by a program for up to `size` of them at a time.

    Not `fresh`: the starts lie near minima.
    """
    parts = [
        _solved(problem, units[first : first + size], texels.rows(slice(first, first + size)), size, fresh)
        for first in range(0, len(units), size)
    ]
    return Found(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _solved(problem: Problem, units: Floats, texels: Texels, size: int, fresh: bool) -> Found:
    count = len(units)
    filled = np.minimum(np.arange(-(-size // TOGETHER) * TOGETHER), count - 1)
    number = np.asarray(-(-count // TOGETHER))
    found = problem.call(_in_blocks, units[filled], texels.rows(filled), number, np.asarray(fresh))
    return Found(*(np.array(part)[:count] for part in found))


def _in_blocks(model: Model, units: Array, texels: Texels, number: Array, fresh: Array) -> Found:
    """So many blocks of the texels; what comes after them is left as it is."""
    rows = blocks((units, texels), TOGETHER)

    def block(index: Array) -> Found:
        units, texels = jax.tree.map(lambda part: part[index], rows)
        return jax.vmap(lambda unit, texel: _one(model, unit, texel, fresh))(units, texels)

    shapes = jax.eval_shape(block, jnp.asarray(0))
    empty = jax.tree.map(lambda part: jnp.zeros((len(rows[0]), *part.shape), part.dtype), shapes)
    found = jax.lax.fori_loop(
        0, number, lambda i, out: jax.tree.map(lambda whole, part: whole.at[i].set(part), out, block(i)), empty
    )
    return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), found)


def _one(model: Model, unit: Array, texel: Texels, fresh: Array) -> Found:
    own = model_of(model, texel)
    end = descend(own, unit, fresh, jnp.asarray(MOST_STEPS), jnp.asarray(PROMISE))
    squares = chi_square(own, texel, end.vector, end.predicted)
    scatter = jnp.ones_like(end.cost)
    if model.objective != "likelihood":
        freedom = jnp.maximum(jnp.sum(texel.used) - unit.size, 1)
        scatter = jnp.maximum(2.0 * end.cost / freedom, jnp.finfo(end.cost.dtype).tiny)
    errors, held, unresolved = _errors(own, end, scatter)
    return Found(end.vector, errors, end.cost, squares, end.converged, unresolved, held, end.predicted)


def _errors(model: Model, end: Any, scatter: Array) -> tuple[Array, Array, Array]:
    """As `fits.inference.uncertainty`, for a compiled program."""
    box, count = model.box, end.vector.size
    root, pull = end.root / jnp.sqrt(scatter), LEAST_PULL * scatter
    known = jnp.isfinite(end.cost) & jnp.all(jnp.isfinite(root))
    root = jnp.where(known, root, 0.0)
    unit = box.to_unit(end.vector)
    idle = jnp.linalg.norm(root, axis=0) * UNKNOWN_BEYOND < 1.0
    held = ((unit <= ON_BOUND) & (end.gradient > pull)) | ((unit >= 1.0 - ON_BOUND) & (end.gradient < -pull))
    held &= ~idle & known
    data = jnp.linalg.svd(jnp.concatenate([root, jnp.zeros((count, count))]), compute_uv=False)
    unresolved = (data[-1] < 1.0 / UNRESOLVED_BEYOND) | ~known
    rows = jnp.where(held, 0.0, jnp.concatenate([root, box.prior_slopes()]))
    _, sizes, directions = jnp.linalg.svd(rows, full_matrices=False)
    least = jnp.maximum(jnp.finfo(sizes.dtype).eps * count * sizes[0], 1.0 / LARGEST_ERROR)
    spread = jnp.linalg.norm(directions / jnp.maximum(sizes, least)[:, None], axis=0)
    errors = jnp.where(spread > UNKNOWN_BEYOND, jnp.inf, spread * box.slope(end.vector))
    errors = jnp.where(known, errors, jnp.inf)
    return jnp.where(held, jnp.nan, errors), held, unresolved


def nearest(problem: Problem, vectors: Floats, predicted: Floats, texels: Texels, most: int) -> NDArray[np.int64]:
    """Which of K vectors (K, P), with what they predict (K, N, C), suit each texel best: (M, most), best first."""
    return np.asarray(problem.call(_nearest, vectors, predicted, texels))[:, :most]


def _nearest(model: Model, vectors: Array, predicted: Array, texels: Texels) -> Array:
    """By the log-likelihood with noise as the problem's own readings have it, as matrix products."""
    sigma = jax.vmap(model.sigma_at)(vectors, predicted)
    weight = 1.0 / sigma**2
    used = texels.used.astype(weight.dtype)
    values = jnp.where(texels.used, texels.values, 0.0)

    def product(readings: Array, of: Array) -> Array:
        return readings.reshape(len(readings), -1) @ of.reshape(len(of), -1).T

    squares = product(values**2, weight) - 2.0 * product(values, weight * predicted)
    squares += product(used, weight * predicted**2 + 2.0 * jnp.log(sigma))
    return jnp.argsort(jnp.where(jnp.isnan(squares), jnp.inf, squares), axis=1)
