"""Tables of fits and predictions: built once as words, then shown by rich on a terminal or as HTML in the report."""

import csv
import io
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TextIO

import numpy as np

from fits.data.geometry import azimuth, polar
from fits.data.measurements import Measurements
from fits.data.scans import incidences
from fits.data.totals import Totals
from fits.optimise.limits import instrument_limits
from fits.optimise.result import OUTCOMES
from fits.prediction.predict import scores
from fits.reports.diagnostics import ResidualStructure
from fits.reports.pages import Table
from fits.reports.pages import html_table as html_table
from fits.reports.verdicts import identifiability, numerical_error

if TYPE_CHECKING:
    from rich.table import Table as Boxed

    from fits.optimise.result import Fit
    from fits.prediction.compare import ComparedFit, Comparison
    from fits.prediction.cross_validation import ModelScore
    from fits.prediction.predict import Prediction
    from fits.problem.problem import Problem
    from fits.sampling.posterior import Posterior

MOST_ANGLES = 24  # incidences that are listed one by one
MOST_MINIMA = 8
UNRELIABLE = (
    "The importance-sampling approximation of the posterior is poor (Pareto k above 0.7): intervals may be too narrow. "
    "Sample the posterior instead (`layerjax sample`)."
)
LONGEST_WORD = 30  # letters of a text that is never wrapped


def print_table(table: Table, stream: TextIO) -> None:
    """Writes the table to `stream`: boxed and as wide as the terminal, or 120 columns where there is none.

    One that does not fit becomes several below each other, each with the keys, so that every column is shown.
    """
    from rich.console import Console

    console = Console(file=stream, width=None if stream.isatty() else 120, highlight=False, markup=False)

    def least_width(columns: list[int]) -> int:
        return console.measure(_boxed(table, columns), options=console.options.update(width=10_000)).minimum

    keys = list(range(table.keys))
    parts = [keys]
    for column in range(table.keys, len(table.columns)):
        if parts[-1] != keys and least_width([*parts[-1], column]) > console.width:
            parts.append(keys)
        parts[-1] = [*parts[-1], column]
    for number, part in enumerate(parts, start=1):
        title = table.title if len(parts) == 1 else f"{table.title} ({number} of {len(parts)})"
        console.print(_boxed(table, part, title, squeezed=least_width(part) > console.width))
    if table.note:
        console.print(table.note)


