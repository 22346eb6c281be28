"""`layerjax fit-many`: what it prints, how it ends, and that its results are those of `layerjax fit`."""

import csv
from pathlib import Path

import pytest

from fits.cli.parser import main
from fits.reports.results import load_fit
from tests.helpers.coats import make_folder
from tests.helpers.commands import refused

MANY = ["fit-many", "scans", "--stacks", "bare.toml", "--out", "out", "--starts", "2", "--processes", "1"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    make_folder(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_folder_is_fitted_and_told_of(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "scans" / "coated.csv").unlink()
    assert main([*MANY, "--max-polar-angle", "80"]) == 1  # one file is broken
    output = capsys.readouterr()
    for words in ("broken.csv", "failed", "paint.csv", "1 of 2 fits are there", "out/table.csv", "out/report.html"):
        assert words in output.out
    assert "layerjax: fits 2/2" in output.err
    assert (
        main(
            [
                "fit",
                "scans/paint.csv",
                "--stack",
                "bare.toml",
                "--out",
                "alone",
                "--starts",
                "2",
                "--max-polar-angle",
                "80",
            ]
        )
        == 0
    )
    own, alone = ({path.name for path in Path(at).iterdir()} for at in ("out/paint.csv/bare", "alone"))
    assert own == alone
    for name in ("fitted.toml", "problem.toml", "data.csv"):
        same = (folder / "out" / "paint.csv" / "bare" / name).read_text() == (folder / "alone" / name).read_text()
        assert same, name
    assert main(["compare", "out/paint.csv/bare", "alone", "--no-refit"]) == 0
    assert main(["predict", "out/paint.csv/bare", "--incidence", "20", "--out", "predicted.csv"]) == 0

    (folder / "scans" / "broken.csv").unlink()
    capsys.readouterr()
    assert main([*MANY, "--max-polar-angle", "80"]) == 0  # nothing is left to do
    assert "1 of 1 fits are there, 1 of them converged" in capsys.readouterr().out
    with open("out/table.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["base.albedo"]) == pytest.approx(load_fit("alone").values["base.albedo"])
    assert "starts 2, not 3" in refused([*MANY, "--max-polar-angle", "80", "--starts", "3"], capsys, folder)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("nowhere --stacks bare.toml", "nowhere: no such file or folder"),
        ("scans", "neither a stack nor a search is given"),
        ("scans/broken.csv --stacks bare.toml", "'twenty'"),
        ("scans --stacks bare.toml --select everything", "'everything' is no selection"),
        ("scans --stacks bare.toml --read strata=flux", "lookup and strata apply to MERL files only"),
        ("scans --stacks bare.toml --noise 0.1", "--noise is given without --search"),
        ("scans --stacks bare.toml --scale-sd 0", "--scale-sd is given without --search"),
    ],
)
def test_bad_input_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str], words: str, message: str) -> None:
    assert message in refused(["fit-many", *words.split(), "--out", "out"], capsys, folder)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*MANY[:-1], "0"], "must be a whole number >= 1"),
        ([*MANY, "--scheduler", "tcp://127.0.0.1:1"], "--scheduler: not allowed with argument --processes"),
    ],
)
def test_bad_usage(folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_a_cluster_that_is_not_there_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dask = pytest.importorskip("dask")
    pytest.importorskip("distributed")
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        assert main([*MANY[:-2], "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "tcp://127.0.0.1:9: there is no scheduler" in capsys.readouterr().err.splitlines()[-1]


def test_an_interrupt_says_how_to_resume(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fits.batch.fit_files.fit_one", interrupted)
    assert main(MANY) == 130
    assert "out keeps what was fitted; the same command resumes it" in capsys.readouterr().err
    assert (folder / "out" / "table.csv").is_file()
