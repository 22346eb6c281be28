"""Pictures of parameters: their posterior, every pair of them, and their correlations."""

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from fits.reports.plots.data import CYCLE, INK, STYLE

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.sampling.posterior import Posterior


def corner_picture(posterior: "Posterior") -> Figure:
    """Every pair of parameters and every single parameter, over the posterior's samples; lines at the fitted values."""
    import corner

    count = len(posterior.names)
    side = float(np.clip(1.6 * count, 4.0, 11.0))
    best = [posterior.fit.values[name] for name in posterior.names]
    with mpl.rc_context(STYLE | {"axes.grid": False, "axes.titlesize": 8}):
        figure = Figure(figsize=(side, side))
        corner.corner(
            np.asarray(posterior.samples),
            labels=list(posterior.names),
            titles=[f"{name}\n" for name in posterior.names],
            quantiles=(0.16, 0.5, 0.84),
            show_titles=True,
            title_fmt=".3g",
            truths=best,
            truth_color=CYCLE[1],
            color=CYCLE[0],
            hist_kwargs={"color": CYCLE[0]},
            label_kwargs={"fontsize": 8},
            max_n_ticks=3,
            labelpad=0.1,
            fig=figure,
            quiet=bool(posterior.modes),  # of modes narrower than a bin there are no contours
        )
    return figure


def correlation_picture(fit: "Fit") -> Figure:
    """The correlation matrix of the fitted parameters, with its numbers."""
    names, matrix = list(fit.values), np.round(fit.correlation, 2)
    side = float(np.clip(0.75 * len(names) + 2.0, 3.5, 9.0))
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(side + 0.8, side), layout="constrained")
        axes = figure.subplots()
        image = axes.imshow(matrix, cmap="PuOr", vmin=-1.0, vmax=1.0)
        axes.set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(len(names)), names)
        for (row, column), value in np.ndenumerate(matrix):
            colour = "white" if abs(value) > 0.6 else INK
            axes.text(column, row, f"{value + 0.0:.2f}", ha="center", va="center", fontsize=8, color=colour)
        figure.colorbar(image, ax=axes, label="correlation", shrink=0.8)
    return figure
