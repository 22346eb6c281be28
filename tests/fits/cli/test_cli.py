"""The `layerjax` command at work: every command writes and prints what it should; flags that are named are its own."""

import ast
import contextlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fits
import layerjax as lj
from fits import load_fit, load_posterior, progress, read, save_fit, slices
from fits.cli import commands
from fits.cli.arguments import COMMANDS, build_parser
from fits.cli.parser import main
from fits.engines import run
from fits.maps.store import FLAGS
from fits.progress import show_progress
from fits.reports.html import FitReport
from tests.helpers import tasks
from tests.helpers.coats import TRUE, make_folder
from tests.helpers.commands import refused
from tests.helpers.painted_maps import numbers, stored, without
from tests.helpers.places import ROOT

EVERY = [name for one in COMMANDS.values() for name in (*one.particular, *one.shared.split())]
OTHERS = {"--help", "--version", "--traceback", "--nthreads"}  # those of the parser itself, and of `dask worker`
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "guides").glob("*.md"))]
SHOWN = [
    (page, line)
    for page in PAGES
    for block in re.findall(r"```(?:\{code-block\} )?sh\n(.*?)```", page.read_text().replace("\\\n", " "), re.DOTALL)
    for line in re.split(r"\n|&&", block)
    if line.split()[:1] == ["layerjax"]
]
WORDS = ["fit-map", "map.npy", "--geometry", "view.csv", "--stack", "coat.toml", "--out", "coat.zarr"]
HELP = """
import contextlib, os, sys
from fits.cli import main
from fits.cli.arguments import COMMANDS, build_parser
from fits.cli.input_output import use_jax
for words in ([], *([name] for name in COMMANDS)):
    with contextlib.suppress(SystemExit):
        main([*words, "--help"])
import fits.data.formats
assert "jax" not in sys.modules
use_jax()
assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"  # XLA reads what it may print as it is loaded: it is told before
"""


def test_fit_writes_a_result(work, capsys, coat_toml, layerjax):
    words = "fit data.csv --stack coat.toml --out result --starts 4"
    output = layerjax(f"{words} --max-polar-angle 80")
    for word in (*TRUE["coated.csv"], "chi2/dof", "4 starts", "result/report.html", "fit 4/4"):
        assert word in output.out + output.err
    result = load_fit("result")
    assert result.problem.data.used().theta_o.max() <= 80
    for name, truth in TRUE["coated.csv"].items():
        assert abs(result.values[name] - truth) < 4 * result.standard_errors[name]
    assert (work / "result" / "problem.toml").read_text() == coat_toml.read_text()
    stored = json.loads((work / "result" / "fit.json").read_text())
    assert (stored["values"], stored["fit"]["settings"]["seed"]) == (result.values, 0)
    assert "low" not in (work / "result" / "fitted.toml").read_text()
    assert "data:image/png;base64," in (work / "result" / "report.html").read_text()
    assert "--force" in refused(words.split(), capsys, work)


def test_results_are_compared(work, capsys, coat_fit, layerjax):
    root = fits.Problem(coat_fit.problem.stack, coat_fit.problem.data, objective="cube_root")
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


def test_info_says_what_is_there_and_draws_it(work, layerjax):
    output = layerjax("info data.csv --out data.png").out
    for word in ("csv", "brdf", "10°", "50°", "sigma", "median 3.00%"):
        assert word in output
    assert (work / "data.png").read_bytes().startswith(b"\x89PNG")
    (work / "data.png").write_bytes(b"precious")
    ascii_only = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    with contextlib.redirect_stdout(ascii_only):  # a terminal without a sign gets a question mark
        assert main(["info", "data.csv"]) == 0
    output = ascii_only.buffer.getvalue().decode("ascii")
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


