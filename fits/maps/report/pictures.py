"""Pictures of a fitted map: values, errors, chi-square and flags over the map, and how often a chi-square occurs.

A map of two axes is drawn as an image, row 0 on top; of one axis as an image of one row; of more axes the slice in the
middle of the leading ones. Colours run over the middle 98 % of the values, and what lies beyond has that of the end.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy import stats

from fits.maps.store import FLAGS, Floats
from fits.reports.plots.data import CYCLE, GREY, INK, LOG_ABOVE, STYLE

MOST = 2000
"""Texels a side of what is drawn of a map; of larger ones every second, third and so on."""

INNER = (1.0, 99.0)  # percentiles between which colours and axes run
WIDTH = 4.8  # inches
RATIO = "χ² / degree of freedom"
ABSENT = "#d4d4d4"


class State(NamedTuple):
    """What a texel is shown as, where it has all of `having` and none of `lacking`."""

    words: str
    colour: str
    having: int = 0
    lacking: int = 0


STATES = (
    State("not there yet", "#ffffff", lacking=sum(FLAGS.values())),
    State("masked", ABSENT, FLAGS["masked"]),
    State("too few measurements", GREY, FLAGS["too_few_measurements"]),
    State("failed", "#000000", FLAGS["failed"]),
    State("not converged", "#D55E00", FLAGS["fitted"], FLAGS["converged"]),
    State("poor", "#E69F00", FLAGS["poor"]),
    State("unidentified", "#CC79A7", FLAGS["unidentified"]),
    State("at a bound", "#56B4E9", FLAGS["at_bound"]),
    State("fine, started again", "#009E73", FLAGS["restarted"]),
    State("fine", "#cfe8dc"),
)
"""The first that applies to a texel is shown."""


def shown_part(shape: Sequence[int]) -> tuple[tuple[Any, ...], str]:
    """What is drawn of a map of this shape: the part of its arrays, (rows, columns), and that in words."""
    leading, sides = tuple(length // 2 for length in shape[:-2]), shape[-2:]
    step = -(-max(sides) // MOST)
    words = [f"slice [{', '.join(map(str, leading))}] of {' x '.join(map(str, shape[:-2]))}"] if leading else []
    words += [f"one texel in {step} x {step}"] if step > 1 else []
    every = slice(None, None, step)
    return (*leading, *((every, every) if len(sides) > 1 else (None, every))), ", ".join(words)


def norm_of(values: Floats) -> Normalize:
    """Over the middle 98 %; logarithmic where these span more than a factor of ten, most of them at its low end."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return Normalize(0.0, 1.0)
    low, middle, high = (float(end) for end in np.percentile(finite, (INNER[0], 50.0, INNER[1])))
    if not low < high:  # one value nearly everywhere
        low, high = low - (0.01 * abs(low) or 0.01), high + (0.01 * abs(high) or 0.01)
    skewed = low > 0.0 and high > LOG_ABOVE * low and middle - low < 0.25 * (high - low)
    return LogNorm(low, high) if skewed else Normalize(low, high)


def value_picture(
    values: Floats, fitted: np.ndarray, title: str, label: str, colours: str, norm: Normalize | None = None
) -> Figure:
    """One number of every texel, such as a parameter or its error; white where it is not finite.

    Args:
        values: of the whole map.
        fitted: texels that are fitted; the others are grey.
        title, label: what stands above, and what the numbers are, with their unit.
        colours: name of a colour map of matplotlib.
        norm: of the colours; None: of the values.
    """
    part, _ = shown_part(values.shape)
    ground = mpl.colors.ListedColormap(["#ffffff", ABSENT])
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure, axes = _figure(values.shape, title)
        _draw(axes, values.shape, ~fitted[part], cmap=ground, vmin=0, vmax=1)
        drawn = np.where(fitted, values, np.nan)[part]
        image = _draw(axes, values.shape, drawn, cmap=colours, norm=norm or norm_of(values[fitted]))
        figure.colorbar(image, ax=axes, label=label)
        _legend(figure, [] if fitted.all() else [(ABSENT, "not fitted")])
    return figure


