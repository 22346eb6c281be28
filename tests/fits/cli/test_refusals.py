"""Bad input and usage, interrupts, full disks and a second process: one line, nothing is lost, and work is resumed."""

import shutil
import sys
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest

from fits import save_fit
from fits._files import locked
from fits.cli.commands import COMMANDS
from fits.cli.parser import main
from fits.optimise import multi_start as starts
from fits.reports.html import FitReport
from fits.store import Store
from tests.helpers import kills
from tests.helpers.coats import make_folder
from tests.helpers.commands import refused
from tests.helpers.files import contents, largest_file, read_only
from tests.helpers.stores import keys

FIT, MANY = "fit data.csv --stack coat.toml --out result", "fit-many scans --stacks coat.toml --out out"
MAP = "fit-map map.npy --geometry view.csv --stack coat.toml --out coat.zarr"

REFUSALS = (
    ("info nowhere.csv", "nowhere.csv"),
    ("info data.csv --out data.csv", "pictures can be written as .png only"),
    ("info data.csv --read csv", "'csv' is no option of a reader; it must be format=..., quantity=..., bins=..."),
    ("info data.csv --read format=csv format=csv", "format is given twice"),
    ("info data.csv --read corrected=maybe", "wavelengths and corrected apply to rxt files only"),
    ("info bad.csv", "bad.csv, line 2, column 'theta_o': 'twenty'"),
    ("fit data.csv --stack bad.toml --out result", "bad.toml: layers[0] has an unknown key 'thicknes'"),
    ("fit data.csv --stack nowhere.toml --out result", "nowhere.toml"),
    ("fit data.csv --stack coat.toml --out no/such/result", "no/such"),
    ("fit data.csv --stack coat.toml --out . --force", "not a result directory"),
    (f"{FIT} --max-polar-angle 1", "no sample"),
    (f"{FIT} --hold-out incidence=10,50", "--select and --hold-out leave nothing to fit"),
    (f"{FIT} --select incidence=10 --hold-out incidence=50", "--hold-out leaves nothing to score"),
    (f"{FIT} --hold-out channels=value", "the parameters of a channel cannot be predicted from others"),
    ("fit data.csv --stack root.toml --out result --hold-out incidence=10", "needs the objective 'likelihood'"),
    ("convert data.csv data.bsdf", ".csv"),
    ("simulate --stack coat.toml --out data.csv", "--force"),
    ("simulate --stack coat.toml --incidence 20,95.5 --out new.csv", "a light at 95.5 degrees sees nothing"),
    ("sample .", "fit.json"),
    ("report nowhere", "nowhere"),
    ("compare .", "it holds no fit.json"),
    ("predict saved --incidence 30 --score data.csv", "predict needs one of --incidence and --score"),
    ("predict saved --incidence 30", "predict --incidence needs --out FILE"),
    ("predict saved --incidence 30 --out new.txt", ".csv"),
    ("predict saved --incidence 30 --out new.csv --select azimuth=0", "--select is given without --score"),
    ("predict saved --score data.csv --azimuth 90", "--azimuth is given without --incidence"),
    ("render fabrik --out a.png", "neither a .toml file nor a material of the gallery: brushed_aluminium"),
    (MAP.replace("map.npy", "nowhere.npy"), "nowhere.npy: no such file"),
    (MAP.replace("map.npy", "."), "layerjax fit-many"),
    (MAP.replace("view.csv", "coat.toml"), "coat.toml, line"),
    (MAP.replace("coat.zarr", "file.zarr"), "file.zarr: is no store of a fitted map"),
    (MAP.replace("coat.zarr", "coat.h5"), "coat.h5: a fitted map can be written as .zarr only"),
    (f"{MAP} --spatial-prior gaussian", "--spatial-prior needs --spatial-scale"),
    ("fit-many scans --out out", "no stack is given"),
)
FIT_MANY = ["fit-many", "scans", "--stacks", "bare.toml", "--out", "out", "--starts", "2", "--processes", "1"]


