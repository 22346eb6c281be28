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
ABSENT, OPEN = "#d4d4d4", "#ffffff"


class Scale(NamedTuple):
    """From where to where colours or an axis run."""

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
    State("too few readings", GREY, FLAGS["too_few_readings"]),
    State("failed", "#000000", FLAGS["failed"]),
    State("not converged", "#D55E00", FLAGS["fitted"], FLAGS["converged"]),
    State("poor", "#E69F00", FLAGS["poor"]),
    State("not resolved", "#CC79A7", FLAGS["unidentified"]),
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


def value_picture(
    values: Floats,
    fitted: np.ndarray,
    shown: Face,
    title: str,
    label: str,
    colours: str,
    beside: Floats | None = None,
) -> Figure:
    """One number of every texel, such as a parameter or its error.

    Args:
        values: of the whole map.
        fitted: texels that are fitted; the others are grey, and those without a finite number white.
        shown: what is drawn of it.
        title, label: what stands above, and what the numbers are, with their unit.
        colours: name of a colour map of matplotlib.
        beside: of the picture that this one stands beside, whose colours it has.
    """
    scale = scale_of((values if beside is None else beside)[fitted])
    return _picture(shown.of(np.where(fitted, values, np.nan)), shown.of(fitted), shown, scale, title, label, colours)


def chi_square_picture(ratio: Floats, fitted: np.ndarray, shown: Face) -> Figure:
    """Chi-square per degree of freedom: white where it is 1, orange above and violet below, on a logarithmic scale."""
    positive = ratio[fitted & np.isfinite(ratio) & (ratio > 0.0)]
    widest = 2.0
    if positive.size:
        widest = max(widest, float(np.exp(np.abs(np.log(np.percentile(positive, INNER))).max())))
    values = np.where(fitted & (ratio > 0.0), ratio, np.nan)
    scale = Scale(1.0 / widest, widest, logarithmic=True)
    title = "chi-square per degree of freedom"
    return _picture(shown.of(values), shown.of(fitted), shown, scale, title, RATIO, "PuOr_r")


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


def _picture(
    values: Floats, fitted: np.ndarray, shown: Face, scale: Scale, title: str, label: str, colours: str
) -> Figure:
    with mpl.rc_context(STYLE | {"axes.grid": values.ndim == 1}):
        figure = Figure(figsize=_size(values.shape), layout="constrained")
        axes = figure.subplots()
        axes.set_title(title)
        if values.ndim == 1:
            _line(axes, values, fitted, shown, scale, label)
            return figure
        missing = fitted & ~np.isfinite(values)
        ground = mpl.colors.ListedColormap([ABSENT, OPEN])
        placed = _placed(values.shape, shown.steps)
        axes.imshow(missing, cmap=ground, vmin=0, vmax=1, interpolation="nearest", **placed)
        image = axes.imshow(values, cmap=colours, norm=scale.norm, **placed)
        _index_axes(axes)
        finite = values[np.isfinite(values)]
        below, above = bool(np.any(finite < scale.low)), bool(np.any(finite > scale.high))
        extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
        bar = figure.colorbar(image, ax=axes, label=label, extend=extend)
        if scale.logarithmic:
            _plain_ticks(bar.ax.yaxis, scale)
        absent = [] if fitted.all() else [(ABSENT, "not fitted")]
        _legend(figure, [*absent, *([(OPEN, "none: at a bound, or open")] if missing.any() else [])])
    return figure


def _size(shape: tuple[int, ...]) -> tuple[float, float]:
    """Of a figure, in inches, for a map drawn true to its sides."""
    if len(shape) == 1:
        return WIDTH, 2.4
    return WIDTH, float(np.clip(0.78 * WIDTH * shape[0] / shape[1] + 0.7, 1.8, 7.0))


def _placed(shape: tuple[int, ...], steps: tuple[int, ...]) -> dict[str, Any]:
    """Where an image lies, in texels of the map, and whether it is drawn true to its sides."""
    rows, columns = (number * step for number, step in zip(shape, steps, strict=True))
    true = 1 / 6 < rows / columns < 6
    return {"extent": (-0.5, columns - 0.5, rows - 0.5, -0.5), "aspect": "equal" if true else "auto"}


def _index_axes(axes: Axes) -> None:
    axes.set(xlabel="column", ylabel="row")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(5, integer=True))


