"""Pictures of parameters: their posterior (corner and trace), their correlations, and the stack that holds them."""

from collections.abc import Sequence
from textwrap import wrap
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from fits.reports.plots.data import CYCLE, GREY, INK, STYLE

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.sampling.posterior import Posterior
    from layerjax import Mixture, Stack


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


def trace_picture(posterior: "Posterior") -> Figure:
    """Every walker against the step, one panel per parameter; what is left of the line was discarded as burn-in."""
    chain = np.asarray(posterior.chain)
    every = max(1, len(chain) // 1000)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 1.3 * len(posterior.names) + 0.5), layout="constrained")
        panels = figure.subplots(len(posterior.names), 1, sharex=True, squeeze=False)[:, 0]
        for index, (axes, name) in enumerate(zip(panels, posterior.names, strict=True)):
            axes.plot(np.arange(len(chain))[::every], chain[::every, :, index], color=INK, linewidth=0.3, alpha=0.3)
            axes.axvline(posterior.burn_in, color=CYCLE[1], linewidth=1.2)
            axes.set_title(f"{name}, autocorrelation time {posterior.autocorrelation_time[index]:.0f} steps")
        panels[-1].set_xlabel("step (used from the line on)")
    return figure


def correlation_picture(fit: "Fit") -> Figure:
    """The correlation matrix of the fitted parameters, with its numbers."""
    return matrix_picture(list(fit.values), fit.correlation)


def matrix_picture(names: Sequence[str], correlation: np.ndarray) -> Figure:
    """A correlation matrix with its numbers."""
    matrix = np.round(correlation, 2)
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


def stack_picture(stack: "Stack | Mixture") -> Figure:
    """The layers from top to bottom, not to scale, each with its parameters; thin: an interface, hatched: a base.

    Parts of a mixture stand one below the other.
    """
    parts = _rows(stack)
    heights = [0.3 if type(part).__name__ in ("Interface", "str") else 0.8 for part, _ in parts]
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(9.5, 0.62 * sum(heights) + 1.0))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set(xlim=(0.0, 10.0), ylim=(-sum(heights) - 0.35, 0.9))
        arrow = {"arrowstyle": "->", "color": INK}
        axes.annotate("", xy=(1.2, 0.0), xytext=(0.7, 0.8), arrowprops=arrow)
        axes.annotate("", xy=(1.7, 0.8), xytext=(1.2, 0.0), arrowprops=arrow)
        top = 0.0
        for (part, is_base), height in zip(parts, heights, strict=True):
            if isinstance(part, str):
                axes.text(0.2, top - height / 2, part, va="center", fontsize=8, color=GREY)
                top -= height
                continue
            is_line = height < 0.5
            face = "#c8c8c8" if is_base else "#8fb8d6" if is_line else "#dcecf7"
            hatch = "//" if is_base else None
            axes.add_patch(Rectangle((0.2, top - height), 2.4, height, facecolor=face, edgecolor=GREY, hatch=hatch))
            axes.text(2.8, top - height / 2, "\n".join(wrap(describe(part), 95)), va="center", fontsize=8.5, color=INK)
            top -= height
    return figure


def _rows(stack: "Stack | Mixture") -> list[tuple[object, bool]]:
    """Layers, bases and words from top to bottom, and whether each is a base."""
    import layerjax as lj

    if isinstance(stack, lj.Mixture):
        rows: list[tuple[object, bool]] = []
        for (name, part), share in zip(stack.parts.items(), stack.shares().values(), strict=True):
            rows += [(f"{name}: {100.0 * float(share):.3g} % of the area", False), *_rows(part)]
        return rows
    base = [("no base: light passes", False)] if stack.base is None else [(stack.base, True)]
    return [*((layer, False) for layer in stack.layers), *base]


def describe(part: object) -> str:
    """A layer, base or phase function in one line: its kind and parameters, such as ``Medium: thickness 0.5``."""
    words = []
    for name, value in vars(part).items():
        if value is None:
            continue
        if hasattr(value, "__dict__") and not hasattr(value, "shape"):
            words.append(f"{name} {describe(value)}")
        elif isinstance(value, str):
            words.append(value)
        else:
            numbers = np.atleast_1d(np.asarray(value))
            text = ", ".join(f"{number:.4g}" for number in numbers)
            words.append(f"{name} {text}" if numbers.size == 1 else f"{name} [{text}]")
    return f"{type(part).__name__}: {', '.join(words)}"