@pytest.mark.parametrize(("command", "fragment"), REFUSALS)
def test_refusals(work, capsys, coat_fit, command, fragment):
    (work / "bad.csv").write_text("theta_i,theta_o,brdf\n10,twenty,0.1\n")
    (work / "bad.toml").write_text((work / "coat.toml").read_text().replace("thickness", "thicknes"))
    (work / "root.toml").write_text('objective = "cube_root"\n' + (work / "coat.toml").read_text())
    if "saved" in command:
        save_fit(coat_fit, "saved")
    if "fit-many" in command:
        (work / "scans").mkdir()
        shutil.copy("data.csv", "scans")
    if "fit-map" in command:
        np.save(work / "map.npy", np.ones((5, 1)))
        (work / "view.csv").write_text("theta_i,phi_i,theta_o,phi_o\n10,180,20,0\n")
        (work / "file.zarr").touch()
    assert fragment in refused(command.split(), capsys, work)


@pytest.mark.parametrize(
    ("command", "fragment"),
    [
        ("", "COMMAND"),
        ("fot", "invalid choice: 'fot'"),
        ("fit data.csv", "required: --out, --stack"),
        (FIT.replace("--stack", "--stakc"), "layerjax fit: error: unrecognized argument: --stakc; is it --stack?"),
        (f"{FIT} --zzz=here", "unrecognized argument: --zzz (see layerjax fit --help)"),
        (f"{FIT} --starts 0", "0 given, must be a whole number >= 1"),
        (f"{FIT} --min-retro-angle nan", "nan given, must be a number in [0, 90]"),
        ("simulate --stack coat.toml --incidence 95.5,200 --out x.csv", "200 given, must be a number in [0, 180]"),
        ("simulate --stack coat.toml --azimuth 0,x --out x.csv", "'x' given, must be a number in [-360, 360]"),
        ("export coat.toml --to rgl --wavelengths 4,1e300 --out x", "1e300 given, must be a number in [1, 1e+09]"),
        (f"{MANY} --processes 2 --scheduler tcp://x:1", "--scheduler: not allowed with argument --processes"),
        (f"{MAP} --spatial-prior wide", "invalid choice: 'wide'"),
        (f"{MAP} --spatial-scale x", "'x' given, must be a number >= 0"),
    ],
)
def test_bad_usage(work, capsys, command, fragment):
    before = contents(work)
    with pytest.raises(SystemExit) as stop:
        main(command.split())
    error = capsys.readouterr().err
    assert (stop.value.code, error.count("\n"), contents(work)) == (2, 1, before)
    assert "error: " in error
    assert fragment in error


def test_a_cluster_that_is_not_there_is_named(work, layerjax):
    dask = pytest.importorskip("dask")
    pytest.importorskip("distributed")
    words = "fit-many data.csv --stacks coat.toml --out out --scheduler tcp://127.0.0.1:9"
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        said = layerjax(words, 2).err
    assert "tcp://127.0.0.1:9: there is no scheduler" in said.splitlines()[-1]


def test_errors_of_the_machine_are_one_line_and_those_of_the_program_have_their_traceback(work, capsys, monkeypatch):
    for error, fragment in (
        (MemoryError(), "memory is not enough: MemoryError"),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of\nmemory"), "enough: RESOURCE_EXHAUSTED: Out of memory"),
        (OverflowError("cannot convert float infinity to integer"), "a number is too large: cannot convert"),
    ):
        monkeypatch.setitem(COMMANDS, "info", Mock(side_effect=error))
        assert fragment in refused(["info", "data.csv"], capsys, work)
    monkeypatch.setitem(COMMANDS, "info", Mock(side_effect=KeyError))
    with pytest.raises(KeyError):
        main(["info", "data.csv"])


def refusal(words, capsys):
    """The one error line of a command that must fail, after what it says of its progress."""
    assert main(words) == 2
    *progress, error = capsys.readouterr().err.splitlines()
    assert error.startswith("layerjax: error: ")
    assert not any("error" in line for line in progress)
    return error


