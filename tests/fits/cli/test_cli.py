"""The `layerjax` command: bad input is one line and exit code 2 with nothing written; good input does the work."""

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

import jax
import numpy as np
import pytest

from fits.cli import commands
from fits.cli.interrupts import raised_again
from fits.cli.parser import main
from fits.optimise.result import Fit
from fits.problem.problem import Problem
from fits.reports.results import load_fit, load_posterior, save_fit
from tests.helpers.commands import refused
from tests.helpers.files import contents
from tests.helpers.places import ROOT

TRUE_ALBEDO, TRUE_THICKNESS = 0.4, 0.6  # of the stack behind coat_data
HEADER = "theta_i,phi_i,theta_o,phi_o,brdf\n"
ROWS = "10,180,20,0,0.1\n10,180,30,0,0.1\n10,180,40,0,0.1\n"

FIT = ["fit", "data.csv", "--stack", "coat.toml", "--out", "result"]

BAD_DATA = {
    "missing column": ("theta_i,phi_i,theta_o,phi_o\n10,180,20,0\n", "brdf"),
    "missing angle": ("theta_i,phi_i,theta_o,brdf\n10,180,20,0.1\n", "phi_o"),
    "text in a number": (HEADER + "10,180,twenty,0,0.1\n", "twenty"),
    "nothing but NaN": (HEADER + "10,180,20,0,nan\n", "no data point below holds a number"),
    "angle of NaN": (HEADER + "10,180,nan,0,0.1\n", "nan"),
    "too large": (HEADER + "10,180,20,0,1e300\n", "1e300"),
    "angle outside its range": (HEADER + "10,180,200,0,0.1\n", "200"),
    "empty file": ("", "empty"),
    "header only": (HEADER, "no samples"),
    "short row": (HEADER + "10,180,20,0\n", "4 cells"),
}


@pytest.mark.parametrize(("text", "word"), BAD_DATA.values(), ids=BAD_DATA)
@pytest.mark.parametrize("command", ["fit", "info", "convert"])
def test_bad_data_is_named(work: Path, capsys: pytest.CaptureFixture[str], text: str, word: str, command: str) -> None:
    (work / "bad.csv").write_text(text)
    options = {
        "fit": ["--stack", "coat.toml", "--out", "result"],
        "info": ["--out", "bad.png"],
        "convert": ["good.csv"],
    }
    message = refused([command, "bad.csv", *options[command]], capsys, work)
    assert "bad.csv" in message
    assert word in message