def chi_square_picture(ratio: Floats, fitted: np.ndarray) -> Figure:
    """Chi-square per degree of freedom: white where it is 1, orange above and violet below, on a logarithmic scale."""
    positive = ratio[fitted & np.isfinite(ratio) & (ratio > 0.0)]
    ends = np.percentile(positive, INNER) if positive.size else np.ones(2)
    widest = max(2.0, float(np.exp(np.abs(np.log(ends)).max())))
    values, norm = np.where(ratio > 0.0, ratio, np.nan), LogNorm(1.0 / widest, widest)
    return value_picture(values, fitted, "chi-square per degree of freedom", RATIO, "PuOr_r", norm)


def states_of(flags: np.ndarray) -> np.ndarray:
    """Which of `STATES` every texel is shown as."""
    bits = flags.astype(int)
    applies = [((bits & one.having) == one.having) & ((bits & one.lacking) == 0) for one in STATES]
    return np.argmax(applies, axis=0)


def flag_picture(flags: np.ndarray) -> Figure:
    """The gravest flag of every texel, with counts over the whole map."""
    states = states_of(flags)
    counts = np.bincount(states.ravel(), minlength=len(STATES))
    colours = mpl.colors.ListedColormap([state.colour for state in STATES])
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure, axes = _figure(flags.shape, "flags of the texels", legend=0.5)
        part, _ = shown_part(flags.shape)
        _draw(axes, flags.shape, states[part], cmap=colours, vmin=-0.5, vmax=len(STATES) - 0.5)
        some = [(state, count) for state, count in zip(STATES, counts, strict=True) if count]
        _legend(figure, [(state.colour, f"{state.words}: {count:,}") for state, count in some])
    return figure


def chi_square_histogram(ratio: Floats, freedom: np.ndarray) -> Figure:
    """Chi-square per degree of freedom of fitted texels, and what independent noise of the stated size makes of it.

    freedom: degrees of freedom of each texel.
    """
    good = np.isfinite(ratio) & (ratio > 0.0) & (freedom > 0)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
        axes = figure.subplots()
        if good.any():
            low, high = np.percentile(ratio[good], INNER) * (0.8, 1.2)
            counts, edges = np.histogram(ratio[good], np.linspace(low, high, 61))
            axes.stairs(counts / (good.sum() * np.diff(edges)), edges, fill=True, color=CYCLE[5])
            at, some = np.linspace(low, high, 400), np.quantile(freedom[good], np.linspace(0.0, 1.0, 50))
            expected = np.mean([one * stats.chi2.pdf(one * at, one) for one in some], axis=0)
            axes.plot(at, expected, color=CYCLE[4], label="of the stated noise")
            axes.axvline(float(np.median(ratio[good])), color=INK, linewidth=1.0, label="median")
            axes.legend()
        axes.set(xlabel=RATIO, ylabel="density", title="chi-square per degree of freedom")
    return figure


def _figure(shape: tuple[int, ...], title: str, legend: float = 0.0) -> tuple[Figure, Axes]:
    rows, columns = shape[-2:] if len(shape) > 1 else (1, shape[0])
    height = float(np.clip(0.78 * WIDTH * rows / columns + 0.7, 1.8, 7.0)) + legend
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots()
    axes.set(title=title, xlabel="column", ylabel="row")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(5, integer=True))
    return figure, axes


def _draw(axes: Axes, shape: tuple[int, ...], image: np.ndarray, **colours: Any) -> Any:
    """An image with axes in texels of the map, true to its sides unless it is very long."""
    rows, columns = shape[-2:] if len(shape) > 1 else (1, shape[0])
    aspect: Any = "equal" if 1 / 6 < rows / columns < 6 else "auto"
    ends = (-0.5, columns - 0.5, rows - 0.5, -0.5)
    return axes.imshow(image, extent=ends, aspect=aspect, interpolation="nearest", **colours)


def _legend(figure: Figure, entries: Sequence[tuple[str, str]]) -> None:
    """Patches of colour and what they mean, below the axes."""
    if entries:
        handles = [Patch(facecolor=colour, edgecolor=GREY, linewidth=0.5, label=words) for colour, words in entries]
        figure.legend(handles=handles, loc="outside lower center", ncols=2 if len(entries) > 1 else 1)
