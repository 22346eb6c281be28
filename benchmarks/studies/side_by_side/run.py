"""Which transport when: every transport on the same stacks, from the results of ``error-vs-time``, as a page of docs.

The page is made from ``benchmarks/results/error-vs-time.json`` alone (and what each transport says it carries); its
picture is drawn by evaluating a stack of every family once more.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import layerjax as lj
from benchmarks.measuring.writing import DIRECTORY, figure, table
from benchmarks.studies.error_vs_time.models import MODELS, VALUES, Model, Row, supports
from benchmarks.studies.error_vs_time.run import NAME as MEASURED
from benchmarks.studies.error_vs_time.tables import amortised, floored, limited_percent, percent
from benchmarks.studies.side_by_side import picture as side_by_side_picture
from benchmarks.suite import cases as suite
from fits._files import write_bytes, write_text

DOCS = Path(__file__).parents[3] / "docs"
PAGE, PICTURE = "which_transport.md", "which_transport.png"
TARGETS = (0.3, 0.1, 0.03, 0.01, 0.001)
"""Relative L2 errors, the targets of the page."""
ENOUGH = 0.75
"""Share of a family's stacks on which a model has to reach the error."""

TEXT = """\
# Which transport when

## How to choose

| you want | take |
|---|---|
| a reliable value or gradient of any stack | `"auto"`, the default: all orders of scattering, error about 1e-3 |
| many pairs of directions of one stack | `lj.prepare(stack)` once, then `lj.evaluate(prepared, wi, wo)` |
| the first fit of media over a base, or of thin or dark ones | `SingleScattering` |
| textures of media: one stack a texel, a few percent of error | `SpongeCake` |
| textures of coats over metal or paint, some percent of error | `Statistical` |
| an independent check, with standard errors | `RandomWalk` |
| a comparison with Guo et al. 2015 or Weidlich & Wilkie 2007 | `ENDF`, `WeidlichWilkie` |

The rest of this page has the measurements behind the table, from
[error against run time](../benchmarks/results/error-vs-time.md): {processor}, {cores} cores. `python -m benchmarks
side-by-side` generates the page from that file.

![BSDF in the plane of incidence by every transport, one stack of each family](which_transport.png)

*One stack of each family in the plane of incidence, light at 50 degrees from the left, by every transport that supports
it. The wide grey line is the reference.*

## Support

{carried}
## The fastest transport for a given error

For each family of stacks and each target: the transport and resolution with the lowest cost among those whose relative
L2 error of the BSDF is below the target on at least {enough:.0f} % of the family's stacks. In brackets: nanoseconds a
value, including the preparation of a stack divided by {values:,} values. Stacks whose reference is less accurate than
the target are omitted; "18 of 21" says how many remain. A dash: none of the measured resolutions reaches the target.

{cheapest}
## Single stacks

Relative L2 error in percent at the finest measured resolution, and nanoseconds a value as above. `<=`: the reference is
no more accurate than this. A dash: not supported.

{examples}
## Summary

{words}
"""


@dataclass(frozen=True)
class Probe:
    """A thing that a stack may hold, and the smallest stack that holds it."""

    words: str
    stack: lj.Stack


_FACE, _METAL = lj.Interface(1.5, 0.2), lj.Conductor(0.2, 3.9, 0.2)
_HAZE, _DYE = lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(0.6)), lj.Medium(0.5, 0.0)
_FLAKES = lj.Medium(1.0, 0.9, lj.SGGX("surface", 0.3))
_FIBERS = lj.Medium(1.0, 0.9, lj.SGGX("fiber", 0.3, (1.0, 0.0, 0.0)))

PROBES = (
    Probe("haze alone", lj.Stack([_HAZE])),
    Probe("flakes over a diffuse base", lj.Stack([_FLAKES], lj.Lambertian(0.5))),
    Probe("fibers over flakes", lj.Stack([_FIBERS, _FLAKES])),
    Probe("a clear coat over a diffuse base", lj.Stack([_FACE], lj.Lambertian(0.5))),
    Probe("the same over a rough diffuse base", lj.Stack([_FACE], lj.VMFDiffuse(0.5, 0.5))),
    Probe("a dyed coat over metal", lj.Stack([_FACE, _DYE], _METAL)),
    Probe("a hazy coat over metal", lj.Stack([_FACE, _HAZE], _METAL)),
    Probe("flakes in a coat", lj.Stack([_FACE, _FLAKES], lj.Lambertian(0.5))),
    Probe("two coats over metal", lj.Stack([_FACE, lj.Interface(1.3, 0.3)], _METAL)),
    Probe("a plate that transmits", lj.Stack([_FACE, lj.Interface(1.0, 0.2)])),
    Probe(
        "vMF normals",
        lj.Stack(
            [lj.Interface(1.5, 0.2, distribution="vmf")], lj.Conductor(0.2, 3.9, 0.2, distribution="vmf")
        ),
    ),
)  # fmt: skip

EXAMPLES = (
    "coated_lambertian_absorbing",
    "coated_sand",
    "anodised_aluminium",
    "thin_layer_glossy",
    "thin_layer_rough",
    "fabric",
    "rough_fibers",
    "autumn_leaf",
    "plant_tilted",
    "rough_glass_slab",
    "milk_glass",
    "cloud",
    "furnace_of_flakes",
    "grazing_coated_metal",
    "grazing_flakes",
)
"""Two stacks of each family, three of coated metals."""

