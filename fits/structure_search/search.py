"""The search for the stack behind data: stacks from a library grow and shrink by a layer, level by level.

Every stack of a level is fitted with independent noise at a coarse resolution, which is cheap, and those with the
lowest Bayesian information criterion (BIC) are fitted as `fits.fit` does and cross-validated, one incidence held out
after the other. The next level has a layer more, or less, than the best of all. The search ends where a level neither
predicts better beyond its error nor has a clearly lower BIC: with model discrepancy, a stack that lacks two layers may
predict as well as one that lacks one.
"""

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fits._files import named as errors_named
from fits.data.measurements import Measurements
from fits.optimise.fit import fit, fit_with_discrepancy, needs_discrepancy, undecided, without_discrepancy
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
    """

    layers: int = 3
    starts: int = 8
    beam: int = 2
    cross_validated: int = 3
    bic_gain: float = 10.0
    budget: float | None = None

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
        directory: keeps every fit and every held-out incidence as it is finished: a search that was killed, or whose
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
    options = SearchOptions() if options is None else options
    settings = {
        "transport": transport,
        "noise": Noise() if noise is None else noise,
        "scale": scale,
        "instrument": instrument,
    }
    with ExitStack() as stack:
        store = None
        if directory is not None:
            used, directory = data.used(), Path(directory)
            numbers = [used.wi, used.wo, used.values, used.sigma]
            whose = fingerprint(data=numbers, library=library, **settings, starts=options.starts, seed=seed)
            if holds_other_files(directory, STORE):
                raise ValueError(f"{directory}: is not empty, and holds no search")
            with errors_named(directory):
                directory.mkdir(parents=True, exist_ok=True)
            store = stack.enter_context(Store.open(directory / STORE, whose))
        run = _Run(data, library, settings, options, seed, store, progress or silent)
        return run.searched()


class _HeldOut(dict[str, tuple[NDArray[np.float64], bool]]):
    """Log-densities of the incidences that were held out of a fit so far, kept in a store: see `cross_validate`."""

    def __init__(self, store: Store, key: str, fit: Fit):
        self._store, self._key, self._whose = store, key, fingerprint(fit=fit.vector)
        kept = store.get(key)
        super().__init__(kept["groups"] if kept is not None and kept["fit"] == self._whose else {})

    def __setitem__(self, name: str, found: tuple[NDArray[np.float64], bool]) -> None:
        super().__setitem__(name, found)
        self._store.put(self._key, {"fit": self._whose, "groups": dict(self)})


@dataclass
class _Run:
    """A search at work: what was fitted and cross-validated so far."""

    data: Measurements
    library: Library
    settings: dict[str, Any]
    options: SearchOptions
    seed: int
    store: Store | None
    progress: Progress
    coarse: dict[Structure, Fit] = field(default_factory=dict)
    full: dict[Structure, tuple[Fit, CrossValidation, Evidence]] = field(default_factory=dict)

    def searched(self) -> Search:
        """Level by level, as long as a level predicts better than those before, or lowers the BIC clearly."""
        options, stopped = self.options, False
        until = math.inf if options.budget is None else time.monotonic() + 60.0 * options.budget
        level: list[Structure] = [(base,) for base in self.library.bases]
        while level and not stopped:
            before, lowest = self.ranked()[:1], self.lowest_bic()
            if before and time.monotonic() > until:
                stopped = True
                break
            self.coarse |= self._in_parallel(f"{len(level[0]) - 1} layers", self._coarse_fit, level, until)
            fitted = [one for one in level if one in self.coarse]
            chosen = sorted(fitted, key=self.bic)[: options.cross_validated]
            self.full |= self._in_parallel("cross-validation", self._cross_validated, chosen, until)
            stopped = len(fitted) < len(level) or any(one not in self.full for one in chosen)
            ahead = not before or self.model_scores()[named(before[0])].clear_diff > 0.0
            if not ahead and not self.lowest_bic() < lowest - options.bic_gain:
                break
            level = self._next_level()
        self.progress("cross-validation", 1, 1, "")
        return replace(self.result(), stopped=stopped)

    def _coarse_fit(self, structure: Structure) -> Fit:
        """The fit with independent noise at a coarse resolution."""

        def fitted() -> Fit:
            problem = self._problem(structure)
            problem = replace(problem, noise=replace(problem.noise, discrepancy=False))
            return fit(problem, starts=self.options.starts, seed=self.seed, screen=True)

        return self._kept(structure, "", fitted)

    def _cross_validated(self, structure: Structure) -> tuple[Fit, CrossValidation, Evidence]:
        """As `fits.fit` fits it, with each incidence held out, and its evidence."""

        def fitted() -> Fit:
            problem, coarse = self._problem(structure), self.coarse[structure]
            if undecided(problem) and needs_discrepancy(without_discrepancy(coarse)):
                return fit_with_discrepancy(problem, coarse, starts=self.options.starts, seed=self.seed)
            if undecided(problem):
                problem = replace(problem, noise=replace(problem.noise, discrepancy=False))
            return fit(problem, starts=self.options.starts, seed=self.seed)

        found = self._kept(structure, "+full", fitted)
        if self.store is None:
            return found, *out_of_sample(found)
        name = named(structure)
        stored = self.store.get(name)
        if stored is None:
            checked, evidence = out_of_sample(found, done=_HeldOut(self.store, f"{name}: held out", found))
            self.store.put(name, {"cross-validation": vars(checked), "evidence": vars(evidence)})
        else:
            kept = stored["cross-validation"]
            checked = CrossValidation(**kept | {"groups": tuple(kept["groups"]), "rows": tuple(kept["rows"])})
            evidence = Evidence(**stored["evidence"])
        return found, checked, evidence

    def _problem(self, structure: Structure) -> Problem:
        return Problem(self.library.stack(structure), self.data, **self.settings)

    def _kept(self, structure: Structure, kind: str, fitted: Callable[[], Fit]) -> Fit:
        """The fit of a structure, from its result directory if it is there."""
        if self.store is None:
            return fitted()
        path = self.store.path.with_name("+".join(name.replace(" ", "-") for name in structure) + kind)
        if path.is_dir():
            return load_fit(path)
        save_fit(found := fitted(), path)
        return found

    def _in_parallel(
        self, stage: str, call: Callable[[Structure], Result], structures: list[Structure], until: float
    ) -> dict[Structure, Result]:
        """What the call gives by structure, of the first few whatever the time, of the others until then.

        Several run at a time, since compiling one keeps a single core busy; none runs while programs are thrown away.
        """
        several, results = min(cores(), TOGETHER), dict[Structure, Result]()
        self.progress(stage, 0, len(structures), named(structures[0]))
        with ThreadPoolExecutor(several) as pool:
            for first in range(0, len(structures), several):
                if first and time.monotonic() > until:
                    break
                make_room()
                some = structures[first : first + several]
                for structure, found in zip(some, pool.map(call, some), strict=True):
                    results[structure] = found
                    self.progress(stage, len(results), len(structures), named(structure))
        return results

    def _next_level(self) -> list[Structure]:
        """Structures not fitted before, with a layer more or less than the best by score and by BIC."""
        grown: list[Structure] = []
        best = self.ranked()[:1] + sorted(self.coarse, key=self.bic)[: self.options.beam]
        for structure in dict.fromkeys(best):
            above, base = structure[:-1], structure[-1]
            grown += [(*above[:place], *above[place + 1 :], base) for place in range(len(above))]
            if len(above) < self.options.layers:
                places = range(len(above) + 1)
                grown += [(*above[:at], layer, *above[at:], base) for at in places for layer in self.library.layers]
        different = [one for one in grown if all(a != b for a, b in pairwise(one))]
        return [one for one in dict.fromkeys(different) if one not in self.coarse]

    def bic(self, structure: Structure) -> float:
        """BIC of the fit with independent noise."""
        fit = self.coarse[structure]
        return len(fit.vector) * float(np.log(fit.problem.count)) - 2.0 * fit.log_likelihood

    def lowest_bic(self) -> float:
        """Lowest BIC of all that was fitted so far."""
        return min(map(self.bic, self.coarse), default=np.inf)

    def ranked(self) -> list[Structure]:
        """What was cross-validated, best first."""
        return sorted(self.full, key=lambda one: -self.full[one][1].elpd)

    def model_scores(self) -> dict[str, ModelScore]:
        """Scores side by side, best first."""
        close = {named(one): self.full[one] for one in self.ranked()}
        return rank_models(
            {name: checked for name, (_, checked, _) in close.items()},
            {name: found for name, (*_, found) in close.items()},
        )

    def result(self) -> Search:
        """All that was fitted, ranked."""
        model_scores, lowest = self.model_scores(), self.lowest_bic()
        rest = sorted((one for one in self.coarse if one not in self.full), key=self.bic)
        candidates = []
        for one in (*self.ranked(), *rest):
            fit = self.full[one][0] if one in self.full else self.coarse[one]
            bic = self.bic(one) - lowest
            candidates.append(Candidate(one, len(fit.vector), bic, fit, model_scores.get(named(one))))
        best = candidates[0].name
        near = tuple(name for name, one in model_scores.items() if name != best and one.clear_diff <= 0.0)
        return Search(tuple(candidates), near, self.options)
