"""Examples that are programs: the quick ones run."""

import runpy

import pytest

from tests.helpers.places import ROOT


def test_a_mixture_is_told_from_a_metal(capsys: pytest.CaptureFixture[str]) -> None:
    example = runpy.run_path(str(ROOT / "examples" / "kinds_of_readings.py"))
    example["mixture"]()
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    (found,) = (line for line in lines if line[:1] == ["weights.coat"])
    assert float(found[2]) == pytest.approx(0.7, abs=0.01)
