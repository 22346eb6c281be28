"""Readings of real coatings that were not fitted: how well every stack of `examples/` foretells them, with noise alone
and with errors that readings share."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax

import fits
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, rounded, table, write
from fits.data.measurements import Measurements
from fits.data.reading import read
from fits.data.selection import Rows, select
from fits.problem.stack_file import read_problem

NAME = "unseen"
EXAMPLES = Path(__file__).parents[2] / "examples"
COATINGS = {
    "Aeroglaze paint": "aeroglaze_650nm_inplane",
    "anodised aluminium": "anoblack_ec1_on_al6061_650nm_inplane",
    "coated steel": "nite_on_blasted_steel1008_650nm_inplane",
}
FITTED, ASKED = (10, 50), (30, 70)
STARTS, QUICK = 8, ("coated_diffuse",)

BAND, EACH = (0.85, 0.99), (0.9, 0.8)
"""Shares of the readings that bands of 95 % are asked to hold, of all and at least of each incidence."""

TEXT = """\
# Readings that were not fitted

{environment}
Every stack of [`examples/`](../../examples), with all orders of scattering, is fitted to three coatings at incidences
of {fitted} degrees and foretells the readings at {asked}: once with noise that readings do not share, once with errors
of the model that they do (`Noise(discrepancy=True)`). {starts} starts a fit.

{rows}
*in 95 %*: share of the unseen readings inside the band of 95 %, at {asked} degrees; *error*: median of |prediction /
reading - 1|, of all of them; *score*: mean log-density of a reading. *chi2*: per degree of freedom, of the fit.
*size*: standard deviation of the errors that readings share, with light and viewer along the normal and at 60 degrees,
and how far they reach in the angles of half vector and difference.

{verdict}"""


@dataclass(frozen=True)
class Row:
    """How one stack foretells one coating; held: shares of readings in the band of 95 %, by incidence."""

    coating: str
    stack: str
    shared: bool
    reduced_chi_square: float
    held: list[float]
    held_all: float
    errors: list[float]
    error: float
    elpd: float
    amplitude: float | None
    half: float | None
    difference: float | None
    at_bound: list[str]
    seconds: float
    growth: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the band holds what it is asked to."""
        each = all(share >= least for share, least in zip(self.held, EACH, strict=True))
        return BAND[0] <= self.held_all <= BAND[1] and each


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    resume: bool = False,
) -> tuple[str, tuple[Path, ...]]:
    """Run it, and write ``unseen.json`` and ``unseen.md``; returns the markdown and the paths.

    Args:
        quick: one stack.
        resume: keep the rows that the directory holds, and run those that it lacks. Each is written as it ends.
    """
    stacks = QUICK if quick else tuple(path.stem for path in sorted(EXAMPLES.glob("*.toml")))
    wanted = [(stack, coating, shared) for stack in stacks for coating in COATINGS for shared in (False, True)]
    rows = _held(directory) if resume else []
    done = {(row.stack, row.coating, row.shared) for row in rows}
    for stack, coating, shared in wanted:
        if (stack, coating, shared) not in done:
            rows.append(run_row(stack, coating, shared))
            jax.clear_caches()  # programs of sixty fits are more than a process may map into its memory
            report(f"{len(rows)}/{len(wanted)} {stack}, {coating}: {rows[-1].seconds:.0f} s")
            _save(rows, directory)
    return _save(rows, directory)


def run_row(stack: str, coating: str, shared: bool, starts: int = STARTS) -> Row:
    """One stack, fitted to one coating, and what it foretells of it."""
    began = time.perf_counter()
    data = read(EXAMPLES / "arizona_black_coatings" / f"{COATINGS[coating]}.csv")
    given = read_problem(EXAMPLES / f"{stack}.toml")
    fit = fits.fit(
        given.stack,
        data.where(_at(data, FITTED)),
        transport=given.transport,
        noise=replace(given.noise, discrepancy=shared),
        scale=given.scale,
        starts=starts,
    )
    unseen = data.where(_at(data, ASKED))
    prediction = fits.predict(fit, unseen)
    each = [fits.scores(prediction, unseen, select(unseen.used(), f"incidence={angle}")) for angle in ASKED]
    both = fits.scores(prediction, unseen)
    at = fit.problem.build(fit.vector).correlation
    return Row(
        coating=coating,
        stack=stack,
        shared=shared,
        reduced_chi_square=fit.reduced_chi_square,
        held=[one.coverage[0.95] for one in each],
        held_all=both.coverage[0.95],
        errors=[one.median_error for one in each],
        error=both.median_error,
        elpd=both.elpd,
        amplitude=None if at is None else float(at.amplitude),
        half=None if at is None else float(at.length_half),
        difference=None if at is None else float(at.length_difference),
        at_bound=list(fit.at_bound),
        seconds=time.perf_counter() - began,
        growth=None if at is None else float(at.grazing_exponent),
    )


