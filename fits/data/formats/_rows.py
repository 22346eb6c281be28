"""A text file that says how many numbers follow, read from top to bottom."""

from pathlib import Path

import numpy as np

from fits.data.formats._text import ANY_NUMBER, Line, plural, rows
from fits.data.geometry import Floats


class Rows:
    """The lines of a file that remain to be read. Errors say what was expected, or name the line."""

    def __init__(self, path: Path, lines: list[Line]) -> None:
        self._path, self._lines, self._next = path, lines, 0

    @property
    def last(self) -> Line:
        """The line read last."""
        return self._lines[max(self._next - 1, 0)]

    def text(self, wanted: str) -> Line:
        """The next line, whatever it holds."""
        if self._next >= len(self._lines):
            raise ValueError(f"{self._path}: the file ends where {wanted} is expected (truncated?)")
        self._next += 1
        return self._lines[self._next - 1]

    def skip_text(self, length: int) -> None:
        """Past a text of so many characters, on one line or, with their ends counted as one or two each, on several."""
        taken = len(self.text("a text").text)
        ends = 0
        while taken + ends < length:
            taken += 1 + len(self.text("a text").text)
            ends += 1

    def filled(self, wanted: str) -> Line:
        """The next line that is not blank."""
        line = self.text(wanted)
        while not line.text.strip():
            line = self.text(wanted)
        return line

    def numbers(self, count: int, wanted: str, allowed: tuple[float, float] = ANY_NUMBER) -> Floats:
        """The next `count` numbers, in the closed range `allowed`, on one or several lines, without blank ones."""
        values: list[float] = []
        while len(values) < count:
            values += self.filled(wanted).numbers(allowed)
        if len(values) != count:
            raise self.last.error(f"{plural(len(values), 'number')} for {wanted}, must be {count}")
        return np.array(values)

    def whole(self, wanted: str, allowed: tuple[float, float]) -> int:
        """One whole number."""
        value = self.numbers(1, wanted, allowed)[0]
        if value != int(value):
            raise self.last.error(f"{value:g} for {wanted}, must be a whole number")
        return int(value)

    def counted(self, wanted: str, allowed: tuple[float, float]) -> Floats:
        """Numbers, and before them how many."""
        return self.numbers(self.whole(f"the number of {wanted}", (1, 100_000)), wanted, allowed)

    def table(self, count: int, columns: int, wanted: str) -> tuple[list[Line], Floats]:
        """The next `count` lines of `columns` numbers, (count, columns), without blank lines before them."""
        self.filled(wanted)
        start = self._next - 1
        body = self._lines[start : start + count]
        if len(body) < count:
            raise ValueError(f"{self._path}: the file ends where {wanted} is expected (truncated?)")
        self._next = start + count
        return body, rows(body, columns)

    def end(self, allowed: str = "") -> None:
        """Nothing is left but blank lines, or one that says so."""
        for line in self._lines[self._next :]:
            if line.text.strip() and line.text.strip().lower() != allowed.lower():
                raise line.error(f"{line.text.strip()[:40]!r} found after the last table")
