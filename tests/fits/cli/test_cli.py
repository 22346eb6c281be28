"""The `layerjax` command at work: every command writes and prints what it should."""

import io
import json
import os
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fits import Problem, load_fit, load_posterior, progress, read, save_fit, slices
from fits.cli import commands
from fits.cli.arguments import COMMANDS
from fits.cli.parser import main
from fits.engines import run
from fits.progress import show_progress
from fits.reports.html import FitReport
from tests.helpers import tasks
from tests.helpers.coats import make_folder
from tests.helpers.commands import refused
from tests.helpers.places import ROOT

TRUE = {"layers[0].thickness": 0.6, "base.albedo": 0.4}  # of the stack behind coat_data


def test_fit_writes_a_result(work, capsys, coat_toml, layerjax):
    words = "fit data.csv --stack coat.toml --out result --starts 4"
    output = layerjax(f"{words} --max-polar-angle 80")
    for word in (*TRUE, "chi2/dof", "4 starts", "result/report.html", "fit 4/4"):
        assert word in output.out + output.err
    result = load_fit("result")
    assert result.problem.data.used().theta_o.max() <= 80
    for name, truth in TRUE.items():
        assert abs(result.values[name] - truth) < 4 * result.standard_errors[name]
    assert (work / "result" / "problem.toml").read_text() == coat_toml.read_text()
    stored = json.loads((work / "result" / "fit.json").read_text())
    assert (stored["values"], stored["fit"]["settings"]["seed"]) == (result.values, 0)
    assert "low" not in (work / "result" / "fitted.toml").read_text()
    assert "data:image/png;base64," in (work / "result" / "report.html").read_text()
    assert "--force" in refused(words.split(), capsys, work)


def test_results_are_compared(work, capsys, coat_fit, layerjax):
    root = Problem(coat_fit.problem.stack, coat_fit.problem.data, objective="cube_root")
    save_fit(coat_fit, "best")
    save_fit(replace(coat_fit, vector=coat_fit.vector + 2 * coat_fit.errors), "worse")
    save_fit(replace(coat_fit, problem=root), "root")
    words = layerjax("compare worse best --no-refit").out
    assert words.index(" best ") < words.index(" worse ")
    assert "cube_root" in refused(["compare", "best", "root"], capsys, work)
    assert "no posterior" in refused(["sample", "root"], capsys, work)
    layerjax("report best --compare worse")
    assert "Comparison" in (work / "best" / "report.html").read_text()


def test_sampling_resumes_until_it_is_enough(work, capsys, coat_fit, monkeypatch, layerjax):
    save_fit(coat_fit, "result")
    assert "no estimates yet" in layerjax("sample result --walkers 8 --max-steps 100", 1).out
    assert "no estimates yet" in (work / "result" / "report.html").read_text()
    assert not (work / "result" / "summary.json").exists()
    posterior = load_posterior("result")
    assert posterior.chain.shape[:2] == (100, 8)
    assert "(walkers 8, not 10)" in refused(["sample", "result", "--walkers", "10"], capsys, work)
    assert "effective samples" in layerjax("sample result --max-steps 5000").out  # the chain's own walkers
    longer = load_posterior("result")
    np.testing.assert_array_equal(longer.chain[:100], posterior.chain)
    for name, entry in json.loads((work / "result" / "summary.json").read_text())["parameters"].items():
        assert abs(entry["mean"] - coat_fit.values[name]) < coat_fit.standard_errors[name]
        assert entry["low_68"] < entry["median"] < entry["high_68"]
    assert (work / "result" / "report.html").read_text().count("data:image/png") == 3  # curves, maps, corner
    monkeypatch.setattr(FitReport, "write", lambda *_: None)
    said = layerjax(f"sample result --ess 1000000 --max-steps {len(longer.chain)}", 1).out
    assert f"layerjax sample result --ess 1000000 --max-steps {2 * len(longer.chain)}" in said


def test_many_files_are_fitted_as_one_is(work, monkeypatch, layerjax):
    monkeypatch.setattr(FitReport, "write", lambda _, folder: (folder / "report.html").write_text("drawn"))
    make_folder(work)
    (work / "scans" / "coated.csv").unlink()
    how = "--starts 2 --max-polar-angle 80"
    many = f"fit-many scans --stacks bare.toml --out out --processes 1 {how}"
    output = layerjax(many, 1)  # one file is broken
    assert "1 of 2 fits are there" in output.out
    assert "out/table.csv" in output.out
    assert "layerjax: fits 2/2" in output.err
    layerjax(f"fit scans/paint.csv --stack bare.toml --out alone {how}")
    folders = Path("out/paint.csv/bare"), Path("alone")
    own, alone = ({path.name: path.read_text() for path in folder.iterdir()} for folder in folders)
    assert own.keys() == alone.keys()
    assert {name for name in own if own[name] != alone[name]} <= {"fit.json"}  # which holds times


def test_held_out_data_are_scored(work, monkeypatch, layerjax):
    monkeypatch.setattr(FitReport, "write", lambda *_: None)
    words = "fit data.csv --stack coat.toml --out result --starts 2 --select azimuth=0 --hold-out incidence=50"
    assert "Held-out data" in layerjax(words).out
    data = load_fit("result").problem.data
    np.testing.assert_allclose(data.theta_i[data.mask], 10.0)
    assert np.all(np.abs(np.sin(np.radians(data.phi_o[data.mask]))) < 1e-9)
    assert {"selected: azimuth=0", "held out: incidence=50"} <= set(data.source.notes)
    assert "Prediction of data.csv" in layerjax("predict result --score data.csv --select incidence=50 azimuth=60").out


