"""Tables on a terminal: whatever its width, every word of every column is there."""

import io
import re
from collections import Counter

import pytest

from fits.reports.tables import Table, degrees, print_table, with_error


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def printed(table: Table, width: int, patch: pytest.MonkeyPatch) -> str:
    """What a terminal of that width shows, without its colours."""
    for name, value in {"COLUMNS": str(width), "LINES": "50", "TERM": "xterm"}.items():
        patch.setenv(name, value)
    terminal = Terminal()
    print_table(table, terminal)
    return re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue())


def test_numbers_in_words() -> None:
    """Degrees to two decimals at most, values to two digits of their error."""
    angles = {89.8511: "89.85°", 30.0: "30°", -1e-9: "0°", 55.5: "55.5°", 359.996: "360°"}
    assert [degrees(angle) for angle in angles] == list(angles.values())
    values = {
        (0.53217, 0.0214): ("0.532", "0.021"),
        (1234.567, 12.0): ("1235", "12"),
        (0.5, float("nan")): ("0.5", "unknown"),
        (1e-7, 2.5e-9): ("1e-07", "2.5e-09"),
        (123456.0, 34567.0): ("123456", "34567"),
    }
    assert [with_error(*pair) for pair in values] == list(values.values())


@pytest.mark.parametrize("width", [40, 80, 200])
def test_what_is_too_wide_is_folded_and_never_cut(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = tuple(
        (f"layers[{k}].thickness", f"{1.23456 * 10**k:.4f}", "weakly identified, direction 1") for k in range(3)
    )
    text = printed(Table("Fit", ("parameter", "value", "identifiability"), rows), width, monkeypatch)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    assert Counter("".join("".join(row).replace(" ", "") for row in rows)) <= Counter(text)
