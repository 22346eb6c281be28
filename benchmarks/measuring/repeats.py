"""Many data sets of one problem, fitted in one compiled program."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from fits.optimise.levenberg_marquardt import COST_TOLERANCE, descend
from fits.optimise.multi_start import MOST_STEPS, start_points
from fits.optimise.resolution import resolutions
from fits.problem.compilation import cores, in_shares
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]


class Repeats(NamedTuple):
    """Fits of K data sets: vectors and standard errors (K, P), cost and convergence (K,)."""

    vectors: Floats
    standard_errors: Floats
    cost: Floats
    converged: NDArray[np.bool_]


def fit_many(problem: Problem, values: ArrayLike, *, starts: int = 1, seed: int = 0) -> Repeats:
    """Fit K data sets (K, N, C) in the place of the problem's used values, in one compiled program.

    Args:
        problem: gives the stack, the directions and the noise. A transport without a resolution of its own takes that
            of the start values; the problem of a `Fit` has the one that the noise requires.
        values: BSDF in 1/sr, (K, N, C).
        starts: of each fit; the lowest minimum is returned, converged or not.
        seed: random seed of the starts.

    Returns:
        Vectors and standard errors (K, P), costs and convergence (K,). The errors are those of the unbounded optimum:
        they mean nothing for parameters at a bound.

    Raises:
        ValueError: values of another shape.
    """
    values, known = np.asarray(values, float), resolutions(problem)
    if known is not None and known.open:  # the resolution that the start values ask for
        problem = replace(problem, transport=known.chosen)
    expected = problem.model.values.shape
    if values.ndim != 3 or values.shape[1:] != expected:
        raise ValueError(f"values has shape {values.shape}; it must be (K, {expected[0]}, {expected[1]})")
    points = start_points(problem, starts, seed)
    workers = max(1, min(cores(), len(values)))
    share = -(-len(values) // (4 * workers)) if workers > 1 else len(values)
    return Repeats(*in_shares(lambda part: problem.call(_solve_repeats, points, part), values, share))


def _solve_repeats(model: Model, starts: Array, values: Array) -> tuple[Array, Array, Array, Array]:
    if model.process is not None and model.process.projection is not None:  # that of the problem's own values
        model = replace(model, process=replace(model.process, projection=None))

    def one(row: Array) -> tuple[Array, Array, Array, Array]:
        repeat = eqx.tree_at(lambda m: m.values, model, row)
        most, tolerance = jnp.asarray(MOST_STEPS), jnp.asarray(COST_TOLERANCE)
        outcomes = jax.lax.map(lambda start: descend(repeat, start, jnp.asarray(True), most, tolerance), starts)
        best = jax.tree.map(lambda part: part[jnp.argmin(outcomes.cost)], outcomes)
        width = model.box.slope(best.vector)
        slopes = model.box.prior_slopes()
        covariance = jnp.linalg.pinv(best.root.T @ best.root + slopes.T @ slopes, hermitian=True)
        if model.objective != "likelihood":
            covariance = covariance * 2.0 * best.cost / max(row.size - width.size, 1)
        return best.vector, jnp.sqrt(jnp.diagonal(covariance)) * width, best.cost, best.converged

    return jax.lax.map(one, values)
