"""The report of a fitted map, finished or not: a few numbers, the verdict on it in sentences, and pictures of it.

The thresholds of the verdict are those of the map's `MapOptions`. A map of two axes is drawn as an image, row 0 on top;
of one axis as an image of one row; of more axes the slice in the middle of the leading ones.
"""

import html
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy.stats import chi2

from fits._files import write_text
from fits.data.geometry import Floats
from fits.maps.options import MapOptions
from fits.maps.store import FLAGS, FittedMap
from fits.progress import Progress, silent
from fits.reports.pages import Table, document, html_table, image, made_with, section
from fits.reports.pages import verdict as verdict_box
from fits.reports.plots.data import GREY, LOG_ABOVE, STYLE, as_png
from fits.reports.tables import with_error
from fits.reports.verdicts import NOISE_ASSUMED, listed

INNER = (1.0, 99.0)  # percentiles between which colours run
WIDTH = 4.8  # inches
NO_VALUE = "#d4d4d4"


# ---- in numbers ----


@dataclass(frozen=True)
class Summary:
    """Counts of texels: of the map, of those that are fitted or excluded, with each flag, and with each parameter at a
    bound; and quartiles of each array of the store over the fitted texels where it is finite, NaN if it nowhere is."""

    texels: int
    done: int
    counts: dict[str, int]
    at_bound: dict[str, int]
    quartiles: dict[str, tuple[float, ...]]

    @property
    def fitted(self) -> int:
        """Texels with values."""
        return self.counts["fitted"]

    @property
    def converged(self) -> float:
        """The share of the fitted texels that converged; NaN if none is fitted."""
        return self.counts["converged"] / self.fitted if self.fitted else np.nan


def summarise(map: FittedMap) -> Summary:
    """The numbers of a map, finished or not; arrays are read one after the other."""
    flags = map.flags  # first: a texel that has them has everything
    fitted = (flags & FLAGS["fitted"]) != 0
    at_bound, quartiles = map.at_bound[fitted], {}
    for path in map.arrays.keys() - {"flags", "at_bound"}:
        values = map.read(path)[fitted].astype(float)
        finite = values[np.isfinite(values)]
        quartiles[path] = tuple(np.quantile(finite, (0.25, 0.5, 0.75)).tolist()) if finite.size else (np.nan,) * 3
    return Summary(
        texels=flags.size,
        done=int(np.count_nonzero(flags)),
        counts={name: int(np.count_nonzero(flags & bit)) for name, bit in FLAGS.items()},
        at_bound={name: int(np.count_nonzero(at_bound & (1 << place))) for place, name in enumerate(map.names)},
        quartiles=quartiles,
    )


# ---- in sentences ----


