"""Which stack of layers is behind the data: stacks from a library grow and shrink by a layer, and are ranked by what
they foretell.

Every structure of a level is fitted with noise alone, at a coarse resolution: that is cheap, and tells by the Bayesian
information criterion which of them are worth a closer look. These few are fitted as `fits.fit` does, with errors that
readings share where residuals say so, and ranked by what they foretell of held-out incidences (`cross_validate`).
The next level has a layer more, or less, than the best of all. It ends where a level neither foretells more than
chance would nor has a clearly lower criterion: with errors that readings share, a stack that lacks two layers may
foretell as well as one that lacks one.
"""

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from fits.data.measurements import Measurements
from fits.optimise.discrepancy import needs_discrepancy, undecided, without_discrepancy
from fits.optimise.fit import fit_again, fit_problem
from fits.optimise.result import Fit
from fits.prediction.cross_validation import CrossValidation
from fits.prediction.evidence import Evidence
from fits.prediction.model_scores import ModelScore, out_of_sample, rank_models
from fits.problem.compilation import cores, make_room
from fits.problem.instrument import Instrument
from fits.problem.model import Transport
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.problem.problem import Problem
from fits.progress import Progress
from fits.structure_search.files import Kept
from fits.structure_search.library import Library, Structure, default_library
from layerjax._checks import in_short, require_kind

STARTS = 8
BEAM = 2
"""So many of the lowest criterion grow and shrink, and that which foretells best."""

STRONG = 10.0
"""A level that does not foretell more is gone on from where its criterion is lower by more than this."""

CLOSER = 3
"""So many of a level are looked at closely, besides those that were before."""

TOGETHER = 8
"""Structures at a time, at most: as many programs as a process can hold beside those that it has."""


Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Found:
    """A structure that was fitted. name: from top to bottom. bic: with noise alone, less that of the best. fit: closer,
    if it was looked at, else with noise alone. model_score: None if it was not looked at closely."""

    structure: Structure
    parameters: int
    bic: float
    fit: Fit
    model_score: ModelScore | None

    @property
    def name(self) -> str:
        """As words."""
        return named(self.structure)


@dataclass(frozen=True, eq=False)
class Search:
    """Structures that were fitted, best first: by what they foretell, then by the information criterion.

    alike: names of those that the data cannot tell from the best. stopped: its budget ended it before it was done.
    """

    found: tuple[Found, ...]
    alike: tuple[str, ...]
    stopped: bool = False

    @property
    def best(self) -> Found:
        """What foretells best."""
        return self.found[0]

    @property
    def ranking(self) -> tuple[str, ...]:
        """Names of all structures, best first."""
        return tuple(one.name for one in self.found)

    @property
    def probabilities(self) -> dict[str, float]:
        """By name, of the structures that were looked at closely: among these, all as probable beforehand."""
        return {one.name: one.model_score.model_probability for one in self.found if one.model_score is not None}


def named(structure: Structure) -> str:
    """A structure as words."""
    return " / ".join(structure)


def search(
    data: Measurements,
    library: Library | None = None,
    *,
    layers: int = 3,
    transport: Transport = "auto",
    noise: Noise | None = None,
    scale: float | Free | None = None,
    instrument: Instrument | None = None,
    starts: int = STARTS,
    seed: int = 0,
    progress: Progress | None = None,
    directory: str | Path | None = None,
    budget: float | None = None,
) -> Search:
    """Look for the stack behind the data among those that a library's layers and bases make.

    Args:
        data: only the samples that its mask leaves in are used.
        library: `default_library` for the channels of the data, if None.
        layers: at most so many over the base, in [0, 6].
        transport, noise, scale, instrument: see `Problem`; "auto" carries all orders of scattering.
        starts, seed: of each fit, see `fit`.
        progress: called with (what is done, structures done, structures of this level, note).
        directory: where each structure is kept as it is fitted: a search that was killed takes those for done. Of
            another search it is refused.
        budget: minutes after which no structure is begun any more, but those that a result needs; what was begun is
            finished. With the same `directory` another call goes on.

    Raises:
        ValueError: layers or budget out of range; another search's directory; or as `fit` and `cross_validate`.
    """
    require_kind("data", data, Measurements)
    require_kind("library", library, Library, None)
    require_kind("noise", noise, Noise, None)
    if not (isinstance(layers, int) and 0 <= layers <= 6):
        raise ValueError(f"layers is {in_short(layers)}; it must be in [0, 6]")
    if budget is not None and not (math.isfinite(budget) and budget >= 0.0):
        raise ValueError(f"budget is {budget}; it must be a number of minutes of at least 0")
    until = math.inf if budget is None else time.monotonic() + 60.0 * budget
    library = default_library(len(data.channels)) if library is None else library
    noise = Noise() if noise is None else noise
    # without an instrument it is the same search as before there were any
    settings = (library, noise, scale, transport, starts, seed, *([] if instrument is None else [instrument]))
    with nullcontext() if directory is None else Kept(directory, data, *settings) as kept:
        run = _Fitting(data, library, transport, noise, scale, instrument, starts, seed, kept)
        return _searched(run, _Looked(kept), layers, progress, until)


