"""Pictures of a fitted map: values, errors, chi-square and flags over the map, and their histograms.

A map of two axes is drawn as an image, row 0 on top; of one axis, or one texel wide, as a line against the index; of
more axes the slice in the middle of the leading ones. Colours run over the middle 98 % of the values, and what lies
beyond has the colour of the end.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from fits.maps.store import FLAGS
from fits.reports.plots.data import CYCLE, GREY, INK, LOG_ABOVE, STYLE

Floats = np.ndarray

MOST = 2000
"""Texels a side of what is drawn of a map; of larger ones every second, third and so on."""

INNER = (1.0, 99.0)  # percentiles between which colours and axes run
LOW_END = 0.25  # of their span
WIDTH = 4.8  # inches
RATIO = "χ² / degree of freedom"
ABSENT, NO_NUMBER = "#d4d4d4", "#ffffff"


class Scale(NamedTuple):
    """Limits of colours or of an axis."""

    low: float
    high: float
    logarithmic: bool = False

    @property
    def norm(self) -> Normalize:
        return LogNorm(self.low, self.high) if self.logarithmic else Normalize(self.low, self.high)


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


class Face(NamedTuple):
    """What is drawn of a map: the part of its arrays, how many texels one that is drawn stands for, that in words."""

    part: tuple[int | slice, ...]
    steps: tuple[int, ...]
    words: str

    def of(self, values: np.ndarray) -> np.ndarray:
        """The part of an array of the map's shape, with one axis or two."""
        return np.asarray(values[self.part])


