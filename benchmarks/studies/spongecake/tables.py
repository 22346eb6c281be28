"""What the study of SpongeCake's multiple scattering finds, and its tables."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.measuring.writing import environment_lines, figure, table

TEXT = """\
# SpongeCake with multiple scattering

{environment}
## Held-out materials

Relative L2 error of the BSDF over 12 directions of light a side and 24 of view a hemisphere each (weighted with both
cosines), beside `AddingDoubling` at ordinates (10, 24), for {one} slabs of one medium and {two} of two, drawn as those
that were learned from but never seen: median and 95th percentile, in percent. *Single* is the error of
`SingleScattering` alone, *lobes alone* that of `SpongeCake` without the factor that puts energies right.

{errors}
## White furnace

The same materials with albedo 1 and no Fresnel term, light at {angles} degrees:
|R + T + unscattered - 1| in percent, over materials and angles, median and 95th percentile: of the lobes
alone, and of `SpongeCake` as it is, with the factor that puts energies right.

{furnace}
## What each step is worth

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


def markdown(
    surroundings: dict[str, Any],
    counts: tuple[int, int],
    errors: Sequence[Errors],
    furnaces: Sequence[Furnace],
    steps: Sequence[Gain],
    drawn: Sequence[Figure],
    fitted: Sequence[Fitted],
    cost: Sequence[Cost],
    rounds: int,
    paths: int,
    angles: Sequence[float],
    gain: tuple[int, int],
) -> str:
    """The tables."""

    def two(values: Sequence[float]) -> str:
        return f"{figure(values[0], 2)} / {figure(values[1], 2)}"

    names = ("full", "multiple", "reflected", "transmitted", "reflected_multiple", "transmitted_multiple")
    heads = ("full", "multiple", "R, full", "T, full", "R, multiple", "T, multiple", "single", "lobes alone")
    return TEXT.format(
        environment=environment_lines(surroundings),
        one=counts[0],
        two=counts[1],
        angles=", ".join(f"{angle:g}" for angle in angles),
        paths=paths,
        gain_materials=gain[0],
        gain_epochs=gain[1],
        errors=table(
            ("materials", "media", "count", *heads),
            [
                (
                    row.kind,
                    str(row.media),
                    str(row.count),
                    *(two(getattr(row, name)) for name in (*names, "single", "lobes")),
                )
                for row in errors
            ],
        ),
        furnace=table(
            ("materials", "media", "count", "lobes alone", "SpongeCake"),
            [(row.kind, str(row.media), str(row.count), two(row.lobes), two(row.both)) for row in furnaces],
        ),
        gains=table(
            ("second lobe", "full", "multiple", "energy"),
            [(row.step, *(two(values) for values in (row.full, row.multiple, row.energy))) for row in steps],
        ),
        figures=table(
            (
                "material",
                "figures",
                "R walk",
                "R single",
                "R",
                "T walk",
                "T single",
                "T",
                "lobe single, %",
                "lobe, %",
                "noise, %",
            ),
            [
                (
                    row.material,
                    row.figures,
                    *itertools.chain.from_iterable(
                        (f"{row.walk[s]:.4f} +- {row.walk_error[s]:.4f}", f"{row.single[s]:.4f}", f"{row.both[s]:.4f}")
                        for s in (0, 1)
                    ),
                    figure(row.lobe_single, 2),
                    figure(row.lobe_both, 2),
                    figure(row.lobe_noise, 2),
                )
                for row in drawn
            ],
        ),
        fits=table(
            ("material", "truth", "SpongeCake", "single scattering", "bias", "bias, single"),
            [
                (
                    row.material,
                    *(", ".join(figure(v) for v in values) for values in (row.truth, row.cake, row.first)),
                    figure(row.cake_bias),
                    figure(row.first_bias),
                )
                for row in fitted
            ],
        ),
        rounds=rounds,
        costs=table(
            ("material", "side", "precision", "single", "SpongeCake", "ratio", "operations"),
            [
                (
                    row.material,
                    row.side,
                    row.precision,
                    *(figure(value) for value in (row.single, row.both, row.ratio, row.operations)),
                )
                for row in cost
            ],
        ),
        closer=sum(row.cake_bias < row.first_bias for row in fitted),
        all=len(fitted),
    )