def _searched(
    run: "_Fitting", looked: "_Looked", layers: int, progress: Progress | None, until: float = math.inf
) -> Search:
    """Level by level, as long as a level foretells more than those before, or fits better by more than it costs.

    until: of the monotonic clock, in seconds, after which nothing more is begun.
    """
    library, stopped = run.library, False
    level: list[Structure] = [(base,) for base in library.bases]
    while level:
        before, lowest = looked.best(), looked.lowest()
        stopped = before is not None and time.monotonic() > until
        if stopped:
            break
        _screen(level, run, looked, progress, until)
        fitted = [one for one in level if one in looked.plain]
        closer = sorted(fitted, key=looked.bic)[:CLOSER]
        _look_closer(closer, run, looked, progress, until)
        stopped = len(fitted) < len(level) or any(one not in looked.left for one in closer)
        if stopped:
            break
        if before is not None and not looked.ahead(before) and not looked.lowest() < lowest - STRONG:
            break
        level = _next(looked, library, layers)
    _report(progress, "closer look", 1, 1, None)
    return replace(looked.result(), stopped=stopped)


@dataclass(frozen=True)
class _Fitting:
    """Fits structures, or takes what was kept of them."""

    data: Measurements
    library: Library
    transport: Transport
    noise: Noise
    scale: float | Free | None
    instrument: Instrument | None
    starts: int
    seed: int
    kept: Kept | None

    def __call__(self, structure: Structure, plain: Fit | None = None) -> Fit:
        """With noise alone at a coarse resolution; closer after that, with the fit that is `plain`."""
        closer = plain is not None
        found = self.kept.fit(structure, closer) if self.kept is not None else None
        if found is None:
            found = self._fitted(structure, plain)
            if self.kept is not None:
                self.kept.keep(structure, closer, found)
        return found

    def _fitted(self, structure: Structure, plain: Fit | None) -> Fit:
        stack = self.library.stack(structure)
        problem = Problem(stack, self.data, self.transport, self.noise, self.scale, instrument=self.instrument)
        if plain is not None and undecided(problem) and needs_discrepancy(without_discrepancy(plain)):
            return fit_again(problem, plain, starts=self.starts, seed=self.seed)
        if plain is None or undecided(problem):
            problem = replace(problem, noise=replace(self.noise, discrepancy=False))
        return fit_problem(problem, starts=self.starts, seed=self.seed, refine=plain is not None)


def _screen(level: list[Structure], run: _Fitting, looked: "_Looked", progress: Progress | None, until: float) -> None:
    """Fit structures with noise alone, some at a time: to compile one keeps a single core busy."""
    _report(progress, f"{len(level[0]) - 1} layers", 0, len(level), level[0])
    for done, (structure, found) in enumerate(_at_a_time(run, level, until), 1):
        looked.plain[structure] = found
        _report(progress, f"{len(level[0]) - 1} layers", done, len(level), structure)


def _look_closer(
    closer: list[Structure], run: _Fitting, looked: "_Looked", progress: Progress | None, until: float
) -> None:
    """At some structures of a level at a time, as they are screened."""
    _report(progress, "closer look", 0, len(closer), closer[0])
    for done, (structure, _) in enumerate(_at_a_time(lambda one: looked.look(one, run), closer, until), 1):
        _report(progress, "closer look", done, len(closer), structure)


