"""What `layerjax` does with readings themselves: info, convert, simulate."""

from pathlib import Path

import numpy as np
import pytest

from fits.cli.parser import main
from fits.data.formats import read
from fits.data.measurements import Measurements
from fits.reports.plots.data import MOST_CHANNELS, data_picture


def test_info_says_what_is_there_and_draws_it(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "data.csv", "--out", "data.png", "--mask-retro", "8"]) == 0
    output = capsys.readouterr().out
    for word in ("csv", "brdf", "10°", "50°", "sigma", "median 3.00%"):
        assert word in output
    assert (work / "data.png").read_bytes().startswith(b"\x89PNG")
    (work / "data.png").write_bytes(b"precious")
    assert main(["info", "data.csv"]) == 0
    assert "--force" in capsys.readouterr().out
    assert (work / "data.png").read_bytes() == b"precious"
    assert main(["info", "data.csv", "--force"]) == 0
    assert (work / "data.png").read_bytes().startswith(b"\x89PNG")


def test_info_of_what_is_all_masked(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "data.csv", "--mask-grazing", "1"]) == 0
    assert "no reading is used" in capsys.readouterr().out


def test_info_of_many_channels_shows_some(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ",".join(f"brdf_{k}" for k in range(400))
    rows = [f"30,{theta}," + ",".join(map(str, np.linspace(1.0, 2.0, 400))) for theta in range(-60, 61, 10)]
    (work / "spectral.csv").write_text("\n".join([f"theta_i,theta_o,{names}", *rows]))
    assert main(["info", "spectral.csv"]) == 0
    told = capsys.readouterr().out
    assert "0, 1, 2, ..., 399 (400 of them)" in told
    assert "1 to 2" in told
    assert len(data_picture(read("spectral.csv")).subfigs[0].axes) == MOST_CHANNELS


def test_convert_and_simulate_write_csv(work: Path, coat_data: Measurements) -> None:
    assert main(["convert", "data.csv", "copy.csv"]) == 0
    np.testing.assert_array_equal(read(work / "copy.csv").values, coat_data.values)
    words = ["simulate", "--stack", "coat.toml", "--incidence", "20", "40", "--noise", "0.1", "--out", "new.csv"]
    assert main([*words, "--seed", "3"]) == 0
    first = read(work / "new.csv")
    assert sorted(set(first.theta_i)) == [20.0, 40.0]
    # Lambertian paint alone would be albedo / pi = 0.159; the coat's start values darken it
    assert 0.02 < float(np.median(first.values)) < 0.16
    assert main([*words, "--seed", "3", "--force"]) == 0
    np.testing.assert_array_equal(read(work / "new.csv").values, first.values)


def test_what_a_stack_file_says_of_readings_is_not_simulated_and_told(
    work: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = "\n[noise]\nrelative = 0.1\n[instrument]\ndetector_aperture = 2.0\n"
    (work / "seen.toml").write_text((work / "coat.toml").read_text() + more)
    for name in ("coat", "seen"):
        assert main(["simulate", "--stack", f"{name}.toml", "--out", f"{name}.csv"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "Not simulated: [noise], [instrument] of seen.toml"
    np.testing.assert_array_equal(read("seen.csv").values, read("coat.csv").values)
    assert "not simulated: [noise], [instrument] of seen.toml" in read("seen.csv").source.notes
