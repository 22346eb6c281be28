"""Tables of fits and predictions: built once as words, then shown by rich on a terminal or as HTML in the report."""

import csv
import io
import math
from collections.abc import Sequence
from typing import TextIO

import numpy as np

from fits.data.geometry import azimuth, polar
from fits.data.measurements import Measurements
from fits.data.scans import incidences
from fits.optimise.result import Fit
from fits.prediction.compare import Comparison
from fits.prediction.predict import LEVELS, Prediction, scores
from fits.problem.problem import Problem
from fits.reports.pages import Table
from fits.reports.verdicts import identifiability, instrument_limits, standardised
from fits.sampling.posterior import Posterior

MOST_MINIMA = 8
UNRELIABLE = (
    "The importance-sampling approximation of the posterior is poor (Pareto k above 0.7): intervals may be too narrow. "
    "Sample the posterior instead (`layerjax sample`)."
)


def print_table(table: Table, stream: TextIO) -> None:
    """Writes the table to `stream`, as wide as the terminal or 120 columns; what is too wide is folded, never cut."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as Boxed

    console = Console(file=stream, width=None if stream.isatty() else 120, highlight=False, markup=False)
    shown = Boxed(title=table.title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for index, name in enumerate(table.columns):
        shown.add_column(name, justify="right" if table.numeric(index) else "left", overflow="fold")
    for row in table.rows:
        shown.add_row(*row)
    console.print(shown)
    if table.note:
        console.print(table.note)


# ---- words in tables ----


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


def shortened(rows: Sequence[tuple[str, ...]], most: int = 40) -> tuple[tuple[str, ...], ...]:
    """The first and the last of so many rows, and how many are omitted between them."""
    if len(rows) <= most:
        return tuple(rows)
    gap = (f"... {len(rows) - most} more", *[""] * (len(rows[0]) - 1))
    return (*rows[: most // 2], gap, *rows[len(rows) - most // 2 :])


def noise_in_words(problem: Problem) -> str:
    """The noise model of a problem in one line."""
    noise, start = problem.noise, problem.build(problem.start)
    parts = ["the file's own sigma"] if noise.use_sigma and problem.data.sigma is not None else []
    for level, unit in (("relative", "of the model's value"), ("floor", "1/sr")):
        if f"noise.{level}" in problem.names:
            parts.append(f"a fitted {level} part")
        elif (value := float(np.asarray(getattr(start, level)))) > 0.0:
            assumed = " (assumed)" if level == "relative" and problem.noise_is_assumed else ""
            parts.append(f"{value:.3g} {unit}{assumed}")
    parts += ["a model discrepancy (Gaussian process)"] if noise.discrepancy else []
    law = "Gaussian" if noise.tails == "gaussian" else f"Student-t, {noise.degrees_of_freedom:g} degrees of freedom"
    return f"{', '.join(parts)}{', added in quadrature' if len(parts) > 1 else ''}; {law}"


# ---- tables of a fit ----


def problem_rows(fit: Fit) -> tuple[tuple[str, str], ...]:
    """What was fitted beside the data: noise model, objective, scale and transport."""
    problem = fit.problem
    fixed = problem.scale is None or isinstance(problem.scale, int | float)
    transport = problem.transport if isinstance(problem.transport, str) else type(problem.transport).__name__
    return (
        ("noise", noise_in_words(problem)),
        ("objective", problem.objective),
        ("scale", f"fixed at {problem.scale or 1:g}" if fixed else "fitted, see the table of values"),
        ("transport", transport if fit.resolution is None else f"{transport}, {fit.resolution}"),
    )


def parameter_table(fit: Fit, both: bool = False) -> Table:
    """Value, standard error, unit, bounds and identifiability of each fitted parameter.

    both: where a model discrepancy was added, also the value with independent noise.
    """
    words, limits, independent = identifiability(fit), instrument_limits(fit), fit.without_discrepancy if both else None
    rows = []
    for name, value, low, high in zip(fit.values, fit.vector, fit.problem.low, fit.problem.high, strict=True):
        number, spread = with_error(value, fit.standard_errors[name])
        if name in limits:
            number, spread = f"< {limits[name]:.2g}", "-"
        before = []
        if independent is not None:
            pair = (independent.values[name], independent.errors[name]) if name in independent.values else None
            before = [" ± ".join(with_error(*pair)) if pair else ""]
        rows.append((name, number, spread, *before, fit.units[name], f"{low:.4g} to {high:.4g}", words[name]))
    notes = ["Errors are those of the best minimum only."] if fit.alternatives else []
    if fit.at_bound:
        notes.append("A parameter at a bound has no error; the errors of the others are conditional on it.")
    heads = ("independent noise",) if independent else ()
    columns = ("parameter", "value", "error", *heads, "unit", "bounds", "identifiability")
    return Table("Fitted parameters", columns, tuple(rows), " ".join(notes))


def minima_table(fit: Fit) -> Table:
    """The minima that the starts reached, a column each, best first: how many starts, the cost, the values there."""
    minima = fit.minima[:MOST_MINIMA]
    heads = ["same cost" if one.equivalent else "higher cost" for one in minima[1:]]
    rows = [
        ("starts", *(str(one.count) for one in minima)),
        ("cost", *(f"{one.cost:.6g}" for one in minima)),
        *((name, *(f"{one.values[name]:.4g}" for one in minima)) for name in fit.values),
    ]
    hidden = len(fit.minima) - len(minima)
    note = f"{hidden} more, with higher cost, are in the result." if hidden else ""
    return Table("Minima that the starts reached", ("", "best", *heads), tuple(rows), note)


def unidentified_table(fit: Fit) -> Table:
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
    kind = "Unidentified" if any(one.unconstrained for one in fit.unidentified) else "Weakly identified"
    return Table(f"{kind} directions of parameter space", columns, tuple(rows), note)


def correlation_table(fit: Fit) -> Table:
    """Correlations of the fitted parameters, which are numbered."""
    rows = []
    for number, (name, correlations) in enumerate(zip(fit.values, fit.correlation, strict=True)):
        words = [f"{value:+.2f}" if math.isfinite(value) else "" for value in correlations[:number]]
        rows.append((f"{name} ({number + 1})", *words, *[""] * (len(fit.values) - 1 - number)))
    return Table("Correlations", ("", *map(str, range(1, len(rows)))), tuple(rows))


def posterior_table(posterior: Posterior) -> Table:
    """Median, 68 % interval, standard deviation, unit and effective sample size of each parameter."""
    effective = np.broadcast_to(posterior.effective_samples, len(posterior.names))
    rows = []
    for (name, (*interval, _, deviation)), size in zip(posterior.summary().items(), effective, strict=True):
        words = (with_error(number, (interval[2] - interval[1]) / 2.0)[0] for number in interval)
        rows.append((name, *words, f"{deviation:.2g}", posterior.fit.units[name], f"{size:.0f}"))
    columns = ("parameter", "median", "16 %", "84 %", "sd", "unit", "effective samples")
    note = f"Estimates cover all {len(posterior.modes)} modes." if posterior.modes else ""
    return Table("Posterior", columns, tuple(rows), note)


def incidence_table(fit: Fit) -> Table:
    """Residuals of each incidence, and of all, in standard deviations."""
    residuals, data = standardised(fit), fit.problem.data
    groups = [(degrees(one.theta), residuals[one.rows]) for one in incidences(data)]
    rows = []
    for label, values in [*groups, ("all", residuals)]:
        if (finite := values[np.isfinite(values)]).size:
            rows.append((label, str(finite.size), f"{finite.mean():+.2f}", f"{np.sqrt(np.mean(finite**2)):.2f}"))
    note = "In standard deviations; the true model and noise give mean 0 and rms 1 at every incidence."
    return Table("Residuals by incidence", ("incidence", "measurements", "mean", "rms"), shortened(rows), note)


# ---- tables of several fits, and of predictions ----


def comparison_table(comparison: Comparison) -> Table:
    """One row per fit, the best first: goodness of fit, number of parameters, and predictive score or else AIC."""
    rows = []
    aic, bic = min(row.aic for row in comparison.rows), min(row.bic for row in comparison.rows)
    for row in comparison.rows:
        fit, number = row.fit, str(len(row.fit.vector))
        cells = {"fit": row.name, "parameters": number, "chi2/dof": f"{fit.reduced_chi_square:.4g}"}
        if (score := row.model_score) is not None:
            cells |= {"elpd": f"{score.elpd:.1f}", "elpd_diff ± dse": f"{score.elpd_diff:.1f} ± {score.dse:.1f}"}
            evidence = f"{score.evidence.log_evidence:.1f} ± {score.evidence.error:.1f}"
            cells |= {"weight": f"{score.weight:.2f}", "log evidence": evidence}
            cells["model probability"] = f"{score.model_probability:.2g}"
        elif math.isfinite(aic):
            differences = {"AIC - best": f"{row.aic - aic:.1f}", "BIC - best": f"{row.bic - bic:.1f}"}
            cells |= {"log-lik.": f"{fit.log_likelihood:.2f}", **differences}
        cells |= {"converged": "yes" if fit.converged else "NO", "at a bound": ", ".join(fit.at_bound)}
        rows.append(tuple(cells.values()))
    words = {"elpd": "cross-validated elpd", "aic": "AIC", "chi_square": "chi-square"}
    notes = (f"sorted by {words[comparison.sorted_by]}, best first", *comparison.notes)
    note = " ".join(f"{line[0].upper()}{line[1:]}." for line in notes)
    return Table("Comparison", tuple(cells), tuple(rows), note)


def scores_table(prediction: Prediction, data: Measurements, title: str) -> Table:
    """Errors, coverage and predictive score of held-out data, for each incidence and for all of them."""
    used, rows = data.used(), []
    groups = [(one.label, np.isin(np.arange(len(used)), one.rows)) for one in incidences(used)]
    for label, chosen in [*groups, *([("all", None)] if len(groups) > 1 else [])]:
        score = scores(prediction, data, chosen)
        shares = (score.median_error, score.p95_error, score.model_error, *score.coverage.values())
        rows.append((label, f"{score.count:,}", *(f"{100.0 * x:.1f} %" for x in shares), f"{score.elpd:.2f}"))
    note = (
        "Median and 95th percentile of |prediction / measurement - 1|; the third is the median error of the stack "
        "without model discrepancy. Coverage: share of the measurements inside the central 50 % and 95 % prediction "
        "intervals. Elpd: mean log predictive density of a measurement."
    )
    note = note if prediction.reliable else f"{note} {UNRELIABLE}"
    heads = ("incidence", "measurements", "median error", "95 % below", "stack only", "in 50 %", "in 95 %", "elpd")
    return Table(title, heads, tuple(rows), note)


def prediction_csv(prediction: Prediction) -> str:
    """A row for each pair of directions and channel: angles in degrees, all else in 1/sr.

    Columns `bsdf_...`: the stack with discrepancy; `latent_...`: without it; `predictive_...`: a new measurement.
    """
    out = io.StringIO()
    numbers: dict[str, np.ndarray] = {}
    for name, part in (("bsdf", prediction.bsdf), ("predictive", prediction.predictive), ("latent", prediction.latent)):
        quantiles = {f"q{100.0 * level:g}": one for level, one in zip(LEVELS, part.quantiles, strict=True)}
        numbers |= {f"{name}_{what}": one for what, one in {"mean": part.mean, "sd": part.sd, **quantiles}.items()}
    angles = np.stack([polar(prediction.wi), azimuth(prediction.wi), polar(prediction.wo), azimuth(prediction.wo)], -1)
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["theta_i", "phi_i", "theta_o", "phi_o", "channel", *numbers])
    for row, place in enumerate(angles):
        for index, channel in enumerate(prediction.channels):
            values = (f"{one[row, index]:.8g}" for one in numbers.values())
            writer.writerow([*(f"{angle:.10g}" for angle in place), channel, *values])
    return out.getvalue()
