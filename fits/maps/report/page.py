"""The report of a fitted map as one HTML file, finished or not."""

import html
import json
from pathlib import Path

from fits._files import write_text
from fits.maps.report import pictures, tables
from fits.maps.report.tables import Summary, summarise
from fits.maps.report.verdicts import degrees_of_freedom, own_parameters, verdict
from fits.maps.store import FLAGS, FittedMap
from fits.progress import Progress, silent
from fits.reports.pages import Pictures, document, image, made_with, section
from fits.reports.plots.data import as_png
from fits.reports.tables import html_table

MADE = ("version", "shape", "chunk", "samples", "channels", "transport", "noise", "options", "pilot", "numerical")
"""What the root of a store says that a report shows as it is."""


def report(map: FittedMap, path: str | Path, force: bool = True, progress: Progress | None = None) -> Summary:
    """Writes the report of a map to `path`, whole or not at all; returns its numbers.

    Raises:
        ValueError: `path` exists and `force` is False, or a chunk of the map is damaged.
    """
    summary = summarise(map)
    write_text(path, page(map, summary, draw(map, progress or silent)), force=force)
    return summary


def draw(map: FittedMap, progress: Progress) -> dict[str, bytes]:
    """Every picture that applies, as PNG by name."""
    flags, names = map.flags, own_parameters(map)
    fitted = (flags & FLAGS["fitted"]) != 0
    figures = {"flags": pictures.flag_picture(flags)}
    if fitted.any():
        ratio, freedom = map.reduced_chi_square, degrees_of_freedom(map.measurements[fitted].astype(float), map)
        figures["chi_square"] = pictures.chi_square_picture(ratio, fitted)
        figures["chi_square_histogram"] = pictures.chi_square_histogram(ratio[fitted], freedom)
        for number, name in enumerate(names):
            progress("pictures", number, len(names), name)
            unit = "unitless" if map.units[name] == "1" else map.units[name]
            norm = pictures.norm_of(map.values[name][fitted])  # of the smoothed map as well
            groups = (("", map.values, map.errors), (", smoothed", map.smoothed, map.smoothed_errors))
            for which, values, errors in groups:
                if values is not None and errors is not None:
                    for words, numbers, colours, of in (
                        (f"{name}{which}", values[name], "viridis", norm),
                        (f"error of {name}{which}", errors[name], "plasma", None),
                    ):
                        figures[words] = pictures.value_picture(numbers, fitted, words, unit, colours, of)
        progress("pictures", len(names), len(names))
    return {name: as_png(figure, trimmed=False) for name, figure in figures.items()}  # of one size, side by side


def page(map: FittedMap, summary: Summary, images: Pictures) -> str:
    """The HTML text of the report, with the pictures inside."""
    title = f"Map of {map.path.resolve().name}"
    words, fine = verdict(summary, map)
    _, shown = pictures.shown_part(map.shape)
    part = f" Shown: {shown}." if shown else ""

    def pair(*figures: tuple[str, str]) -> str:
        return f'<div class="pair">{"".join(image(images, name, f"{words}{part}") for name, words in figures)}</div>'

    counted = pair(("flags", "The gravest of a texel's flags; counts are of the whole map."))
    sections = [
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="verdict{" fine" if fine else ""}">{html.escape(" ".join(words))}</p>',
        section("Texels", counted, html_table(tables.count_table(summary))),
    ]
    if summary.fitted:
        sections.append(section("Values in short", html_table(tables.quartile_table(summary, map))))
        if (common := tables.common_table(map)).rows:
            note = "<p>One value for all texels, from the pilot that was fitted first.</p>"
            sections.append(section("Common parameters", note, html_table(common)))
        note = '<p class="note">Colours run over the middle 98 % of values; what lies beyond has that of an end.</p>'
        parts = [note, f"<p>{html.escape(tables.smoothing_words(map))}</p>"]
        for name in own_parameters(map):
            parts.append(f"<h3>{html.escape(name)}</h3>")
            for which, said in (("", "over the map"), (", smoothed", "with a spatial prior")):
                if f"{name}{which}" in images:
                    value = (f"{name}{which}", f"{name}, {said}.")
                    parts.append(pair(value, (f"error of {name}{which}", f"Standard error of {name}, {said}.")))
        ratio = ("chi_square", "Chi-square per degree of freedom; 1: as the noise makes it.")
        often = ("chi_square_histogram", "How often it occurs, beside what noise of the stated size makes of it.")
        sections += [
            section("Values and errors", *parts),
            section("Goodness of fit", pair(ratio, often)),
            section("The worst texels", html_table(tables.worst_table(map))),
        ]
    made = {name: map.attributes[name] for name in MADE if name in map.attributes}
    texts = (str(map.path), json.dumps(made, indent=1), str(map.attributes.get("stack", "")))
    sections += [section("How it was made", *(f"<pre>{html.escape(text)}</pre>" for text in texts)), made_with()]
    return document(title, sections)
