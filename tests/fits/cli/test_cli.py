"""The `layerjax` command at work: every command writes and prints what it should."""

import csv
import gc
import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fits.cli.interrupts import raised_again
from fits.cli.parser import main
from fits.data.measurements import Measurements
from fits.data.reading import read
from fits.optimise.result import Fit
from fits.problem.problem import Problem
from fits.reports.plots.data import MOST_CHANNELS, data_picture
from fits.reports.results import load_fit, load_posterior, save_fit
from tests.helpers.commands import refused
from tests.helpers.files import contents
from tests.helpers.places import ROOT

TRUE_ALBEDO, TRUE_THICKNESS = 0.4, 0.6  # of the stack behind coat_data


def test_fit_writes_a_result(work: Path, capsys: pytest.CaptureFixture[str], coat_toml: Path) -> None:
    words = ["fit", "data.csv", "--stack", "coat.toml", "--out", "result", "--starts", "4"]
    assert main([*words, "--max-polar-angle", "80"]) == 0
    output = capsys.readouterr()
    for word in ("layers[0].thickness", "base.albedo", "chi2/dof", "4 starts", "result/report.html"):
        assert word in output.out
    assert "fit 4/4" in output.err
    result = load_fit("result")
    assert result.problem.data.theta_o[result.problem.data.mask].max() <= 80
    for name, truth in (("layers[0].thickness", TRUE_THICKNESS), ("base.albedo", TRUE_ALBEDO)):
        assert abs(result.values[name] - truth) < 4 * result.standard_errors[name]
    assert (work / "result" / "problem.toml").read_text() == coat_toml.read_text()
    stored = json.loads((work / "result" / "fit.json").read_text())
    assert stored["versions"]["jax"]
    assert {"starts": 4, "seed": 0, "solver": "least_squares"}.items() <= stored["fit"]["settings"].items()
    assert "low" not in (work / "result" / "fitted.toml").read_text()
    assert {"model.png", "maps.png", "residuals.png", "report.html"} <= {path.name for path in Path("result").iterdir()}
    assert "--force" in refused([*words], capsys, work)


