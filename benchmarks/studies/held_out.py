"""Held-out measurements of real coatings: how well every stack of `examples/` predicts them, with independent noise and
with model discrepancy."""

import json
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax

import fits
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, rounded, table, write
from fits.data.measurements import Measurements
from fits.data.reading import read
from fits.data.scans import Rows, select
from fits.problem.stack_file import read_problem

NAME = "held-out"
EXAMPLES = Path(__file__).parents[2] / "examples"
COATINGS = {
    "Aeroglaze paint": "aeroglaze_650nm_inplane",
    "anodised aluminium": "anoblack_ec1_on_al6061_650nm_inplane",
    "coated steel": "nite_on_blasted_steel1008_650nm_inplane",
}
FITTED, HELD_OUT = (10, 50), (30, 70)
"""Degrees of incidence."""
STARTS, QUICK = 8, ("coated_diffuse",)

COVERAGE, LEAST_COVERAGE = (0.85, 0.99), (0.9, 0.8)
"""Required coverage of 95 % intervals: of all held-out measurements, and at least of each incidence."""

TEXT = """\
# Held-out measurements

{environment}
Every stack of [`examples/`](../../examples), with all orders of scattering, is fitted to measurements of three coatings
at incidences of {fitted} degrees and predicts those held out, at {held_out}: once with independent noise only, once
with model discrepancy as well (`Noise(discrepancy=True)`). {starts} starts a fit.

{rows}
*chi2*: reduced chi-square of the fit. *in 95 %*: coverage of the 95 % intervals of held-out measurements at
{held_out} degrees; *error*: median of |prediction / measurement - 1| over all of these; *elpd*: their mean log
predictive density. *discrepancy*: its amplitude at normal incidence and at 60 degrees, and its length scales in the
half and the difference angle.

{verdict}"""


@dataclass(frozen=True)
class Row:
    """How one stack predicts one coating.

    coverage: of 95 % intervals, by incidence. amplitude, length_half, length_difference, grazing_exponent: of the model
    discrepancy, see `fits.Discrepancy`; None without.
    """

    coating: str
    stack: str
    discrepancy: bool
    reduced_chi_square: float
    coverage: list[float]
    coverage_all: float
    errors: list[float]
    error: float
    elpd: float
    amplitude: float | None
    length_half: float | None
    length_difference: float | None
    at_bound: list[str]
    seconds: float
    grazing_exponent: float | None = None

    @property
    def is_calibrated(self) -> bool:
        """Whether the intervals have the required coverage."""
        each = all(share >= least for share, least in zip(self.coverage, LEAST_COVERAGE, strict=True))
        return COVERAGE[0] <= self.coverage_all <= COVERAGE[1] and each


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    resume: bool = False,
) -> tuple[str, tuple[Path, ...]]:
    """Run it, and write ``held-out.json`` and ``held-out.md``; returns the markdown and the paths.

    Args:
        quick: one stack.
        resume: keep the rows that the directory holds, and run those that it lacks. Each is written as it ends.
    """
    stacks = QUICK if quick else tuple(path.stem for path in sorted(EXAMPLES.glob("*.toml")))
    wanted = [(stack, coating, on) for stack in stacks for coating in COATINGS for on in (False, True)]
    rows = _stored(directory) if resume else []
    done = {(row.stack, row.coating, row.discrepancy) for row in rows}
    for stack, coating, discrepancy in wanted:
        if (stack, coating, discrepancy) not in done:
            rows.append(run_row(stack, coating, discrepancy))
            jax.clear_caches()  # programs of sixty fits are more than a process may map into its memory
            report(f"{len(rows)}/{len(wanted)} {stack}, {coating}: {rows[-1].seconds:.0f} s")
            _save(rows, directory)
    return _save(rows, directory)


def run_row(stack: str, coating: str, discrepancy: bool, starts: int = STARTS) -> Row:
    """One stack, fitted to one coating, and its predictions of the held-out measurements."""
    began = time.perf_counter()
    data = read(EXAMPLES / "arizona_black_coatings" / f"{COATINGS[coating]}.csv")
    given = read_problem(EXAMPLES / f"{stack}.toml")
    fit = fits.fit(
        given.stack,
        data.where(_at(data, FITTED)),
        transport=given.transport,
        noise=replace(given.noise, discrepancy=discrepancy),
        scale=given.scale,
        starts=starts,
    )
    held_out = data.where(_at(data, HELD_OUT))
    prediction = fits.predict(fit, held_out)
    each = [fits.scores(prediction, held_out, select(held_out.used(), f"incidence={angle}")) for angle in HELD_OUT]
    both = fits.scores(prediction, held_out)
    process = fit.problem.build(fit.vector).correlation
    return Row(
        coating=coating,
        stack=stack,
        discrepancy=discrepancy,
        reduced_chi_square=fit.reduced_chi_square,
        coverage=[one.coverage[0.95] for one in each],
        coverage_all=both.coverage[0.95],
        errors=[one.median_error for one in each],
        error=both.median_error,
        elpd=both.elpd,
        amplitude=None if process is None else float(process.amplitude),
        length_half=None if process is None else float(process.length_half),
        length_difference=None if process is None else float(process.length_difference),
        at_bound=list(fit.at_bound),
        seconds=time.perf_counter() - began,
        grazing_exponent=None if process is None else float(process.grazing_exponent),
    )


