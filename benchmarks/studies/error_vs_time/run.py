"""Every model against the truth: error against run time, over the suite of stacks."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from benchmarks.measuring import accuracy, environment
from benchmarks.measuring.memory import keep_within
from benchmarks.measuring.writing import DIRECTORY, rounded, write
from benchmarks.studies.error_vs_time import pictures as error_pictures
from benchmarks.studies.error_vs_time import tables as error_tables
from benchmarks.studies.error_vs_time.models import MODELS, VALUES, Model, Programs, Row, Size, row, run, supports
from benchmarks.studies.error_vs_time.truth import (
    REFERENCES,
    Judged,
    References,
    Truth,
    agree_anew,
    judge,
    pack,
    unpack,
)
from benchmarks.suite import cases as suite
from benchmarks.suite.cases import Case
from fits._files import write_bytes
from fits.reports.plots.data import as_png

NAME = "error-vs-time"
QUICK = Size(rounds=1, longest=1.0)
QUICK_STEP = 6
"""A quick run takes every so many stacks."""

TIMED = ("batch", "rounds", "values a stack")
"""Settings that times alone depend on: a truth is the same without."""


@dataclass(frozen=True)
class Setup:
    """What is compared with what, how long, and where the results go."""

    directory: Path
    quick: bool
    models: Sequence[Model]
    references: References
    size: Size
    surroundings: dict[str, str | int]

    @property
    def settings(self) -> dict[str, Any]:
        """What has to be the same for results to stand in one file, as they stand there."""
        references = {name: repr(getattr(self.references, name)) for name in ("truth", "check", "solver", "walk")}
        return rounded(
            {
                **asdict(self.size),
                "values a stack": VALUES,
                "floor": accuracy.FLOOR,
                **references,
            }
        )


@dataclass(frozen=True)
class Held:
    """What is measured so far. judged, truths: by stack; rows: of every model; without_truth: stacks that have none.

    reused: truths of another run, by stack, for the models to be measured against anew.
    """

    judged: dict[str, Judged] = field(default_factory=dict)
    truths: dict[str, Truth] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    without_truth: list[str] = field(default_factory=list)
    reused: dict[str, tuple[Judged, Truth]] = field(default_factory=dict)


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    families: Sequence[str] | None = None,
    stacks: Sequence[str] | None = None,
    resume: bool = False,
    truths: Path | None = None,
    models: Sequence[Model] = MODELS,
    cases: Sequence[Case] | None = None,
    references: References = REFERENCES,
    size: Size | None = None,
) -> tuple[str, tuple[Path, ...]]:
    """Measure, and write ``error-vs-time.json``, ``.md``, ``.png`` and ``-truth.npz``; returns markdown and paths.

    Args:
        quick: some of the stacks, one repeat, short ladders: a look, no result to quote.
        families: keys of `suite.FAMILIES`; all if None.
        stacks: names; all of the families if None.
        resume: keep what the directory holds, measured with the same settings, and measure what it lacks: stacks, or a
            new model. Every stack is written as soon as it is measured, so that an interrupted run can be resumed.
        truths: a directory of results whose truths stand for stacks that are not measured yet; the models, and the
            walk that the default solver is compared with, are run anew.
        models: what is compared.
        cases: stacks instead of those of the suite.

    Raises:
        ValueError: a family that there is not, or results to resume that were measured with other settings.
    """
    if cases is None:
        cases = suite.load(families, stacks)[:: QUICK_STEP if quick else 1]
    size = size or (QUICK if quick else Size())
    setup = Setup(directory, quick, models, references, size, environment.describe())
    held = _held(directory, setup.settings) if resume else Held()
    if truths is not None:
        other = _held(truths, setup.settings, apart_from=TIMED)
        held.reused.update({name: (judged, other.truths[name]) for name, judged in other.judged.items()})
    programs = Programs()
    for index, case in enumerate(cases, start=1):
        keep_within()
        began = time.perf_counter()
        if not _measure(case, setup, held, programs):
            continue
        _save(setup, held)
        judgement = held.judged[case.name]
        report(
            f"{index}/{len(cases)} {case.family}: {case.name}: truth to {judgement.limit:.1e}, "
            f"z {judgement.z_root_mean_square:.2f}, {time.perf_counter() - began:.1f} s"
        )
    text, paths = _save(setup, held)
    picture = as_png(error_pictures.picture(models, list(held.judged.values()), held.rows))
    write_bytes(directory / f"{NAME}.png", picture, force=True)
    return text, (*paths, directory / f"{NAME}.png")


def _measure(case: Case, setup: Setup, held: Held, programs: Programs) -> bool:
    """Add to `held` what it lacks of a stack; False if that is nothing."""
    if case.name in held.without_truth:
        return False
    if not all(supports(transport, case.stack) for transport in vars(setup.references).values()):
        held.without_truth.append(case.name)
        return False
    done = {row.model for row in held.rows if row.stack == case.name}
    # the models first: what the references compile would no longer count among their compile times
    lacking = [model for model in setup.models if model.name not in done]
    runs = [found for model in lacking for found in run(case, model, setup.size, programs)]
    if case.name not in held.judged:
        longest, reused = setup.size.longest, held.reused.get(case.name)
        held.judged[case.name], held.truths[case.name] = (
            judge(case, setup.references, setup.size.walked(case), longest)
            if reused is None
            else agree_anew(case, setup.references, *reused, longest)
        )
    elif not runs:
        return False
    judgement, truth = held.judged[case.name], held.truths[case.name]
    held.rows.extend(row(case, found, truth, judgement.limit) for found in runs)
    return True


def _save(setup: Setup, held: Held) -> tuple[str, tuple[Path, ...]]:
    """Write all that is measured so far, but no picture; returns markdown and paths."""
    judged = list(held.judged.values())
    text = error_tables.markdown(
        setup.surroundings, setup.models, judged, held.rows, setup.size, setup.references, held.without_truth
    )
    content = {
        "environment": setup.surroundings,
        "quick": setup.quick,
        "settings": setup.settings,
        "stacks": [asdict(judgement) | {"limit": judgement.limit} for judgement in judged],
        "without a truth": held.without_truth,
        "rows": [asdict(row) for row in held.rows],
    }
    truths = setup.directory / f"{NAME}-truth.npz"
    paths = write(NAME, content, text, setup.directory)
    write_bytes(truths, pack(held.truths), force=True)
    return text, (*paths, truths)


def _held(directory: Path, settings: Mapping[str, Any], apart_from: Sequence[str] = ()) -> Held:
    """What the directory holds; ValueError if that was measured with other settings (but for those of some names)."""
    path = directory / f"{NAME}.json"
    if not path.exists():
        return Held()
    content = json.loads(path.read_text())
    before, now = (
        {key: value for key, value in of.items() if key not in apart_from} for of in (content["settings"], settings)
    )
    if before != now:
        raise ValueError(f"{path}: measured with other settings, it cannot be resumed")
    known = {entry.name for entry in fields(Judged)}
    judged = {
        entry["stack"]: Judged(
            **{key: value for key, value in entry.items() if key in known} | {"failures": tuple(entry["failures"])}
        )
        for entry in content["stacks"]
    }
    truths = unpack(directory / f"{NAME}-truth.npz")
    return Held(judged, truths, [Row(**entry) for entry in content["rows"]], content["without a truth"])
