"""Bad input and bad usage of `layerjax`: one line on stderr, exit code 2, and nothing written."""

import shutil
from unittest.mock import Mock

import jax
import pytest

from fits.cli.commands import COMMANDS
from fits.cli.parser import main
from fits.reports.results import save_fit
from tests.helpers.commands import refused
from tests.helpers.files import contents

FIT = "fit data.csv --stack coat.toml --out result"

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
    ("fit-many scans", "no stack is given"),
)


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
        command = f"{command} --out out"
    assert fragment in refused(command.split(), capsys, work)


MAP, MANY = "fit-map map.npy --stack coat.toml --out coat.zarr", "fit-many scans --stacks coat.toml --out out"


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


def test_a_cluster_that_is_not_there_is_named(work, capsys):
    dask = pytest.importorskip("dask")
    pytest.importorskip("distributed")
    words = ["fit-many", "data.csv", "--stacks", "coat.toml", "--out", "out", "--scheduler", "tcp://127.0.0.1:9"]
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        assert main(words) == 2
    assert "tcp://127.0.0.1:9: there is no scheduler" in capsys.readouterr().err.splitlines()[-1]


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
