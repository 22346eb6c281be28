"""Noisy repeats of every case, fitted; and every bin of a table at once."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measuring import environment
from benchmarks.measuring.repeats import fit_many
from benchmarks.measuring.writing import DIRECTORY, environment_lines, figure, table, write
from benchmarks.studies.pulls import cases
from benchmarks.studies.pulls.cases import Case

NAME = "pulls"
WITHIN, ENOUGH = 3.0, 0.98
MOST_BYTES = 4e9

TEXT = """\
# Pulls: instruments, mixtures and tables of bins

{environment}
Simulated readings with {noise:.0%} noise, fitted from one start. *bias* and *pull*: (fitted - true) over the standard
error, its mean and standard deviation over the repeats. *within 3*: share of the repeats within {within:g} standard
errors; asked for: {enough:.0%}.

## Instruments ({many} repeats)

A coat of alpha 0.08 over a diffuse base, at 10, 30, 50 and 70 degrees, every 2 degrees. Readings are means over the
detector's cone by dense quadrature; the sample leans by {leans:g} degrees, and each incidence has a gain of its own,
{gain:.0%} about 1. Fitted with `fits.Instrument(detector_aperture=..., tilt=Free, gain_sd={gain})`, and without.

{instruments}
## Mixtures ({many} repeats)

{mixtures}
## Bins of MERL tables ({few} repeats)

Tables of six materials, read at {bins:,} bins that were chosen by each of both strata. Asked for: a mean pull within 3
of its standard errors of 0, and a standard deviation within 3 of its own, {unit:.2f}, of 1.

{tables}
## Every bin

{every}"""


@dataclass(frozen=True)
class Row:
    """One parameter of a case over its repeats."""

    group: str
    name: str
    how: str
    parameter: str
    truth: float
    typical: float
    error: float
    bias: float
    pull: float
    within: float
    converged: float
    repeats: int

    @property
    def recovered(self) -> bool:
        """Whether enough repeats are within 3 standard errors."""
        return self.within >= ENOUGH

    @property
    def of_unit_width(self) -> bool:
        """Whether pulls are those of unbiased values with honest errors."""
        own = self.pull / np.sqrt(self.repeats), 1.0 / np.sqrt(2 * self.repeats)
        return abs(self.bias) <= WITHIN * own[0] and abs(self.pull - 1.0) <= WITHIN * own[1]


@dataclass(frozen=True)
class Size:
    """Repeats of instruments and mixtures, and of bins."""

    many: int
    few: int


DEFAULT, QUICK = Size(400, 400), Size(8, 4)


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    size: Size | None = None,
) -> tuple[str, tuple[Path, Path]]:
    """Run it, and write ``pulls.json`` and ``pulls.md``; returns the markdown and the two paths."""
    size = size or (QUICK if quick else DEFAULT)
    surroundings = environment.describe()
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for group, found in (
            ("instruments", cases.by_instruments(size.many)),
            ("mixtures", cases.of_mixtures(size.many)),
            ("tables", cases.of_bins(size.few, Path(folder))),
        ):
            for case in found:
                rows += run_case(group, case)
                report(f"{case.name}, {case.how}: {min(row.within for row in rows if row.name == case.name):.0%}")
        every = every_bin(Path(folder) / "noisy.binary")
    text = TEXT.format(
        environment=environment_lines(surroundings),
        noise=cases.NOISE,
        within=WITHIN,
        enough=ENOUGH,
        many=size.many,
        few=size.few,
        leans=cases.LEANS,
        gain=cases.GAIN,
        bins=cases.BINS,
        unit=1.0 / np.sqrt(2 * size.few),
        **{
            group: _table([row for row in rows if row.group == group], group == "tables")
            for group in ("instruments", "mixtures", "tables")
        },
        every=_every_text(every),
    )
    content = {"environment": surroundings, "rows": [asdict(row) for row in rows], "every bin": every}
    return text, write(NAME, content, text, directory)


def run_case(group: str, case: Case) -> list[Row]:
    """All repeats of one case, fitted at once: a row for each parameter whose truth is known."""
    found = fit_many(case.problem, case.values)
    rows = []
    for name, truth in case.truth.items():
        place = case.problem.names.index(name)
        fitted, error = found.vectors[:, place], found.standard_errors[:, place]
        pulls = (fitted - truth) / error
        rows.append(
            Row(
                group=group,
                name=case.name,
                how=case.how,
                parameter=name,
                truth=float(truth),
                typical=float(np.median(fitted)),
                error=float(np.median(error)),
                bias=float(np.mean(pulls)),
                pull=float(np.std(pulls, ddof=1)),
                within=float(np.mean(np.abs(pulls) <= WITHIN)),
                converged=float(np.mean(found.converged)),
                repeats=len(pulls),
            )
        )
    return rows


def every_bin(path: Path) -> dict[str, Any]:
    """What a fit to every bin of a noisy table gives and takes."""
    stack, _ = cases.materials()["flakes over paint"]
    cases.write_table(path, stack, cases.NOISE)
    words = [sys.executable, "-m", "benchmarks.studies.pulls.every_bin", str(path)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _table(rows: list[Row], of_tables: bool) -> str:
    heads = ("", "", "parameter", "truth", "median", "error", "bias", "pull", "within 3", "converged", "as asked")
    body = []
    for row in rows:
        asked = row.of_unit_width if of_tables else row.recovered
        words = "met" if asked else "no" if row.how == "without" else "**not met**"
        numbers = (figure(row.truth), figure(row.typical, 4), figure(row.error, 2), f"{row.bias:+.2f}")
        shares = (f"{row.pull:.2f}", f"{row.within:.0%}", f"{row.converged:.0%}")
        body.append((row.name, row.how, row.parameter, *numbers, *shares, words))
    return table(heads, body)


def _every_text(every: dict[str, Any]) -> str:
    verdict = "met" if every["bytes"] < MOST_BYTES else "**not met**"
    heads = "parameter", "fitted", "error"
    body = [(name, figure(value, 6), figure(every["errors"][name], 2)) for name, value in every["values"].items()]
    return (
        f"Flakes over paint, {every['readings']:,} bins in three channels: {every['seconds']:.0f} s with two starts, "
        f"{every['bytes'] / 1e9:.1f} GB at most (asked for: under {MOST_BYTES / 1e9:g} GB, {verdict}).\n\n"
        + table(heads, body)
    )