def _plain_ticks(axis: Axis, scale: Scale) -> None:
    """Ticks of a logarithmic axis as plain numbers, and some on a short one."""
    wide = scale.high > 1e3 * scale.low
    axis.set_major_locator(mpl.ticker.LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(mpl.ticker.NullFormatter())


def _line(axes: Axes, values: Floats, fitted: np.ndarray, shown: Face, scale: Scale, label: str) -> None:
    """Values against the index; what is not fitted is shaded."""
    index = np.arange(len(values)) * shown.steps[0]
    axes.plot(index, values, "o-" if len(values) <= 200 else "-", markersize=2.5, linewidth=0.8, color=CYCLE[0])
    margin = 0.05 * (scale.high - scale.low)
    if scale.logarithmic:
        axes.set_yscale("log")
        axes.set_ylim(scale.low / 1.1, scale.high * 1.1)
        _plain_ticks(axes.yaxis, scale)
    else:
        axes.set_ylim(scale.low - margin, scale.high + margin)
    half = 0.5 * shown.steps[0]
    axes.fill_between(
        np.repeat(index, 2) + np.tile([-half, half], len(index)),
        0.0,
        1.0,
        where=np.repeat(~fitted, 2),
        transform=axes.get_xaxis_transform(),
        color=ABSENT,
        linewidth=0.0,
    )
    axes.set(xlabel="texel", ylabel=label, xlim=(-half, index[-1] + half))
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(6, integer=True))


def states_of(flags: np.ndarray) -> np.ndarray:
    """Which of `STATES` every texel is shown as."""
    bits = flags.astype(int)
    found = np.full(bits.shape, len(STATES) - 1, np.uint8)
    for place in reversed(range(len(STATES) - 1)):
        state = STATES[place]
        found[((bits & state.having) == state.having) & ((bits & state.lacking) == 0)] = place
    return found


def flag_picture(flags: np.ndarray, shown: Face) -> Figure:
    """What became of every texel, the gravest of what is said of it; with counts over the whole map."""
    states = states_of(flags)
    counts = np.bincount(states.ravel(), minlength=len(STATES))
    drawn = shown.of(states)
    image = drawn[None] if drawn.ndim == 1 else drawn
    colours = mpl.colors.ListedColormap([state.colour for state in STATES])
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        height = 1.9 if drawn.ndim == 1 else _size(drawn.shape)[1] + 0.5
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        axes = figure.subplots()
        placed = _placed(image.shape, shown.steps if drawn.ndim == 2 else (1, *shown.steps))
        axes.imshow(image, cmap=colours, vmin=-0.5, vmax=len(STATES) - 0.5, interpolation="nearest", **placed)
        axes.set_title("what became of the texels")
        _index_axes(axes)
        if drawn.ndim == 1:
            axes.set(xlabel="texel", ylabel="", yticks=[])
        words = [f"{state.words}: {count:,}" for state, count in zip(STATES, counts, strict=True)]
        _legend(figure, [(STATES[place].colour, words[place]) for place in np.flatnonzero(counts)])
    return figure


def _legend(figure: Figure, entries: Sequence[tuple[str, str]]) -> None:
    """Patches of colour and what they mean, below the axes."""
    if entries:
        handles = [Patch(facecolor=colour, edgecolor=GREY, linewidth=0.5, label=words) for colour, words in entries]
        figure.legend(handles=handles, loc="outside lower center", ncols=2 if len(entries) > 1 else 1)


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


def _bars(axes: Axes, finite: Floats, title: str, density: bool = False) -> tuple[float, float]:
    """Bars over a range of values, and that range."""
    scale, number = scale_of(finite), int(np.clip(np.sqrt(finite.size), 8, 60))
    low, high = scale.low, scale.high
    if scale.logarithmic:
        low, high = low * (low / high) ** 0.1, high * (high / low) ** 0.1
    else:
        low, high = low - 0.1 * (high - low), high + 0.1 * (high - low)
    if finite.min() < finite.max():
        low, high = max(low, float(finite.min())), min(high, float(finite.max()))
    edges = np.geomspace(low, high, number + 1) if scale.logarithmic else np.linspace(low, high, number + 1)
    inside = finite[(finite >= edges[0]) & (finite <= edges[-1])]
    # shares are of all texels, also of those outside
    weights = np.full(inside.size, 1.0 / finite.size) if density else np.ones(inside.size)
    counts, _ = np.histogram(inside, edges, weights=weights)
    axes.stairs(counts / np.diff(edges) if density else counts, edges, fill=True, color=CYCLE[5])
    middle = float(np.median(finite))
    axes.axvline(middle, color=INK, linewidth=1.0)
    if scale.logarithmic:
        axes.set_xscale("log")
        _plain_ticks(axes.xaxis, scale)
    outside = finite.size - inside.size
    axes.set_title(f"{title}: median {middle:.4g}" + (f"; {outside:,} outside" if outside else ""))
    axes.margins(x=0.02)
    return low, high


def chi_square_histogram(ratio: Floats, freedom: np.ndarray) -> Figure:
    """Chi-square per degree of freedom of fitted texels, and what independent noise of the stated size makes of it.

    Args:
        ratio: of texels.
        freedom: degrees of freedom of each.
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
