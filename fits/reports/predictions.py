"""Predictions as a table of text, and how well they agree with held-out readings."""

import csv
import io
from typing import TYPE_CHECKING

import numpy as np

from fits.data.geometry import azimuth, polar
from fits.data.scans import incidences
from fits.prediction.predict import scores
from fits.reports.tables import Table

if TYPE_CHECKING:
    from fits.data.measurements import Measurements
    from fits.prediction.predict import Prediction, Scores

UNRELIABLE = (
    "The importance-sampling approximation of the posterior is poor (Pareto k above 0.7): intervals may be too narrow. "
    "Sample the posterior instead (`layerjax sample`)."
)


def prediction_csv(prediction: "Prediction") -> str:
    """A row for each pair of directions and channel: angles in degrees, all else in 1/sr.

    Columns `bsdf_...` are the best estimate, of the stack with the model discrepancy; `predictive_...` are of a new
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
        place = [f"{angle[row]:.10g}" for angle in angles]
        for index, channel in enumerate(prediction.channels):
            numbers = [
                number
                for band in parts.values()
                for number in (band.mean[row, index], band.sd[row, index], *band.quantiles[:, row, index])
            ]
            writer.writerow([*place, channel, *(f"{number:.8g}" for number in numbers)])
    return out.getvalue()


def scores_table(prediction: "Prediction", readings: "Measurements", title: str) -> Table:
    """How well the used readings were predicted, for each incidence and for all of them."""
    used = readings.used()
    every = incidences(used)
    rows = [_row(one.label, scores(prediction, readings, _only(len(used), one.rows))) for one in every]
    if len(every) > 1:
        rows.append(_row("all", scores(prediction, readings)))
    note = (
        "error: |prediction / reading - 1|, its median and 95th percentile; stack alone: median error of the physical "
        "model without the discrepancy term. In 50 %, in 95 %: share of the readings inside the prediction intervals. "
        "Log score: mean log predictive density of a reading."
    )
    if not prediction.reliable:
        note = f"{note} {UNRELIABLE}"
    heads = ("incidence", "readings", "error", "95 % below", "stack alone", "in 50 %", "in 95 %", "log score")
    return Table(title, heads, tuple(rows), note)


def _only(count: int, rows: np.ndarray) -> np.ndarray:
    chosen = np.zeros(count, bool)
    chosen[rows] = True
    return chosen


def _row(label: str, found: "Scores") -> tuple[str, ...]:
    shares = (found.median_error, found.p95_error, found.model_error, *found.coverage.values())
    return (label, f"{found.count:,}", *(f"{100.0 * share:.1f} %" for share in shares), f"{found.elpd:.2f}")
