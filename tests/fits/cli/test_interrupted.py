"""Commands that are interrupted or killed, full disks, and processes that meet: what was kept stays, and is resumed."""

import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from fits import save_fit
from fits.cli.parser import main
from fits.optimise import multi_start as starts
from fits.reports.html import FitReport
from fits.store import Store
from tests.fits import kills
from tests.helpers.coats import make_folder
from tests.helpers.files import contents, largest_file, read_only
from tests.helpers.stores import keys
from tests.helpers.tasks import started, wait_until

FIT = ["fit", "data.csv", "--stack", "coat.toml", "--out", "result"]
MANY_STARTS = [*FIT, "--starts", "200"]
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
def test_commands_that_are_killed_resume_with_the_same_result():
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
    after = contents(work)
    after.pop(str(work / ".result.starts"))
    assert len(keys(Store.read(".result.starts"))) == 3
    assert after == before
    monkeypatch.setattr(starts, "rough_descent", pytest.fail)  # no start is run again
    monkeypatch.setattr(FitReport, "write", lambda *_: None)
    assert main(words) == 0
    assert not list(work.glob(".*"))


def test_an_interrupted_fit_exits_with_130_and_the_next_resumes_with_its_starts(work, capsys, monkeypatch):
    done = work / ".result.starts"
    with started(["-m", "fits.cli", *MANY_STARTS]) as process:
        wait_until(lambda: process.poll() is not None or (done.is_file() and len(keys(Store.read(done))) > 2))
        assert process.poll() is None, "it ended too soon"
        process.send_signal(signal.SIGSTOP)
        before = contents(work)
        assert f"result is in use by another process ({process.pid})" in refusal(MANY_STARTS, capsys)
        assert contents(work) == before
        process.send_signal(signal.SIGCONT)
        error = ""
        for _ in range(10):  # Python drops one that comes in a callback of the garbage collector
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                _, error = process.communicate(timeout=6)
                break
    assert process.returncode == 130
    words = "result was not written; the same command resumes with the starts that are done"
    assert error.splitlines()[-1] == f"layerjax: interrupted: {words}"
    assert not (work / "result").exists()
    kept = len(keys(Store.read(done)))
    assert 2 < kept < 200
    solve, solved = starts.rough_descent, []
    monkeypatch.setattr(starts, "rough_descent", lambda *given, **how: solved.append(how) or solve(*given, **how))
    monkeypatch.setattr(FitReport, "write", lambda *_: None)
    assert main(MANY_STARTS) == 0
    assert solved.count({}) == 200 - kept
    assert not list(work.glob(".*"))
    assert main([*MANY_STARTS[:-3], "whole", *MANY_STARTS[-2:]]) == 0
    for name in ("fit.json", "fitted.toml", "data.csv"):
        assert (work / "result" / name).read_bytes() == (work / "whole" / name).read_bytes()
