"""Many data sets of one problem, fitted by the same compiled programs."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fits.optimise.levenberg_marquardt import descent
from fits.optimise.multi_start import MOST_STEPS, start_points
from fits.optimise.resolution import resolutions
from fits.problem.compilation import on_all_cores
from fits.problem.problem import Problem

Floats = NDArray[np.float64]


class Repeats(NamedTuple):
    """Fits of K data sets: vectors and standard errors (K, P), cost and convergence (K,)."""

    vectors: Floats
    standard_errors: Floats
    cost: Floats
    converged: NDArray[np.bool_]


def fit_many(problem: Problem, values: ArrayLike, *, starts: int = 1, seed: int = 0) -> Repeats:
    """Fit K data sets (K, N, C) in the place of the problem's used values, by the same compiled programs.

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
    points, model, _ = start_points(problem, starts, seed), problem.model, problem.without_discrepancy
    if model.process is not None and model.process.projection is not None:  # that of the problem's own values
        model = replace(model, process=replace(model.process, projection=None))
    slopes = np.asarray(model.box.prior_slopes())

    def one(row: Floats) -> tuple[Floats, Floats, float, bool]:
        own = problem.with_model(eqx.tree_at(lambda m: m.values, model, jnp.asarray(row)))
        best = min((descent(own, point, True, MOST_STEPS) for point in points), key=lambda end: float(end.cost))
        covariance = np.linalg.pinv(best.root.T @ best.root + slopes.T @ slopes, hermitian=True)
        if problem.objective != "likelihood":
            covariance = covariance * 2.0 * best.cost / max(row.size - len(best.vector), 1)
        width = np.asarray(model.box.slope(jnp.asarray(best.vector)))
        return best.vector, np.sqrt(np.diagonal(covariance)) * width, best.cost, best.converged

    found = [one(values[0]), *on_all_cores(one, values[1:])]  # the first alone: it compiles the programs
    return Repeats(*(np.array(part) for part in zip(*found, strict=True)))
