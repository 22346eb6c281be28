"""Totals and what a fit makes of them."""

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fits.data.totals import KINDS, Totals
from fits.reports.plots.data import CYCLE, INK, STYLE

if TYPE_CHECKING:
    from fits.optimise.result import Fit

MOST_NAMES = 12
"""Channels whose names stand along the axis; of more, some."""


def totals_picture(totals: Totals, fit: "Fit | None" = None) -> Figure:
    """A panel for each kind: the shares of light that were read, against the channel, or against the angle of incidence
    where there is but one channel; and those of the fit."""
    kinds = [kind for kind in KINDS if kind in totals.kinds]
    predicted, angles = np.full(totals.values.shape, np.nan), list(dict.fromkeys(map(_degrees, totals.theta_i)))
    if fit is not None:
        predicted[totals.mask] = fit.predicted
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 3.2), layout="constrained")
        panels = figure.subplots(1, len(kinds), squeeze=False)[0]
        for axes, kind in zip(panels, kinds, strict=True):
            rows = np.flatnonzero([one == kind for one in totals.kinds])
            _panel(axes, totals, rows, predicted, angles)
            axes.set_title("unscattered transmittance" if kind == "unscattered" else f"total {kind}")
        panels[0].set_ylabel("share of the light")
        told = [one for axes in panels for one in zip(*axes.get_legend_handles_labels(), strict=True)]
        marks = {label: handle for handle, label in told}
        figure.legend(marks.values(), marks.keys(), loc="outside lower center", ncols=min(len(marks), 6))
    return figure


def _panel(axes: Axes, totals: Totals, rows: np.ndarray, predicted: np.ndarray, angles: list[str]) -> None:
    """The rows of one kind; angles: of incidence of all kinds, each of which has a colour."""
    channels = len(totals.channels)
    if channels == 1:
        order = rows[np.argsort(totals.theta_i[rows], kind="stable")]
        lines = [(totals.theta_i[order], order, np.zeros(len(order), int), "")]
        axes.set_xlabel("angle of incidence, degrees")
    else:
        places = np.arange(channels)
        lines = [(places, np.full(channels, row), places, _degrees(totals.theta_i[row])) for row in rows]
        shown = places[:: -(-channels // MOST_NAMES)]
        axes.set_xticks(shown, [totals.channels[place] for place in shown], rotation=45, ha="right")
    for x, row, channel, angle in lines:
        colour = CYCLE[angles.index(angle) % len(CYCLE) if angle else 0]
        label = f" at {angle}" if angle and len(angles) > 1 else ""
        errors = None if totals.sigma is None else totals.sigma[row, channel]
        read = totals.values[row, channel]
        axes.errorbar(x, read, errors, fmt="o", color=INK, markersize=3, capsize=2, label=f"read{label}")
        if np.isfinite(predicted).any():
            axes.plot(x, predicted[row, channel], "-" if len(x) > 1 else "x", color=colour, label=f"fit{label}")
    axes.margins(y=0.1)
    axes.set_ylim(bottom=0.0)


def _degrees(angle: float) -> str:
    return f"{angle:g}°"
