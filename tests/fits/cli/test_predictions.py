"""Readings that a fit has not seen, on the command line."""

import csv
from pathlib import Path

import numpy as np
import pytest

from fits.cli.parser import main
from fits.optimise.result import Fit
from fits.reports.results import load_fit, save_fit
from tests.helpers.commands import refused

FIT = ["fit", "data.csv", "--stack", "coat.toml", "--out", "result", "--starts", "2"]
ALONG = ["predict", "result", "--incidence", "30", "--out", "new.csv"]


def test_readings_are_held_out_and_scored(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shared = (work / "coat.toml").read_text() + "\n[noise]\nrelative = 0.03\ncorrelated = true\n"
    (work / "shared.toml").write_text(shared)
    words = ["fit", "data.csv", "--stack", "shared.toml", "--out", "result", "--starts", "2"]
    assert main([*words, "--only", "plane=0", "--hold-out", "incidence=50"]) == 0
    shown = capsys.readouterr().out
    assert "Readings that were held out" in shown
    assert "θᵢ = 50°" in shown
    assert "noise.discrepancy.amplitude" in shown
    data = load_fit("result").problem.data
    np.testing.assert_allclose(data.theta_i[data.mask], 10.0)
    assert np.all(np.abs(np.sin(np.radians(data.phi_o[data.mask]))) < 1e-9)
    assert {"only: plane=0", "held out: incidence=50"} <= set(data.source.notes)

    assert main(["predict", "result", "--at", "data.csv", "--only", "incidence=50", "plane=60"]) == 0
    assert "Readings of data.csv" in capsys.readouterr().out


def test_predictions_are_written(work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit) -> None:
    save_fit(coat_fit, "result")
    words = ["predict", "result", "--incidence", "30,70", "20", "--out", "new.csv"]
    assert main(words) == 0
    with (work / "new.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["theta_i"] for row in rows} == {"20", "30", "70"}
    assert len(rows) == 3 * 35
    for row in rows:
        bands = {name: float(row[name]) for name in row if name.startswith(("bsdf", "model", "reading"))}
        assert bands["predictive_q2.5"] < bands["bsdf_q50"] < bands["predictive_q97.5"]
        assert 0.0 < bands["bsdf_sd"] < bands["reading_sd"]
        assert bands["bsdf_mean"] == bands["latent_mean"]  # no discrepancy is modelled
    names = [name.partition("_")[0] for name in rows[0]][5:]
    assert sorted(set(names), key=names.index) == ["bsdf", "reading", "model"]
    capsys.readouterr()
    assert "--force" in refused(words, capsys, work)
    assert main([*words, "--force"]) == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*FIT, "--hold-out", "incidence=30"], "incidence 30 is not in the data; there are 10, 50 degrees"),
        ([*FIT, "--hold-out", "incidence=10,50"], "--only and --hold-out leave nothing to fit"),
        ([*FIT, "--only", "incidence=10", "--hold-out", "incidence=50"], "--hold-out leaves nothing to score"),
        ([*FIT, "--hold-out", "everything"], "'everything' is no selection"),
        ([*FIT, "--hold-out", "channel=value"], "a fit says nothing of the colour of a channel that it has not seen"),
        ([*FIT, "--only", "channel=blue"], "channel blue is not in the data; there are"),
        ([*FIT, "--hold-out", "share=0.2", "--objective", "cube_root"], "--hold-out needs the objective 'likelihood'"),
        (["predict", "result"], "predict needs one of --incidence and --at"),
        (["predict", "result", "--incidence", "30", "--at", "data.csv"], "predict needs one of --incidence and --at"),
        (["predict", "result", "--incidence", "30"], "predict --incidence needs --out FILE"),
        (["predict", "result", "--incidence", "30", "--out", "new.txt"], ".csv"),
        ([*ALONG, "--only", "plane=0"], "--only is given without --at"),
        ([*ALONG, "--all"], "--all is given without --at"),
        (["predict", "result", "--at", "data.csv", "--azimuth", "90"], "--azimuth is given without --incidence"),
        (["predict", "result", "--incidence", "95", "--out", "new.csv"], "a light at 95 degrees sees nothing"),
        (["predict", "nowhere", "--incidence", "30", "--out", "new.csv"], "nowhere"),
        (["predict", "result", "--at", "nowhere.csv"], "nowhere.csv"),
        (["predict", "result", "--at", "data.csv", "--only", "incidence=40"], "incidence 40 is not in the data"),
        (["predict", "result", "--incidence", "130", "--out", "new.csv", "--azimuth", "400"], "400"),
    ],
)
def test_bad_requests_are_one_line(
    work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit, words: list[str], message: str
) -> None:
    if words[0] == "predict":
        save_fit(coat_fit, "result")
    assert message in refused(words, capsys, work)
