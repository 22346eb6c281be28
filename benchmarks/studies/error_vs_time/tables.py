"""The tables of the error-against-time benchmark."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

import layerjax as lj
from benchmarks.measuring import accuracy
from benchmarks.measuring.writing import environment_lines, figure, table
from benchmarks.studies.error_vs_time.models import VALUES, Model, Row, Size
from benchmarks.studies.error_vs_time.truth import STANDARD_ERRORS, TOLERANCE, Judged, References
from benchmarks.suite.cases import FAMILIES

LEAST_DIFFERENCE = 0.1
"""Least difference of a call for many values and one for few, as a share of the latter, that timings resolve."""

TEXT = """\
# Error against run time

{environment}
{stacks} stacks ({files}), at the pairs of directions of `benchmarks/suite/cases.py`.
{omitted}
![Error against time per value, a panel a family](error-vs-time.png)

{words}

A value is a pair of directions with all its channels. *ns a value* is the median of up to {rounds} repeats, everything
compiled and prepared ({batch:,} pairs at a time; {opaque} for random walks over a base, {transmitting} without one);
*prepare* is the preparation of a stack, and *all, ns* is both when {values:,} values of a stack are evaluated.
*compile* is the first call less a later one, without a cache on disk; stacks of the same structure share it.
*operations* counts those of the lowered program of an evaluation. Steps that would take longer than {longest:g} s on a
stack are omitted. Models that are given the stack itself ({called}) are
timed for few values and for {values:,}: *ns a value* is from the difference, with a dash where that is less than
{least:.0f} % of the time for few at half of the stacks, which is within the scatter of timings.

The reference is {truth}, computed {dates}. Its limit is the larger of the difference to the next coarser
resolution and of the deviation that {check} finds beyond its noise.
An error below the limit is printed as `<=` the limit, since the reference is not more accurate.

## Summary

Medians over the *stacks* of a family that the model supports (of all there are); *worst* and *albedo* are the largest
of any of them. `<=`: at the limit of the reference, for a median at half of the stacks or more.

{summary}
## Do the references agree?

{solver} against {walk}, in both hemispheres: every value within {errors:g} standard errors
or {tolerance:g} % of its scale (that of the worst error, above), whichever is larger.
**{agree} of {stacks} stacks agree in every value.**{disagree}

{agreement}
## Relative L2 error, stack by stack

{details}"""


def markdown(
    environment: Mapping[str, Any],
    models: Sequence[Model],
    judged: Sequence[Judged],
    rows: Sequence[Row],
    size: Size,
    references: References,
    without_truth: Sequence[str],
) -> str:
    """The whole results file."""
    failing = [judgement for judgement in judged if not judgement.agrees]
    return TEXT.format(
        environment=environment_lines(environment),
        stacks=len(judged),
        files="`benchmarks/suite/FAMILY/NAME.toml`",
        omitted=f"Omitted, as they have no truth: {', '.join(without_truth)}.\n" if without_truth else "",
        words=accuracy.WORDS,
        rounds=size.rounds,
        batch=size.batch,
        opaque=size.walked_opaque,
        transmitting=size.walked_transmitting,
        values=VALUES,
        longest=size.longest,
        called=_listed(model.name for model in models if model.called),
        least=100 * LEAST_DIFFERENCE,
        truth=_name(references.truth),
        dates=_dates(judged),
        check=_name(references.check),
        solver=_name(references.solver),
        walk=_name(references.walk),
        summary=_summary(models, judged, rows),
        errors=STANDARD_ERRORS,
        tolerance=100 * TOLERANCE,
        agree=len(judged) - len(failing),
        disagree=" Those that do not, and why:" if failing else "",
        agreement=_agreement(failing) if failing else "",
        details=_details(models, judged, rows),
    )


def once(row: Row) -> float:
    """Nanoseconds of the preparation, spread over `VALUES` values."""
    return 1e9 * row.prepare_seconds / VALUES


def amortised(row: Row) -> float:
    """Nanoseconds a value, the preparation spread over `VALUES` of them."""
    return row.nanoseconds_per_value + once(row)


def steps(models: Sequence[Model]) -> list[tuple[str, str]]:
    """Every model with every step of it, in the order of registration."""
    return [(model.name, step) for model in models for step in model.steps]


def limits_of(judged: Sequence[Judged]) -> dict[str, float]:
    """Relative L2 error of the truth of each stack."""
    return {judgement.stack: judgement.limit for judgement in judged}


def floored(row: Row, limits: Mapping[str, float]) -> float:
    """Relative L2 error, not below that of the truth; NaN where the model's values were not finite."""
    return float("nan") if row.l2 is None else max(row.l2, limits[row.stack])


def percent(value: float) -> str:
    """A share in percent; a dash for none."""
    return figure(100.0 * value, digits=2) if np.isfinite(value) else "-"


def limited_percent(row: Row, limits: Mapping[str, float]) -> str:
    """The relative L2 error in percent, "<=" before it where it is the truth's limit."""
    return ("<= " if row.truth_limits else "") + percent(floored(row, limits))


