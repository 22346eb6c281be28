"""How many rays stand for the cones of a fit's instrument: as many as the lobe asks for that is found.

Starts take as many as the start values ask for, but few. At the optimum more are tried, by values alone, until they
change nothing.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fits.optimise.resolution import spread
from fits.problem.aperture_rays import most_rings
from fits.problem.instrument import rings_for
from fits.problem.problem import Problem
from fits.progress import Progress

ENOUGH_OF_PEAK = 1e-3
"""Numerical error of measurements, in units of the largest, that no fit needs to fall below."""

NO_BETTER = 0.3
"""Share of an error: a ring more that leaves as much of it costs more than it gains; of a lobe it leaves a fifth."""

FAR_RINGS = 2
"""The most rings of a cone where starts are fitted."""

Floats = NDArray[np.float64]


class Needed(NamedTuple):
    """Rings that the cones of a problem need, and the numerical error there, in standard deviations."""

    rings: int
    error: float


def has_rays(problem: Problem) -> bool:
    """Whether measurements are means over cones."""
    return problem.model.optics is not None and problem.model.optics.row is not None


def leaves_open(problem: Problem) -> bool:
    """Whether a fit chooses how many rays there are."""
    return has_rays(problem) and problem.instrument is not None and problem.instrument.rings is None


def rings_of(problem: Problem) -> int:
    """Rings of a cone that the problem has."""
    assert problem.instrument is not None
    return problem.instrument.rings or 1


def with_rings(problem: Problem, rings: int) -> Problem:
    """The problem with so many of a cone."""
    assert problem.instrument is not None
    return replace(problem, instrument=replace(problem.instrument, rings=rings))


def for_starts(problem: Problem) -> Problem:
    """The problem with the rings that its start values ask for, if it gives none."""
    if not leaves_open(problem):
        return problem
    return with_rings(problem, min(_of_lobes(problem, problem.start), FAR_RINGS))


def needed(
    problem: Problem, vector: Floats, predicted: Floats, is_open: bool, allowed: float, progress: Progress
) -> Needed:
    """Rings from those on that the problem has: so many that more of them, with these parameters, change too little.

    predicted: by the problem, (N, C). is_open: False: those that it has, with their error. allowed: numerical error, in
    standard deviations of the data.
    """
    assert problem.instrument is not None
    rings, values = rings_of(problem), predicted
    most = most_rings(problem.instrument.source_aperture, problem.instrument.detector_aperture)
    sigma, peak = spread(problem, vector, predicted), np.max(np.abs(predicted))
    wanted = min(_of_lobes(problem, vector), most)
    if is_open and wanted > rings:
        rings = wanted
        values = np.asarray(with_rings(problem, rings).predict(vector), float)
    before = np.inf
    while True:
        other = with_rings(problem, max(rings, wanted)).with_other_rays()
        apart = np.abs(values - np.asarray(other.predict(vector), float))
        error = float(np.max(apart / sigma))
        progress("numerical error", rings, None, f"{error:.2g} sigma at {in_words(rings)}")
        if error > NO_BETTER * before:  # not of the lobe, but of cones that the horizon cuts, say
            return Needed(rings - 1, before)
        if not is_open or rings == most or (error <= allowed and np.max(apart) <= ENOUGH_OF_PEAK * peak):
            return Needed(rings, error)
        rings, before = rings + 1, error
        values = np.asarray(with_rings(problem, rings).predict(vector), float)


def in_words(rings: int) -> str:
    """Such as "2 rings of rays a cone"."""
    return f"{rings} ring{'s' if rings > 1 else ''} of rays a cone"


def _of_lobes(problem: Problem, vector: Floats) -> int:
    """Rings that the lobes of the stack ask for with this vector (P,)."""
    parts, data = problem.build(vector), problem.data.used()
    assert problem.instrument is not None
    assert parts.instrument is not None
    return rings_for(problem.instrument, parts.instrument, parts.stack, data.wi, data.wo)