def _at_a_time(
    call: Callable[[Structure], Result], structures: list[Structure], until: float
) -> Iterator[tuple[Structure, Result]]:
    """Structures with what the call gives of them, some on all cores at a time, and none runs while programs go.

    The first of them whatever the time, others until then.
    """
    together = min(cores(), TOGETHER)
    with ThreadPoolExecutor(together) as pool:
        for first in range(0, len(structures), together):
            if first and time.monotonic() > until:
                return
            make_room()
            some = structures[first : first + together]
            yield from zip(some, pool.map(call, some), strict=True)


def _next(looked: "_Looked", library: Library, layers: int) -> list[Structure]:
    """Structures not fitted before, a layer more or less than what foretells best and what fits best."""
    grown: list[Structure] = []
    best = looked.ranked()[:1] + sorted(looked.plain, key=looked.bic)[:BEAM]
    for structure in dict.fromkeys(best):
        above, base = structure[:-1], structure[-1]
        shrunk = [(*above[:place], *above[place + 1 :], base) for place in range(len(above))]
        more = [
            (*above[:place], layer, *above[place:], base)
            for place in range(len(above) + 1)
            for layer in library.layers
            if len(above) < layers
        ]
        grown += [one for one in (*shrunk, *more) if all(a != b for a, b in pairwise(one))]
    return [one for one in dict.fromkeys(grown) if one not in looked.plain]


class _Looked:
    """What was fitted so far, and what the closer looks found."""

    def __init__(self, kept: Kept | None):
        self.kept = kept
        self.plain: dict[Structure, Fit] = {}
        self.fits: dict[Structure, Fit] = {}
        self.left: dict[Structure, CrossValidation] = {}
        self.evidences: dict[Structure, Evidence] = {}

    def bic(self, structure: Structure) -> float:
        fit = self.plain[structure]
        return len(fit.vector) * float(np.log(fit.problem.count)) - 2.0 * fit.log_likelihood

    def lowest(self) -> float:
        """The lowest criterion so far."""
        return min(map(self.bic, self.plain), default=np.inf)

    def look(self, structure: Structure, run: _Fitting) -> None:
        found = self.fits[structure] = run(structure, self.plain[structure])
        stored = self.kept.look(structure) if self.kept is not None else None
        if stored is None:
            stored = out_of_sample(found, done=None if self.kept is None else self.kept.groups(structure, found))
            if self.kept is not None:
                self.kept.keep_look(structure, *stored)
        self.left[structure], self.evidences[structure] = stored

    def ranked(self) -> list[Structure]:
        return sorted(self.left, key=lambda one: -self.left[one].elpd)

    def best(self) -> Structure | None:
        return self.ranked()[0] if self.left else None

    def ahead(self, before: Structure) -> bool:
        """Whether the best is clearly better than what was it before."""
        return self.ranked()[0] != before and self.model_scores()[named(before)].clear_diff > 0.0

    def model_scores(self) -> dict[str, ModelScore]:
        ranked = self.ranked()
        return rank_models(
            {named(one): self.left[one] for one in ranked}, {named(one): self.evidences[one] for one in ranked}
        )

    def result(self) -> Search:
        ranked = self.ranked()
        model_scores = self.model_scores()
        lowest = self.lowest()
        rest = sorted((one for one in self.plain if one not in self.left), key=self.bic)
        found = tuple(
            Found(
                structure=one,
                parameters=len(self.fits.get(one, self.plain[one]).vector),
                bic=self.bic(one) - lowest,
                fit=self.fits.get(one, self.plain[one]),
                model_score=model_scores.get(named(one)),
            )
            for one in (*ranked, *rest)
        )
        alike = tuple(name for name, seen in model_scores.items() if name != found[0].name and seen.clear_diff <= 0.0)
        return Search(found, alike)


def _report(progress: Progress | None, stage: str, done: int, total: int, structure: Structure | None) -> None:
    if progress is not None:
        progress(stage, done, total, "" if structure is None else named(structure))
