"""Every model against the truth: error against run time, over the suite of stacks."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from benchmarks import accuracy, environment, error_pictures, error_tables, suite
from benchmarks.models import MODELS, Model, Programs, Row, Size, row, run, supports
from benchmarks.results import DIRECTORY, write
from benchmarks.suite import Case
from benchmarks.truth import REFERENCES, Judged, References, judge
from fits._files import write_bytes
from fits.pictures import as_png

NAME = "error-vs-time"
QUICK = Size(rounds=1, longest=1.0)
QUICK_STEP = 6
"""A quick run takes every so many stacks."""


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    families: Sequence[str] | None = None,
    add: bool = False,
    models: Sequence[Model] = MODELS,
    cases: Sequence[Case] | None = None,
    references: References = REFERENCES,
    size: Size | None = None,
) -> tuple[str, tuple[Path, ...]]:
    """Measure, and write ``error-vs-time.json``, ``.md`` and ``.png``; returns the markdown and the paths.

    Args:
        quick: some of the stacks, one repeat, short ladders: a look, no result to quote.
        families: keys of `suite.FAMILIES`; all if None.
        add: keep what the directory holds of other stacks, measured with the same settings.
        models: what is compared.
        cases: stacks instead of those of the suite.

    Raises:
        ValueError: a family that there is not, or results to add to that were measured with other settings.
    """
    if cases is None:
        cases = suite.load(families)[:: QUICK_STEP if quick else 1]
    size = size or (QUICK if quick else Size())
    surroundings = environment.describe()
    settings = {
        **asdict(size),
        "values a stack": error_tables.VALUES,
        "floor": accuracy.FLOOR,
        "models": {model.name: list(model.steps) for model in models},
        **{name: repr(getattr(references, name)) for name in ("truth", "check", "solver", "walk")},
    }
    judged, rows, untold = _measured_before(directory, settings, cases) if add else ([], [], [])
    programs = Programs()
    for index, case in enumerate(cases, start=1):
        began = time.perf_counter()
        if not all(supports(transport, case.stack) for transport in vars(references).values()):
            untold.append(case.name)
            continue
        # the models first: what the references compile would no longer count among their compile times
        runs = [found for model in models for found in run(case, model, size, programs)]
        judgement, truth = judge(case, references, size.walked(case))
        judged.append(judgement)
        rows += [row(case, found, truth, judgement.limit) for found in runs]
        report(
            f"{index}/{len(cases)} {case.family}: {case.name}: truth to {judgement.limit:.1e}, "
            f"z {judgement.z_root_mean_square:.2f}, {time.perf_counter() - began:.1f} s"
        )
    text = error_tables.markdown(surroundings, models, judged, rows, size, references, untold)
    content = {
        "environment": surroundings,
        "quick": quick,
        "settings": settings,
        "stacks": [asdict(judgement) | {"limit": judgement.limit} for judgement in judged],
        "without a truth": untold,
        "rows": [asdict(row) for row in rows],
    }
    picture = as_png(error_pictures.picture(models, judged, rows))
    paths = write(NAME, content, text, directory)
    write_bytes(directory / f"{NAME}.png", picture, force=True)
    return text, (*paths, directory / f"{NAME}.png")


def _measured_before(
    directory: Path, settings: dict[str, Any], cases: Sequence[Case]
) -> tuple[list[Judged], list[Row], list[str]]:
    """What the directory holds of stacks that are not among these."""
    path = directory / f"{NAME}.json"
    if not path.exists():
        return [], [], []
    content = json.loads(path.read_text())
    if content["settings"] != settings:
        raise ValueError(f"{path}: measured with other settings, nothing can be added to it")
    new = {case.name for case in cases}
    known = {field.name for field in fields(Judged)}
    judged = [
        Judged(**{key: value for key, value in entry.items() if key in known} | {"failures": tuple(entry["failures"])})
        for entry in content["stacks"]
        if entry["stack"] not in new
    ]
    rows = [Row(**entry) for entry in content["rows"] if entry["stack"] not in new]
    return judged, rows, [name for name in content["without a truth"] if name not in new]
