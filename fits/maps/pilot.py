"""A sample of a map, fitted first: at which resolution its stacks are solved, and where all other fits begin."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.maps.searching import Ends, Starts, all_predicted, reduced_chi_square, search, starts_at
from fits.maps.solving import Found, solve
from fits.maps.texels import Texels
from fits.optimise import apertures
from fits.optimise.fit import fit_problem
from fits.optimise.multi_start import start_points
from fits.optimise.options import DEFAULT
from fits.optimise.refinement import resolution_in_words
from fits.optimise.resolution import Resolutions, resolutions
from fits.problem.model import Model
from fits.problem.problem import Problem
from fits.progress import Progress

Floats = NDArray[np.float64]

FIRST = 8
"""Texels of the sample that are fitted from all starts; the rest of it begins where these ended."""

USUAL, ALLOWED = 0.9, 1.5
"""A reduced chi-square is as expected up to this multiple of this quantile of the sample's."""


@dataclass(frozen=True)
class Pilot:
    """What a sample of S texels says of a map.

    Attributes:
        problem: with the resolution that the noise asks for.
        starts: of all other fits.
        ends: of the sample.
        reduced: its reduced chi-squares, (S,).
        numerical_error: of the model, in standard deviations, at most; None if the transport has none.
        resolution: in words; "" if there is nothing to choose.
    """

    problem: Problem
    starts: Starts
    ends: Ends
    reduced: Floats
    numerical_error: float | None
    resolution: str


def resolved(problem: Problem, starts: int, seed: int, progress: Progress | None) -> tuple[Problem, Resolutions | None]:
    """The problem at the resolution that a fit of its own readings ends with, and the resolutions that there are."""
    known = resolutions(problem)
    if not (apertures.leaves_open(problem) or (known is not None and known.open)):
        return problem, known
    found = fit_problem(problem, starts=starts, seed=seed, progress=progress).problem
    return replace(problem, transport=found.transport, instrument=found.instrument), known


def fly(
    problem: Problem,
    known: Resolutions | None,
    sample: Texels,
    *,
    starts: int,
    seed: int,
    size: int,
    prepare: Callable[[Problem], Problem] = lambda problem: problem,
) -> Pilot:
    """Fit the sample, at a finer resolution if its noise asks for it.

    Args:
        problem: a prototype, whose readings each texel's take the place of.
        known: its resolutions.
        size: of programs: texels at a time.
        prepare: what makes a problem cheap to evaluate, such as a table of it.
    """
    while True:
        ready = prepare(problem)
        pilot = _fitted(ready, sample, starts, seed, size)
        if (known is None and not apertures.has_rays(problem)) or sample.wi is not None:
            return pilot
        finer = None if known is None else known.finer(problem.transport)  # type: ignore[arg-type]
        fine = None if finer is None else replace(problem, transport=finer)
        error = 0.0 if fine is None else _numerical_error(ready, fine, pilot.ends, sample)
        rays = (
            _numerical_error(ready, problem.with_other_rays(), pilot.ends, sample)
            if apertures.has_rays(problem)
            else 0.0
        )
        pilot = replace(pilot, numerical_error=error + rays, resolution=resolution_in_words(problem, known))
        if not (known is not None and known.open and fine is not None and error > DEFAULT.numerical_error):
            return pilot
        problem = fine


def _fitted(problem: Problem, sample: Texels, starts: int, seed: int, size: int) -> Pilot:
    points = start_points(problem, starts, seed)
    own = sample.wi is not None
    first = np.unique(np.linspace(0, sample.number - 1, min(FIRST, sample.number)).astype(int))
    opened = from_all(problem, points, sample.rows(first), size)
    ends = search(problem, starts_at(problem, distinct(opened), points[1:], own, size), sample, size)
    reduced = reduced_chi_square(ends.found, sample)
    finite = reduced[np.isfinite(reduced)]
    expected = ALLOWED * float(np.quantile(finite, USUAL)) if finite.size else 0.0
    best = starts_at(problem, distinct(ends.found), points[1:], own, size, expected)
    return Pilot(problem, best, ends, reduced, None, "")


def from_all(problem: Problem, points: Floats, texels: Texels, size: int) -> Found:
    """The lowest ends of texels from all of the points (starts, P) of the unit box."""
    best = None
    for point in points:
        found = solve(problem, np.tile(point, (texels.number, 1)), texels, size)
        if best is None:
            best = found
            continue
        rows = np.flatnonzero(best.better(found, slice(None)))
        best.put(rows, found.rows(rows))
    assert best is not None
    return best


def distinct(found: Found) -> Floats:
    """Where fits ended that can be begun from, (K, P): converged ones, or if there are none all that are finite."""
    finite = np.isfinite(found.cost) & np.all(np.isfinite(found.vector), axis=1)
    good = finite & found.converged
    vectors = found.vector[good if good.any() else finite]
    if not len(vectors):
        raise ValueError("values: no texel of the sample has a finite fit; are they in 1/sr?")
    return np.unique(vectors, axis=0)


def _numerical_error(ready: Problem, fine: Problem, ends: Ends, sample: Texels) -> float:
    """Of the sample, in standard deviations, at most, as a finer problem tells."""
    good = np.isfinite(ends.found.cost)
    vectors = ends.found.vector[good]
    if not len(vectors):
        return 0.0
    exact = all_predicted(fine, vectors)
    sigma = np.asarray(ready.call(_sigmas, vectors, exact), float)
    of_readings = np.where(sample.used[good], np.sqrt(sample.variance[good]), 0.0)
    error = np.abs(ends.found.predicted[good] - exact) / np.hypot(sigma, of_readings)
    return float(np.max(np.where(sample.used[good], error, 0.0)))


def _sigmas(model: Model, vectors: Array, predicted: Array) -> Array:
    return jax.vmap(model.sigma_at)(vectors, predicted)
