"""Which stack is behind data: stacks from a library of layers and bases grow and shrink by a layer, level by level.

Every stack of a level is fitted with independent noise at a coarse resolution, which is cheap, and those with the
lowest Bayesian information criterion (BIC) are fitted as `fits.fit` does and cross-validated, one incidence held out
after the other. The next level has a layer more, or less, than the best of all. The search ends where a level neither
predicts better beyond its error nor has a clearly lower BIC: with model discrepancy, a stack that lacks two layers may
predict as well as one that lacks one.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import layerjax as lj
from fits._files import given_path
from fits.data.measurements import TO_HAVE_THEM, Measurements
from fits.optimise.fit import fit as run_fit
from fits.optimise.options import DEFAULT, FitOptions
from fits.optimise.result import Fit
from fits.prediction.compare import ComparedFit, Comparison
from fits.prediction.cross_validation import CrossValidation, ModelScore, out_of_sample, rank_models
from fits.prediction.evidence import Evidence
from fits.prediction.options import ComparisonOptions
from fits.problem.compilation import cores, make_room
from fits.problem.instrument import Instrument
from fits.problem.model import Transport
from fits.problem.noise import Noise
from fits.problem.parameters import Free, LogUniform
from fits.problem.problem import Problem
from fits.problem.stack_file import check_keys, read_tables, require_table, stack_from_dict
from fits.progress import Progress, given_progress
from fits.reports.pages import Table
from fits.reports.results import load_fit, save_fit
from fits.reports.tables import comparison_table
from fits.reports.verdicts import listed, verdict
from fits.store import Store, fingerprint, make_directory
from layerjax._checks import require_count, require_kind, require_number, require_seed
from layerjax._numerics import allow_broadcasting
from layerjax.compiling import program_cache

STORE = "search.store"
TOGETHER = 8  # structures at a time, at most: as many programs as a process can hold beside those that it has

Structure = tuple[str, ...]
"""Names of layers from top to bottom, and of the base."""


class Checked(NamedTuple):
    """The fit of a structure as `fits.fit` fits it, its cross-validation and its evidence."""

    fit: Fit
    held_out: CrossValidation
    evidence: Evidence


# ---- what stacks are made of ----


@dataclass(frozen=True)
class Library:
    """Layers and bases by name, which differ by more than case; a base is a stack that lets no light pass."""

    layers: Mapping[str, lj.Interface | lj.Medium]
    bases: Mapping[str, lj.Stack]

    def __post_init__(self) -> None:
        for kind in ("bases", "layers"):
            if not getattr(self, kind):
                raise ValueError(f"library: it has no {kind}")
        names = [name.casefold() for name in (*self.layers, *self.bases)]
        if same := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"library: {min(same)!r} is there twice; names must differ by more than case")

    def stack(self, structure: Structure) -> lj.Stack:
        """The stack with these layers over this base."""
        base = self.bases[structure[-1]]
        return lj.Stack([*(self.layers[name] for name in structure[:-1]), *base.layers], base.base)


def default_library(channels: int = 1) -> Library:
    """Interfaces, haze, particles and flakes over diffuse, rough diffuse and metallic bases and deep pigment.

    channels: of the data; what has a colour has a value for each.
    """
    require_count("channels", channels, 1)

    def coloured(start: float) -> Free:
        return Free(start if channels == 1 else (start,) * channels, 0.0, 1.0)

    alpha, thickness = Free(0.3, 0.02, 1.0), Free(0.5, 0.01, 20.0, LogUniform())
    index, extinction = Free(1.5, 0.05, 9.0, LogUniform()), Free(0.5, 0.01, 9.0, LogUniform())
    forward, anywhere = (lj.HenyeyGreenstein(Free(*g)) for g in ((0.3, -0.6, 0.9), (0.5, -0.9, 0.9)))
    pigment = lj.Medium(50.0, coloured(0.5), lj.HenyeyGreenstein(Free(0.0, -0.9, 0.9)))
    return Library(
        layers={
            "interface": lj.Interface(Free(1.5, 1.01, 3.0), alpha),
            "haze": lj.Medium(Free(0.1, 1e-3, 5.0, LogUniform()), 1.0, forward),
            "particles": lj.Medium(thickness, coloured(0.9), anywhere),
            "flakes": lj.Medium(thickness, f0=Free(0.03, 1e-3, 0.3, LogUniform()), phase=lj.SGGX("surface", alpha)),
        },
        bases={
            "diffuse": lj.Stack([], lj.Lambertian(coloured(0.2))),
            "rough diffuse": lj.Stack([], lj.OrenNayar(coloured(0.2), Free(0.5, 0.0, 1.0))),
            "metal": lj.Stack([], lj.Conductor(index, extinction, alpha)),
            "pigment": lj.Stack([pigment]),
        },
    )


def read_library(path: str | Path) -> Library:
    """A library from a TOML file: tables ``[layers.NAME]`` and ``[bases.NAME]``, as layers and bases stand in a stack
    file; of a base of several layers ``[[bases.NAME.layers]]`` and ``[bases.NAME.base]``.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: on one line, which names the file and the place in it.
    """
    _, tables = read_tables(given_path("path", path))

    def part(place: str, table: Any) -> lj.Stack:
        try:
            return stack_from_dict(table)
        except ValueError as error:
            raise ValueError(f"{place}: {error}") from None

    def whole(table: Any) -> Any:  # of a base as that of a stack
        return table if isinstance(table, dict) and {"layers", "base"} & set(table) else {"base": table}

    try:
        check_keys("the file", tables, ("layers", "bases"))
        layers, bases = (require_table(kind, tables.get(kind, {})) for kind in ("layers", "bases"))
        return Library(
            layers={name: part(f"layers.{name}", {"layers": [table]}).layers[0] for name, table in layers.items()},
            bases={name: part(f"bases.{name}", whole(table)) for name, table in bases.items()},
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


# ---- the search ----


@dataclass(frozen=True)
class SearchOptions:
    """How far a search goes.

    Attributes:
        layers: at most so many over the base, in [0, 6].
        starts: of each fit, see `fits.fit`.
        beam: so many stacks of the lowest BIC grow and shrink, and the one that predicts best.
        cross_validated: so many of a level, those of its lowest BIC, are cross-validated.
        bic_gain: a level that does not predict better is followed by another if it lowers the BIC by more than this.
        fit: tolerances and thresholds of each fit, of which some decide on a model discrepancy.
    """

    layers: int = 3
    starts: int = 8
    beam: int = 2
    cross_validated: int = 3
    bic_gain: float = 10.0
    fit: FitOptions = DEFAULT

    def __post_init__(self) -> None:
        require_count("layers", self.layers, 0, 6)
        for name in ("starts", "beam", "cross_validated"):
            require_count(name, getattr(self, name), 1)
        require_number("bic_gain", self.bic_gain, 0.0)
        require_kind("fit", self.fit, FitOptions)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A stack that was fitted.

    Attributes:
        structure: its layers from the top, and its base.
        bic: of the fit with independent noise, less the lowest of all.
        fit: at full resolution if it was cross-validated, else the one with independent noise.
        model_score: predictive score and evidence; None if it was not cross-validated.
    """

    structure: Structure
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
        options: of the search.
    """

    candidates: tuple[Candidate, ...]
    options: SearchOptions = SearchOptions()

    @property
    def best(self) -> Candidate:
        """The one with the best predictive score."""
        return self.candidates[0]

    @property
    def indistinguishable(self) -> tuple[str, ...]:
        """Names of those whose predictive score is within its error of the best."""
        others = [(one.name, one.model_score) for one in self.candidates[1:]]
        return tuple(name for name, score in others if score is not None and score.indistinguishable)

    @property
    def probabilities(self) -> dict[str, float]:
        """Model probabilities by name, among the cross-validated stacks, all as probable beforehand."""
        return {one.name: one.model_score.model_probability for one in self.candidates if one.model_score is not None}


def named(structure: Structure) -> str:
    """A structure as words."""
    return " / ".join(structure)


@program_cache()
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
    """Search for the stack that predicts the data best, built from a library of layers and bases.

    Args:
        data: measurements; masked ones are not used.
        library: `default_library` for the channels of the data, if None.
        transport, noise, scale, instrument: see `Problem`; "auto" carries all orders of scattering.
        seed: of the starts, see `fit`.
        options: how far the search goes.
        directory: directory of finished fits and cross-validations, from which a search resumes, also one that ended
            with fewer layers. The fits are result directories.
        progress: called with (what is done, structures done, structures of this level, note).

    Raises:
        ValueError: the directory is in use, or holds another search or something else; as `fit`, `cross_validate`.
    """
    require_kind("library", library, Library, None)
    require_kind("noise", noise, Noise, None)
    require_kind("options", options, SearchOptions, None)
    require_kind("data", data, Measurements, fix=TO_HAVE_THEM)
    require_seed(seed)
    library, options = library or default_library(len(data.channels)), options or SearchOptions()
    settings = {"transport": transport, "noise": noise or Noise(), "scale": scale, "instrument": instrument}
    store: Any = nullcontext()
    if directory is not None:
        path, used = make_directory(given_path("directory", directory), STORE), data.used()
        # how far it goes is no part of whose search it is: one may go on where another has ended
        starting = {"starts": options.starts, "seed": seed, "fit": options.fit}
        numbers = [used.wi, used.wo, used.values, used.sigma]
        store = Store.open(path, fingerprint(data=numbers, library=library, **settings, **starting))
    with store as opened:
        work = _Work(data, library, settings, options, seed, opened, given_progress(progress))
        fits: dict[Structure, Fit] = {}
        bic: dict[Structure, float] = {}
        checked: dict[Structure, Checked] = {}
        scores: dict[Structure, ModelScore] = {}
        level: list[Structure] = [(base,) for base in library.bases]
        while level:
            leader, lowest = list(scores)[:1], min(bic.values(), default=math.inf)
            # every structure of the level with independent noise, at a coarse resolution
            fits |= work.in_parallel(f"{len(level[0]) - 1} layers", partial(work.fit, coarse=True), level)
            bic |= {one: ComparedFit(named(one), fits[one]).bic for one in level}
            # those of the lowest BIC as `fits.fit` fits them, cross-validated
            best_of_level = sorted(level, key=bic.__getitem__)[: options.cross_validated]
            checked |= work.in_parallel("cross-validation", work.cross_validate, best_of_level)
            scores = _scores(checked)
            # a level that neither predicts better nor lowers the BIC clearly is the last
            ahead = not leader or scores[leader[0]].clear_diff > 0.0
            if not ahead and not min(bic.values()) < lowest - options.bic_gain:
                break
            parents = dict.fromkeys([*list(scores)[:1], *sorted(bic, key=bic.__getitem__)[: options.beam]])
            level = [one for one in _neighbours(library, parents, options.layers) if one not in bic]
        work.progress("cross-validation", 1, 1, "")
    # all that was fitted, ranked
    fits |= {one: found.fit for one, found in checked.items()}
    order = [*scores, *sorted((one for one in bic if one not in scores), key=bic.__getitem__)]
    lowest = min(bic.values())
    return Search(tuple(Candidate(one, bic[one] - lowest, fits[one], scores.get(one)) for one in order), options)


class _Work(NamedTuple):
    """What the fits of a search have in common."""

    data: Measurements
    library: Library
    settings: Mapping[str, Any]
    options: SearchOptions
    seed: int
    store: Store | None
    progress: Progress

    def fit(self, structure: Structure, coarse: bool = False) -> Fit:
        """As `fits.fit` fits it, or with independent noise at a coarse resolution; kept in a result directory."""
        path = None
        if self.store is not None:
            path = self.store.path.with_name("+".join(quote(name, "") for name in structure) + "+full" * (not coarse))
            if path.is_dir():
                return load_fit(path)
        problem = Problem(self.library.stack(structure), self.data, **self.settings)
        if coarse:
            problem = replace(problem, noise=replace(problem.noise, discrepancy=False))
        options = self.options
        fit = run_fit(problem, starts=options.starts, seed=self.seed, options=options.fit, screen=coarse)
        if path is not None:
            save_fit(fit, path)
        return fit

    def cross_validate(self, structure: Structure) -> Checked:
        """The fit, with each incidence held out, and its evidence; both are kept in the store."""
        fit, key = self.fit(structure), named(structure)
        if self.store is not None and (record := self.store.get(key)) is not None:
            checked = record["cross-validation"]
            checked |= {"groups": tuple(checked["groups"]), "rows": tuple(checked["rows"])}
            return Checked(fit, CrossValidation(**checked), Evidence(**record["evidence"]))
        held_out, evidence = out_of_sample(fit)
        if self.store is not None:
            self.store.put(key, {"cross-validation": vars(held_out), "evidence": vars(evidence)})
        return Checked(fit, held_out, evidence)

    def in_parallel(
        self, stage: str, call: Callable[[Structure], Any], structures: list[Structure]
    ) -> dict[Structure, Any]:
        """What the call gives by structure. Several run at a time, since compiling one keeps a single core busy; none
        runs while programs are thrown away."""
        several, results = min(cores(), TOGETHER), dict[Structure, Any]()
        self.progress(stage, 0, len(structures), named(structures[0]))
        with ThreadPoolExecutor(several) as pool:
            for first in range(0, len(structures), several):
                make_room()
                some = structures[first : first + several]
                for structure, result in zip(some, pool.map(allow_broadcasting(call), some), strict=True):
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


def _scores(checked: Mapping[Structure, Checked]) -> dict[Structure, ModelScore]:
    """Scores of structures side by side, best first."""
    ranked = sorted(checked, key=lambda one: -checked[one].held_out.elpd)
    held_out = {named(one): checked[one].held_out for one in ranked}
    evidences = {named(one): checked[one].evidence for one in ranked}
    return dict(zip(ranked, rank_models(held_out, evidences).values(), strict=True))


# ---- what it found ----


def search_table(search: Search) -> Table:
    """The cross-validated stacks side by side, as `fits.compare` has them."""
    rows = [ComparedFit(one.name, one.fit, one.model_score) for one in search.candidates if one.model_score is not None]
    others = len(search.candidates) - len(rows)
    notes = (f"{others} others were fitted with independent noise only",) if others else ()
    return comparison_table(Comparison(tuple(rows), "elpd", "", notes, ComparisonOptions()))


def search_sentences(search: Search) -> list[str]:
    """Which stacks predict best; what is to be said of the best; and caveats."""
    scores = {one.name: one.model_score for one in search.candidates if one.model_score is not None}
    others = "It is ahead of every other cross-validated model by more than the error of the difference."
    if search.indistinguishable:
        near = [f"{name} ({scores[name].elpd_diff:.2g} ± {scores[name].dse:.2g})" for name in search.indistinguishable]
        others = (
            f"It is statistically indistinguishable from {listed(near)}: these score differences are within two "
            "standard errors. BIC, weight and probability do not overrule this."
        )
    elif len(scores) == 1:
        others = "No other was cross-validated."
    count, best = len(search.candidates), verdict(search.best.fit)
    words = [f"Of {count} models, {search.best.name} has the best cross-validated predictive score. {others}"]
    words += [" ".join(best.sentences), *best.remarks]
    if unsure := [name for name, score in scores.items() if not score.evidence.reliable]:
        words.append(f"Probabilities are unreliable for {listed(unsure)}.")
    return words
