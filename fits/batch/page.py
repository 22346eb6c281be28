"""What became of many files, as tables, a picture for each stack, and one HTML page."""

import html
import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING
from urllib.parse import quote

import matplotlib as mpl
import numpy as np

from fits.batch.rows import BEST, Parameter, Row, standings
from fits.reports import tables
from fits.reports.html import document, image, section, sentences
from fits.reports.plots.data import CYCLE, GREY, STYLE, as_png
from fits.reports.verdicts import listed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMED = 40
"""Files that a picture names; of more every so many."""

WIDE = 3
"""Panels beside each other."""

SHOWN = 40
"""Rows on a terminal."""


def overview(rows: Sequence[Row], most: int | None = None) -> tables.Table:
    """A row each, without the parameters."""
    words = standings(rows)
    several = len({row.stack for row in rows}) > 1
    scored = any(row.scored for row in rows)
    shared = any(math.isfinite(row.alone) for row in rows)
    heads = ["file", "stack", "converged", "chi2/dof", *(["without shared"] if shared else [])]
    heads += ["log score"] if scored else []
    heads += [*(["standing"] if several else []), "readings", "seconds", "status"]
    cells = []
    for row in rows:
        fitted = ["yes" if row.converged else "NO", f"{row.reduced_chi_square:.3g}"]
        fitted += [f"{row.alone:.3g}" if math.isfinite(row.alone) else ""] if shared else []
        fitted += [f"{row.score:.2f}" if row.scored else ""] if scored else []
        fitted += [words[row.file, row.stack]] if several else []
        fitted += [f"{row.readings:,}", f"{row.seconds:.1f}"]
        short = "; ".join(row.status.split("; ")[:2])  # all of it is in the table and in the report of the fit
        found = f"{row.structure}; {short}" if row.structure else short
        middle = ["FAILED", *[""] * (len(fitted) - 1)] if row.failure else fitted
        cells.append((row.file, row.stack, *middle, row.failure or found))
    shown = cells if most is None else list(tables.shortened(cells, most))
    notes = [_measured(rows)] if several else []
    notes += [_SHARED] if shared else []
    return tables.Table("Fits", tuple(heads), tuple(shown), " ".join(notes), keys=2)


def _measured(rows: Sequence[Row]) -> str:
    by = "the log-density of what was held out" if any(row.scored for row in rows) else "AIC"
    return (
        f"Standing: of the stacks of a file, by {by}: as good as the best, or by how much behind, in AIC or -2 "
        "log-density; where the best misses the data, the scatter that it leaves counts as noise."
    )


def told(rows: Sequence[Row], left_out: Sequence[str]) -> list[str]:
    """What became of them, in sentences."""
    files, stacks = list(dict.fromkeys(row.file for row in rows)), list(dict.fromkeys(row.stack for row in rows))
    fitted = [row for row in rows if row.fitted]
    converged = sum(row.converged for row in fitted)
    words = [
        f"{_count(len(files), 'file')} by {_count(len(stacks), 'stack')}: {len(fitted)} of {len(rows)} fits are there, "
        f"{converged} of them converged."
    ]
    failed = [row for row in rows if not row.fitted]
    if failed:
        broken = list(dict.fromkeys(row.file for row in failed))
        words.append(f"No result of {_few(broken)} ({_count(len(failed), 'fit')}).")
    unsure = [f"{row.file} by {row.stack}" for row in fitted if not row.converged]
    if unsure:
        words.append(f"Not converged: {_few(unsure)}.")
    if len(stacks) > 1:
        ahead = standings(rows)
        counts = {
            stack: sum(ahead[file, stack] == BEST for file in files if (file, stack) in ahead) for stack in stacks
        }
        words.append("Best of a file: " + ", ".join(f"{name} {_count(n, 'time')}" for name, n in counts.items()) + ".")
    bound: dict[str, int] = {}
    for row in fitted:
        for one in row.parameters:
            bound[f"{one.name} of {row.stack}"] = bound.get(f"{one.name} of {row.stack}", 0) + one.at_bound
    held = [f"{name} ({_count(number, 'file')})" for name, number in bound.items() if number]
    if held:
        words.append(f"At a bound: {_few(held)}.")
    if left_out:
        words.append(f"Not taken for measurements: {_few(list(left_out))}.")
    return words


