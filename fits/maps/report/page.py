"""The report of a fitted map as one HTML file, finished or not."""

import html
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fits._files import write_text
from fits.maps.fitted_map import FittedMap
from fits.maps.report import pictures, tables, verdicts
from fits.maps.store import FLAGS
from fits.maps.summary import Summary, summarised
from fits.progress import Progress
from fits.reports.pages import Pictures, document, image, made_with, section
from fits.reports.plots.data import as_png
from fits.reports.plots.parameters import matrix_picture
from fits.reports.tables import html_table

MOST_CORRELATED = 100_000
"""Texels that correlations are taken over; of more, evenly spaced ones."""


def report(map: FittedMap, path: str | Path, force: bool = True, progress: Progress | None = None) -> Summary:
    """Writes the report of a map to `path`, whole or not at all; returns its numbers.

    Raises:
        ValueError: `path` exists and `force` is False, or a chunk of the map is damaged.
    """
    found = summarised(map)
    write_text(path, page(map, found, draw(map, progress)), force=force)
    return found


def draw(map: FittedMap, progress: Progress | None = None) -> dict[str, bytes]:
    """Every picture that applies, as PNG by name."""
    flags = map.flags
    fitted = (flags & FLAGS["fitted"]) != 0
    shown = pictures.face(map.shape)
    images = {"flags": _png(pictures.flag_picture(flags, shown))}
    if not fitted.any():
        return images
    ratio = map.reduced_chi_square
    images["chi_square"] = _png(pictures.chi_square_picture(ratio, fitted, shown))
    freedom = verdicts.degrees_of_freedom(map.readings[fitted].astype(float), map)
    images["chi_square_histogram"] = _png(pictures.chi_square_histogram(ratio[fitted], freedom))
    numerical = map.numerical_error
    if numerical is not None and np.isfinite(numerical[fitted]).any():
        words = ("numerical error of the model", "standard deviations")
        images["numerical_error"] = _png(pictures.value_picture(numerical, fitted, shown, *words, "cividis"))
    sampled = _evenly(np.flatnonzero(fitted))
    samples = {}
    for number, name in enumerate(drawn(map)):
        if progress is not None:
            progress("pictures", number, len(drawn(map)), name)
        values = map.values[name]
        samples[name] = values.ravel()[sampled]
        images |= _parameter(map, name, values, fitted, shown)
        images |= _smoothed(map, name, values, fitted, shown)
    if progress is not None:
        progress("pictures", len(samples), len(samples))
    varying, correlation = _correlation(samples)
    if len(varying) > 1:
        images["correlation"] = as_png(matrix_picture(varying, correlation))
    return images


def drawn(map: FittedMap) -> list[str]:
    """The parameters that differ from texel to texel."""
    shared = map.attributes.get("shared") or {}
    return [name for name in map.names if name not in shared]


def _parameter(
    map: FittedMap, name: str, values: np.ndarray, fitted: np.ndarray, shown: pictures.Face
) -> dict[str, bytes]:
    unit = "unitless" if map.units[name] == "1" else map.units[name]
    errors = map.errors[name]
    of = {"value": (values, name, unit, "viridis"), "error": (errors, f"error of {name}", unit, "plasma")}
    images = {}
    for what, (numbers, title, label, colours) in of.items():
        images[f"{what} {name}"] = _png(pictures.value_picture(numbers, fitted, shown, title, label, colours))
        images[f"histogram of {what} {name}"] = _png(pictures.histogram_picture(numbers[fitted], title, label))
    return images


def _smoothed(
    map: FittedMap, name: str, values: np.ndarray, fitted: np.ndarray, shown: pictures.Face
) -> dict[str, bytes]:
    """Of a map that was smoothed, in the colours of the plain one."""
    smoothed, errors = map.smoothed, map.smoothed_errors
    if smoothed is None or errors is None:
        return {}
    unit = "unitless" if map.units[name] == "1" else map.units[name]
    of: dict[str, tuple[Any, ...]] = {
        "value": (smoothed[name], f"{name}, smoothed", unit, "viridis", values),
        "error": (errors[name], f"error of {name}, smoothed", unit, "plasma"),
    }
    drawn = {what: pictures.value_picture(one[0], fitted, shown, *one[1:]) for what, one in of.items()}
    return {f"smoothed {what} {name}": _png(figure) for what, figure in drawn.items()}


