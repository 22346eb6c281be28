"""The report of a fitted map as one HTML file, finished or not."""

import html
from pathlib import Path
from typing import Any

import numpy as np

from fits._files import write_text
from fits.maps.fitted_map import FittedMap, Summary, summarise
from fits.maps.report import pictures, tables
from fits.maps.report.verdicts import degrees_of_freedom, own_parameters, verdict
from fits.maps.store import FLAGS
from fits.progress import Progress
from fits.reports.pages import Pictures, document, image, made_with, section
from fits.reports.plots.data import as_png
from fits.reports.plots.parameters import matrix_picture
from fits.reports.tables import Table, html_table

MOST_CORRELATED = 100_000
"""Texels that correlations are taken over; of more, evenly spaced ones."""


def report(map: FittedMap, path: str | Path, force: bool = True, progress: Progress | None = None) -> Summary:
    """Writes the report of a map to `path`, whole or not at all; returns its numbers.

    Raises:
        ValueError: `path` exists and `force` is False, or a chunk of the map is damaged.
    """
    found = summarise(map)
    write_text(path, page(map, found, draw(map, progress)), force=force)
    return found


def draw(map: FittedMap, progress: Progress | None = None) -> dict[str, bytes]:
    """Every picture that applies, as PNG by name."""
    flags, names, shown = map.flags, own_parameters(map), pictures.face(map.shape)
    fitted = (flags & FLAGS["fitted"]) != 0
    figures: dict[str, Any] = {"flags": pictures.flag_picture(flags, shown)}
    correlated: dict[str, np.ndarray] = {}
    if fitted.any():
        ratio, numerical, smoothed, smoothed_errors = (
            map.reduced_chi_square, map.numerical_error, map.smoothed, map.smoothed_errors
        )  # fmt: skip
        figures["chi_square"] = pictures.chi_square_picture(ratio, fitted, shown)
        freedom = degrees_of_freedom(map.measurements[fitted].astype(float), map)
        figures["chi_square_histogram"] = pictures.chi_square_histogram(ratio[fitted], freedom)
        if numerical is not None and np.isfinite(numerical[fitted]).any():
            words = ("numerical error of the model", "standard deviations")
            figures["numerical_error"] = pictures.value_picture(numerical, fitted, shown, *words, "cividis")
        for number, name in enumerate(names):
            if progress is not None:
                progress("pictures", number, len(names), name)
            unit = "unitless" if map.units[name] == "1" else map.units[name]
            values, errors = map.values[name], map.errors[name]
            places = np.flatnonzero(fitted)
            correlated[name] = values.ravel()[places[:: -(-len(places) // MOST_CORRELATED)]]
            for what, numbers, title, colours in (
                ("value", values, name, "viridis"),
                ("error", errors, f"error of {name}", "plasma"),
            ):
                figures[f"{what} {name}"] = pictures.value_picture(numbers, fitted, shown, title, unit, colours)
                figures[f"histogram of {what} {name}"] = pictures.histogram_picture(numbers[fitted], title, unit)
            if smoothed is not None and smoothed_errors is not None:  # in the colours of the plain one
                value, error = f"{name}, smoothed", f"error of {name}, smoothed"
                figures[f"smoothed value {name}"] = pictures.value_picture(
                    smoothed[name], fitted, shown, value, unit, "viridis", pictures.scale_of(values[fitted])
                )
                figures[f"smoothed error {name}"] = pictures.value_picture(
                    smoothed_errors[name], fitted, shown, error, unit, "plasma"
                )
        if progress is not None:
            progress("pictures", len(names), len(names))
    images = {name: as_png(figure, trimmed=False) for name, figure in figures.items()}  # of one size, side by side
    whole = np.all([np.isfinite(values) for values in correlated.values()], axis=0)
    varying = {name: values[whole] for name, values in correlated.items() if np.unique(values[whole]).size > 1}
    if len(varying) > 1:
        images["correlation"] = as_png(matrix_picture(list(varying), np.corrcoef(list(varying.values()))))
    return images


def page(map: FittedMap, found: Summary, images: Pictures) -> str:
    """The HTML text of the report, with the pictures inside."""
    title = f"Map of {map.path.resolve().name}"
    words, fine = verdict(found, map)
    shown = pictures.face(map.shape).words
    part = f" Shown: {shown}." if shown else ""
    sections = [
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="verdict{" fine" if fine else ""}">{html.escape(" ".join(words))}</p>',
        section(
            "Texels",
            _pair(image(images, "flags", f"The gravest of a texel's flags; counts are of the whole map.{part}")),
            html_table(tables.count_table(found)),
        ),
    ]
    if found.fitted:
        common = tables.common_table(map)
        sections += [
            section("Values in short", html_table(tables.quartile_table(found, map))),
            _table("Common parameters", "One value for all texels, from the pilot that was fitted first.", common),
            _values(map, images, part),
            section(
                "Goodness of fit",
                _pair(
                    image(images, "chi_square", f"Chi-square per degree of freedom; 1: as the noise makes it.{part}"),
                    image(
                        images,
                        "chi_square_histogram",
                        "How often it occurs; line: the median; orange: expected of noise of the stated size.",
                    ),
                ),
                _pair(
                    image(
                        images, "numerical_error", "Numerical error of the model, in standard deviations of the data."
                    )
                ),
            ),
        ]
        if "correlation" in images:
            caption = "Correlation of the fitted values over the texels: of the material, and of the fits."
            sections.append(section("Discrepancy parameters", image(images, "correlation", caption)))
        sections.append(section("The worst texels", html_table(tables.worst_table(map))))
    stack = f"<pre>{html.escape(str(map.attributes.get('stack', '')))}</pre>"
    sections += [section("How it was made", html_table(tables.made_table(map)), stack), made_with()]
    return document(title, sections)


def _pair(*figures: str) -> str:
    return f'<div class="pair">{"".join(figures)}</div>' if any(figures) else ""


def _table(head: str, note: str, table: Table) -> str:
    return section(head, f"<p>{html.escape(note)}</p>", html_table(table)) if table.rows else ""


def _values(map: FittedMap, images: Pictures, part: str) -> str:
    """Pictures of every parameter: value beside error, or beside the smoothed value; and how often each occurs."""
    parts = []
    for name in own_parameters(map):
        rows = [
            (
                image(images, f"{prefix}value {name}", f"{name}, {words}"),
                image(images, f"{prefix}error {name}", f"Standard error of {name}, {words}"),
            )
            for prefix, words in (
                ("", f"over the map.{part}"),
                ("smoothed ", f"with a spatial prior.{part}"),
                ("histogram of ", "how often it occurs; line: the median."),
            )
        ]
        if any(rows[1]):
            rows[:2] = list(zip(*rows[:2], strict=True))
        parts += [f"<h3>{html.escape(name)}</h3>", *(_pair(*row) for row in rows)]
    note = '<p class="note">Colours run over the middle 98 % of the values; what lies beyond has that of the end.</p>'
    smoothing = f"<p>{html.escape(tables.smoothing_words(map))}</p>" if map.smoothing is not None else ""
    return section("Values and errors", note, smoothing, *parts)
