"""What the study of SpongeCake's multiple scattering finds, and its tables."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.measuring.writing import environment_lines, figure, table

TEXT = """\
# SpongeCake with multiple scattering

{environment}
## Held-out materials

Relative L2 error of the BSDF over 12 directions of light per side and 24 viewers per hemisphere (weighted with both
cosines), compared with `AddingDoubling` at ordinates (10, 24), for {one} slabs of one medium and {two} of two, from the
distribution of the training data but not part of them: median and 95th percentile, in percent. *Single* is the error of
`SingleScattering`, *lobes alone* that of `SpongeCake` without the factor that corrects energies.

{errors}
## White furnace

The same materials with albedo 1 and no Fresnel term, light at {angles} degrees:
|R + T + unscattered - 1| in percent, over materials and angles, median and 95th percentile: of the lobes
alone, and of `SpongeCake` as it is, with the factor that puts energies right.

{furnace}
## The gain of each step

The same short training each time (one medium, {gain_materials:,} materials, {gain_epochs} epochs), half as many held
out: errors as above, and those of the energy of lossless materials, the mean over 12 angles of |R + T - truth|, each
over its 24 directions (so that narrow lobes leave noise in it).

{gains}
## The paper's figures

Figures 8 to 10 show slabs of one medium of surface flakes or fibers, figures 11 to 13 of two, by roughness and
thickness; their numbers stand in the pictures alone, which the text that we have lacks. Here a grid over the same
parameters. Light at 30 degrees; *walk* counts the energy that `goniophotometer` finds ({paths:,} paths), with its
standard error; lobes are compared at 40 directions in the plane of incidence and across it, beside `RandomWalk`, as
relative L2 errors; *noise* is that of the walk.

{figures}
## Fits of thick materials

Data by `AddingDoubling` with 1 % noise, four slices; roughness, thickness and albedo are fitted, from the same start.
*Bias* is the root mean square of the errors of the three (log alpha, log thickness, albedo).

{fits}
SpongeCake is closer in {closer} of {all}.

## What evaluation costs

Nanoseconds a pair of directions, the least of {rounds} rounds in which both ways take turns, stacks made ready before;
and the ratio of operations. Single scattering is evaluated in both.

{costs}
"""


@dataclass(frozen=True)
class Errors:
    """Errors of the materials of one kind, (median, 95th percentile) each, in percent."""

    kind: str
    media: int
    count: int
    full: tuple[float, float]
    multiple: tuple[float, float]
    reflected: tuple[float, float]
    transmitted: tuple[float, float]
    reflected_multiple: tuple[float, float]
    transmitted_multiple: tuple[float, float]
    single: tuple[float, float]
    lobes: tuple[float, float]


@dataclass(frozen=True)
class Furnace:
    """|R + T + unscattered - 1|, median and 95th percentile, percent."""

    kind: str
    media: int
    count: int
    lobes: tuple[float, float]
    both: tuple[float, float]


@dataclass(frozen=True)
class Gain:
    """Errors with some of the steps, (median, 95th percentile) each, in percent."""

    step: str
    full: tuple[float, float]
    multiple: tuple[float, float]
    energy: tuple[float, float]


@dataclass(frozen=True)
class Figure:
    """A material of the paper's figures: energies (R, T) by the walk, all orders; errors in percent."""

    figures: str
    material: str
    walk: tuple[float, float]
    walk_error: tuple[float, float]
    single: tuple[float, float]
    both: tuple[float, float]
    lobe_single: float
    lobe_both: float
    lobe_noise: float


@dataclass(frozen=True)
class Fitted:
    """Bias of a fit with each model."""

    material: str
    truth: tuple[float, ...]
    cake: tuple[float, ...]
    first: tuple[float, ...]
    cake_bias: float
    first_bias: float


@dataclass(frozen=True)
class Cost:
    """Time of a value, in nanoseconds, and ratios to single scattering alone."""

    material: str
    side: str
    precision: str
    single: float
    both: float
    ratio: float
    operations: float


@dataclass(frozen=True)
class Settings:
    """How much was measured.

    counts: slabs of one medium and of two. angles: of light in the furnace, degrees. paths: of the walk. rounds: of
    timing. gain_materials, gain_epochs: of the training that measures the gain of each step.
    """

    counts: tuple[int, int]
    angles: tuple[float, ...]
    paths: int
    rounds: int
    gain_materials: int
    gain_epochs: int