def test_help_and_reading_need_no_jax_whose_alarms_are_not_shown() -> None:
    environment = {name: word for name, word in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    words = [sys.executable, "-c", HELP]
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert all(flag in done.stdout for flag in EVERY)


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


def test_messages_name_flags_that_exist_and_these_are_few():
    assert sum(name.startswith("--") for name in EVERY) < 91
    unknown = [
        (flag, path.name)
        for path in sorted((ROOT / "fits").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]+", node.value)
        if flag not in OTHERS.union(EVERY)
    ]
    assert not unknown


@pytest.mark.parametrize(("page", "line"), [pytest.param(*one, id=f"{one[0].stem}-{k}") for k, one in enumerate(SHOWN)])
def test_commands_of_pages_are_understood(page, line):
    words = shlex.split(line, comments=True)[1:]
    build_parser().parse_args(["rgl" if word == "FORMAT" else word for word in words])


def made(path, failing=0, chunks=None):
    """A store of ten texels: two masked, eight fitted, all but so many of these converged; or only its first chunks."""
    arrays, place = numbers((2, 5)), np.arange(10.0).reshape(2, 5)
    arrays["values/base.albedo"] = place.copy()
    arrays["flags"][place < failing] &= ~np.uint16(FLAGS["converged"])
    without(arrays, place >= 8, "masked")
    shutil.rmtree(path, ignore_errors=True)
    return stored(path, arrays, (1, 5), chunks=chunks)


@pytest.fixture
def fit_map(work, monkeypatch):
    """The command with further words, and a map that is made up: its exit code, and what `fits.fit_map` is given."""

    def run(words="", **state):
        given = {}

        def made_up(*arguments, options, **rest):
            given.update(zip(("stack", "geometry", "values", "out"), arguments, strict=True), **rest)
            given["options"] = replace(options, progress=None)
            options.progress("texels", 5, 10)
            return made(work / "found.zarr", **state)

        monkeypatch.setattr("fits.maps.fit_map.fit_map", made_up)
        return main([*WORDS, *words.split()]), given

    return run


def test_defaults_and_options_of_fit_map_arrive(work, fit_map):
    code, given = fit_map()
    assert (code, given.pop("options")) == (0, fits.MapOptions())
    assert isinstance(given.pop("stack"), lj.Stack)
    assert isinstance(given.pop("transport"), lj.SingleScattering)
    places = {"geometry": "view.csv", "values": "map.npy", "out": "coat.zarr", "sigma": None, "mask": None}
    assert given == {**places, "noise": fits.Noise(), "client": None}
    # the stack file says what no option does
    more = "[noise]\nrelative = 0.1\ntails = 'student'\n[scale]\nstart = 1\nlow = 0.8\nhigh = 1.2\n"
    (work / "coat.toml").write_text((work / "coat.toml").read_text() + more)
    _, given = fit_map(
        "--sigma sigma.npy --mask mask.npy --noise 0.02 --starts 3 --seed 5 --pilot-texels 9 --chunk-size 100 --force "
        "--processes 3 --emulator never --spatial-prior gaussian --spatial-scale 0.1"
    )
    counts = {"starts": 3, "seed": 5, "pilot_texels": 9, "chunk_size": 100, "processes": 3}
    more = {"emulator": False, "force": True, "spatial_prior": fits.SpatialPrior("gaussian", 0.1)}
    assert given["options"] == fits.MapOptions(scale=fits.Free(1, 0.8, 1.2), **counts, **more)
    assert (given["sigma"], given["mask"]) == ("sigma.npy", "mask.npy")
    assert given["noise"] == fits.Noise(0.02, tails="student")
    _, given = fit_map("--scheduler tcp://10.0.0.1:8786 --emulator always")
    assert given["client"] == "tcp://10.0.0.1:8786"
    assert given["options"].emulator


def test_what_was_found_is_printed_and_a_map_that_did_not_converge_is_doubtful(fit_map, capsys):
    assert fit_map()[0] == 0
    output = capsys.readouterr()
    rows = {line.split("  ")[0].strip(): line.split() for line in reversed(output.out.splitlines()) if line.strip()}
    assert "A map of 10 texels: 8 are fitted, 2 masked.\n100 % of the fitted texels converged." in output.out
    assert rows["base.albedo"][1:4] == ["1.75", "3.5", "5.25"]  # quartiles of 0 to 7
    assert rows["layers[0].f0"] == ["layers[0].f0", "0.04321", "0.00012", "1"]
    assert "layerjax report coat.zarr" in output.out
    assert "texels 5/10" in output.err
    assert fit_map(failing=1)[0] == fit_map(chunks=1)[0] == 1