def time_of_a_value(rows: Sequence[Row], called: bool) -> str:
    """The median of nanoseconds a value; a dash for differences that timings do not resolve at half of the stacks."""
    resolved = sum(row.nanoseconds_per_value >= LEAST_DIFFERENCE * once(row) for row in rows)
    return figure(_median(row.nanoseconds_per_value for row in rows)) if not called or 2 * resolved > len(rows) else "-"


def _summary(models: Sequence[Model], judged: Sequence[Judged], rows: Sequence[Row]) -> str:
    by_name, error_limits = {judgement.stack: judgement for judgement in judged}, limits_of(judged)
    called = {model.name for model in models if model.called}
    header = ("model", "stacks", "L2 error, %", "worst, %", "albedo, %", "ns a value", "prepare, ms", "all, ns",
              "compile, s", "operations")  # fmt: skip
    parts = []
    for family, title in FAMILIES.items():
        limits = [judgement.limit for judgement in judged if judgement.family == family]
        whole = len(limits)
        if not whole:
            continue
        lines = []
        for model, step in steps(models):
            found = [row for row in rows if (row.family, row.model, row.step) == (family, model, step)]
            if not found:
                lines.append([f"{model}, {step}", f"0/{whole}", *["-"] * 8])
                continue
            limited = "<= " if np.mean([row.truth_limits for row in found]) >= 0.5 else ""
            lines.append(
                [
                    f"{model}, {step}",
                    f"{len(found)}/{whole}",
                    limited + percent(_median(floored(row, error_limits) for row in found)),
                    _largest((row.worst, by_name[row.stack].worst_uncertainty) for row in found),
                    _largest((row.albedo, by_name[row.stack].albedo_uncertainty) for row in found),
                    time_of_a_value(found, model in called),
                    figure(1e3 * _median(row.prepare_seconds for row in found)),
                    figure(_median(map(amortised, found))),
                    _compile([row.compile_seconds for row in found]),
                    f"{np.median([row.operations for row in found]):,.0f}",
                ]
            )
        parts.append(
            f"### {title.capitalize()}\n\n{table(header, lines)}\n"
            f"Limit of the reference: median {percent(float(np.median(limits)))} %, at most {percent(max(limits))} %.\n"
        )
    return "\n".join(parts)


def _agreement(failing: Sequence[Judged]) -> str:
    header = ("stack", "values", "beyond, same side", "beyond, other side", "largest, %", "truth to, %", "truth z rms")
    rows = [
        (
            judgement.stack,
            str(judgement.compared),
            *map(str, judgement.failures),
            percent(judgement.worst),
            percent(judgement.limit),
            f"{judgement.z_root_mean_square:.2f}",
        )
        for judgement in failing
    ]
    causes = "".join(f"- {judgement.stack}: {judgement.cause or 'not known'}\n" for judgement in failing)
    return f"{table(header, rows)}\n{causes}"


def _details(models: Sequence[Model], judged: Sequence[Judged], rows: Sequence[Row]) -> str:
    limits = limits_of(judged)
    cells = {(row.stack, row.model, row.step): row for row in rows}
    columns = steps(models)
    header = ("%", "limit of truth", "truth z rms", "agree", *(f"{_short(model)} {step}" for model, step in columns))
    parts = []
    for family, title in FAMILIES.items():
        lines = []
        for judgement in judged:
            if judgement.family != family:
                continue
            line = [judgement.stack, percent(judgement.limit), f"{judgement.z_root_mean_square:.2f}"]
            line.append("yes" if judgement.agrees else "no")
            for model, step in columns:
                row = cells.get((judgement.stack, model, step))
                if row is None:
                    line.append("-")
                elif row.l2 is None:
                    line.append("not finite")
                else:
                    line.append(limited_percent(row, limits))
            lines.append(line)
        if lines:
            parts.append(f"### {title.capitalize()}, stack by stack\n\n{table(header, lines)}")
    return "\n".join(parts)


def _dates(judged: Sequence[Judged]) -> str:
    """When the truths were solved: results may keep those of runs before."""
    dates = sorted({judgement.date for judgement in judged})
    return f"{dates[0]} to {dates[-1]}" if len(dates) > 1 else "".join(dates)


def _name(transport: lj.Transport) -> str:
    """The transport as code."""
    return f"`{transport!r}`"


def _short(name: str) -> str:
    """The initials of a model whose name has several words."""
    words = name.replace("-", " ").split()
    return "".join(word[0].upper() for word in words) if len(words) > 1 else name


def _listed(names: Iterable[str]) -> str:
    """The names as code, with commas."""
    return ", ".join(f"`{name}`" for name in names)


def _compile(seconds: Sequence[float | None]) -> str:
    known = [value for value in seconds if value is not None]
    return figure(_median(known) if known else None, digits=2)


def _median(values: Iterable[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.median(finite)) if finite else float("nan")


def _largest(errors: Iterable[tuple[float | None, float]]) -> str:
    """The largest of errors, each with that of its truth, in percent."""
    finite = [(max(error, limit), error <= limit) for error, limit in errors if error is not None]
    if not finite:
        return "-"
    error, limited = max(finite)
    return ("<= " if limited and error > 0 else "") + percent(error)