def test_predictions_are_written(work, capsys, coat_fit, layerjax):
    save_fit(coat_fit, "result")
    words = "predict result --incidence 30,70,20 --out new.csv"
    layerjax(words)
    rows = np.genfromtxt(work / "new.csv", delimiter=",", names=True, deletechars="")
    assert (set(rows["theta_i"]), len(rows)) == ({20.0, 30.0, 70.0}, 3 * 35)
    columns = ("predictive_q2.5", "bsdf_q50", "predictive_q97.5")
    assert np.all(np.diff([rows[name] for name in columns], axis=0) > 0.0)
    assert np.all((rows["bsdf_sd"] > 0.0) & (rows["bsdf_sd"] < rows["predictive_sd"]))
    assert np.all(rows["bsdf_mean"] == rows["latent_mean"])  # no discrepancy is modelled
    assert "--force" in refused(words.split(), capsys, work)


def test_info_says_what_is_there_and_draws_it(work, monkeypatch, layerjax):
    output = layerjax("info data.csv --out data.png").out
    for word in ("csv", "brdf", "10°", "50°", "sigma", "median 3.00%"):
        assert word in output
    assert (work / "data.png").read_bytes().startswith(b"\x89PNG")
    (work / "data.png").write_bytes(b"precious")
    ascii_only = io.BytesIO()
    with monkeypatch.context() as patch:  # a terminal without a sign gets a question mark
        patch.setattr(sys, "stdout", io.TextIOWrapper(ascii_only, encoding="ascii"))
        assert main(["info", "data.csv"]) == 0
        output = ascii_only.getvalue().decode("ascii")
    assert "50?" in output
    assert "--force" in output
    assert (work / "data.png").read_bytes() == b"precious"
    names, cells = (",".join(f"{word}{k}" for k in range(9)) for word in ("brdf_", ""))
    (work / "spectral.csv").write_text(f"theta_i,theta_o,{names}\n30,10,{cells}\n")
    output = layerjax("info spectral.csv").out
    assert "0, 1, 2, ..., 8 (9 in all)" in output
    assert "0 to 8" in output


def test_convert_and_simulate_write_csv(work, coat_data, layerjax):
    layerjax("convert data.csv copy.csv")
    np.testing.assert_array_equal(read(work / "copy.csv").values, coat_data.values)
    layerjax("simulate --stack coat.toml --incidence 20,40 --azimuth 0,90,45 --noise 0.1 --out new.csv --seed 3")
    first, view = read(work / "new.csv"), slices([20.0, 40.0], azimuth=[0.0, 90.0, 45.0])
    np.testing.assert_allclose(first.wo, view.wo, atol=1e-9)
    # Lambertian paint alone would be albedo / pi = 0.159; the coat's start values darken it
    assert 0.02 < float(np.median(first.values)) < 0.16


HELP = """
import contextlib, os, sys
from fits.cli import main
from fits.cli.arguments import COMMANDS
from fits.cli.input_output import use_jax
for words in ([], *([name] for name in COMMANDS)):
    with contextlib.suppress(SystemExit):
        main([*words, "--help"])
import fits.data.formats
assert "jax" not in sys.modules
use_jax()
assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"  # XLA reads what it may print as it is loaded: it is told before
"""


def test_help_and_reading_need_no_jax_whose_alarms_are_not_shown() -> None:
    environment = {name: word for name, word in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    words = [sys.executable, "-c", HELP]
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    flags = [flag for one in COMMANDS.values() for flag in (*one.particular, *one.shared.split())]
    assert all(flag in done.stdout for flag in flags)


def test_a_warning_for_users_is_one_line_and_shown_once(capfd, monkeypatch):
    """Also one of threads; any other stays what it is."""

    def warned(_):
        warnings.warn("of the program", RuntimeWarning, stacklevel=1)
        return len(dict(run(tasks.warned, None, range(3)))) - 3

    monkeypatch.setitem(commands.COMMANDS, "info", warned)
    with pytest.warns(RuntimeWarning, match="of the program"):
        assert main(["info", "data.csv"]) == 0
    lines = sorted(capfd.readouterr().err.splitlines())
    assert lines == [f"layerjax: warning: {words}" for words in ("task 0", "task 1", "task 2", "too narrow")]


def test_a_fit_of_angles_in_radians_is_doubted(layerjax, work):
    (work / "data.csv").write_text("theta_i,theta_o,brdf\n0.5,0.3,0.1\n0.5,0.4,0.1\n")
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        said = layerjax("fit data.csv --stack missing.toml --out result", 2).err
    assert "layerjax: warning: Angles: none is above 0.5°: are they radians?" in said


def test_the_first_step_does_not_count_once_there_are_others(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    stream = io.StringIO()
    with show_progress(stream) as told:
        # taken up again at 10 of 40; the first step compiles for 100 s, others take 20 s each
        for done, at in ((10, 0.0), (11, 100.0), (12, 120.0), (13, 140.0), (40, 680.0)):
            clock[0] = at
            told("map", done, 40, "fine")
    assert stream.getvalue().splitlines() == [
        "layerjax: map 10/40 (fine)",
        "layerjax: map 11/40 (about 48 min left; fine)",
        "layerjax: map 12/40 (about 9 min left; fine)",
        "layerjax: map 13/40 (about 9 min left; fine)",
        "layerjax: map 40/40 (fine)",
    ]
