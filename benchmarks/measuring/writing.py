"""Results as JSON and as a markdown table that lines up, each file written whole or not at all; and the bar."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fits._files import write_text

DIRECTORY = Path(__file__).parents[1] / "results"

DIGITS = 6
"""Significant digits of the numbers in a JSON file: what lies beyond differs between machines."""

NOT_REACHED = "**error not reached**"
"""Verdict on the time of something that is not as exact as it should be."""


@dataclass(frozen=True)
class Bar:
    """The required ratio to a peer, and the one aimed at.

    For times (ours / theirs) smaller is better, for rates (ours / theirs, `rate`) larger.
    """

    least: float
    aim: float
    rate: bool = False

    def verdict(self, ratio: float) -> str:
        """ "aim met", "met" or "not met"."""
        reached = [ratio >= limit if self.rate else ratio <= limit for limit in (self.least, self.aim)]
        return "aim met" if reached[1] else "met" if reached[0] else "**not met**"

    def words(self) -> str:
        """The bar as it stands in the table: what is required and, in brackets, what is aimed at."""
        sign = ">=" if self.rate else "<="
        return f"{sign} {self.least:g} ({self.aim:g})"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A markdown table with aligned columns: the first to the left, the others to the right."""
    widths = [max(len(row[column]) for row in (header, *rows)) for column in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        first, *others = (
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        return "| " + " | ".join([first, *others]) + " |"

    rule = "|" + "|".join("-" * (w + 2) if c == 0 else "-" * (w + 1) + ":" for c, w in enumerate(widths)) + "|"
    return "\n".join([line(header), rule, *(line(row) for row in rows)]) + "\n"


def figure(value: float | None, digits: int = 3) -> str:
    """The number to three significant digits, without an exponent where it can be helped; a dash for none."""
    if value is None:
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e7:
        decimals = 0
        while decimals < 6 and abs(value) * 10**decimals < 10 ** (digits - 1) and value:
            decimals += 1
        return f"{value:,.{decimals}f}"
    return f"{value:.{digits - 1}e}"


def environment_lines(environment: Mapping[str, Any]) -> str:
    """The environment as one paragraph."""
    return "; ".join(f"{name} {value}" for name, value in environment.items()) + ".\n"


def as_json(content: Mapping[str, Any]) -> str:
    """JSON text in which every record has a line, so that a rerun changes the lines of what came out differently.

    Args:
        content: entries that are single values, lists of records, or records by name. Floats are rounded to `DIGITS`
            significant digits.

    Raises:
        ValueError: a number is not finite.
    """
    return _braced("{}", _entries(rounded(content), _records), "") + "\n"


def rounded(content: Any) -> Any:
    """Nested lists and mappings with their floats rounded to `DIGITS` significant digits; tuples become lists."""
    if isinstance(content, Mapping):
        return {name: rounded(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [rounded(value) for value in content]
    if isinstance(content, float) and math.isfinite(content):
        return float(f"{content:.{DIGITS}g}")
    return content


def write(name: str, content: Mapping[str, Any], markdown: str, directory: Path = DIRECTORY) -> tuple[Path, Path]:
    """Write ``NAME.json`` (see `as_json`) and ``NAME.md`` into `directory`, made if it is not there.

    Raises:
        ValueError: a number is not finite; then neither file is written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    paths = directory / f"{name}.json", directory / f"{name}.md"
    write_text(paths[0], as_json(content), force=True)
    write_text(paths[1], markdown, force=True)
    return paths


def _records(value: Any) -> str:
    """A list of records or records by name with a line for each; all else on one line."""
    if isinstance(value, dict) and value:
        return _braced("{}", _entries(value, _line), "  ")
    if isinstance(value, list) and any(isinstance(entry, dict | list) for entry in value):
        return _braced("[]", [_line(entry) for entry in value], "  ")
    return _line(value)


def _entries(mapping: Mapping[str, Any], write_value: Callable[[Any], str]) -> list[str]:
    return [f"{_line(name)}: {write_value(value)}" for name, value in mapping.items()]


def _braced(braces: str, lines: list[str], indent: str) -> str:
    separator = f"\n{indent}  "
    return braces[0] + separator + f",{separator}".join(lines) + f"\n{indent}{braces[1]}"


def _line(value: Any) -> str:
    return json.dumps(value, allow_nan=False)