def face(shape: Sequence[int]) -> Face:
    """How maps of this shape are drawn."""
    leading, ends = tuple(length // 2 for length in shape[:-2]), tuple(shape[-2:])
    drawn = [axis for axis, length in enumerate(ends) if length > 1] or [len(ends) - 1]
    steps = {axis: -(-ends[axis] // MOST) for axis in drawn}
    trailing = (slice(None, None, steps[axis]) if axis in steps else 0 for axis in range(len(ends)))
    words = []
    if leading:
        words.append(f"slice [{', '.join(map(str, leading))}] of {' x '.join(map(str, shape[:-2]))}")
    if max(steps.values()) > 1:
        words.append(f"one texel in {' x '.join(map(str, steps.values()))}")
    return Face((*leading, *trailing), tuple(steps.values()), ", ".join(words))


def scale_of(values: Floats) -> Scale:
    """Over the middle 98 %; logarithmic where these span more than a factor of ten, most of them at its low end."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return Scale(0.0, 1.0)
    low, high = (float(end) for end in np.percentile(finite, INNER))
    if not low < high:
        low, high = float(finite.min()), float(finite.max())
    if not low < high:  # one value everywhere
        width = 0.01 * abs(low) or 0.01
        return Scale(low - width, high + width)
    skewed = float(np.median(finite)) - low < LOW_END * (high - low)
    return Scale(low, high, logarithmic=low > 0.0 and high > LOG_ABOVE * low and skewed)


# ---- over the map ----


def value_picture(
    values: Floats, fitted: np.ndarray, shown: Face, title: str, label: str, colours: str, scale: Scale | None = None
) -> Figure:
    """One number of every texel, such as a parameter or its error.

    Args:
        values: of the whole map.
        fitted: texels that are fitted; the others are grey, and those without a finite number white.
        shown: what is drawn of it.
        title, label: what stands above, and what the numbers are, with their unit.
        colours: name of a colour map of matplotlib.
        scale: of the colours; None: of the values.
    """
    scale = scale or scale_of(values[fitted])
    drawn, there = shown.of(np.where(fitted, values, np.nan)), shown.of(fitted)
    with mpl.rc_context(STYLE | {"axes.grid": drawn.ndim == 1}):
        figure, axes = _figure(drawn.shape, title)
        if drawn.ndim == 1:
            _line(axes, drawn, there, shown.steps[0], scale, label)
            return figure
        missing = there & ~np.isfinite(drawn)
        placed, ground = _placed(drawn.shape, shown.steps), mpl.colors.ListedColormap([ABSENT, NO_NUMBER])
        axes.imshow(missing, cmap=ground, vmin=0, vmax=1, interpolation="nearest", **placed)
        image = axes.imshow(drawn, cmap=colours, norm=scale.norm, **placed)
        below, above = (bool(np.any(out)) for out in (drawn < scale.low, drawn > scale.high))
        extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
        bar = figure.colorbar(image, ax=axes, label=label, extend=extend)
        if scale.logarithmic:
            _plain_ticks(bar.ax.yaxis, scale)
        absent = [] if there.all() else [(ABSENT, "not fitted")]
        _legend(figure, [*absent, *([(NO_NUMBER, "none: at a bound, or unidentified")] if missing.any() else [])])
    return figure


def chi_square_picture(ratio: Floats, fitted: np.ndarray, shown: Face) -> Figure:
    """Chi-square per degree of freedom: white where it is 1, orange above and violet below, on a logarithmic scale."""
    positive = ratio[fitted & np.isfinite(ratio) & (ratio > 0.0)]
    widest = 2.0
    if positive.size:
        widest = max(widest, float(np.exp(np.abs(np.log(np.percentile(positive, INNER))).max())))
    scale = Scale(1.0 / widest, widest, logarithmic=True)
    values = np.where(ratio > 0.0, ratio, np.nan)
    return value_picture(values, fitted, shown, "chi-square per degree of freedom", RATIO, "PuOr_r", scale)


def states_of(flags: np.ndarray) -> np.ndarray:
    """Which of `STATES` every texel is shown as."""
    bits = flags.astype(int)
    applies = [((bits & one.having) == one.having) & ((bits & one.lacking) == 0) for one in STATES]
    return np.argmax(applies, axis=0)


def flag_picture(flags: np.ndarray, shown: Face) -> Figure:
    """The gravest flag of every texel, with counts over the whole map."""
    states = states_of(flags)
    counts = np.bincount(states.ravel(), minlength=len(STATES))
    drawn = shown.of(states)
    image, steps = (drawn, shown.steps) if drawn.ndim == 2 else (drawn[None], (1, *shown.steps))
    colours = mpl.colors.ListedColormap([state.colour for state in STATES])
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure, axes = _figure(drawn.shape, "flags of the texels", legend=0.5)
        ends: dict[str, Any] = {"vmin": -0.5, "vmax": len(STATES) - 0.5}
        axes.imshow(image, cmap=colours, interpolation="nearest", **ends, **_placed(image.shape, steps))
        if drawn.ndim == 1:
            axes.set(xlabel="texel", ylabel="", yticks=[])
        words = [f"{state.words}: {count:,}" for state, count in zip(STATES, counts, strict=True)]
        _legend(figure, [(STATES[place].colour, words[place]) for place in np.flatnonzero(counts)])
    return figure


def _figure(shape: tuple[int, ...], title: str, legend: float = 0.0) -> tuple[Figure, Axes]:
    """A figure for a map drawn true to its sides, or for a line."""
    height = 2.4
    if len(shape) == 2:
        height = float(np.clip(0.78 * WIDTH * shape[0] / shape[1] + 0.7, 1.8, 7.0)) + legend
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots()
    axes.set(title=title, xlabel="column", ylabel="row")
    if len(shape) == 2:
        axes.yaxis.set_major_locator(mpl.ticker.MaxNLocator(5, integer=True))
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(5, integer=True))
    return figure, axes


def _placed(shape: tuple[int, ...], steps: tuple[int, ...]) -> dict[str, Any]:
    """Where an image lies, in texels of the map, and whether it is drawn true to its sides."""
    rows, columns = (number * step for number, step in zip(shape, steps, strict=True))
    true = 1 / 6 < rows / columns < 6
    return {"extent": (-0.5, columns - 0.5, rows - 0.5, -0.5), "aspect": "equal" if true else "auto"}


def _line(axes: Axes, values: Floats, fitted: np.ndarray, step: int, scale: Scale, label: str) -> None:
    """Values against the index; what is not fitted is shaded."""
    index, half = np.arange(len(values)) * step, 0.5 * step
    axes.plot(index, values, "o-" if len(values) <= 200 else "-", markersize=2.5, linewidth=0.8, color=CYCLE[0])
    if scale.logarithmic:
        axes.set_yscale("log")
        axes.set_ylim(scale.low / 1.1, scale.high * 1.1)
        _plain_ticks(axes.yaxis, scale)
    else:
        margin = 0.05 * (scale.high - scale.low)
        axes.set_ylim(scale.low - margin, scale.high + margin)
    for place in index[~fitted]:
        axes.axvspan(place - half, place + half, color=ABSENT, linewidth=0.0)
    axes.set(xlabel="texel", ylabel=label, xlim=(-half, index[-1] + half))


def _plain_ticks(axis: Axis, scale: Scale) -> None:
    """Ticks of a logarithmic axis as plain numbers, and some on a short one."""
    wide = scale.high > 1e3 * scale.low
    axis.set_major_locator(mpl.ticker.LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(mpl.ticker.NullFormatter())


def _legend(figure: Figure, entries: Sequence[tuple[str, str]]) -> None:
    """Patches of colour and what they mean, below the axes."""
    if entries:
        handles = [Patch(facecolor=colour, edgecolor=GREY, linewidth=0.5, label=words) for colour, words in entries]
        figure.legend(handles=handles, loc="outside lower center", ncols=2 if len(entries) > 1 else 1)


# ---- histograms ----


def histogram_picture(values: Floats, title: str, label: str) -> Figure:
    """How often which number occurs, over the middle 98 % and a tenth beyond; the title says how many lie outside."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 2.3), layout="constrained")
        axes = figure.subplots()
        finite = values[np.isfinite(values)]
        if finite.size:
            _bars(axes, finite, title)
        else:
            axes.set_title(f"{title}: no finite value")
        axes.set(xlabel=label, ylabel="texels")
    return figure


def chi_square_histogram(ratio: Floats, freedom: np.ndarray) -> Figure:
    """Chi-square per degree of freedom of fitted texels, and what independent noise of the stated size makes of it.

    freedom: degrees of freedom of each texel.
    """
    finite = np.isfinite(ratio) & (ratio > 0.0) & (freedom > 0)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
        axes = figure.subplots()
        if finite.any():
            low, high = _bars(axes, ratio[finite], "over the texels", density=True)
            grid = np.linspace(min(low, 0.3), max(high, 2.0), 400)
            axes.plot(grid, expected_density(grid, freedom[finite]), color=CYCLE[1], linewidth=1.3, label="expected")
            axes.legend(loc="upper right")
        axes.set(xlabel=RATIO, ylabel="density")
    return figure


def expected_density(ratio: Floats, freedom: np.ndarray) -> Floats:
    """Density of chi-square per degree of freedom of texels with these degrees of freedom, at each of `ratio`."""
    from scipy import stats

    if np.unique(freedom).size > 50:
        freedom = np.quantile(freedom, np.linspace(0.01, 0.99, 50), method="nearest")
    each, counts = np.unique(freedom, return_counts=True)
    density = stats.chi2.pdf(ratio[:, None] * each, each) * each
    return np.asarray(density @ (counts / counts.sum()))


def _bars(axes: Axes, finite: Floats, title: str, density: bool = False) -> tuple[float, float]:
    """Bars over a range of values, and that range; shares are of all texels, also of those outside."""
    scale, number = scale_of(finite), int(np.clip(np.sqrt(finite.size), 8, 60))
    low, high = scale.low, scale.high
    if scale.logarithmic:
        low, high = low * (low / high) ** 0.1, high * (high / low) ** 0.1
    else:
        low, high = low - 0.1 * (high - low), high + 0.1 * (high - low)
    if finite.min() < finite.max():
        low, high = max(low, float(finite.min())), min(high, float(finite.max()))
    edges = np.geomspace(low, high, number + 1) if scale.logarithmic else np.linspace(low, high, number + 1)
    counts, _ = np.histogram(finite, edges)
    outside, middle = finite.size - int(counts.sum()), float(np.median(finite))
    axes.stairs(counts / (finite.size * np.diff(edges)) if density else counts, edges, fill=True, color=CYCLE[5])
    axes.axvline(middle, color=INK, linewidth=1.0)
    if scale.logarithmic:
        axes.set_xscale("log")
        _plain_ticks(axes.xaxis, scale)
    axes.set_title(f"{title}: median {middle:.4g}" + (f"; {outside:,} outside" if outside else ""))
    axes.margins(x=0.02)
    return low, high