def _at(data: Measurements, angles: tuple[int, ...]) -> Rows:
    return select(data, f"incidence={','.join(map(str, angles))}")


def _held(directory: Path) -> list[Row]:
    path = directory / f"{NAME}.json"
    return [Row(**record) for record in json.loads(path.read_text())["rows"]] if path.exists() else []


def _save(rows: list[Row], directory: Path) -> tuple[str, tuple[Path, Path]]:
    surroundings = environment.describe()
    text = TEXT.format(
        environment=environment_lines(surroundings),
        fitted=" and ".join(map(str, FITTED)),
        asked=" and ".join(map(str, ASKED)),
        starts=STARTS,
        rows=_table(rows),
        verdict=_verdict(rows),
    )
    content = {"environment": surroundings, "rows": [rounded(asdict(row)) for row in rows]}
    return text, write(NAME, content, text, directory)


def _table(rows: list[Row]) -> str:
    lines = []
    by = {(row.stack, row.coating, row.shared): row for row in rows}
    for stack, coating in dict.fromkeys((row.stack, row.coating) for row in rows):
        pair = [by.get((stack, coating, shared)) for shared in (False, True)]
        cells = [_cells(row) for row in pair]
        last = pair[1]
        size = "-"
        if last is not None and last.amplitude is not None:
            ends = (last.amplitude, last.amplitude * 2.0 ** (last.growth or 0.0))
            size = f"{' to '.join(f'{100.0 * end:.0f}' for end in ends)} %; {last.half:.0f}°, {last.difference:.0f}°"
        lines.append((f"`{stack}`", coating, *(cell for both in zip(*cells, strict=True) for cell in both), size))
    heads = [
        f"{what}{kind}" for what in ("chi2", "in 95 %", "error", "score") for kind in (", noise alone", ", shared")
    ]
    return table(("stack", "coating", *heads, "size"), lines)


def _cells(row: Row | None) -> tuple[str, ...]:
    if row is None:
        return ("-",) * 4
    held = " / ".join(f"{100.0 * share:.0f}" for share in row.held)
    return f"{row.reduced_chi_square:.2g}", held, f"{100.0 * row.error:.1f} %", f"{row.elpd:.2f}"


def _verdict(rows: list[Row]) -> str:
    """How many bands hold what they are asked to, and how many predictions are the better for it."""
    shared = {(row.stack, row.coating): row for row in rows if row.shared}
    plain = {(row.stack, row.coating): row for row in rows if not row.shared}
    both = [key for key in shared if key in plain]
    better = sum(shared[key].error <= plain[key].error for key in both)
    higher = sum(shared[key].elpd > plain[key].elpd for key in both)
    gain = math.fsum(shared[key].elpd - plain[key].elpd for key in both) / max(len(both), 1)
    words = [
        f"With shared errors predictions err by no more than those with noise alone in {better} of {len(both)}, the "
        f"score is higher in {higher}, by {gain:.2f} in the mean.",
        f"Bands hold {100 * BAND[0]:.0f} to {100 * BAND[1]:.0f} % of all readings and at least {100 * EACH[0]:.0f} and "
        f"{100 * EACH[1]:.0f} % of each incidence in {sum(row.holds for row in shared.values())} of {len(shared)} with "
        f"shared errors, in {sum(row.holds for row in plain.values())} of {len(plain)} with noise alone.",
        "Readings of a scan are alike over many degrees: their share in a band is that of few independent ones, and "
        "100 % is nothing rare where the band is right.",
    ]
    return "\n".join(words) + "\n"
