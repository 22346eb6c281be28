"""Results as JSON and as a markdown table that lines up, each file written whole or not at all; and the bar."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fits._files import write_text

DIRECTORY = Path(__file__).parents[1] / "results"


@dataclass(frozen=True)
class Bar:
    """The ratio to a peer that is asked for at least, and the one aimed at.

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
        """The bar as it stands in the table: what is asked for and, in brackets, what is aimed at."""
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


def write(name: str, content: Mapping[str, Any], markdown: str, directory: Path = DIRECTORY) -> tuple[Path, Path]:
    """Write ``NAME.json`` and ``NAME.md`` into `directory`, made if it is not there."""
    directory.mkdir(parents=True, exist_ok=True)
    paths = directory / f"{name}.json", directory / f"{name}.md"
    write_text(paths[0], json.dumps(content, indent=2, allow_nan=False) + "\n", force=True)
    write_text(paths[1], markdown, force=True)
    return paths
