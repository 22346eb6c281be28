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
Simulated measurements with {noise:.0%} noise, fitted from one start. *mean pull* and *sd of pulls*: mean and standard
deviation over the repeats of (fitted - true) / standard error. *within 3*: share of the repeats within {within:g}
standard errors; required: {enough:.0%}.

## Instruments ({many} repeats)

A coat of alpha 0.08 over a diffuse base, at 10, 30, 50 and 70 degrees, every 2 degrees. Measurements are means over the
detector's aperture by dense quadrature; the sample is tilted by {tilt:g} degrees, and each incidence has a gain of its
own, {gain:.0%} about 1. Fitted with `fits.Instrument(detector_aperture=..., tilt=Free, gain_sd={gain})`, and without.

{instruments}
## Mixtures ({many} repeats)

{mixtures}
## Bins of MERL tables ({few} repeats)

Tables of six materials, fitted to {bins:,} bins that were chosen by each of both strata. Required: a mean pull within 3
of its standard errors of 0, and a standard deviation within 3 of its own, {unit:.2f}, of 1.

{tables}
## Every bin

{all_bins}"""


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
    mean_of_pulls: float
    sd_of_pulls: float
    within_3: float
    converged: float
    repeats: int

    @property
    def recovered(self) -> bool:
        """Whether enough repeats are within 3 standard errors."""
        return self.within_3 >= ENOUGH

    @property
    def of_unit_width(self) -> bool:
        """Whether pulls are those of unbiased values with honest errors."""
        errors = self.sd_of_pulls / np.sqrt(self.repeats), 1.0 / np.sqrt(2 * self.repeats)
        return abs(self.mean_of_pulls) <= WITHIN * errors[0] and abs(self.sd_of_pulls - 1.0) <= WITHIN * errors[1]


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
        for group, cases_of_group in (
            ("instruments", cases.by_instruments(size.many)),
            ("mixtures", cases.of_mixtures(size.many)),
            ("tables", cases.of_bins(size.few, Path(folder))),
        ):
            for case in cases_of_group:
                rows += run_case(group, case)
                report(f"{case.name}, {case.how}: {min(row.within_3 for row in rows if row.name == case.name):.0%}")
        fit_of_all = all_bins(Path(folder) / "noisy.binary")
    text = TEXT.format(
        environment=environment_lines(surroundings),
        noise=cases.NOISE,
        within=WITHIN,
        enough=ENOUGH,
        many=size.many,
        few=size.few,
        tilt=cases.TILT,
        gain=cases.GAIN,
        bins=cases.BINS,
        unit=1.0 / np.sqrt(2 * size.few),
        **{
            group: _table([row for row in rows if row.group == group], group == "tables")
            for group in ("instruments", "mixtures", "tables")
        },
        all_bins=_all_bins_text(fit_of_all),
    )
    content = {"environment": surroundings, "rows": [asdict(row) for row in rows], "every bin": fit_of_all}
    return text, write(NAME, content, text, directory)


def run_case(group: str, case: Case) -> list[Row]:
    """All repeats of one case, fitted at once: a row for each parameter whose truth is known."""
    repeats = fit_many(case.problem, case.values)
    rows = []
    for name, truth in case.truth.items():
        place = case.problem.names.index(name)
        fitted, error = repeats.vectors[:, place], repeats.standard_errors[:, place]
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
                mean_of_pulls=float(np.mean(pulls)),
                sd_of_pulls=float(np.std(pulls, ddof=1)),
                within_3=float(np.mean(np.abs(pulls) <= WITHIN)),
                converged=float(np.mean(repeats.converged)),
                repeats=len(pulls),
            )
        )
    return rows


def all_bins(path: Path) -> dict[str, Any]:
    """Values, errors, time and memory of a fit to every bin of a noisy table."""
    stack, _ = cases.materials()["flakes over paint"]
    cases.write_table(path, stack, cases.NOISE)
    words = [sys.executable, "-m", "benchmarks.studies.pulls.every_bin", str(path)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    results: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return results


def _table(rows: list[Row], of_tables: bool) -> str:
    heads: tuple[str, ...] = ("", "", "parameter", "truth", "median", "error", "mean pull", "sd of pulls")
    heads += ("within 3", "converged", "verdict")
    body = []
    for row in rows:
        met = row.of_unit_width if of_tables else row.recovered
        words = "met" if met else "no" if row.how == "without" else "**not met**"
        numbers = (figure(row.truth), figure(row.typical, 4), figure(row.error, 2), f"{row.mean_of_pulls:+.2f}")
        shares = (f"{row.sd_of_pulls:.2f}", f"{row.within_3:.0%}", f"{row.converged:.0%}")
        body.append((row.name, row.how, row.parameter, *numbers, *shares, words))
    return table(heads, body)


def _all_bins_text(fit: dict[str, Any]) -> str:
    verdict = "met" if fit["bytes"] < MOST_BYTES else "**not met**"
    heads = "parameter", "fitted", "error"
    body = [(name, figure(value, 6), figure(fit["errors"][name], 2)) for name, value in fit["values"].items()]
    return (
        f"Flakes over paint, {fit['measurements']:,} bins in three channels: {fit['seconds']:.0f} s with two starts, "
        f"{fit['bytes'] / 1e9:.1f} GB at most (required: under {MOST_BYTES / 1e9:g} GB, {verdict}).\n\n"
        + table(heads, body)
    )
