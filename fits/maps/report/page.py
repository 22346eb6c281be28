"""The report of a fitted map as one HTML file: verdict, counts, pictures of every parameter, the worst texels.

A map of two axes is drawn as an image, row 0 on top; of one axis as an image of one row; of more axes the slice in the
middle of the leading ones. Colours run over the middle 98 % of the values, and what lies beyond has that of the end.
"""

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy import stats

from fits._files import write_text
from fits.maps.report import summary as summaries
from fits.maps.report.summary import Summary, degrees_of_freedom, own_parameters, summarise
from fits.maps.store import FLAGS, FittedMap, Floats
from fits.progress import Progress, silent
from fits.reports.pages import document, image, made_with, section, verdict
from fits.reports.plots.data import CYCLE, GREY, INK, LOG_ABOVE, STYLE, as_png

MADE = ("version", "shape", "chunk", "samples", "channels", "transport", "noise", "options", "pilot", "numerical")
"""Attributes of a store that a report shows as they are."""

INNER = (1.0, 99.0)  # percentiles between which colours and axes run
WIDTH = 4.8  # inches
RATIO = "χ² / degree of freedom"
NO_VALUE = "#d4d4d4"


def report(map: FittedMap, path: str | Path, force: bool = True, progress: Progress = silent) -> Summary:
    """Writes the report of a map to `path`, whole or not at all; returns its numbers.

    Raises:
        ValueError: `path` exists and `force` is False, or a chunk of the map is damaged.
    """
    numbers = summarise(map)
    write_text(path, page(map, numbers, progress), force=force)
    return numbers


def page(map: FittedMap, numbers: Summary, progress: Progress = silent) -> str:
    """The HTML text of the report, with the pictures inside."""
    title, flags, names = f"Map of {map.path.resolve().name}", map.flags, own_parameters(map)
    body = [
        f"<h1>{html.escape(title)}</h1>",
        verdict(*summaries.verdict(numbers, map)),
        section(
            "Texels",
            _pair(map, ("The gravest flag of each texel.", flag_picture(flags))),
            summaries.count_table(numbers),
        ),
    ]
    if numbers.fitted:
        common, note = (
            summaries.common_table(map),
            "<p>One value for all texels, from the pilot that was fitted first.</p>",
        )
        body.append(section("Values in short", summaries.quartile_table(numbers, map)))
        body.append(section("Common parameters", note, common) if common.rows else "")
        parts = ['<p class="note">Colours run over the middle 98 % of the values.</p>']
        parts.append(f"<p>{html.escape(summaries.smoothing_words(map))}</p>")
        for number, name in enumerate(names):
            progress("pictures", number, len(names), name)
            unit, norm = "unitless" if map.units[name] == "1" else map.units[name], inner_norm(map.values[name])
            parts.append(f"<h3>{html.escape(name)}</h3>")
            plain, smoothed = (map.values, map.errors, "over the map"), (map.smoothed, map.smoothed_errors)
            for values, errors, words in (plain, (*smoothed, "with a spatial prior")):
                if values is not None and errors is not None:
                    value = value_picture(values[name], name, unit, "viridis", norm)
                    error = value_picture(errors[name], f"error of {name}", unit, "plasma", inner_norm(errors[name]))
                    parts.append(
                        _pair(map, (f"{name}, {words}.", value), (f"Standard error of {name}, {words}.", error))
                    )
        progress("pictures", len(names), len(names))
        fitted = (flags & FLAGS["fitted"]) != 0
        ratio = np.where(fitted, map.reduced_chi_square, np.nan)
        freedom = degrees_of_freedom(map.measurements[fitted].astype(float), map)
        goodness = (
            ("Chi-square per degree of freedom; 1: as the noise makes it.",
             value_picture(ratio, "chi-square per degree of freedom", RATIO, "PuOr_r", ratio_norm(ratio))),
            ("How often it occurs, beside what noise of the stated size makes of it.",
             chi_square_histogram(ratio[fitted], freedom)),
        )  # fmt: skip
        body += [
            section("Values and errors", *parts),
            section("Goodness of fit", _pair(map, *goodness)),
            section("The worst texels", summaries.worst_table(map)),
        ]
    made = {name: map.attributes[name] for name in MADE if name in map.attributes}
    texts = (str(map.path), json.dumps(made, indent=1), str(map.attributes.get("stack", "")))
    body += [section("How it was made", *(f"<pre>{html.escape(text)}</pre>" for text in texts)), made_with()]
    return document(title, body)


def _pair(map: FittedMap, *figures: tuple[str, Figure]) -> str:
    """Pictures beside each other, with what each shows."""
    leading = _leading(map.shape)
    part = f" Slice {list(leading)} of {' x '.join(str(size) for size in map.shape[:-2])}." if leading else ""
    shown = (image(as_png(figure, trimmed=False), f"{words}{part}") for words, figure in figures)
    return f'<div class="pair">{"".join(shown)}</div>'


# ---- pictures ----


