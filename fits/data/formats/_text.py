"""Common parts of the text readers: numbered lines, numbers, and one-line errors that name the line."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fits.data.geometry import Floats
from fits.data.measurements import LARGEST

BOM = b"\xef\xbb\xbf"
BOMS_16 = (b"\xff\xfe", b"\xfe\xff")
ANY_NUMBER = (-LARGEST, LARGEST)
MOST_VALUES = 20_000_000
"""Data points times channels that are made of one file: 160 MB, which are copied some times."""


@dataclass(frozen=True)
class Line:
    """One line of a file: its number (from 1) and its text."""

    path: Path
    number: int
    text: str

    def error(self, problem: str, column: str | int | None = None) -> ValueError:
        """A ValueError that names file, line and, where given, column."""
        place = "" if column is None else f", column {column!r}"
        return ValueError(f"{self.path}, line {self.number}{place}: {problem}")

    def parse(self, cell: str, column: str | int, allowed: tuple[float, float] = ANY_NUMBER) -> float:
        """The finite number in a cell, inside the closed range `allowed`."""
        low, high = allowed
        wanted = (
            f"a finite number of at most {high:g} in size"
            if allowed == ANY_NUMBER
            else f"a number in [{low:g}, {high:g}]"
        )
        try:
            value = float(cell)
        except ValueError:
            raise self.error(f"{cell.strip()!r} is not a number, must be {wanted}", column) from None
        if not math.isfinite(value) or not low <= value <= high:
            raise self.error(f"{cell.strip()} is not allowed, must be {wanted}", column)
        return value

    def numbers(self, allowed: tuple[float, float] = ANY_NUMBER) -> list[float]:
        """All whitespace-separated numbers of the line; columns count from 1 in errors."""
        return [self.parse(cell, column, allowed) for column, cell in enumerate(self.text.split(), start=1)]


def without_mark(raw: bytes) -> bytes:
    """The same bytes without a byte order mark; those of UTF-16, which nothing else tells from binary, as UTF-8."""
    if raw.startswith(BOMS_16):
        return raw.decode("utf-16", "replace").encode()
    return raw.removeprefix(BOM)


def read_lines(path: Path, encoding: str = "utf-8") -> list[Line]:
    """All lines of a text file, without a byte order mark; ValueError for an empty file or one that is not text."""
    marked = path.read_bytes()
    raw = without_mark(marked)
    encoding = "utf-8" if marked.startswith(BOMS_16) else encoding
    if not raw.strip():
        raise ValueError(f"{path}: the file is empty")
    try:
        text = raw.decode(encoding)
    except UnicodeDecodeError as error:
        try:  # comments may be of Windows, with a degree sign or an umlaut
            lines = ((line, line.lstrip().startswith(b"#")) for line in raw.splitlines())
            text = "\n".join(
                line.decode("cp1252" if comment else encoding, "replace" if comment else "strict")
                for line, comment in lines
            )
        except UnicodeDecodeError:
            raise ValueError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from None
    if "\0" in text:
        raise ValueError(f"{path}: not a text file (it holds a zero byte at {text.index(chr(0))})")
    return [Line(path, number, line) for number, line in enumerate(text.splitlines(), start=1)]


def content(lines: list[Line]) -> list[Line]:
    """The lines that are neither blank nor a # comment."""
    return [line for line in lines if line.text.strip() and not line.text.lstrip().startswith("#")]


def rows(lines: list[Line], columns: int) -> Floats:
    """The numbers of all lines, (lines, columns), split at blanks and commas; an error names line and column."""
    cells = [line.text.replace(",", " ").split() for line in lines]
    try:
        numbers = np.array(cells, np.float64)
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape == (len(lines), columns) and np.max(np.abs(numbers), initial=0.0) <= LARGEST:  # NaN is not
        return numbers
    for line, found in zip(lines, cells, strict=True):  # which one it was
        if len(found) != columns:
            raise line.error(f"{plural(len(found), 'number')}, must be {columns}")
    parsed = [[line.parse(*pair) for pair in _columns(found)] for line, found in zip(lines, cells, strict=True)]
    return np.array(parsed, np.float64).reshape(-1, columns)


def require_range(lines: list[Line], values: Floats, column: str | int, allowed: tuple[float, float]) -> None:
    """ValueError at the first of values (lines,) that is out of the closed range `allowed`."""
    low, high = allowed
    bad = ~((values >= low) & (values <= high))
    if bad.any():
        at = int(np.argmax(bad))
        raise lines[at].error(f"{values[at]:g} is not allowed, must be a number in [{low:g}, {high:g}]", column)


def _columns(cells: list[str]) -> list[tuple[str, int]]:
    return [(cell, column) for column, cell in enumerate(cells, start=1)]


def require_room(path: Path, points: int, channels: int) -> None:
    """ValueError for more than can be held: files may state few numbers that stand for many."""
    if points * channels > MOST_VALUES:
        raise ValueError(
            f"{path}: {plural(points, 'data point')} of {plural(channels, 'channel')} are {points * channels:,} "
            f"numbers, must be {MOST_VALUES:,} at most"
        )


def plural(count: int, noun: str) -> str:
    """'1 sample', '2 samples'."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