def verdict(summary: Summary, map: FittedMap) -> tuple[list[str], bool]:
    """How far the map can be relied on, in a few sentences, and whether they are without reservation."""
    counts, fitted, option, about = summary.counts, summary.fitted, map.option, map.attributes

    # how much of the map there is, and why the rest is not
    reasons = {"masked": "masked", "too_few_measurements": "with too few measurements", "failed": "failed"}
    rest = [f"{counts[flag]:,} {words}" for flag, words in reasons.items() if counts[flag]]
    words = [f"A map of {summary.texels:,} texels: {', '.join([f'{fitted:,} are fitted', *rest])}."]
    if not (finished := summary.done == summary.texels):
        done = f"{summary.done:,} of {summary.texels:,} texels ({share(summary.done, summary.texels)}) are done"
        words.append(f"The map is not finished: {done}, and the same command resumes it.")
    if not fitted:
        return [*words, "No texel is fitted."], False
    words.append(f"{share(counts['converged'], fitted)} of the fitted texels converged.")
    converged = counts["converged"] >= option("converged_share") * (fitted + counts["failed"])

    # chi-square beside what noise makes of it
    assumed = about.get("noise_assumed", False)
    words += [NOISE_ASSUMED] if assumed else []
    low, median, high = summary.quartiles["reduced_chi_square"]
    freedom = summary.quartiles["measurements"][1] - len(map.names)
    spread = math.sqrt(2.0 / freedom) if freedom > 0 else math.inf
    far = option("chi_square_sigmas") * spread
    if math.isfinite(median):
        words.append(
            f"Chi-square per degree of freedom is {median:.3g} in the median texel, and between {low:.3g} and "
            f"{high:.3g} in half of them; the right model with the right noise gives 1 ± {spread:.2g}."
        )
    else:
        words.append("No texel has a chi-square: there are no more measurements than parameters.")
    if median > 1.0 + far:
        words.append("The model does not explain the data to within their noise: the errors are too small.")
    if median < 1.0 - far:
        words.append(
            f"The data scatter less than the {'assumed' if assumed else 'stated'} noise: errors are too large."
        )
    explained = abs(median - 1.0) <= far  # not so for NaN

    # flags; where noise does not explain the pilot, by which texels are flagged, few are
    limit, freedom = about["pilot"]["poor_above"], max(freedom, 1.0)
    explained &= limit <= option("pilot_factor") * float(chi2.isf(option("poor_probability"), freedom)) / freedom
    flags = {
        "at_bound": "are at a bound",
        "poor": f"are poor: chi-square is above {limit:.3g}, more than noise and the pilot explain",
        "unidentified": "have a parameter that the data leave unidentified",
    }
    words += [
        f"{share(counts[flag], fitted)} of the fitted texels {what}." for flag, what in flags.items() if counts[flag]
    ]
    few_flagged = max(counts[flag] for flag in flags) <= option("flagged_share") * fitted

    # what all texels have from the pilot
    joint = all(one["converged"] for one in about["common"].values())
    if not joint:
        words.append("The joint fit of common parameters has not converged: all else is fitted with wrong values.")
    if unknown := [name for name, one in about["common"].items() if math.isinf(float(one["error"]))]:
        words.append(f"The pilot leaves {listed(unknown)}, common to all texels, unidentified.")
    error = map.numerical_error or 0.0
    accurate = error <= option("numerical_error")
    if map.numerical_error is not None:
        but = "" if accurate else ": a finer resolution may give other values"
        words.append(f"The numerical error of the model is at most {error:.2g} standard deviations in the pilot{but}.")
    if (smoothing := map.smoothing) is not None:
        scales = ", ".join(f"{name} {one:g}" for name, one in smoothing["prior"]["scale"].items())
        settled = "" if smoothing["settled"] else ": it has not settled"
        words.append(
            f"Smoothed beside the plain fit by block alternation ({smoothing['prior']['kind'].replace('_', ' ')}, of "
            f"the bounds: {scales}), in {smoothing['rounds']} rounds; in the last one texels moved by at most "
            f"{smoothing['largest_moves'][-1]:.2g} standard errors{settled}."
        )
        words.append("Errors of the smoothed map are conditional on the values of the neighbours.")
    return words, finished and converged and explained and few_flagged and joint and not unknown and accurate


def share(part: float, whole: float) -> str:
    """A share in per cent, rounded down to 0.01 %: nearly all is not all."""
    percent = math.floor(1e4 * part / whole + 1e-6) / 100.0
    return "< 0.01 %" if part and not percent else f"{percent:.4g} %"


# ---- in tables ----


def quartile_table(summary: Summary, map: FittedMap) -> Table:
    """Quartiles over the fitted texels: of each parameter, of its standard error, and of how well texels are fitted;
    and how many texels have a parameter at a bound."""

    def words(path: str) -> tuple[str, ...]:
        return tuple(f"{value:.4g}" if math.isfinite(value) else "" for value in summary.quartiles[path])

    rows = [
        (name, *words(f"values/{name}"), *words(f"errors/{name}"), map.units[name], share(count, summary.fitted or 1))
        for name, count in summary.at_bound.items()
    ]
    rows.append(("chi2/dof", *words("reduced_chi_square"), "", "", "", "1", ""))
    rows.append(("measurements", *words("measurements"), "", "", "", "1", ""))
    columns = ("", "25 %", "median", "75 %", "error: 25 %", "error: median", "error: 75 %", "unit", "at a bound")
    return Table("Quartiles over the fitted texels", columns, tuple(rows), "Of errors, those that are finite.")


def common_table(map: FittedMap) -> Table:
    """The parameters that all texels have in common."""
    common = map.attributes["common"].items()
    rows = [(name, *with_error(float(one["value"]), float(one["error"])), one["unit"]) for name, one in common]
    return Table("Common to all texels", ("parameter", "value", "error", "unit"), tuple(rows))


def made_table(map: FittedMap) -> Table:
    """How the map was made: the model but for the stack, the pilot, and options that are not the usual ones."""
    about = map.attributes
    options = (f"{name} {value}" for name, value in about["options"].items() if value != getattr(MapOptions, name))
    rows = {
        "store": map.path,
        "transport": about["transport"],
        **about["numerical"],
        "noise": about["noise"],
        "data": f"{about['samples']} measurements a texel, of {', '.join(about['channels'])}",
        "chi2/dof": f"poor above {about['pilot']['poor_above']:.3g}",
        "options": ", ".join(options) or "default",
        "fitted by": f"layerjax {about['version']}",
    }
    return Table("", ("", ""), tuple((name, str(value)) for name, value in rows.items() if value is not None))