@pytest.mark.parametrize(
    ("place", "words", "hint"),
    [
        (
            "fits.batch.fit_file",
            FIT.replace("result", "new").split(),
            "new was not written; the same command resumes with the starts",
        ),
        ("fits.sampling.sample.sample", ["sample", "result"], "the chain is kept, `layerjax sample result` resumes it"),
        ("fits.batch.fit_one", FIT_MANY, "out keeps what was fitted; the same command resumes it"),
        ("fits.maps.fit_map.fit_map", MAP.split(), "coat.zarr keeps what was fitted; the same command resumes it"),
        ("fits.structure_search.search", ["search", "data.csv", "--out", "out"], "out keeps what was fitted"),
    ],
)
def test_an_interrupt_says_how_to_resume(work, capsys, coat_fit, monkeypatch, place, words, hint):
    save_fit(coat_fit, "result")
    make_folder(work)
    monkeypatch.setattr(place, Mock(side_effect=KeyboardInterrupt))
    assert main(words) == 130
    assert hint in capsys.readouterr().err
    assert (work / "out" / "table.csv").is_file() == (words is FIT_MANY)


@pytest.mark.slow
@pytest.mark.parametrize("name", kills.COMMANDS)
def test_a_command_that_is_killed_resumes_with_the_same_result(monkeypatch, name):
    monkeypatch.setattr(kills, "COMMANDS", {name: kills.COMMANDS[name]})
    assert kills.main(1) == 0


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("convert data.csv out.csv --force", "out.csv"),
        ("info data.csv --out out.png --force", "out.png"),
        ("report one", "one/report.html"),
        ("sample one", "one/chain.db"),
    ],
)
def test_a_full_disk_is_one_line_and_changes_nothing(work, capsys, coat_fit, words, name):
    save_fit(coat_fit, "one")
    for output in ("out.csv", "out.png", "one/report.html"):
        (work / output).write_text("precious")
    before = contents(work)
    with largest_file(6_000):
        error = refusal(words.split(), capsys)
    assert error.startswith(f"layerjax: error: {name}: ")
    assert error.endswith(("file too large", "quota allows"))
    after = contents(work)
    assert (after.pop(str(work / "one" / "chain.db"), b""), after) == (b"", before)


def test_a_full_disk_behind_stdout_is_one_line(work, capsys, monkeypatch):
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    with open("/dev/full", "w") as full:  # closing it fails if anything is left to be written
        monkeypatch.setattr(sys, "stdout", full)
        assert "No space left on device" in refusal(["convert", "data.csv", "out.csv"], capsys)


def test_the_report_of_a_result_that_can_only_be_read_goes_elsewhere(work, capsys, coat_fit, monkeypatch):
    monkeypatch.setattr(FitReport, "page", lambda _: "drawn")
    save_fit(coat_fit, "result")
    with read_only(work / "result"):
        assert refusal(["report", "result"], capsys).startswith("layerjax: error: result/report.html: ")
        assert main(["report", "result", "--out", "report.html"]) == 0
        assert "chain.db.lock: " in refusal(["sample", "result"], capsys)
    assert (work / "report.html").read_text() == "drawn"
    assert "--force" in refusal(["report", "result", "--out", "report.html"], capsys)


def test_a_fit_on_a_full_disk_keeps_its_starts_and_the_earlier_result(work, capsys, coat_fit, monkeypatch):
    save_fit(coat_fit, "result")
    before = contents(work)
    words = [*FIT.split(), "--starts", "3", "--force"]
    with largest_file(30_000):
        assert refusal(words, capsys) == "layerjax: error: result/report.html: file too large"
    kept = (work / ".result.starts").read_bytes()
    assert len(keys(Store.read(".result.starts"))) == 3
    with locked(work / ".result.lock", "result"):
        assert "result is in use by another process" in refusal(words, capsys)
    assert contents(work) == {**before, str(work / ".result.starts"): kept}
    monkeypatch.setattr(starts, "rough_descent", pytest.fail)  # no start is run again
    monkeypatch.setattr(FitReport, "write", lambda *_: None)
    assert main(words) == 0
    assert not list(work.glob(".*"))
