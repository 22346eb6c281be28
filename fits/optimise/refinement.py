"""Refinement: from the outcomes of starts at a coarse resolution to the optimum at the one that the noise needs.

Programs of a finer resolution take seconds to compile: which one is needed is found out by values alone, and only the
minima that may be the best or as good as it are fitted again.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import layerjax as lj
from fits.optimise import apertures
from fits.optimise.multi_start import Solver, StartOutcome, bounded_descent, rough_descent, unit_of
from fits.optimise.options import FitOptions
from fits.optimise.polish import Optimum, polish
from fits.optimise.resolution import Resolutions, Values
from fits.problem.model import Density
from fits.problem.problem import FittingProblem, Problem
from fits.progress import Progress

SAME_OUTCOME = 0.01
"""Of the box: ends that are closer in every parameter are fitted again as one."""

MINOR_SHARE = 0.5
"""Of the numerical error that is allowed: left to nodes or modes where the other is what has to be finer."""

MOST_MINIMA = 8
"""Minima that are fitted again, at most, other than those that turn out to be the best."""


class Accuracy(NamedTuple):
    """The resolution of a fit in words, the numerical error there in standard deviations, and what is said of it."""

    resolution: str
    error: float
    words: str


def refined(
    at: Optimum,
    known: Mapping[str, Resolutions],
    open_rays: Set[str],
    solver: Solver,
    options: FitOptions,
    progress: Progress,
) -> tuple[Optimum, Accuracy]:
    """The optimum at the resolution that the noise of each measurement asks for; at the given one where one is given.

    known: of those measurements whose transport has one, by name. open_rays: names of those whose instrument leaves
    open how many rays stand for its cones.
    """
    own = {name: at.problem.problems[name].transport if one.open else one.chosen for name, one in known.items()}
    while True:
        shares, needed, found = at.problem.shares(at.predicted), dict(own), {}
        changed: dict[str, Problem] = {}
        for name, problem in at.problem.problems.items():
            vector, parts = at.lowest.vector[list(at.problem.places(name))], []
            if name in known:
                one = known[name]
                values = Values(problem, own[name], vector, shares[name])
                needed[name], error, finest = _needed(one, own[name], values, options.numerical_error, progress)
                parts.append(_accuracy(one.in_words(own[name]), error, finest, one.open))
                if needed[name] != own[name] and one.open:
                    changed[name] = replace(problem, transport=needed[name])
            if apertures.has_rays(problem):
                rays = apertures.needed(
                    problem, vector, shares[name], name in open_rays, options.numerical_error, progress
                )
                parts.append(_accuracy(apertures.in_words(rays.rings), rays.error, False, name in open_rays))
                if rays.rings != apertures.rings_of(problem):
                    changed[name] = apertures.with_rings(changed.get(name, problem), rays.rings)
            if parts:
                found[name] = _of_both(parts)
        if not changed:
            return at, _together(found)
        own = needed
        problem = at.problem.with_problems(changed)
        words = _listed({name: resolution_in_words(problem.problems[name], known.get(name)) for name in found})
        ends = _fitted_again(at, problem, solver, words, options.equivalent_cost, progress)
        again = polish(problem, ends, solver, check=at.improved)
        at = again._replace(improved=again.improved or at.improved)


def _together(found: Mapping[str, Accuracy]) -> Accuracy:
    """What is said of several measurements: the largest error, and the words of each."""
    resolution = _listed({name: one.resolution for name, one in found.items()})
    words = _listed({name: one.words for name, one in found.items()})
    return Accuracy(resolution, float(np.max([one.error for one in found.values()])), words)


def _listed(words: Mapping[str, str]) -> str:
    return "; ".join(f"{name}: {one}" if name else one for name, one in words.items())


def resolution_in_words(problem: Problem, known: Resolutions | None) -> str:
    """The resolution of a problem whose transport may have one."""
    parts = []
    if known is not None:
        own = problem.transport if known.open else known.chosen
        assert isinstance(own, lj.AddingDoubling)
        parts.append(known.in_words(own))
    if apertures.has_rays(problem):
        parts.append(apertures.in_words(apertures.rings_of(problem)))
    return ", ".join(parts)


def _needed(
    known: Resolutions, own: lj.AddingDoubling, values: Values, allowed: float, progress: Progress
) -> tuple[lj.AddingDoubling, float, bool]:
    """The coarsest resolution from its own on that is fine enough, its error, and whether it is the finest there is."""

    def error(one: lj.AddingDoubling, other: lj.AddingDoubling) -> float:
        found = values.error(one, other)
        progress("numerical error", values.count, None, f"{found:.2g} sigma at {known.in_words(own)}")
        return found

    finer = known.finer(own)
    if finer is None:
        return own, error(known.coarser(own), own), True
    found = error(own, finer)
    while known.open and found > allowed:
        parts = known.partly_finer(own, finer)
        own = next((part for part in parts if error(part, finer) <= MINOR_SHARE * allowed), finer)
        finer = known.finer(own)
        if finer is None:
            return own, found, True
        found = error(own, finer)
    return own, found, False


def _accuracy(resolution: str, error: float, finest: bool, is_open: bool) -> Accuracy:
    if not np.isfinite(error):
        words = f"not known at {resolution}"
    elif finest:
        words = f"up to {error:.2g} sigma at {resolution}{', the finest tried' if is_open else ''}"
    else:
        words = f"{error:.2g} sigma at most at {resolution}{'' if is_open else ', as given'}"
    return Accuracy(resolution, error, words)


def _of_both(parts: Sequence[Accuracy]) -> Accuracy:
    """What is said of one measurement whose transport has a resolution and whose instrument has rays: errors add up."""
    resolution, words = (", ".join(getattr(one, of) for one in parts) for of in ("resolution", "words"))
    error = float(np.sum([one.error for one in parts]))
    return Accuracy(resolution, error, f"numerical error of the model: {words}")


def _fitted_again(
    at: Optimum, problem: FittingProblem, solver: Solver, words: str, equivalent: float, progress: Progress
) -> list[StartOutcome]:
    """The ends at another resolution: those that matter fitted again, the cost of the others there."""
    solve = rough_descent if solver == "least_squares" else bounded_descent
    groups = _grouped(at)
    before = [at.ends[group[0]] for group in groups]
    ends = [end._replace(cost=_cost(problem, end)) for end in before]
    moved = np.abs([new.cost - old.cost for new, old in zip(ends, before, strict=True)])
    behind = np.array([end.cost - before[0].cost for end in before])
    matter = np.flatnonzero(~(behind > equivalent * at.excess + np.fmax(moved, moved[0])))
    wanted, done = [int(index) for index in matter[:MOST_MINIMA]], 0
    fitted: set[int] = set()
    while wanted:
        for index in wanted:
            end = solve(problem, unit_of(problem, before[index].vector), False)
            ends[index] = end._replace(steps=before[index].steps + end.steps)
            fitted.add(index)
            done += 1
            progress(f"fit at {words}", done, len(fitted | set(wanted)), f"best cost {min(e.cost for e in ends):.6g}")
        lowest = int(np.argmin([end.cost for end in ends]))
        wanted = [] if lowest in fitted else [lowest]
    result = list(at.ends)
    for group, end in zip(groups, ends, strict=True):
        for index in group:
            result[index] = end
    return result


def _grouped(at: Optimum) -> list[list[int]]:
    """Places of the ends with a finite cost, in groups of ends that lie close together, lowest first."""
    groups: list[list[int]] = []
    units = [unit_of(at.problem, end.vector) for end in at.ends]
    order = sorted(range(len(at.ends)), key=lambda index: (index != at.best, at.ends[index].cost))
    for index in order:
        if not np.isfinite(at.ends[index].cost):
            continue
        for group in groups:
            if np.max(np.abs(units[index] - units[group[0]])) < SAME_OUTCOME:
                group.append(index)
                break
        else:
            groups.append([index])
    return groups


def _cost(problem: FittingProblem, end: StartOutcome) -> float:
    """What the end of another resolution costs at the problem's own; infinite where that is not finite."""
    cost = float(problem.call(Density.cost_at, end.vector, problem.predict(end.vector)))
    return cost if np.isfinite(cost) else np.inf