def _boxed(table: Table, columns: list[int], title: str = "", squeezed: bool = False) -> "Boxed":
    """The named columns of a table in a box. Texts may be wrapped, numbers only where the box is to be `squeezed`."""
    from rich import box
    from rich.cells import cell_len
    from rich.table import Table as Boxed

    boxed = Boxed(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for index in columns:
        longest = max(map(cell_len, [table.columns[index], *(row[index] for row in table.rows)]))
        number = table.numeric(index)
        wraps = not number and (index == len(table.columns) - 1 or longest > LONGEST_WORD)
        boxed.add_column(
            table.columns[index],
            justify="right" if number else "left",
            no_wrap=not (wraps or squeezed),
            overflow="fold",
            min_width=None if squeezed else min(longest, 12) if wraps else longest,
        )
    for row in table.rows:
        boxed.add_row(*(row[index] for index in columns))
    return boxed


def problem_table(fit: "Fit") -> Table:
    """What was fitted: the data, the noise model, the transport and the starts."""
    data, problem = fit.problem.data, fit.problem
    angles = [group.theta for group in incidences(data.used())]
    span = ", ".join(f"{angle:g}°" for angle in angles)
    if len(angles) > MOST_ANGLES:
        span = f"{len(angles)}, from {min(angles):g}° to {max(angles):g}°"
    fixed = problem.scale is None or isinstance(problem.scale, int | float)
    transport = problem.transport if isinstance(problem.transport, str) else type(problem.transport).__name__
    rows = [
        ("file", data.source.path or "none"),
        ("format", data.source.format),
        ("quantity in the file", quantity_in_words(data)),
        ("channels", ", ".join(data.channels)),
        ("measurements", f"{int(data.mask.sum())} of {len(data.mask)} used, {int((~data.mask).sum())} masked"),
        ("incidence", span),
        ("noise", noise_in_words(problem)),
        ("objective", problem.objective),
        ("scale", f"fixed at {problem.scale or 1:g}" if fixed else "fitted, see the table of values"),
        ("starts", starts_in_words(fit)),
        ("transport", transport if fit.resolution is None else f"{transport}, {fit.resolution}"),
        *((("numerical error of the model", numerical_error(fit.numerical_error)),) if fit.resolution else ()),
        *(("note", note) for note in data.source.notes),
        *((("attribution", data.source.attribution),) if data.source.attribution else ()),
    ]
    return Table("", ("", ""), tuple(rows))


def quantity_in_words(data: Measurements) -> str:
    """What the values of a file are."""
    if not isinstance(data, Totals):
        return f"{data.source.quantity}, converted to BRDF in 1/sr"
    if data.spheres is None:
        return "shares of the incident flux"
    spheres = "two integrating spheres" if data.spheres.together else "an integrating sphere"
    return f"shares of the incident flux, as measured with {spheres}"


def noise_in_words(problem: "Problem") -> str:
    """The noise model of a problem in one line."""
    noise, parts = problem.noise, []
    if noise.use_sigma and problem.data.sigma is not None:
        parts.append("the file's own sigma")
    for level, unit in (("relative", "of the model's value"), ("floor", "1/sr")):
        value = float(np.asarray(getattr(problem.build(problem.start), level)))
        if f"noise.{level}" in problem.names:
            parts.append(f"a fitted {level} part")
        elif value > 0.0:
            assumed = " (assumed)" if level == "relative" and problem.noise_is_assumed else ""
            parts.append(f"{value:.3g} {unit}{assumed}")
    if noise.discrepancy:
        parts.append("a model discrepancy (Gaussian process)")
    tails = (
        f"Student-t with {noise.degrees_of_freedom:g} degrees of freedom" if noise.tails != "gaussian" else "Gaussian"
    )
    return f"{', '.join(parts)}{', added in quadrature' if len(parts) > 1 else ''}; {tails}"


def starts_in_words(fit: "Fit") -> str:
    """How many starts there were, and how they ended, in one line."""
    if not fit.start_outcomes:
        return "not recorded"
    run = ", ".join(f"{name} {fit.settings[name]}" for name in ("seed", "solver") if name in fit.settings)
    ended = ", ".join(f"{fit.start_outcomes[key]} {word}" for key, word in OUTCOMES.items() if fit.start_outcomes[key])
    count = sum(fit.start_outcomes.values())
    if fit.without_discrepancy is None:
        return f"{count} ({run}): {ended}"
    given = fit.settings.get("starts", "?")
    return f"{given} with independent noise ({run}), then {count} with the discrepancy term: {ended}"


def parameter_table(fit: "Fit") -> Table:
    """Value, standard error, unit, bounds and identifiability of each fitted parameter."""
    words, limits = identifiability(fit), instrument_limits(fit)
    rows = []
    for index, (name, value) in enumerate(fit.values.items()):
        low, high = float(fit.problem.low[index]), float(fit.problem.high[index])
        error = fit.standard_errors[name]
        number, spread = (f"< {limits[name]:.2g}", "-") if name in limits else with_error(value, error)
        rows.append((name, number, spread, fit.units[name], f"{low:.4g} to {high:.4g}", words[name]))
    notes = ["Errors are those of the best minimum only."] if fit.alternatives else []
    if not fit.is_posterior:
        notes.append("The objective is a named residual, not a likelihood: the errors are only indicative.")
    note = " ".join(notes)
    return Table(
        "Fitted parameters", ("parameter", "value", "error", "unit", "bounds", "identifiability"), tuple(rows), note
    )


def discrepancy_table(fit: "Fit") -> Table:
    """Values and errors of a fit with model discrepancy beside those with independent noise."""
    assert fit.without_discrepancy is not None
    rows = []
    for name, value in fit.without_discrepancy.values.items():
        pairs = (fit.values[name], fit.standard_errors[name]), (value, fit.without_discrepancy.errors[name])
        rows.append((name, *(word for pair in pairs for word in with_error(*pair)), fit.units[name]))
    ratio = fit.without_discrepancy.chi_square / max(fit.without_discrepancy.degrees_of_freedom, 1)
    note = f"The reduced chi-square is {fit.reduced_chi_square:.3g} with and {ratio:.3g} without."
    columns = ("parameter", "with", "error", "without", "error", "unit")
    return Table("With and without the model discrepancy", columns, tuple(rows), note)


def minima_table(fit: "Fit") -> Table:
    """The minima that the starts reached, a column each, best first: how many starts, the cost, the values there."""
    shown = fit.minima[:MOST_MINIMA]
    equal = {id(minimum) for minimum in fit.alternatives}
    heads = ["best", *("same cost" if id(minimum) in equal else "higher cost" for minimum in shown[1:])]
    rows = [
        ("starts", *(str(minimum.count) for minimum in shown)),
        ("cost", *(f"{minimum.cost:.6g}" for minimum in shown)),
        *((name, *(f"{minimum.values[name]:.4g}" for minimum in shown)) for name in fit.values),
    ]
    hidden = len(fit.minima) - len(shown)
    note = f"{hidden} more, with higher cost, are in the result." if hidden else ""
    return Table("Minima that the starts reached", ("", *heads), tuple(rows), note)


def unidentified_table(fit: "Fit") -> Table:
    """Directions of parameter space that the data do not identify, with the conditional errors of their parameters."""
    rows = []
    for place, direction in enumerate(fit.unidentified, 1):
        size = f"{direction.error:.2g}" if math.isfinite(direction.error) else "infinite"
        weights = ", ".join(f"{weight:+.2g} {name}" for name, weight in direction.weights.items())
        conditional = ", ".join(f"{name} {error:.2g}" for name, error in direction.conditional_errors.items())
        kind = "unidentified" if direction.unconstrained else "weakly identified"
        rows.append((str(place), size, kind, weights, conditional))
    note = (
        "Standard errors from the likelihood only, in units of the prior range; where they exceed it, only bounds and "
        "priors decide. A parameter's own error along a direction is its weight times that. Conditional errors: with "
        "the other parameters fixed, in the parameter's own unit."
    )
    columns = ("direction", "error", "", "weights", "conditional errors")
    return Table("Unidentified directions of parameter space", columns, tuple(rows), note if rows else "")


def posterior_table(posterior: "Posterior") -> Table:
    """Median, 68 % interval, mean, unit, autocorrelation time and effective sample size of each parameter."""
    summary = posterior.summary()
    time, effective = (
        np.ravel(posterior.autocorrelation_time),
        np.broadcast_to(posterior.effective_samples, len(posterior.names)),
    )
    rows = []
    for index, name in enumerate(posterior.names):
        median, low, high, mean, deviation = summary[name]
        width = (high - low) / 2.0
        words = (with_error(number, width)[0] for number in (median, low, high, mean))
        unit = posterior.fit.units[name]
        rows.append((name, *words, f"{deviation:.2g}", unit, f"{time[index]:.0f}", f"{effective[index]:.0f}"))
    columns = ("parameter", "median", "16 %", "84 %", "mean", "sd", "unit", "autocorr. steps", "effective samples")
    note = f"Estimates cover all {len(posterior.modes)} modes." if posterior.modes else ""
    return Table("Posterior", columns, tuple(rows), note)


def incidence_table(structure: ResidualStructure) -> Table:
    """Residuals of each incidence in units of sigma."""
    rows = [
        (degrees(group.theta), str(group.count), f"{group.mean:+.2f}", f"{group.rms:.2f}")
        for group in structure.by_incidence
    ]
    note = "In standard deviations; the true model and noise give mean 0 and rms 1 at every incidence."
    return Table(
        "Residuals by incidence", ("incidence", "measurements", "mean", "rms"), tuple(shortened(rows, 40)), note
    )


_ORDERS = {"elpd": "cross-validated elpd", "loo": "leave-one-out", "aic": "AIC", "chi_square": "chi-square"}


def comparison_table(comparison: "Comparison") -> Table:
    """One row per fit, the best first: goodness of fit, number of parameters, and predictive score."""
    compared = comparison.rows
    aic, bic = min(row.aic for row in compared), min(row.bic for row in compared)
    columns: list[tuple[str, Callable[[ComparedFit], str]]] = [
        ("fit", lambda row: row.name),
        ("parameters", lambda row: str(row.parameters)),
        ("chi2/dof", lambda row: f"{row.reduced_chi_square:.4g}"),
        ("chi2", lambda row: f"{row.chi_square:.5g}"),
    ]
    if math.isfinite(aic):
        columns += [
            ("log-lik.", lambda row: f"{row.log_likelihood:.2f}"),
            ("AIC - best", lambda row: f"{row.aic - aic:.1f}"),
            ("BIC - best", lambda row: f"{row.bic - bic:.1f}"),
        ]
    if all(math.isfinite(row.loo) for row in compared):
        columns += [("elpd_loo diff", lambda row: f"{row.loo_diff:.1f} ± {row.loo_dse:.1f}")]
    if compared[0].model_score is not None:
        columns += [
            ("elpd", lambda row: f"{_score(row).elpd:.1f}"),
            ("elpd_diff ± dse", lambda row: f"{_score(row).elpd_diff:.1f} ± {_score(row).dse:.1f}"),
            ("weight", lambda row: f"{_score(row).weight:.2f}"),
            ("log evidence", lambda row: f"{_score(row).evidence.log_evidence:.1f} ± {_score(row).evidence.error:.1f}"),
            ("model probability", lambda row: f"{_score(row).model_probability:.2g}"),
        ]
    columns += [
        ("converged", lambda row: "yes" if row.converged else "NO"),
        ("at a bound", lambda row: ", ".join(row.at_bound)),
    ]
    rows = tuple(tuple(word(row) for _, word in columns) for row in compared)
    order = _ORDERS[comparison.sorted_by]
    note = " ".join(f"{line[0].upper()}{line[1:]}." for line in (f"sorted by {order}, best first", *comparison.notes))
    return Table("Comparison", tuple(head for head, _ in columns), rows, note)


def _score(row: "ComparedFit") -> "ModelScore":
    assert row.model_score is not None
    return row.model_score


def scores_table(prediction: "Prediction", data: Measurements, title: str) -> Table:
    """Errors, coverage and predictive score of held-out data, for each incidence and for all of them."""
    used = data.used()
    rows, every = [], incidences(used)
    for incidence in every:
        chosen = np.zeros(len(used), bool)
        chosen[incidence.rows] = True
        rows.append((incidence.label, scores(prediction, data, chosen)))
    if len(every) > 1:
        rows.append(("all", scores(prediction, data)))
    cells = []
    for label, found in rows:
        shares = (found.median_error, found.p95_error, found.model_error, *found.coverage.values())
        cells.append((label, f"{found.count:,}", *(f"{100.0 * x:.1f} %" for x in shares), f"{found.elpd:.2f}"))
    note = (
        "Median and 95th percentile of |prediction / measurement - 1|; the third is the median error of the stack "
        "without model discrepancy. Coverage: share of the measurements inside the central 50 % and 95 % prediction "
        "intervals. Elpd: mean log predictive density of a measurement."
    )
    if not prediction.reliable:
        note = f"{note} {UNRELIABLE}"
    heads = ("incidence", "measurements", "median error", "95 % below", "stack only", "in 50 %", "in 95 %", "elpd")
    return Table(title, heads, tuple(cells), note)


def prediction_csv(prediction: "Prediction") -> str:
    """A row for each pair of directions and channel: angles in degrees, all else in 1/sr.

    Columns `bsdf_...` are the best estimate, of the stack with the model discrepancy; `predictive_...` of a new
    measurement; `latent_...` of the stack without the discrepancy.
    """
    parts = {"bsdf": prediction.bsdf, "predictive": prediction.predictive, "latent": prediction.latent}
    statistics = ("mean", "sd", *(f"q{100.0 * level:g}" for level in prediction.levels))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    columns = [f"{part}_{statistic}" for part in parts for statistic in statistics]
    writer.writerow(["theta_i", "phi_i", "theta_o", "phi_o", "channel", *columns])
    angles = [polar(prediction.wi), azimuth(prediction.wi), polar(prediction.wo), azimuth(prediction.wo)]
    for row in range(len(prediction.wi)):
        for index, channel in enumerate(prediction.channels):
            numbers = [
                number
                for part in parts.values()
                for number in (part.mean[row, index], part.sd[row, index], *part.quantiles[:, row, index])
            ]
            place = (f"{angle[row]:.10g}" for angle in angles)
            writer.writerow([*place, channel, *(f"{number:.8g}" for number in numbers)])
    return out.getvalue()


def degrees(angle: float) -> str:
    """An angle in degrees as a word, to 0.01 at most: ``"89.85°"``, ``"30°"``."""
    return f"{round(float(angle), 2) + 0.0:g}°"  # the sum makes 0 of -0


def with_error(value: float, error: float) -> tuple[str, str]:
    """Value and error as words, both to two digits of the error; ``("0.532", "0.021")``."""
    if not (math.isfinite(error) and error > 0.0):
        return f"{value:.6g}", "unknown"
    digits = 1 - math.floor(math.log10(error))
    if not -3 <= digits <= 9:
        return f"{value:.6g}", f"{error:.2g}"
    return f"{value:.{max(digits, 0)}f}", f"{error:.{max(digits, 0)}f}"


def shortened(rows: Sequence[tuple[str, ...]], most: int) -> Sequence[tuple[str, ...]]:
    """The first and the last of so many rows, and how many are omitted between them."""
    if len(rows) <= most:
        return rows
    gap = (f"... {len(rows) - most} more", *[""] * (len(rows[0]) - 1))
    return [*rows[: most // 2], gap, *rows[len(rows) - most // 2 :]]
