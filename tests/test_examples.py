"""Examples that are programs: the quick ones run."""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest

from fits.maps.store import open_map
from tests.helpers.places import ROOT


@pytest.mark.slow
def test_a_mixture_is_told_from_a_metal(capsys: pytest.CaptureFixture[str]) -> None:
    example = runpy.run_path(str(ROOT / "examples" / "measured_quantities.py"))
    example["mixture"]()
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    (found,) = (line for line in lines if line[:1] == ["weights.coat"])
    assert float(found[2]) == pytest.approx(0.7, abs=0.01)


def test_the_table_of_predictions_rounds_the_results() -> None:
    """The first table of the README beside the results of `held-out`."""
    rows = json.loads((ROOT / "benchmarks" / "results" / "held-out.json").read_text())["rows"]
    found = {(row["coating"], row["stack"], row["discrepancy"]): row for row in rows}
    text = (ROOT / "examples" / "README.md").read_text()
    header, _, *lines = text[text.index("| file | layers and base | Aeroglaze") :].split("\n\n")[0].splitlines()
    coatings = [cell.strip() for cell in header.split("|")[3:6]]
    table = [(line.split("|"), line.split("`")[1].removesuffix(".toml")) for line in lines]
    assert 2 * len(table) * len(coatings) == len(found)
    for cells, stack in table:
        for coating, cell in zip(coatings, cells[3:6], strict=True):
            error, noise_error, *coverage = map(float, re.findall(r"[\d.]+", cell))
            both, noise = found[coating, stack, True], found[coating, stack, False]
            assert [error, noise_error] == [pytest.approx(100 * row["error"], abs=0.051) for row in (both, noise)]
            assert coverage == [
                pytest.approx(100 * share, abs=0.51) for share in (*both["coverage"], *noise["coverage"])
            ]


@pytest.mark.slow
def test_a_painted_plate_is_found_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["painted_map.py", "--size", "16", "--out", str(tmp_path)])
    example = runpy.run_path(str(ROOT / "examples" / "painted_map.py"))
    example["main"]()
    widths = [float(width) for width in re.findall(r"width (\S+),", capsys.readouterr().out)]
    # of 256 pulls the width is known to 4.4 %
    assert widths == pytest.approx([1.0, 1.0], abs=0.15)
    assert open_map(tmp_path / "plate.zarr").has("converged").all()
    assert (tmp_path / "painted_map.png").stat().st_size > 20_000
    assert "</html>" in (tmp_path / "plate.html").read_text()
