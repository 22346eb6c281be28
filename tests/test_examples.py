"""Examples that are programs: the quick ones run."""

import re
import runpy
import sys
from pathlib import Path

import pytest

from fits.maps.fitted_map import open_map
from tests.helpers.places import ROOT


def test_a_mixture_is_told_from_a_metal(capsys: pytest.CaptureFixture[str]) -> None:
    example = runpy.run_path(str(ROOT / "examples" / "kinds_of_readings.py"))
    example["mixture"]()
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    (found,) = (line for line in lines if line[:1] == ["weights.coat"])
    assert float(found[2]) == pytest.approx(0.7, abs=0.01)


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
