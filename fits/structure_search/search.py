"""The search for the stack behind data: stacks from a library grow and shrink by a layer, level by level.

Every stack of a level is fitted with independent noise at a coarse resolution, which is cheap, and those with the
lowest Bayesian information criterion (BIC) are fitted as `fits.fit` does and cross-validated, one incidence held out
after the other. The next level has a layer more, or less, than the best of all. The search ends where a level neither
predicts better beyond its error nor has a clearly lower BIC: with model discrepancy, a stack that lacks two layers may
predict as well as one that lacks one.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fits._files import named as errors_named
from fits.data.measurements import Measurements
from fits.optimise.fit import fit as run_fit
from fits.optimise.fit import fit_with_discrepancy, needs_discrepancy, undecided, without_discrepancy
from fits.optimise.options import DEFAULT, FitOptions
from fits.optimise.result import Fit
from fits.prediction.cross_validation import CrossValidation, ModelScore, out_of_sample, rank_models
from fits.prediction.importance import Evidence
from fits.problem.compilation import cores, make_room
from fits.problem.instrument import Instrument
from fits.problem.model import Transport
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.problem.problem import Problem
from fits.progress import Progress, silent
from fits.reports.results import load_fit, save_fit
from fits.store import Store, fingerprint, holds_other_files
from fits.structure_search.library import Library, Structure, default_library
from layerjax._checks import in_short, require_kind
from layerjax.compiling import programs_kept

STORE = "search.store"
TOGETHER = 8
"""Structures at a time, at most: as many programs as a process can hold beside those that it has."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class SearchOptions:
    """How far a search goes.

    Attributes:
        layers: at most so many over the base, in [0, 6].
        starts: of each fit, see `fits.fit`.
        beam: so many stacks of the lowest BIC grow and shrink, and the one that predicts best.
        cross_validated: so many of a level, those of its lowest BIC, are cross-validated.
        bic_gain: a level that does not predict better is followed by another if it lowers the BIC by more than this.
        budget: minutes after which no stack is begun any more, but those that a result needs; what was begun is
            finished. None: without end.
        fit: tolerances and thresholds of each fit, of which some decide on a model discrepancy.
    """

    layers: int = 3
    starts: int = 8
    beam: int = 2
    cross_validated: int = 3
    bic_gain: float = 10.0
    budget: float | None = None
    fit: FitOptions = DEFAULT

    def __post_init__(self) -> None:
        most = {"layers": (0, 6), "starts": (1, math.inf), "beam": (1, math.inf), "cross_validated": (1, math.inf)}
        for name, (low, high) in most.items():
            number = getattr(self, name)
            if not (isinstance(number, int) and low <= number <= high):
                raise ValueError(f"{name} is {in_short(number)}; it must be a whole number in [{low}, {high}]")
        for name in ("bic_gain", "budget"):
            number = getattr(self, name)
            if number is not None and not 0.0 <= number < math.inf:
                raise ValueError(f"{name} is {in_short(number)}; it must be a finite number of at least 0")
        require_kind("fit", self.fit, FitOptions)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A stack that was fitted.

    Attributes:
        structure: its layers from the top, and its base.
        parameters: how many are free in its fit.
        bic: of the fit with independent noise, less the lowest of all.
        fit: at full resolution if it was cross-validated, else the one with independent noise.
        model_score: predictive score and evidence; None if it was not cross-validated.
    """

    structure: Structure
    parameters: int
    bic: float
    fit: Fit
    model_score: ModelScore | None

    @property
    def name(self) -> str:
        """The structure as words."""
        return named(self.structure)


@dataclass(frozen=True, eq=False)
class Search:
    """What a search found.

    Attributes:
        candidates: all stacks that were fitted, best first: by predictive score, then by BIC.
        indistinguishable: names of those whose predictive score is within its error of the best.
        options: of the search.
        stopped: whether its budget ended it before it was done.
    """

    candidates: tuple[Candidate, ...]
    indistinguishable: tuple[str, ...]
    options: SearchOptions = SearchOptions()
    stopped: bool = False

    @property
    def best(self) -> Candidate:
        """The one with the best predictive score."""
        return self.candidates[0]

    @property
    def ranking(self) -> tuple[str, ...]:
        """Names of all stacks, best first."""
        return tuple(one.name for one in self.candidates)

    @property
    def probabilities(self) -> dict[str, float]:
        """Model probabilities by name, among the cross-validated stacks, all as probable beforehand."""
        return {one.name: one.model_score.model_probability for one in self.candidates if one.model_score is not None}


def named(structure: Structure) -> str:
    """A structure as words."""
    return " / ".join(structure)


@programs_kept()
def search(
    data: Measurements,
    library: Library | None = None,
    *,
    transport: Transport = "auto",
    noise: Noise | None = None,
    scale: float | Free | None = None,
    instrument: Instrument | None = None,
    seed: int = 0,
    options: SearchOptions | None = None,
    directory: str | Path | None = None,
    progress: Progress | None = None,
) -> Search:
    """Look for the stack behind the data among those that a library's layers and bases make.

    Args:
        data: only the samples that its mask leaves in are used.
        library: `default_library` for the channels of the data, if None.
        transport, noise, scale, instrument: see `Problem`; "auto" carries all orders of scattering.
        seed: of the starts, see `fit`.
        options: how far the search goes.
        directory: keeps every fit and cross-validation as it is finished: a search that was killed, or whose
            budget ended it, is resumed there. The fits are result directories.
        progress: called with (what is done, structures done, structures of this level, note).

    Raises:
        ValueError: the directory is in use, or holds another search or something else; as `fit`, `cross_validate`.
    """
    require_kind("data", data, Measurements)
    require_kind("library", library, Library, None)
    require_kind("noise", noise, Noise, None)
    require_kind("options", options, SearchOptions, None)
    library = default_library(len(data.channels)) if library is None else library
    options = options or SearchOptions()
    settings = {"transport": transport, "noise": noise or Noise(), "scale": scale, "instrument": instrument}
    until = math.inf if options.budget is None else time.monotonic() + 60.0 * options.budget
    used = data.used()
    numbers = [used.wi, used.wo, used.values, used.sigma]
    # how far it goes is no part of whose search it is: one may go on where another has ended
    starting = {"starts": options.starts, "seed": seed, "fit": options.fit}
    whose = fingerprint(data=numbers, library=library, **settings, **starting)
    with nullcontext() if directory is None else _opened(Path(directory), whose) as store:
        work = _Work(data, library, settings, options, seed, store, until, progress or silent)
        coarse: dict[Structure, Fit] = {}
        full: dict[Structure, _CrossValidated] = {}
        level: list[Structure] = [(base,) for base in library.bases]
        stopped = False
        while level and not stopped:
            leader, lowest = _ranked(full)[:1], min(map(_bic, coarse.values()), default=math.inf)
            if leader and time.monotonic() > until:
                stopped = True
                break
            # every structure of the level with independent noise, at a coarse resolution
            coarse |= work.in_parallel(f"{len(level[0]) - 1} layers", work.fit_coarsely, level)
            fitted = sorted((one for one in level if one in coarse), key=lambda one: _bic(coarse[one]))
            # those of the lowest BIC as `fits.fit` fits them, cross-validated
            chosen = fitted[: options.cross_validated]
            full |= work.in_parallel("cross-validation", partial(work.cross_validate, coarse), chosen)
            stopped = len(fitted) < len(level) or any(one not in full for one in chosen)
            # a level that neither predicts better nor lowers the BIC clearly is the last
            ahead = not leader or _scores(full)[named(leader[0])].clear_diff > 0.0
            if not ahead and not min(map(_bic, coarse.values())) < lowest - options.bic_gain:
                break
            by_bic = sorted(coarse, key=lambda one: _bic(coarse[one]))
            grown = _neighbours(library, dict.fromkeys(_ranked(full)[:1] + by_bic[: options.beam]), options.layers)
            level = [one for one in grown if one not in coarse]
        work.progress("cross-validation", 1, 1, "")
    return _result(coarse, full, options, stopped)


class _CrossValidated(NamedTuple):
    """A fit at full resolution, its cross-validation and its evidence."""

    fit: Fit
    checked: CrossValidation
    evidence: Evidence


@contextmanager
def _opened(directory: Path, whose: Mapping[str, str]) -> Iterator[Store]:
    """The store of a search in its directory, which is made if it is not there."""
    if holds_other_files(directory, STORE):
        raise ValueError(f"{directory}: is not empty, and holds no search")
    with errors_named(directory):
        directory.mkdir(parents=True, exist_ok=True)
    with Store.open(directory / STORE, whose) as store:
        yield store


class _Work(NamedTuple):
    """What the fits of a search have in common."""

    data: Measurements
    library: Library
    settings: Mapping[str, Any]
    options: SearchOptions
    seed: int
    store: Store | None
    until: float
    progress: Progress

    def fit_coarsely(self, structure: Structure) -> Fit:
        """The fit with independent noise at a coarse resolution."""
        return self._load_or_fit(
            structure, "", lambda: self._fit(self._problem(structure, independent=True), screen=True)
        )

    def cross_validate(self, coarse: Mapping[Structure, Fit], structure: Structure) -> _CrossValidated:
        """The fit as `fits.fit` fits it, with each incidence held out, and its evidence."""

        def fitted() -> Fit:
            problem, options = self._problem(structure), self.options
            if not undecided(problem):
                return self._fit(problem)
            if needs_discrepancy(without_discrepancy(coarse[structure]), options.fit):
                return fit_with_discrepancy(
                    problem, coarse[structure], starts=options.starts, seed=self.seed, options=options.fit
                )
            return self._fit(self._problem(structure, independent=True))

        fit = self._load_or_fit(structure, "+full", fitted)
        kept = None if self.store is None else self.store.get(named(structure))
        if kept is not None:
            checked = kept["cross-validation"]
            checked |= {"groups": tuple(checked["groups"]), "rows": tuple(checked["rows"])}
            return _CrossValidated(fit, CrossValidation(**checked), Evidence(**kept["evidence"]))
        found = _CrossValidated(fit, *out_of_sample(fit))
        if self.store is not None:
            record = {"cross-validation": vars(found.checked), "evidence": vars(found.evidence)}
            self.store.put(named(structure), record)
        return found

    def _problem(self, structure: Structure, independent: bool = False) -> Problem:
        problem = Problem(self.library.stack(structure), self.data, **self.settings)
        return replace(problem, noise=replace(problem.noise, discrepancy=False)) if independent else problem

    def _fit(self, problem: Problem, screen: bool = False) -> Fit:
        options = self.options
        return run_fit(problem, starts=options.starts, seed=self.seed, options=options.fit, screen=screen)

    def _load_or_fit(self, structure: Structure, kind: str, fitted: Callable[[], Fit]) -> Fit:
        """The fit of a structure, from its result directory if it is there."""
        if self.store is None:
            return fitted()
        path = self.store.path.with_name("+".join(name.replace(" ", "-") for name in structure) + kind)
        if path.is_dir():
            return load_fit(path)
        save_fit(found := fitted(), path)
        return found

    def in_parallel(
        self, stage: str, call: Callable[[Structure], Result], structures: list[Structure]
    ) -> dict[Structure, Result]:
        """What the call gives by structure: of the first few whatever the time, of the others while there is any.

        Several run at a time, since compiling one keeps a single core busy; none runs while programs are thrown away.
        """
        several, results = min(cores(), TOGETHER), dict[Structure, Result]()
        self.progress(stage, 0, len(structures), named(structures[0]))
        with ThreadPoolExecutor(several) as pool:
            for first in range(0, len(structures), several):
                if first and time.monotonic() > self.until:
                    break
                make_room()
                some = structures[first : first + several]
                for structure, result in zip(some, pool.map(call, some), strict=True):
                    results[structure] = result
                    self.progress(stage, len(results), len(structures), named(structure))
        return results


def _neighbours(library: Library, structures: Iterable[Structure], most: int) -> list[Structure]:
    """Structures with a layer more or less than one of these, and at most so many; none twice in a row."""
    neighbours: list[Structure] = []
    for *above, base in structures:
        neighbours += [(*above[:place], *above[place + 1 :], base) for place in range(len(above))]
        if len(above) < most:
            places = range(len(above) + 1)
            neighbours += [(*above[:at], layer, *above[at:], base) for at in places for layer in library.layers]
    return list(dict.fromkeys(one for one in neighbours if all(a != b for a, b in pairwise(one))))


def _bic(fit: Fit) -> float:
    """Bayesian information criterion of a fit with independent noise."""
    return len(fit.vector) * float(np.log(fit.problem.count)) - 2.0 * fit.log_likelihood


def _ranked(full: Mapping[Structure, _CrossValidated]) -> list[Structure]:
    """What was cross-validated, best first."""
    return sorted(full, key=lambda one: -full[one].checked.elpd)


def _scores(full: Mapping[Structure, _CrossValidated]) -> dict[str, ModelScore]:
    """Scores side by side by name, best first."""
    ranked = {named(one): full[one] for one in _ranked(full)}
    return rank_models(
        {name: one.checked for name, one in ranked.items()}, {name: one.evidence for name, one in ranked.items()}
    )


def _result(
    coarse: Mapping[Structure, Fit],
    full: Mapping[Structure, _CrossValidated],
    options: SearchOptions,
    stopped: bool,
) -> Search:
    """All that was fitted, ranked."""
    scores, bic = _scores(full), {structure: _bic(fit) for structure, fit in coarse.items()}
    candidates = []
    for structure in (*_ranked(full), *sorted((one for one in coarse if one not in full), key=bic.__getitem__)):
        fit = full[structure].fit if structure in full else coarse[structure]
        above = bic[structure] - min(bic.values())
        candidates.append(Candidate(structure, len(fit.vector), above, fit, scores.get(named(structure))))
    best = candidates[0].name
    near = tuple(name for name, one in scores.items() if name != best and one.indistinguishable)
    return Search(tuple(candidates), near, options, stopped)
