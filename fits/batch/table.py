"""The table over all files and stacks, as CSV and as JSON."""

import csv
import io
from collections.abc import Sequence
from typing import Any

from fits.batch.rows import Row, best_of, standings

KIND = "layerjax_table"

COLUMNS = ("file", "stack", "structure", "result", "converged", "standing")
NUMBERS = {
    "reduced_chi_square": "reduced_chi_square",
    "without shared errors": "alone",
    "aic": "aic",
    "score": "score",
}
"""Columns, and what of a row stands in them."""

MORE = ("readings", "seconds", "at_bound", "status")


def table_csv(rows: Sequence[Row]) -> str:
    """A line each; value and error of every parameter that any of them has, empty where it has none."""
    words = standings(rows)
    names = list(dict.fromkeys(one.name for row in rows for one in row.parameters))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*COLUMNS, *NUMBERS, *(head for name in names for head in (name, f"{name} error")), *MORE])
    for row in rows:
        own = {one.name: one for one in row.parameters}
        numbers = [_word(getattr(row, of)) for of in NUMBERS.values()]
        cells = [row.file, row.stack, row.structure, "failed" if row.failure else "fitted"]
        cells += ["" if row.failure else "yes" if row.converged else "no", words[row.file, row.stack], *numbers]
        for name in names:
            one = own.get(name)
            cells += ["", ""] if one is None else [_word(one.value), _word(one.error)]
        bounds = " ".join(one.name for one in row.parameters if one.at_bound)
        count = "" if row.failure else str(row.readings)
        writer.writerow([*cells, count, _word(row.seconds), bounds, row.failure or row.status])
    return out.getvalue()


def table_json(rows: Sequence[Row], left_out: Sequence[str], settings: dict[str, Any]) -> dict[str, Any]:
    """The same with units, and what else is known."""
    from fits.reports.results import versions

    words = standings(rows)
    return {
        KIND: 1,
        "versions": versions(),
        "settings": settings,
        "best": best_of(rows),
        "not_measurements": list(left_out),
        "rows": [row.plain() | {"standing": words[row.file, row.stack]} for row in rows],
    }


def _word(number: float) -> str:
    return "" if number != number else f"{number:.8g}"
