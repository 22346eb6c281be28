"""Tables on a terminal: whatever its width, every word of every column is there."""

import io
import re

import numpy as np
import pytest

from fits.data.geometry import Geometry, direction
from fits.reports.data_summary import data_table
from fits.reports.tables import Table, degrees, print_table, with_error
from tests.helpers.models import along


def measured(channels: int) -> Table:
    angles = np.meshgrid((8.123456, 30.0, 55.5, 75.0), (0.0012345, 12.3456, 45.0, 89.851123), indexing="ij")
    theta_i, theta_o = (grid.ravel() for grid in angles)
    values = 10 ** np.random.default_rng(0).uniform(-4, 2, (len(theta_i), channels))
    geometry = Geometry(direction(theta_i, 180), direction(theta_o, 33.3333))
    return data_table(along(geometry, values, channels=[f"{400 + 10 * channel}nm" for channel in range(channels)]))


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


@pytest.mark.parametrize(("channels", "width"), [(1, 60), (3, 80), (3, 120), (11, 60), (11, 200)])
def test_angles_stay_beside_many_channels(channels: int, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    table = measured(channels)
    text = printed(table, width, monkeypatch)
    lines = text.splitlines()
    assert max(map(len, lines)) <= width
    assert "…" not in text
    for word in (*table.columns, *(word for row in table.rows for word in row)):
        assert word in text
    assert len(re.findall("theta_o", text)) == 1
    assert not re.search(r"\d\.\d{3,}°", text)
    heads = [index for index, line in enumerate(lines) if "theta_i" in line]
    assert (len(heads) == 1) == ("(1 of " not in text)
    assert len(heads) == 1 or width < 120 or channels > 3
    for head in heads:  # each part says which incidence a line is of
        assert [line.split()[:2] for line in lines[head + 2 : head + 6]] == [list(row[:2]) for row in table.rows]


def test_texts_are_wrapped_before_a_table_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    sentence = "yes, and so well that there is no need to say more about it here"
    table = Table("Fit", ("parameter", "value", "identified"), (("layers[0].thickness", "1.234", sentence),))
    text = printed(table, 60, monkeypatch)
    assert text.count("parameter") == 1
    assert set(sentence.split()) <= set(text.split())


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