def _at(data: Measurements, angles: tuple[int, ...]) -> Rows:
    return select(data, f"incidence={','.join(map(str, angles))}")


def _stored(directory: Path) -> list[Row]:
    path = directory / f"{NAME}.json"
    return [Row(**record) for record in json.loads(path.read_text())["rows"]] if path.exists() else []


def _save(rows: list[Row], directory: Path) -> tuple[str, tuple[Path, Path]]:
    surroundings = environment.describe()
    text = TEXT.format(
        environment=environment_lines(surroundings),
        fitted=" and ".join(map(str, FITTED)),
        held_out=" and ".join(map(str, HELD_OUT)),
        starts=STARTS,
        rows=_table(rows),
        verdict=_verdict(rows),
    )
    content = {"environment": surroundings, "rows": [rounded(asdict(row)) for row in rows]}
    return text, write(NAME, content, text, directory)


def _table(rows: list[Row]) -> str:
    lines = []
    by = {(row.stack, row.coating, row.discrepancy): row for row in rows}
    for stack, coating in dict.fromkeys((row.stack, row.coating) for row in rows):
        pair = [by.get((stack, coating, discrepancy)) for discrepancy in (False, True)]
        cells = [_cells(row) for row in pair]
        last = pair[1]
        discrepancy = "-"
        if last is not None and last.amplitude is not None:
            amplitudes = (last.amplitude, last.amplitude * 2.0 ** (last.grazing_exponent or 0.0))
            percents = " to ".join(f"{100.0 * amplitude:.0f}" for amplitude in amplitudes)
            discrepancy = f"{percents} %; {last.length_half:.0f}°, {last.length_difference:.0f}°"
        both = (cell for two in zip(*cells, strict=True) for cell in two)
        lines.append((f"`{stack}`", coating, *both, discrepancy))
    heads = [
        f"{what}{kind}" for what in ("chi2", "in 95 %", "error", "elpd") for kind in (", independent", ", discrepancy")
    ]
    return table(("stack", "coating", *heads, "discrepancy"), lines)


def _cells(row: Row | None) -> tuple[str, ...]:
    if row is None:
        return ("-",) * 4
    coverage = " / ".join(f"{100.0 * share:.0f}" for share in row.coverage)
    return f"{row.reduced_chi_square:.2g}", coverage, f"{100.0 * row.error:.1f} %", f"{row.elpd:.2f}"


def _verdict(rows: list[Row]) -> str:
    """How many intervals have the required coverage, and how many predictions are better with model discrepancy."""
    discrepant = {(row.stack, row.coating): row for row in rows if row.discrepancy}
    independent = {(row.stack, row.coating): row for row in rows if not row.discrepancy}
    both = [key for key in discrepant if key in independent]
    better = sum(discrepant[key].error <= independent[key].error for key in both)
    higher = sum(discrepant[key].elpd > independent[key].elpd for key in both)
    gain = math.fsum(discrepant[key].elpd - independent[key].elpd for key in both) / max(len(both), 1)
    words = [
        f"Model discrepancy makes the error no larger in {better} of {len(both)} fits, and the elpd higher in "
        f"{higher}, by {gain:.2f} in the mean.",
        f"The 95 % intervals cover {100 * COVERAGE[0]:.0f} to {100 * COVERAGE[1]:.0f} % of all held-out measurements, "
        f"and at least {100 * LEAST_COVERAGE[0]:.0f} and {100 * LEAST_COVERAGE[1]:.0f} % at the two incidences, in "
        f"{_calibrated(discrepant.values())} of {len(discrepant)} fits with model discrepancy and in "
        f"{_calibrated(independent.values())} of {len(independent)} without it.",
        "Deviations of a scan are correlated over many degrees: coverage is that of few independent measurements, and "
        "100 % is not rare for intervals of the right width.",
    ]
    return "\n".join(words) + "\n"


def _calibrated(rows: Iterable[Row]) -> int:
    return sum(row.is_calibrated for row in rows)