def test_a_truncated_binary_is_named(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (work / "short.binary").write_bytes(np.array([90, 90, 180], "<i4").tobytes() + b"\0" * 1000)
    assert "short.binary" in refused(["info", "short.binary"], capsys, work)


BAD_STACKS = {
    "unknown key": ("thicknes = 1.0", "thicknes"),
    "bounds the wrong way round": ("thickness = { start = 1.0, low = 5.0, high = 0.05 }", "low"),
    "start outside its bounds": ("thickness = { start = 9.0, low = 0.05, high = 5.0 }", "start"),
    "outside the range of the field": ("thickness = -1.0", "thickness"),
    "not TOML": ("thickness = = 1", "TOML"),
}


@pytest.mark.parametrize(("line", "word"), BAD_STACKS.values(), ids=BAD_STACKS)
@pytest.mark.parametrize("command", ["fit", "simulate"])
def test_a_bad_stack_is_named(
    work: Path, capsys: pytest.CaptureFixture[str], line: str, word: str, command: str
) -> None:
    lines = (work / "coat.toml").read_text().splitlines()
    (work / "bad.toml").write_text("\n".join(line if old.startswith("thickness") else old for old in lines))
    words = {
        "fit": ["fit", "data.csv", "--stack", "bad.toml", "--out", "result"],
        "simulate": ["simulate", "--stack", "bad.toml", "--out", "new.csv"],
    }
    message = refused(words[command], capsys, work)
    assert "bad.toml" in message
    assert word in message


def test_a_layer_that_the_transport_cannot_carry_is_named(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    interface = '[[layers]]\nkind = "Interface"\nior = { start = 1.5, low = 1.2, high = 2.0 }\nalpha = 0.1\n'
    (work / "rough.toml").write_text('transport = "SingleScattering"\n' + interface)
    message = refused(["fit", "data.csv", "--stack", "rough.toml", "--out", "result"], capsys, work)
    assert "Interface" in message


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["info", "nowhere.csv"], "nowhere.csv"),
        (["info", "."], "."),
        (["fit", "data.csv", "--stack", "nowhere.toml", "--out", "result"], "nowhere.toml"),
        (["fit", "data.csv", "--stack", "coat.toml", "--out", "no/such/result"], "no/such"),
        (["fit", "data.csv", "--stack", "coat.toml", "--out", "."], "not a result directory"),
        (["fit", "data.csv", "--stack", "coat.toml", "--out", ".", "--force"], "not a result directory"),
        (
            ["fit", "data.csv", "--stack", "coat.toml", "--out", "x", "--sample", "--objective", "cube_root"],
            "cube_root",
        ),
        (["fit", "data.csv", "--stack", "coat.toml", "--out", "x", "--mask-grazing", "1"], "no sample"),
        ([*FIT, "--ess", "100"], "--ess is given without --sample"),
        ([*FIT, "--allow-unconverged"], "--allow-unconverged is given without --sample"),
        ([*FIT, "--no-surrogate"], "--no-surrogate is given without --sample"),
        ([*FIT, "--sample", "--walkers", "7"], "walkers is 7; it must be even and at least 6 for 2 parameters"),
        ([*FIT, "--sample", "--max-steps", "5"], "max_steps is 5; it must be at least 100"),
        (["convert", "data.csv", "data.csv"], "--force"),
        (["convert", "data.csv", "data.bsdf"], ".csv"),
        (["simulate", "--stack", "coat.toml", "--out", "data.csv"], "--force"),
        (["simulate", "--stack", "coat.toml", "--incidence", "95.5", "200", "--out", "new.csv"], "200"),
        (["info", "data.csv", "--out", "coat.toml"], "--force"),
        (["sample", "."], "fit.json"),
        (["report", "nowhere"], "nowhere"),
        (["compare", "."], "two or more"),
        (["compare", ".", "nowhere"], "fit.json"),
    ],
)
def test_other_bad_input_is_named(
    work: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert message in refused(words, capsys, work)


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["fot"],
        ["fit", "data.csv"],
        ["fit", "data.csv", "--stack", "coat.toml", "--out", "x", "--starts", "0"],
        ["fit", "data.csv", "--stack", "coat.toml", "--out", "x", "--mask-retro", "nan"],
        ["fit", "data.csv", "--stack", "coat.toml", "--out", "x", "--objective", "chi"],
        ["simulate", "--stack", "coat.toml", "--out", "x.csv", "--noise", "-1"],
    ],
)
def test_bad_usage_exits_with_2(work: Path, capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    before = contents(work)
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert contents(work) == before
    assert "error: " in capsys.readouterr().err


def test_fit_writes_a_result(work: Path, capsys: pytest.CaptureFixture[str], coat_toml: Path) -> None:
    words = ["fit", "data.csv", "--stack", "coat.toml", "--out", "result", "--starts", "4"]
    assert main([*words, "--mask-grazing", "80"]) == 0
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
    assert stored["settings"] == {"starts": 4, "seed": 0, "solver": "least_squares"}
    assert "low" not in (work / "result" / "fitted.toml").read_text()
    assert {"model.png", "maps.png", "residuals.png", "report.html"} <= {path.name for path in Path("result").iterdir()}
    assert "--force" in refused([*words], capsys, work)


def test_the_objective_can_be_chosen(work: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["fit", "data.csv", "--stack", "coat.toml", "--out", "root", "--starts", "1", "--objective", "cube_root"]
    assert main(words) == 0
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


def test_sampling_goes_on_until_it_is_enough(work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit) -> None:
    save_fit(coat_fit, "result")
    words = ["sample", "result", "--walkers", "8", "--seed", "3"]
    assert main([*words, "--max-steps", "100", "--no-surrogate"]) == 1
    assert "no estimates yet" in capsys.readouterr().out
    assert not (work / "result" / "summary.json").exists()
    posterior = load_posterior("result")
    assert posterior is not None
    assert posterior.chain.shape[:2] == (100, 8)
    with pytest.raises(ValueError, match="too short"):
        posterior.summary()
    assert "no estimates yet" in (work / "result" / "report.html").read_text()
    assert "--walkers" in refused(["sample", "result", "--walkers", "10"], capsys, work)

    assert main(["sample", "result", "--max-steps", "5000"]) == 0  # the chain's own walkers and seed
    assert "effective samples" in capsys.readouterr().out
    summary = (work / "result" / "summary.json").read_text()
    longer = load_posterior("result")
    assert longer is not None
    np.testing.assert_array_equal(longer.chain[:100], posterior.chain)
    for entry in json.loads(summary)["parameters"]:
        assert abs(entry["mean"] - coat_fit.values[entry["name"]]) < coat_fit.standard_errors[entry["name"]]
        assert entry["low_68"] < entry["median"] < entry["high_68"]
    text = (work / "result" / "report.html").read_text()
    assert text.count("data:image/png") == 7  # stack, curves, maps, residuals, correlation, corner, trace
    assert main(["sample", "result"]) == 0
    assert (work / "result" / "summary.json").read_text() == summary
    assert main(["sample", "result", "--ess", "1000000", "--max-steps", str(len(longer.chain))]) == 1
    assert f"layerjax sample result --ess 1000000 --max-steps {2 * len(longer.chain)}" in capsys.readouterr().out
    assert "(surrogate differs)" in refused(["sample", "result", "--surrogate"], capsys, work)


def test_sampling_with_a_surrogate_says_so(work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit) -> None:
    save_fit(coat_fit, "result")
    assert main(["sample", "result", "--walkers", "16", "--ess", "2000", "--surrogate"]) == 0
    shown = capsys.readouterr()
    assert "The sampler: proposals from a surrogate of degree" in shown.out
    assert "layerjax: surrogate" in shown.err
    assert "proposals from a surrogate" in (work / "result" / "report.html").read_text()
    assert "proposals from a surrogate" in json.loads((work / "result" / "summary.json").read_text())["status"]
    assert main(["sample", "result"]) == 0


def test_an_interrupted_sampler_says_how_to_go_on(
    work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    save_fit(coat_fit, "result")
    monkeypatch.setattr("fits.sampling.sample.sample", interrupted)
    assert main(["sample", "result"]) == 130
    assert "`layerjax sample result` goes on with it" in capsys.readouterr().err


def test_a_terminal_that_lacks_a_sign_gets_a_question_mark(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    process = subprocess.Popen(
        [*command, "--starts", "100000", "--solver", "bounded"], stderr=subprocess.PIPE, text=True, env=environment
    )
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
        "layerjax: interrupted: result was not written; the same command again goes on with the starts that are done"
    )
    after = contents(work)
    assert len(after.pop(str(work / ".result.starts")).splitlines()) > 1  # what it is of, and at least one start
    assert after == before


LACKING = {
    "memory": (MemoryError("Unable to allocate 74.5 GiB"), "memory is not enough: Unable to allocate 74.5 GiB"),
    "memory, unsaid": (MemoryError(), "memory is not enough: MemoryError"),
    "JAX's memory": (
        jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory\nallocating 9 bytes."),
        "memory is not enough: RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.",
    ),
    "size": (OverflowError("cannot convert float infinity to integer"), "a number is too large: cannot convert"),
}


@pytest.mark.parametrize(("error", "words"), LACKING.values(), ids=LACKING)
def test_what_the_machine_lacks_is_one_line(
    work: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, error: Exception, words: str
) -> None:
    def fails(_: object) -> int:
        raise error

    monkeypatch.setattr(commands, "info", fails)
    assert words in refused(["info", "data.csv"], capsys, work)


def test_a_fault_of_the_program_has_its_traceback(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "info", lambda _: {}["nothing"])
    with pytest.raises(KeyError):
        main(["info", "data.csv"])