def value_picture(values: Floats, title: str, label: str, colours: str, norm: Normalize) -> Figure:
    """One number of every texel, such as a parameter or its error; grey where it is not finite.

    Args:
        values: of the whole map.
        title, label: what stands above, and what the numbers are, with their unit.
        colours, norm: of matplotlib.
    """
    finite, cmap = np.isfinite(values), mpl.colormaps[colours].with_extremes(bad=NO_VALUE)
    legend = {} if finite.all() else {NO_VALUE: "no value"}
    return _map_picture(np.where(finite, values, np.nan), title, legend, label, cmap=cmap, norm=norm)


def inner_norm(values: Floats) -> Normalize:
    """Colours over the middle 98 %; logarithmic where these span more than a factor of ten."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, INNER).tolist() if finite.size else (0.0, 1.0)
    if not low < high:  # one value nearly everywhere
        low, high = low - (0.01 * abs(low) or 0.01), high + (0.01 * abs(high) or 0.01)
    return LogNorm(low, high) if 0.0 < low * LOG_ABOVE < high else Normalize(low, high)


def ratio_norm(ratio: Floats) -> Normalize:
    """Colours of chi-square per degree of freedom: white at 1, as far below as above on a logarithmic scale."""
    positive = ratio[np.isfinite(ratio) & (ratio > 0.0)]
    ends = np.percentile(positive, INNER) if positive.size else np.ones(2)
    widest = max(2.0, float(np.exp(np.abs(np.log(ends)).max())))
    return LogNorm(1.0 / widest, widest)


STATES = (
    ("not done yet", "#ffffff", 0, 0xFFFF),
    ("masked", NO_VALUE, FLAGS["masked"], 0),
    ("too few measurements", GREY, FLAGS["too_few_measurements"], 0),
    ("failed", "#000000", FLAGS["failed"], 0),
    ("not converged", "#D55E00", FLAGS["fitted"], FLAGS["converged"]),
    ("poor", "#E69F00", FLAGS["poor"], 0),
    ("unidentified", "#CC79A7", FLAGS["unidentified"], 0),
    ("at a bound", "#56B4E9", FLAGS["at_bound"], 0),
    ("good, from other starts", "#009E73", FLAGS["restarted"], 0),
    ("good", "#cfe8dc", 0, 0),
)
"""How a texel is shown: in words, its colour, the flags that it has, and those that it has not; the first one that
applies."""


def flag_picture(flags: np.ndarray) -> Figure:
    """The gravest flag of every texel, with counts over the whole map."""
    states = np.argmax([((flags & bits) == bits) & ((flags & without) == 0) for _, _, bits, without in STATES], axis=0)
    counts, colours = np.bincount(states.ravel(), minlength=len(STATES)), [colour for _, colour, *_ in STATES]
    legend = {colour: f"{words}: {count:,}" for (words, colour, *_), count in zip(STATES, counts, strict=True) if count}
    norm, cmap = Normalize(-0.5, len(STATES) - 0.5), mpl.colors.ListedColormap(colours)
    return _map_picture(states, "flags of the texels", legend, cmap=cmap, norm=norm)


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
            axes.hist(
                np.clip(ratio[good], low, high), np.linspace(low, high, 61).tolist(), density=True, color=CYCLE[5]
            )
            at, some = np.linspace(low, high, 400), np.quantile(freedom[good], np.linspace(0.0, 1.0, 50))
            expected = np.mean([one * stats.chi2.pdf(one * at, one) for one in some], axis=0)
            axes.plot(at, expected, color=CYCLE[4], label="of the stated noise")
            axes.axvline(float(np.median(ratio[good])), color=INK, linewidth=1.0, label="median")
            axes.legend()
        axes.set(xlabel=RATIO, ylabel="density", title="chi-square per degree of freedom")
    return figure


def _leading(shape: Sequence[int]) -> tuple[int, ...]:
    """The slice of a map of more than two axes that is drawn."""
    return tuple(size // 2 for size in shape[:-2])


def _map_picture(values: np.ndarray, title: str, legend: dict[str, str], label: str = "", **colours: Any) -> Figure:
    """An image with axes in texels; label: of the bar of colours; legend: words by colour."""
    values = np.atleast_2d(values[_leading(values.shape)])
    rows, columns = values.shape
    height = float(np.clip(0.78 * WIDTH * rows / columns + 0.7, 1.8, 7.0)) + 0.2 * len(legend)
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        axes: Axes = figure.subplots()
        shown = axes.imshow(values, aspect="equal" if 1 / 6 < rows / columns < 6 else "auto",
                            interpolation="nearest", **colours)  # fmt: skip
        axes.set(title=title, xlabel="column", ylabel="row")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(mpl.ticker.MaxNLocator(5, integer=True))
        if label:
            figure.colorbar(shown, ax=axes, label=label)
        if legend:
            handles = [Patch(facecolor=colour, edgecolor=GREY, label=words) for colour, words in legend.items()]
            figure.legend(handles=handles, loc="outside lower center", ncols=2 if len(handles) > 1 else 1)
    return figure
