"""Commands that are interrupted or killed, full disks, and a second process: what was kept stays, and is resumed."""

import sys
from pathlib import Path

import pytest

from fits import save_fit
from fits._files import locked
from fits.cli.parser import main
from fits.optimise import multi_start as starts
from fits.reports.html import FitReport
from fits.store import Store
from tests.helpers import kills
from tests.helpers.coats import make_folder
from tests.helpers.files import contents, largest_file, read_only
from tests.helpers.stores import keys

FIT = ["fit", "data.csv", "--stack", "coat.toml", "--out", "result"]
FIT_MAP = ["fit-map", "map.npy", "--geometry", "view.csv", "--stack", "coat.toml", "--out", "coat.zarr"]
FIT_MANY = ["fit-many", "scans", "--stacks", "bare.toml", "--out", "out", "--starts", "2", "--processes", "1"]


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
        ("fits.batch.fit_file", [*FIT[:-1], "new"], "new was not written; the same command resumes with the starts"),
        ("fits.sampling.sample.sample", ["sample", "result"], "the chain is kept, `layerjax sample result` resumes it"),
        ("fits.batch.fit_one", FIT_MANY, "out keeps what was fitted; the same command resumes it"),
        ("fits.maps.fit_map.fit_map", FIT_MAP, "coat.zarr keeps what was fitted; the same command resumes it"),
        ("fits.structure_search.search", ["search", "data.csv", "--out", "out"], "out keeps what was fitted"),
    ],
)
def test_an_interrupt_says_how_to_resume(work, capsys, coat_fit, monkeypatch, place, words, hint):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    save_fit(coat_fit, "result")
    make_folder(work)
    monkeypatch.setattr(place, interrupted)
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
        (["convert", "data.csv", "out.csv", "--force"], "out.csv"),
        (["info", "data.csv", "--out", "out.png", "--force"], "out.png"),
        (["report", "one"], "one/report.html"),
        (["sample", "one"], "one/chain.db"),
    ],
    ids=["convert", "info", "report", "sample"],
)
def test_a_full_disk_is_one_line_and_changes_nothing(work, capsys, coat_fit, words, name):
    save_fit(coat_fit, "one")
    for output in ("out.csv", "out.png", "one/report.html"):
        (work / output).write_text("precious")
    before = contents(work)
    with largest_file(6_000):
        error = refusal(words, capsys)
    assert error.startswith(f"layerjax: error: {name}: ")
    assert error.endswith(("file too large", "quota allows"))
    after = contents(work)
    assert after.pop(str(work / "one" / "chain.db"), b"") == b""
    assert after == before


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
    words = [*FIT, "--starts", "3", "--force"]
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
