"""Every model against the truth: error against run time, over the suite of stacks."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import jax

from benchmarks.measuring import accuracy, environment
from benchmarks.measuring.writing import DIRECTORY, write
from benchmarks.studies.error_vs_time import pictures as error_pictures
from benchmarks.studies.error_vs_time import tables as error_tables
from benchmarks.studies.error_vs_time.models import MODELS, Model, Programs, Row, Size, row, run, supports
from benchmarks.studies.error_vs_time.truth import REFERENCES, Judged, References, Truth, judge, pack, unpack
from benchmarks.suite import cases as suite
from benchmarks.suite.cases import Case
from fits._files import write_bytes
from fits.reporting.plots.data import as_png

NAME = "error-vs-time"
QUICK = Size(rounds=1, longest=1.0)
KEPT = 6
"""Stacks after which compiled programs are dropped: a process may map a limited number of pieces of memory only."""
QUICK_STEP = 6
"""A quick run takes every so many stacks."""


@dataclass(frozen=True)
class Held:
    """What is measured so far. judged, truths: by stack; rows: of every model; untold: stacks without a truth."""

    judged: dict[str, Judged]
    truths: dict[str, Truth]
    rows: list[Row]
    untold: list[str]


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    families: Sequence[str] | None = None,
    resume: bool = False,
    models: Sequence[Model] = MODELS,
    cases: Sequence[Case] | None = None,
    references: References = REFERENCES,
    size: Size | None = None,
) -> tuple[str, tuple[Path, ...]]:
    """Measure, and write ``error-vs-time.json``, ``.md``, ``.png`` and ``-truth.npz``; returns markdown and paths.

    Args:
        quick: some of the stacks, one repeat, short ladders: a look, no result to quote.
        families: keys of `suite.FAMILIES`; all if None.
        resume: keep what the directory holds, measured with the same settings, and measure what it lacks: stacks, or a
            new model. Every stack is written as soon as it is measured: an interrupted run goes on from there.
        models: what is compared.
        cases: stacks instead of those of the suite.

    Raises:
        ValueError: a family that there is not, or results to resume that were measured with other settings.
    """
    if cases is None:
        cases = suite.load(families)[:: QUICK_STEP if quick else 1]
    size = size or (QUICK if quick else Size())
    surroundings = environment.describe()
    settings = {
        **asdict(size),
        "values a stack": error_tables.VALUES,
        "floor": accuracy.FLOOR,
        **{name: repr(getattr(references, name)) for name in ("truth", "check", "solver", "walk")},
    }
    held = _held(directory, settings) if resume else Held({}, {}, [], [])
    programs = Programs()

    def save() -> tuple[str, tuple[Path, ...]]:
        judged = list(held.judged.values())
        text = error_tables.markdown(surroundings, models, judged, held.rows, size, references, held.untold)
        content = {
            "environment": surroundings,
            "quick": quick,
            "settings": settings,
            "stacks": [asdict(judgement) | {"limit": judgement.limit} for judgement in judged],
            "without a truth": held.untold,
            "rows": [asdict(row) for row in held.rows],
        }
        truths = directory / f"{NAME}-truth.npz"
        paths = write(NAME, content, text, directory)
        write_bytes(truths, pack(held.truths), force=True)
        return text, (*paths, truths)

    for index, case in enumerate(cases, start=1):
        if index % KEPT == 0:
            jax.clear_caches()
        began = time.perf_counter()
        if case.name in held.untold:
            continue
        if not all(supports(transport, case.stack) for transport in vars(references).values()):
            held.untold.append(case.name)
            continue
        done = {row.model for row in held.rows if row.stack == case.name}
        # the models first: what the references compile would no longer count among their compile times
        runs = [found for model in models if model.name not in done for found in run(case, model, size, programs)]
        if case.name in held.judged:
            judgement, truth = held.judged[case.name], held.truths[case.name]
            if not runs:
                continue
        else:
            judgement, truth = judge(case, references, size.walked(case), size.longest)
        held.judged[case.name], held.truths[case.name] = judgement, truth
        held.rows.extend(row(case, found, truth, judgement.limit) for found in runs)
        save()
        report(
            f"{index}/{len(cases)} {case.family}: {case.name}: truth to {judgement.limit:.1e}, "
            f"z {judgement.z_root_mean_square:.2f}, {time.perf_counter() - began:.1f} s"
        )
    text, paths = save()
    picture = as_png(error_pictures.picture(models, list(held.judged.values()), held.rows))
    write_bytes(directory / f"{NAME}.png", picture, force=True)
    return text, (*paths, directory / f"{NAME}.png")


def _held(directory: Path, settings: dict[str, Any]) -> Held:
    """What the directory holds."""
    path = directory / f"{NAME}.json"
    if not path.exists():
        return Held({}, {}, [], [])
    content = json.loads(path.read_text())
    if content["settings"] != settings:
        raise ValueError(f"{path}: measured with other settings, it cannot be resumed")
    known = {field.name for field in fields(Judged)}
    judged = {
        entry["stack"]: Judged(
            **{key: value for key, value in entry.items() if key in known} | {"failures": tuple(entry["failures"])}
        )
        for entry in content["stacks"]
    }
    truths = unpack(directory / f"{NAME}-truth.npz")
    return Held(judged, truths, [Row(**entry) for entry in content["rows"]], content["without a truth"])