def page(rows: Sequence[Row], left_out: Sequence[str], pictures: bool, drawn: Collection[str]) -> str:
    """All of it as one HTML file, which stands beside the results; drawn: directories of those that have a report."""
    title = f"Fits of {_count(len({row.file for row in rows}), 'file')}"
    told_of = [row for row in rows if row.directory in drawn]
    links = {f"{row.file}\n{row.stack}": quote(f"{row.directory}/report.html") for row in told_of}
    fine = all(row.fitted and row.converged for row in rows)
    verdict = f'<p class="verdict{" fine" if fine else ""}">{html.escape(told(rows, left_out)[0])}</p>'
    body = [f"<h1>{html.escape(title)}</h1>", verdict, sentences(told(rows, left_out)[1:])]
    body.append(section("All fits", _linked(overview(rows), links)))
    for stack in dict.fromkeys(row.stack for row in rows):
        own = [row for row in rows if row.stack == stack and row.fitted]
        structures = list(dict.fromkeys(row.structure for row in own))
        for structure in structures:
            some = [row for row in own if row.structure == structure]
            name = f"{stack}: {structure}" if structure else stack
            images = {"parameters": as_png(parameters_picture(some))} if pictures and len(some) > 1 else {}
            body.append(
                section(name, image(images, "parameters", _CAPTION), _linked(parameters_table(some), links, stack))
            )
    return document(title, body)


def parameters_table(rows: Sequence[Row]) -> tables.Table:
    """Values and errors of fits of one stack."""
    heads = _with_units(rows)
    cells = []
    for row in rows:
        own = {one.name: one for one in row.parameters}
        cells.append((row.file, *(_value(own[name]) if name in own else "" for name in heads)))
    note = "Value ± standard error; an error says nothing of a parameter at a bound."
    return tables.Table("", ("file", *heads.values()), tuple(cells), note)


def _with_units(rows: Sequence[Row]) -> dict[str, str]:
    """What to call each parameter of these fits, by its name."""
    units = {one.name: one.unit for row in rows for one in row.parameters}
    return {name: name if unit in ("", "1") else f"{name} ({unit})" for name, unit in units.items()}


def parameters_picture(rows: Sequence[Row]) -> "Figure":
    """Reduced chi-square and every parameter against the file, with standard errors; orange: at a bound."""
    from matplotlib.figure import Figure

    names = _with_units(rows)
    places = np.arange(len(rows))
    panels = 1 + len(names)
    high = -(-panels // WIDE)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.5, 1.9 * high + 1.2), layout="constrained")
        grid = figure.subplots(high, WIDE, sharex=True, squeeze=False).ravel()
        grid[0].plot(places, [row.reduced_chi_square for row in rows], ".", color=CYCLE[0])
        grid[0].axhline(1.0, color=GREY, linewidth=0.8)
        grid[0].set_title("chi-square per degree of freedom")
        for axes, name in zip(grid[1:], names, strict=False):
            for place, row in zip(places, rows, strict=True):
                for one in (one for one in row.parameters if one.name == name):
                    error = one.error if np.isfinite(one.error) else 0.0
                    colour = CYCLE[1] if one.at_bound else CYCLE[0]
                    axes.errorbar(place, one.value, yerr=error, fmt=".", color=colour, elinewidth=0.8, markersize=4)
            axes.set_title(names[name])
        every = max(1, -(-len(rows) // NAMED))
        for axes in grid:
            axes.set_xticks(places[::every], [row.file for row in rows][::every], rotation=90, fontsize=5)
        for axes in grid[max(panels - WIDE, 0) : panels]:  # the lowest of their columns
            axes.tick_params(labelbottom=True)
        for axes in grid[panels:]:
            axes.set_axis_off()
    return figure


_SHARED = (
    "Without shared: chi2/dof of the same stack without errors that readings share, where they are counted: how far "
    "the stack alone misses the data."
)

_CAPTION = "Every fitted parameter by file, with its standard error; orange: at a bound."


def _linked(table: tables.Table, links: Mapping[str, str], stack: str | None = None) -> str:
    """The table as HTML, the name of each file a link to the report of its fit."""
    text = tables.html_table(table)
    head, _, rest = text.partition("<tbody>")
    rows, _, tail = rest.partition("</tbody>")
    lines = rows.splitlines()
    for number, row in enumerate(table.rows):
        link = links.get(f"{row[0]}\n{stack or row[1]}")
        if link is not None:
            word = html.escape(row[0])
            anchor = f'<a href="{html.escape(link)}">{word}</a>'
            lines[number] = lines[number].replace(f">{word}</td>", f">{anchor}</td>", 1)
    return f"{head}<tbody>{chr(10).join(lines)}\n</tbody>{tail}"


def _value(one: Parameter) -> str:
    if one.at_bound:
        return f"{one.value:.4g} (bound)"
    return " ± ".join(tables.with_error(one.value, one.error))


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _few(words: list[str], most: int = 5) -> str:
    """The first of them, and how many more there are."""
    return listed([*words[:most], *([f"{len(words) - most} more"] if len(words) > most else [])])