@dataclass(frozen=True)
class Findings:
    """All that the study found, a list a section."""

    errors: list[Errors] = field(default_factory=list)
    furnace: list[Furnace] = field(default_factory=list)
    gains: list[Gain] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    fits: list[Fitted] = field(default_factory=list)
    costs: list[Cost] = field(default_factory=list)


def markdown(surroundings: dict[str, Any], settings: Settings, findings: Findings) -> str:
    """The page of results: words, and a table a section."""
    return TEXT.format(
        environment=environment_lines(surroundings),
        one=settings.counts[0],
        two=settings.counts[1],
        angles=", ".join(f"{angle:g}" for angle in settings.angles),
        paths=settings.paths,
        rounds=settings.rounds,
        gain_materials=settings.gain_materials,
        gain_epochs=settings.gain_epochs,
        errors=_errors_table(findings.errors),
        furnace=_furnace_table(findings.furnace),
        gains=_gains_table(findings.gains),
        figures=_figures_table(findings.figures),
        fits=_fits_table(findings.fits),
        closer=sum(row.cake_bias < row.first_bias for row in findings.fits),
        all=len(findings.fits),
        costs=_costs_table(findings.costs),
    )


def _errors_table(rows: Sequence[Errors]) -> str:
    columns = {
        "full": "full",
        "multiple": "multiple",
        "reflected": "R, full",
        "transmitted": "T, full",
        "reflected_multiple": "R, multiple",
        "transmitted_multiple": "T, multiple",
        "single": "single",
        "lobes": "lobes alone",
    }
    cells = [
        (row.kind, str(row.media), str(row.count), *(_middle_and_high(getattr(row, name)) for name in columns))
        for row in rows
    ]
    return table(("materials", "media", "count", *columns.values()), cells)


def _furnace_table(rows: Sequence[Furnace]) -> str:
    cells = [
        (row.kind, str(row.media), str(row.count), _middle_and_high(row.lobes), _middle_and_high(row.both))
        for row in rows
    ]
    return table(("materials", "media", "count", "lobes alone", "SpongeCake"), cells)


def _gains_table(rows: Sequence[Gain]) -> str:
    cells = [(row.step, *map(_middle_and_high, (row.full, row.multiple, row.energy))) for row in rows]
    return table(("second lobe", "full", "multiple", "energy"), cells)


def _figures_table(rows: Sequence[Figure]) -> str:
    energies = [f"{energy}{how}" for energy in "RT" for how in (" walk", " single", "")]
    lobes = ("lobe single, %", "lobe, %", "noise, %")
    cells = [
        (
            row.material,
            row.figures,
            *_energies(row, 0),
            *_energies(row, 1),
            *(figure(error, 2) for error in (row.lobe_single, row.lobe_both, row.lobe_noise)),
        )
        for row in rows
    ]
    return table(("material", "figures", *energies, *lobes), cells)


def _energies(row: Figure, side: int) -> tuple[str, str, str]:
    """By the walk, single scattering and SpongeCake; side: 0 reflected, 1 transmitted."""
    walk = f"{row.walk[side]:.4f} +- {row.walk_error[side]:.4f}"
    return walk, f"{row.single[side]:.4f}", f"{row.both[side]:.4f}"


def _fits_table(rows: Sequence[Fitted]) -> str:
    cells = [
        (
            row.material,
            *(", ".join(map(figure, values)) for values in (row.truth, row.cake, row.first)),
            figure(row.cake_bias),
            figure(row.first_bias),
        )
        for row in rows
    ]
    return table(("material", "truth", "SpongeCake", "single scattering", "bias", "bias, single"), cells)


def _costs_table(rows: Sequence[Cost]) -> str:
    cells = [
        (row.material, row.side, row.precision, *map(figure, (row.single, row.both, row.ratio, row.operations)))
        for row in rows
    ]
    return table(("material", "side", "precision", "single", "SpongeCake", "ratio", "operations"), cells)


def _middle_and_high(values: tuple[float, float]) -> str:
    """Median and 95th percentile, as TEXT says."""
    return f"{figure(values[0], 2)} / {figure(values[1], 2)}"
