"""The cells of a CSV, below a line that names its columns."""

import csv
from collections.abc import Iterable

import numpy as np

from fits.data.formats._text import ANY_NUMBER, Line, plural
from fits.data.geometry import Floats

SUFFIXES = ("_std", "_sigma")
_PLAIN = ("theta_i", "phi_i", "theta_o", "phi_o", "used")
MISSING = ("", "nan", "-nan", "na", "n/a", "null")
"""Cells of values that were not measured, in lower case, as programs write them."""


class Table:
    """The cells below a header line; columns are parsed on request, so that unused ones may hold anything."""

    def __init__(self, header: Line, body: list[Line], quantities: Iterable[str]) -> None:
        self.header, self.body = header, body
        delimiter = delimiter_of(header.text)
        self.names = [in_known_case(name.strip(), quantities) for name in _cells(header, delimiter)]
        for position, name in enumerate(self.names):
            if name in self.names[:position]:
                raise header.error("this column appears twice, each may appear once", name)
        if not body:
            raise header.error("no samples below the header, must be at least one")
        self.cells = [_cells(line, delimiter) for line in body]
        for line, cells in zip(body, self.cells, strict=True):
            if len(cells) != len(self.names):
                raise line.error(f"{plural(len(cells), 'cell')}, must be {len(self.names)} as in the header")

    def skip_missing(self, names: list[str]) -> int:
        """Drop rows with a missing number in one of these columns, and say how many; ValueError if none is left."""
        places = [self.names.index(name) for name in names]
        keep = [not any(_missing(cells[place]) for place in places) for cells in self.cells]
        if not any(keep):
            raise self.header.error(f"no data point below holds a number in {named(names)}, must be at least one")
        self.body = [line for line, kept in zip(self.body, keep, strict=True) if kept]
        self.cells = [cells for cells, kept in zip(self.cells, keep, strict=True) if kept]
        return len(keep) - len(self.body)

    def column(self, name: str, allowed: tuple[float, float] = ANY_NUMBER, empty: float | None = None) -> Floats:
        """The numbers of a column, (N,); a missing one gives `empty`, or is an error where that is None."""
        if name not in self.names:
            raise self.header.error(f"no column {name!r}, the file has {', '.join(self.names)}")
        position = self.names.index(name)
        return np.array(
            [
                empty if empty is not None and _missing(cells[position]) else line.parse(cells[position], name, allowed)
                for line, cells in zip(self.body, self.cells, strict=True)
            ],
            dtype=float,
        )


def _missing(cell: str) -> bool:
    return cell.strip().lower() in MISSING


def _cells(line: Line, delimiter: str) -> list[str]:
    try:
        return next(csv.reader([line.text], delimiter=delimiter, strict=True))
    except csv.Error as error:
        raise line.error(f"not a line of CSV ({error})") from None


def delimiter_of(header: str) -> str:
    """The delimiter of the cells of a header line."""
    return max(",;\t", key=header.count)


def in_known_case(name: str, quantities: Iterable[str]) -> str:
    """The name of a column with angle, quantity and deviation in lower case; the name of a channel stays as it is."""
    lower = name.lower()
    known = [one for one in quantities if lower == one or lower.startswith(f"{one}_")]
    if not known:
        return lower if lower in _PLAIN else name
    quantity, suffix = max(known, key=len), next((one for one in SUFFIXES if lower.endswith(one)), "")
    return f"{quantity}{name[len(quantity) : len(name) - len(suffix)]}{suffix}"


def names_in(header: str) -> list[str]:
    """The names of a header line, in lower case."""
    return [name.strip().strip('"').lower() for name in header.split(delimiter_of(header))]


def named(columns: list[str]) -> str:
    """'column brf', 'columns brf_a, ..., brf_z'."""
    if len(columns) == 1:
        return f"column {columns[0]}"
    return f"columns {', '.join(columns if len(columns) < 5 else [columns[0], '...', columns[-1]])}"
