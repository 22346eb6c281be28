"""Pictures of what was foretold, beside what was read there."""

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fits.data.scans import in_plane, incidences, signed_angle
from fits.reports.plots.data import ANGLE_LABEL, CYCLE, INK, STYLE, chosen, value_axis, value_label

if TYPE_CHECKING:
    from fits.data.measurements import Measurements
    from fits.prediction.predict import Prediction

FEWEST = 3  # readings in the plane of incidence that make a panel


def bands_picture(prediction: "Prediction", readings: "Measurements") -> Figure | None:
    """Readings that were not fitted and the bands that were to hold them, a column for each incidence and a row for
    each channel.

    prediction: of the used readings, with levels 0.025, 0.25, 0.5, 0.75 and 0.975.
    None where no incidence has at least three readings in the plane of incidence.
    """
    used = readings.used()
    flat, angle = in_plane(used), signed_angle(used)
    shown = [one for one in chosen(incidences(used)) if np.count_nonzero(flat[one.rows]) >= FEWEST]
    if not shown:
        return None
    channels = len(used.channels)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 3.0 * channels), layout="constrained")
        grid = figure.subplots(channels, len(shown), squeeze=False, sharex="col")
        for column, incidence in enumerate(shown):
            rows = incidence.rows[flat[incidence.rows]]
            rows = rows[np.argsort(angle[rows], kind="stable")]
            for channel in range(channels):
                axes = grid[channel, column]
                _bands(axes, angle[rows], prediction, rows, channel)
                axes.plot(angle[rows], used.values[rows, channel], ".", color=INK, markersize=3, label="readings")
                value_axis(axes, used.values[rows], value_label(used, channel) if column == 0 else "")
                axes.set_title(incidence.label if channel == 0 else "")
            grid[-1, column].set_xlabel(ANGLE_LABEL)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


def _bands(axes: Axes, angle: np.ndarray, prediction: "Prediction", rows: np.ndarray, channel: int) -> None:
    low, quarter, middle, three, high = prediction.predictive.quantiles[:, rows, channel]
    axes.fill_between(angle, low, high, color=CYCLE[0], alpha=0.2, linewidth=0, label="95 % of new measurements")
    axes.fill_between(angle, quarter, three, color=CYCLE[0], alpha=0.35, linewidth=0, label="50 %")
    axes.plot(angle, middle, color=CYCLE[0], linewidth=1.2, label="median")
    alone = prediction.latent.quantiles[2, rows, channel]
    axes.plot(angle, alone, color=CYCLE[1], linewidth=1.0, linestyle="dashed", label="stack alone")