WORDS = {
    "single scattering": "media over a base where light collides once: thin or dark ones, and the first model of a fit",
    "SpongeCake": "media where a few percent are good enough, for a second lobe and a constant more",
    "statistics, forward": (
        "coats and absorbing or forward scattering media over metal and diffuse bases; not reciprocal"
    ),
    "statistics, symmetric": "the same, reciprocal",
    "ENDF, paper": "as `ENDF, reciprocal`, to compare with the paper; not reciprocal",
    "ENDF, reciprocal": (
        "one coat over metal, or a slab, of vMF normals (the stacks `thin_layer_...`). It takes a GGX width for that "
        "of vMF normals, whose tails are far shorter: the other stacks of the suite measure that"
    ),
    "Weidlich & Wilkie": "coats over a base without inter-reflection, to compare with what was used before",
    "adding-doubling": "everything, exactly; the choice for stacks that are evaluated at more than a few hundred pairs",
    "adding-doubling, fixed directions": (
        "the same where `evaluate` knows the directions beforehand, as in a fit: under an interface light is traced "
        "along them and not interpolated in a table"
    ),
    "adding-doubling, automatic resolution": (
        "the same at the resolution that is chosen for each stack by default, for errors of about 1e-3"
    ),
    "random walk": "everything, with standard errors; to check the others",
}


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DOCS,
    results: Path = DIRECTORY,
) -> tuple[str, tuple[Path, ...]]:
    """Write the page and its picture into `directory`; returns markdown and paths.

    quick: a picture of two panels. results: folder of ``error-vs-time.json``.
    """
    models, text = page(results)
    directory.mkdir(parents=True, exist_ok=True)
    write_text(directory / PAGE, text, force=True)
    report("page written; drawing")
    picture = side_by_side_picture.draw(models, suite.load(), report, panels=2 if quick else None)
    write_bytes(directory / PICTURE, picture, force=True)
    return text, (directory / PAGE, directory / PICTURE)


def page(results: Path = DIRECTORY) -> tuple[list[Model], str]:
    """The models that the results hold, and the page made from them.

    Raises:
        ValueError: there is no file of results in the folder.
    """
    path = results / f"{MEASURED}.json"
    if not path.exists():
        raise ValueError(f"{path}: not there; python -m benchmarks {MEASURED} makes it")
    content = json.loads(path.read_text())
    rows = [Row(**entry) for entry in content["rows"]]
    limits = {entry["stack"]: float(entry["limit"]) for entry in content["stacks"]}
    present = {row.model for row in rows}
    models = [model for model in MODELS if model.name in present]
    text = TEXT.format(
        processor=content["environment"]["processor"],
        cores=content["environment"]["cores"],
        carried=carried(models),
        enough=100 * ENOUGH,
        values=VALUES,
        cheapest=cheapest(rows, limits),
        examples=examples(models, rows, limits),
        words="".join(
            f"- **{model.name}**: {WORDS[model.name]}{_over_all(rows, limits, model)}.\n" for model in models
        ),
    )
    return models, text


def carried(models: Sequence[Model]) -> str:
    """What the transports say of the probes."""
    names = [model.name for model in models]
    lines = []
    for probe in PROBES:
        transports = [next(iter(model.steps.values())) for model in models]
        lines.append([probe.words, *("yes" if supports(transport, probe.stack) else "-" for transport in transports)])
    return table(("stack", *names), lines)


def cheapest(rows: Sequence[Row], limits: Mapping[str, float]) -> str:
    """For every family and target the cheapest model and step. limits: error of the truth of each stack."""
    lines = []
    for family, title in suite.FAMILIES.items():
        here = [row for row in rows if row.family == family]
        if not here:
            continue
        stacks = {row.stack for row in here}
        cells = [title]
        for target in TARGETS:
            known = {stack for stack in stacks if limits[stack] <= target}
            reached = []
            for model, step in dict.fromkeys((row.model, row.step) for row in here):
                own = [row for row in here if (row.model, row.step) == (model, step) and row.stack in known]
                good = [row for row in own if floored(row, limits) <= target]
                if good and len(good) >= ENOUGH * len(known):
                    reached.append((float(np.median([amortised(row) for row in own])), f"{model}, {step}"))
            some = "" if known == stacks else f", {len(known)} of {len(stacks)}"
            cells.append("-" if not reached else f"{min(reached)[1]} ({figure(min(reached)[0])}{some})")
        lines.append(cells)
    return table(("family", *(f"{100 * target:g} %" for target in TARGETS)), lines)


def examples(models: Sequence[Model], rows: Sequence[Row], limits: Mapping[str, float]) -> str:
    """Error and cost of every model on the stacks of `EXAMPLES`."""
    lines = []
    for stack in EXAMPLES:
        cells = [f"`{stack}`"]
        for model in models:
            own = [row for row in rows if (row.stack, row.model) == (stack, model.name) and row.l2 is not None]
            cells.append("-" if not own else _cell(own[-1], limits))
        lines.append(cells)
    return table(("stack", *(model.name for model in models)), lines)


def _over_all(rows: Sequence[Row], limits: Mapping[str, float], model: Model) -> str:
    """Median error at the finest step, over all stacks that the model carries."""
    finest = {row.stack: row for row in rows if row.model == model.name and row.l2 is not None}.values()
    limited = "<= " if np.mean([row.truth_limits for row in finest]) >= 0.5 else ""
    median = float(np.median([floored(row, limits) for row in finest]))
    return f" (median error of {len(finest)} stacks {limited}{percent(median)} %)"


def _cell(row: Row, limits: Mapping[str, float]) -> str:
    return f"{limited_percent(row, limits)} % ({figure(amortised(row))} ns)"
