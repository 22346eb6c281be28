"""Tables on a terminal: whatever its width, every word of every column is there."""

import io
import re

import numpy as np
import pytest

from fits.data.geometry import direction
from fits.data.measurements import Measurements
from fits.reports.data_summary import data_table
from fits.reports.tables import Table, degrees, print_table

INCIDENCES, OUTGOING = (8.123456, 30.0, 55.5, 75.0), (0.0012345, 12.3456, 45.0, 89.851123)


def measured(channels: int) -> Measurements:
    theta_i, theta_o = (grid.ravel() for grid in np.meshgrid(INCIDENCES, OUTGOING, indexing="ij"))
    return Measurements(
        wi=direction(theta_i, 180),
        wo=direction(theta_o, 33.3333),
        values=10 ** np.random.default_rng(0).uniform(-4, 2, (len(theta_i), channels)),
        sigma=None,
        mask=np.ones(len(theta_i), bool),
        channels=tuple(f"{400 + 10 * channel}nm" for channel in range(channels)),
    )


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


@pytest.mark.parametrize("width", [60, 80, 200])
@pytest.mark.parametrize("channels", [1, 3, 11])
def test_angles_stay_beside_many_channels(channels: int, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    table = data_table(measured(channels))
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
    for head in heads:  # each part says which incidence a line is of
        assert "phi_i" in lines[head]
        assert [line.split()[:2] for line in lines[head + 2 : head + 6]] == [list(row[:2]) for row in table.rows]


def test_a_wide_terminal_gets_one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    assert printed(data_table(measured(3)), 120, monkeypatch).count("theta_i") == 1


def test_a_terminal_narrower_than_two_columns_folds_them(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table("", ("angle", "range"), (("12.5°", "0.000123 to 0.456789"),))
    text = printed(table, 16, monkeypatch)
    assert max(map(len, text.splitlines())) <= 16
    assert re.sub(r"[\s─]", "", text) == "anglerange12.5°0.000123to0.456789"


def test_texts_are_wrapped_before_a_table_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    sentence = "yes, and so well that there is no need to say more about it here"
    table = Table("Fit", ("parameter", "value", "identified"), (("layers[0].thickness", "1.234", sentence),))
    text = printed(table, 60, monkeypatch)
    assert text.count("parameter") == 1
    assert set(sentence.split()) <= set(text.split())


@pytest.mark.parametrize(
    ("angle", "word"), [(89.8511, "89.85°"), (30.0, "30°"), (-1e-9, "0°"), (55.5, "55.5°"), (359.996, "360°")]
)
def test_degrees_have_two_decimals_at_most(angle: float, word: str) -> None:
    assert degrees(angle) == word