def test_a_named_residual_has_no_posterior(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (work / "root.toml").write_text('objective = "cube_root"\n' + (work / "coat.toml").read_text())
    assert main(["fit", "data.csv", "--stack", "root.toml", "--out", "root", "--starts", "1"]) == 0
    assert load_fit("root").problem.objective == "cube_root"
    capsys.readouterr()
    assert "no posterior" in refused(["sample", "root"], capsys, work)


def test_results_are_compared(work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit) -> None:
    problem = coat_fit.problem
    worse = replace(coat_fit, vector=coat_fit.vector + 2 * coat_fit.errors)
    other = replace(coat_fit, problem=Problem(problem.stack, problem.data, objective="cube_root"))
    for name, fit in (("best", coat_fit), ("worse", worse), ("root", other)):
        save_fit(fit, name)
    assert main(["compare", "worse", "best", "--out", "both.html"]) == 0
    words = capsys.readouterr().out
    assert words.index(" best ") < words.index(" worse ")
    assert "data:image/png;base64," in (work / "both.html").read_text()
    assert "twice" in refused(["compare", "best", "best/../best"], capsys, work)
    assert "cube_root" in refused(["compare", "best", "root"], capsys, work)
    assert main(["report", "best", "--compare", "worse"]) == 0
    assert "Comparison" in (work / "best" / "report.html").read_text()


def test_sampling_resumes_until_it_is_enough(work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit) -> None:
    save_fit(coat_fit, "result")
    words = ["sample", "result", "--walkers", "8"]
    assert main([*words, "--max-steps", "100"]) == 1
    assert "no estimates yet" in capsys.readouterr().out
    assert not (work / "result" / "summary.json").exists()
    posterior = load_posterior("result")
    assert posterior is not None
    assert posterior.chain.shape[:2] == (100, 8)
    with pytest.raises(ValueError, match="too short"):
        posterior.summary()
    assert "no estimates yet" in (work / "result" / "report.html").read_text()
    assert "--walkers" in refused(["sample", "result", "--walkers", "10"], capsys, work)

    assert main(["sample", "result", "--max-steps", "5000"]) == 0  # the chain's own walkers
    assert "effective samples" in capsys.readouterr().out
    summary = (work / "result" / "summary.json").read_text()
    longer = load_posterior("result")
    assert longer is not None
    np.testing.assert_array_equal(longer.chain[:100], posterior.chain)
    for entry in json.loads(summary)["parameters"]:
        assert abs(entry["mean"] - coat_fit.values[entry["name"]]) < coat_fit.standard_errors[entry["name"]]
        assert entry["low_68"] < entry["median"] < entry["high_68"]
    text = (work / "result" / "report.html").read_text()
    assert text.count("data:image/png") == 6  # curves, maps, residuals, correlation, corner, trace
    assert main(["sample", "result"]) == 0
    assert (work / "result" / "summary.json").read_text() == summary
    assert main(["sample", "result", "--ess", "1000000", "--max-steps", str(len(longer.chain))]) == 1
    assert f"layerjax sample result --ess 1000000 --max-steps {2 * len(longer.chain)}" in capsys.readouterr().out


def test_an_interrupted_sampler_says_how_to_resume(
    work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    save_fit(coat_fit, "result")
    monkeypatch.setattr("fits.sampling.sample.sample", interrupted)
    assert main(["sample", "result"]) == 130
    assert "`layerjax sample result` resumes it" in capsys.readouterr().err


def test_a_terminal_without_a_sign_gets_a_question_mark(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding="ascii"))
    assert main(["info", "data.csv"]) == 0
    assert "50?" in shown.getvalue().decode("ascii")


def test_help_imports_no_jax() -> None:
    script = "import sys; from fits.cli import main\ntry: main(['--help'])\nfinally: assert 'jax' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "simulate" in done.stdout


def test_an_interrupt_that_a_callback_drops_comes_again() -> None:
    def dropped(phase: str, info: dict[str, int]) -> None:
        gc.callbacks.remove(dropped)
        raise KeyboardInterrupt

    def collect_and_wait() -> None:
        gc.callbacks.append(dropped)
        with raised_again():
            gc.collect()
            time.sleep(30)

    ours = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            collect_and_wait()
    finally:
        signal.signal(signal.SIGINT, ours)


def test_an_interrupted_fit_exits_with_130_and_leaves_its_starts_alone(work: Path, coat_fit: Fit) -> None:
    before = contents(work)
    command = [sys.executable, "-m", "fits.cli", "fit", "data.csv", "--stack", "coat.toml", "--out", "result"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(work.parent / "cache")}
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job's ignoring would be inherited
    process = subprocess.Popen([*command, "--starts", "100000"], stderr=subprocess.PIPE, text=True, env=environment)
    signal.signal(signal.SIGINT, ours)
    assert process.stderr is not None
    first = process.stderr.readline()
    process.send_signal(signal.SIGINT)
    try:
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert first.startswith("layerjax: fit ")
    assert process.returncode == 130
    assert error.splitlines()[-1] == (
        "layerjax: interrupted: result was not written; the same command resumes with the starts that are done"
    )
    after = contents(work)
    assert after.pop(str(work / ".result.starts"))
    assert after == before


def test_held_out_data_are_scored(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (work / "coat.toml").read_text() + "\n[noise]\nrelative = 0.03\ndiscrepancy = true\n"
    (work / "discrepancy.toml").write_text(text)
    words = ["fit", "data.csv", "--stack", "discrepancy.toml", "--out", "result", "--starts", "2"]
    assert main([*words, "--select", "plane=0", "--hold-out", "incidence=50"]) == 0
    shown = capsys.readouterr().out
    assert "Held-out data" in shown
    assert "θᵢ = 50°" in shown
    assert "noise.discrepancy.amplitude" in shown
    data = load_fit("result").problem.data
    np.testing.assert_allclose(data.theta_i[data.mask], 10.0)
    assert np.all(np.abs(np.sin(np.radians(data.phi_o[data.mask]))) < 1e-9)
    assert {"selected: plane=0", "held out: incidence=50"} <= set(data.source.notes)

    assert main(["predict", "result", "--score", "data.csv", "--select", "incidence=50", "plane=60"]) == 0
    assert "Prediction of data.csv" in capsys.readouterr().out


def test_predictions_are_written(work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit) -> None:
    save_fit(coat_fit, "result")
    words = ["predict", "result", "--incidence", "30,70", "20", "--out", "new.csv"]
    assert main(words) == 0
    with (work / "new.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["theta_i"] for row in rows} == {"20", "30", "70"}
    assert len(rows) == 3 * 35
    for row in rows:
        intervals = {name: float(row[name]) for name in row if name.startswith(("bsdf", "predictive", "latent"))}
        assert intervals["predictive_q2.5"] < intervals["bsdf_q50"] < intervals["predictive_q97.5"]
        assert 0.0 < intervals["bsdf_sd"] < intervals["predictive_sd"]
        assert intervals["bsdf_mean"] == intervals["latent_mean"]  # no discrepancy is modelled
    names = [name.partition("_")[0] for name in rows[0]][5:]
    assert sorted(set(names), key=names.index) == ["bsdf", "predictive", "latent"]
    capsys.readouterr()
    assert "--force" in refused(words, capsys, work)
    assert main([*words, "--force"]) == 0


def test_info_says_what_is_there_and_draws_it(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "data.csv", "--out", "data.png"]) == 0
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

    names = ",".join(f"brdf_{k}" for k in range(400))
    rows = [f"30,{theta}," + ",".join(map(str, np.linspace(1.0, 2.0, 400))) for theta in range(-60, 61, 10)]
    (work / "spectral.csv").write_text("\n".join([f"theta_i,theta_o,{names}", *rows]))
    capsys.readouterr()
    assert main(["info", "spectral.csv"]) == 0
    shown = capsys.readouterr().out
    assert "0, 1, 2, ..., 399 (400 in all)" in shown
    assert "1 to 2" in shown
    assert len(data_picture(read("spectral.csv")).subfigs[0].axes) == MOST_CHANNELS


def test_convert_and_simulate_write_csv(
    work: Path, capsys: pytest.CaptureFixture[str], coat_data: Measurements
) -> None:
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

    more = "\n[noise]\nrelative = 0.1\n[instrument]\ndetector_aperture = 2.0\n"
    (work / "noisy.toml").write_text((work / "coat.toml").read_text() + more)
    for name in ("coat", "noisy"):
        assert main(["simulate", "--stack", f"{name}.toml", "--out", f"{name}.csv"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "Not simulated: [noise], [instrument] of noisy.toml"
    np.testing.assert_array_equal(read("noisy.csv").values, read("coat.csv").values)
    assert "not simulated: [noise], [instrument] of noisy.toml" in read("noisy.csv").source.notes


SLOW = """
import sys
import numpy as np
from fits.cli.setting import use_jax

assert "jax" not in sys.modules, "XLA reads what it may print as it is loaded"
use_jax()
import jax

image, kernel = np.random.rand(1, 1, 170, 170), np.random.rand(4, 1, 21, 21)
folded = lambda x: x + jax.lax.conv_general_dilated(image, kernel, (1, 1), "SAME").sum()
jax.jit(folded).lower(1.0).compile()
"""
"""A constant that XLA folds for more than a second, of which it raises the alarm that it raises of slow programs."""


def test_alarms_of_the_compiler_are_not_shown(tmp_path: Path) -> None:
    environment = {
        name: value for name, value in os.environ.items() if name not in ("TF_CPP_MIN_LOG_LEVEL", "XLA_FLAGS")
    }
    environment["JAX_COMPILATION_CACHE_DIR"] = str(tmp_path)  # nothing is compiled yet
    run = subprocess.run([sys.executable, "-c", SLOW], capture_output=True, text=True, env=environment, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
