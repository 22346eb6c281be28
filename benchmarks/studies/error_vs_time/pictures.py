"""The picture of the error-against-time benchmark: a panel a family, a curve or a point a model."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.studies.error_vs_time.models import VALUES, Model, Row
from benchmarks.studies.error_vs_time.tables import amortised, floored, limits_of
from benchmarks.studies.error_vs_time.truth import Judged
from benchmarks.suite.cases import FAMILIES
from fits.reports.plots.data import CYCLE, GREY, INK, STYLE

MARKERS = "osD^v<>P*Xp"
HIGHEST = 10.0
"""Larger errors are drawn as this: they only say that the model is of no use there."""

LOWEST = 1e-6  # errors below it are drawn there: exact models would stretch the axis
COLUMNS = 4


def picture(models: Sequence[Model], judged: Sequence[Judged], rows: Sequence[Row]) -> Figure:
    """Relative L2 error against time per value, both logarithmic.

    Large marks are medians over the stacks of the family, joined from coarse to fine, with the quartiles as bars; small
    ones are single stacks; an open mark says that the truth is the limit at half of the stacks or more. The dotted line
    is the median limit of the truth.
    """
    families = [family for family in FAMILIES if any(judgement.family == family for judgement in judged)]
    count = len(families) + 1
    columns = min(COLUMNS, count)
    lines = -(-count // columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.3 * columns, 3.1 * lines + 0.3), layout="constrained")
        panels = np.ravel(figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False))
        limits = limits_of(judged)
        for panel, family in zip(panels, families, strict=False):
            members = [judgement for judgement in judged if judgement.family == family]
            for index, model in enumerate(models):
                finite = [row for row in rows if row.l2 is not None]
                chosen = [row for row in finite if (row.family, row.model) == (family, model.name)]
                _curve(panel, index, model, chosen, limits)
            limit = float(np.median([judgement.limit for judgement in members]))
            panel.axhline(max(limit, LOWEST), color=GREY, linestyle=":", linewidth=1.0)
            panel.set(xscale="log", yscale="log", title=f"{FAMILIES[family]} ({len(members)})")
        for panel in panels[len(families) :]:
            panel.axis("off")
        for index, panel in enumerate(panels[: len(families)]):
            panel.tick_params(labelbottom=index + columns >= len(families), labelleft=index % columns == 0)
        _legend(panels[len(families)], models)
        spread = f"compiled; preparation divided by {VALUES:,} values"
        figure.supxlabel(f"time per value, ns ({spread})", size=9)
        figure.supylabel("relative L2 error of the BSDF", size=9)
    return figure


def _curve(panel: Axes, index: int, model: Model, rows: Sequence[Row], limits: Mapping[str, float]) -> None:
    colour, marker = _style(index)
    points = []
    for step in model.steps:
        here = [row for row in rows if row.step == step]
        if not here:
            continue
        times = np.array([amortised(row) for row in here])
        errors = np.array([min(max(floored(row, limits), LOWEST), HIGHEST) for row in here])
        panel.plot(times, errors, marker, color=colour, markersize=2.0, markeredgewidth=0, alpha=0.35)
        low, middle, high = np.quantile(errors, [0.25, 0.5, 0.75])
        open_mark = float(np.mean([row.truth_limits for row in here])) >= 0.5
        points.append((float(np.median(times)), middle, low, high, open_mark))
    if not points:
        return
    x, y, low, high, hollow = (np.array(column) for column in zip(*points, strict=True))
    panel.plot(x, y, "-", color=colour, linewidth=1.2)
    panel.errorbar(x, y, [y - low, high - y], fmt="none", ecolor=colour, elinewidth=0.8, capsize=2)
    for chosen, face in ((hollow, "white"), (~hollow, colour)):
        panel.plot(x[chosen], y[chosen], marker, color=colour, markerfacecolor=face, markersize=6)


def _style(index: int) -> tuple[str, str]:
    """Colour and marker of a model."""
    return CYCLE[index % len(CYCLE)], MARKERS[index % len(MARKERS)]


def _legend(panel: Axes, models: Sequence[Model]) -> None:
    handles = []
    for index, model in enumerate(models):
        labels = list(model.steps)
        span = labels[0] if len(labels) == 1 else f"{labels[0]} to {labels[-1]}"
        colour, marker = _style(index)
        handles.append(Line2D([], [], color=colour, marker=marker, label=f"{model.name}\n({span})"))
    for size, face, label in ((6.0, "white", "at the limit of the reference"), (2.0, INK, "one stack")):
        handles.append(Line2D([], [], color=INK, marker="o", markerfacecolor=face, markersize=size, label=label))
        handles[-1].set_linestyle("none")
    handles.append(Line2D([], [], color=GREY, linestyle=":", label="uncertainty of the reference, median"))
    panel.legend(handles=handles, loc="center left", fontsize=7, labelspacing=0.35)