# ---- as a page ----


def fragment(map: FittedMap) -> str:
    """The map in a notebook, as HTML: the verdict, and the median of every parameter."""
    summary = summarise(map)
    table = html_table(quartile_table(summary, map)) if summary.fitted else ""
    return f"<p>{html.escape(' '.join(verdict(summary, map)[0]))}</p>{table}"


def report(map: FittedMap, path: str | Path, force: bool = True, progress: Progress = silent) -> Summary:
    """Write the report of a map to `path`, whole or not at all, see `fits.report`; returns its numbers."""
    numbers, title = summarise(map), f"Map of {map.path.resolve().name}"
    body = [f"<h1>{html.escape(title)}</h1>", verdict_box(*verdict(numbers, map))]
    flags = _figures(map, ("The gravest flag of each texel.", flag_picture(map.flags)))
    body.append(section("Texels", flags))
    if numbers.fitted:
        body.append(section("Values in short", quartile_table(numbers, map), common_table(map)))
        parts = ['<p class="note">Colours run over the middle 98 % of the values.</p>']
        for number, name in enumerate(map.names):
            progress("pictures", number, len(map.names), name)
            unit, norm = "unitless" if map.units[name] == "1" else map.units[name], inner_norm(map.values[name])
            parts.append(f"<h3>{html.escape(name)}</h3>")
            plain, smoothed = (map.values, map.errors, "over the map"), (map.smoothed, map.smoothed_errors)
            for values, errors, words in (plain, (*smoothed, "with a spatial prior")):
                if values is not None and errors is not None:
                    value = value_picture(values[name], name, unit, "viridis", norm)
                    error = value_picture(errors[name], f"error of {name}", unit, "plasma", inner_norm(errors[name]))
                    captions = f"{name}, {words}.", f"Standard error of {name}, {words}."
                    parts.append(_figures(map, *zip(captions, (value, error), strict=True)))
        progress("pictures", len(map.names), len(map.names))
        ratio, words = map.reduced_chi_square, "chi-square per degree of freedom"
        chi_square = value_picture(ratio, words, "χ² / degree of freedom", "viridis", inner_norm(ratio))
        fit = _figures(map, (f"{words.capitalize()}; 1: as the noise makes it.", chi_square))
        body += [section("Values and errors", *parts), section("Goodness of fit", fit)]
    stack = f"<pre>{html.escape(str(map.attributes['stack']))}</pre>"
    body += [section("How it was made", made_table(map), stack), made_with()]
    write_text(path, document(title, body), force=force)
    return numbers


def _figures(map: FittedMap, *figures: tuple[str, Figure]) -> str:
    """Pictures beside each other, with what each shows."""
    leading = [size // 2 for size in map.shape[:-2]]
    part = f" Slice {leading} of {' x '.join(str(size) for size in map.shape[:-2])}." if leading else ""
    shown = (image(as_png(figure, trimmed=False), f"{words}{part}") for words, figure in figures)
    return f'<div class="pair">{"".join(shown)}</div>'


# ---- pictures ----


def value_picture(values: Floats, title: str, label: str, colours: str, norm: Normalize) -> Figure:
    """One number of every texel, such as a parameter or its error; grey where it is not finite."""
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


def _map_picture(values: np.ndarray, title: str, legend: dict[str, str], label: str = "", **colours: Any) -> Figure:
    """An image with axes in texels; label: of the bar of colours; legend: words by colour."""
    values = np.atleast_2d(values[tuple(size // 2 for size in values.shape[:-2])])
    rows, columns = values.shape
    height = float(np.clip(0.78 * WIDTH * rows / columns + 0.7, 1.8, 7.0)) + 0.2 * len(legend)
    with mpl.rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        axes = figure.subplots()
        shown = axes.imshow(
            values, aspect="equal" if 1 / 6 < rows / columns < 6 else "auto", interpolation="nearest", **colours
        )
        axes.set(title=title, xlabel="column", ylabel="row")
        if label:
            figure.colorbar(shown, ax=axes, label=label)
        if legend:
            handles = [Patch(facecolor=colour, edgecolor=GREY, label=words) for colour, words in legend.items()]
            figure.legend(handles=handles, loc="outside lower center", ncols=2 if len(handles) > 1 else 1)
    return figure