def _evenly(places: np.ndarray) -> np.ndarray:
    return places[:: -(-len(places) // MOST_CORRELATED)]


def _correlation(samples: dict[str, np.ndarray]) -> tuple[list[str], np.ndarray]:
    """Names of parameters that vary, and their correlation over the texels where all are finite."""
    whole = np.all([np.isfinite(values) for values in samples.values()], axis=0)
    varying = {name: values[whole] for name, values in samples.items() if np.unique(values[whole]).size > 1}
    return list(varying), np.atleast_2d(np.corrcoef(list(varying.values()))) if varying else np.eye(0)


def page(map: FittedMap, found: Summary, images: Pictures) -> str:
    """The HTML text of the report, with the pictures inside."""
    title = f"Map of {map.path.resolve().name}"
    words, fine = verdicts.in_short(found, map)
    shown = pictures.face(map.shape).words
    part = f" Shown: {shown}." if shown else ""
    sections = [
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="verdict{" fine" if fine else ""}">{html.escape(" ".join(words))}</p>',
        section(
            "What became of the texels",
            _pair(
                image(images, "flags", f"The gravest of what is said of a texel; counts are of the whole map.{part}")
            ),
            html_table(tables.count_table(found)),
        ),
    ]
    if found.fitted:
        sections += [
            section("Values in short", html_table(tables.quartile_table(found, map))),
            _shared(map),
            _values(map, images, part),
            _explained(images, part),
            _together(images),
            _posterior(map),
            section("The worst texels", html_table(tables.worst_table(map))),
        ]
    sections += [_made(map), made_with()]
    return document(title, sections)


def _png(figure: Figure) -> bytes:
    return as_png(figure, trimmed=False)  # beside each other they are to be of one size


def _pair(*figures: str) -> str:
    return f'<div class="pair">{"".join(figures)}</div>'


def _shared(map: FittedMap) -> str:
    table = tables.shared_table(map)
    if not table.rows:
        return ""
    note = "<p>One value for all texels, from the sample that was fitted first.</p>"
    return section("Shared parameters", note, html_table(table))


def _posterior(map: FittedMap) -> str:
    table = tables.posterior_table(map)
    return "" if table is None else section("How far the standard errors hold", html_table(table))


def _values(map: FittedMap, images: Pictures, part: str) -> str:
    parts = []
    for name in drawn(map):
        parts.append(f"<h3>{html.escape(name)}</h3>")
        rows = []
        for prefix, words in (
            ("", f"over the map.{part}"),
            ("smoothed ", f"with neighbouring texels held together.{part}"),
            ("histogram of ", "how often it occurs; line: the median."),
        ):
            value = image(images, f"{prefix}value {name}", f"{name}, {words}")
            rows.append((value, image(images, f"{prefix}error {name}", f"Standard error of {name}, {words}")))
        plain, smoothed, histograms = rows
        if any(smoothed):  # beside the plain one, value by value
            plain, smoothed = (plain[0], smoothed[0]), (plain[1], smoothed[1])
        parts += [_pair(*row) for row in (plain, smoothed, histograms) if any(row)]
    note = "Colours run over the middle 98 % of the values; what lies beyond has the colour of the end."
    told = f"<p>{html.escape(tables.smoothing_words(map))}</p>" if map.smoothing is not None else ""
    return section("Values and errors", f'<p class="note">{note}</p>', told, *parts)


def _explained(images: Pictures, part: str) -> str:
    return section(
        "How well the model explains the readings",
        _pair(
            image(images, "chi_square", f"Chi-square per degree of freedom; 1: as good as the noise allows.{part}"),
            image(
                images,
                "chi_square_histogram",
                "How often it occurs; line: the median; orange: what independent noise of the stated size makes of it.",
            ),
        ),
        _pair(
            image(images, "numerical_error", "Numerical error of the model, in standard deviations of the readings.")
        ),
    )


def _together(images: Pictures) -> str:
    if "correlation" not in images:
        return ""
    words = "what goes together in the material, and what fits trade against each other."
    return section(
        "Parameters that go together",
        image(images, "correlation", f"Correlation of the fitted values over the texels: {words}"),
    )


def _made(map: FittedMap) -> str:
    stack = map.attributes.get("stack")
    text = f"<pre>{html.escape(str(stack))}</pre>" if stack else ""
    return section("How it was made", html_table(tables.made_table(map)), text)
