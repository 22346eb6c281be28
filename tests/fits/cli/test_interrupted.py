"""Disks that fill up, processes that are killed or that meet, and damaged files: what was kept stays, and is seen."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from fits.cli.parser import main
from fits.optimise import multi_start as starts
from fits.optimise.result import Fit
from fits.reports.plots.data import data_picture
from fits.reports.results import load_fit, load_posterior, save_fit, save_posterior, writing
from fits.sampling.posterior import Posterior
from fits.sampling.sample import load, sample
from fits.store import Store
from tests.helpers.files import contents, largest_file, mounted, read_only
from tests.helpers.places import ROOT

MANY = {"walkers": 400, "seed": 1, "max_steps": 300, "ess": 1e6}  # a step is 9.6 kB
MANY_STARTS = ["fit", "data.csv", "--stack", "coat.toml", "--out", "result", "--starts", "200"]


def refusal(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one error line of a command that must fail, after what it says of its progress."""
    assert main(words) == 2
    *progress, error = capsys.readouterr().err.splitlines()
    assert error.startswith("layerjax: error: ")
    assert not any("error" in line for line in progress)
    return error


@contextmanager
def stopped(words: list[str], cache: Path, when: Callable[[], bool]) -> Iterator[subprocess.Popen]:
    """A `layerjax` command in a process of its own, held where it is once `when` is true, and killed in the end."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cache)}
    with subprocess.Popen([sys.executable, "-m", "fits.cli", *words], env=environment, text=True) as process:
        try:
            end = time.monotonic() + 100
            while not when():
                assert process.poll() is None, "it ended too soon"
                assert time.monotonic() < end, "it never got there"
                time.sleep(0.0005)
            process.send_signal(signal.SIGSTOP)
            yield process
        finally:
            process.kill()


@pytest.fixture(scope="module")
def many(result: Fit) -> Posterior:
    return sample(result, **MANY)


def assert_it_goes_on(result: Fit, path: Path, many: Posterior) -> None:
    """What was kept is the beginning of the chain of a run that was never interrupted, and grows into all of it."""
    kept = load(result, path)
    assert 0 < len(kept.chain) <= len(many.chain)
    np.testing.assert_array_equal(kept.chain, many.chain[: len(kept.chain)])
    np.testing.assert_array_equal(sample(result, path=path, **MANY).chain, many.chain)


def test_a_chain_survives_a_full_disk(result: Fit, many: Posterior, tmp_path: Path) -> None:
    path = tmp_path / "chain.db"
    with largest_file(1_500_000), pytest.raises(OSError, match="No space left") as error:
        sample(result, path=path, **MANY)
    assert error.value.filename == str(path)
    assert_it_goes_on(result, path, many)


def test_a_chain_on_a_small_disk_goes_on_with_more_room(result: Fit, many: Posterior, tmp_path: Path) -> None:
    with mounted(tmp_path, "-t", "tmpfs", "-o", "size=2m", "tmpfs"):
        with pytest.raises(OSError, match="No space left"):
            sample(result, path=tmp_path / "chain.db", **MANY)
        subprocess.run(["mount", "-o", "remount,size=20m", str(tmp_path)], check=True)
        assert_it_goes_on(result, tmp_path / "chain.db", many)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["convert", "data.csv", "out.csv", "--force"], "out.csv"),
        (["simulate", "--stack", "coat.toml", "--out", "out.csv", "--force"], "out.csv"),
        (["render", "coat.toml", "--size", "16", "--out", "out.png", "--force"], "out.png"),
        (["info", "data.csv", "--out", "out.png", "--force"], "out.png"),
        (["compare", "one", "two", "--out", "out.html", "--force"], "out.html"),
        (["report", "one"], "one"),
        (["sample", "one"], "one/chain.db"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_full_disk_is_one_line_and_changes_nothing(
    work: Path,
    capsys: pytest.CaptureFixture[str],
    coat_fit: Fit,
    words: list[str],
    name: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # any picture will do, and this one is drawn fast
    monkeypatch.setattr("fits.reports.render.render", lambda *_, **__: data_picture(coat_fit.problem.data))
    for directory in ("one", "two"):
        save_fit(coat_fit, directory)
    for output in ("out.csv", "out.png", "out.html", "one/report.html"):
        (work / output).write_text("precious")
    before = contents(work)
    with largest_file(6_000):
        error = refusal(words, capsys)
    assert error.startswith(f"layerjax: error: {name}: ")
    assert error.endswith(("file too large", "quota allows"))
    after = contents(work)
    assert after.pop(str(work / "one" / "chain.db"), b"") == b""
    assert after == before


def test_a_full_disk_behind_stdout_is_one_line(
    work: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    with open("/dev/full", "w") as full:  # closing it fails if anything is left to be written
        monkeypatch.setattr(sys, "stdout", full)
        assert "No space left on device" in refusal(["convert", "data.csv", "out.csv"], capsys)


def test_the_report_of_a_result_that_can_only_be_read_goes_elsewhere(
    work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit
) -> None:
    save_fit(coat_fit, "result")
    with read_only(work / "result"):
        assert "(--out FILE writes the report elsewhere)" in refusal(["report", "result"], capsys)
        assert main(["report", "result", "--out", "report.html"]) == 0
        assert "chain.db.lock: " in refusal(["sample", "result"], capsys)
    assert "</html>" in (work / "report.html").read_text()
    assert "--force" in refusal(["report", "result", "--out", "report.html"], capsys)


def test_a_fit_on_a_full_disk_keeps_its_starts_and_the_earlier_result(
    work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_fit(coat_fit, "result")
    before = contents(work)
    words = ["fit", "data.csv", "--stack", "coat.toml", "--out", "result", "--starts", "3", "--force"]
    with largest_file(30_000):
        assert refusal(words, capsys) == "layerjax: error: result: file too large"
    after = contents(work)
    after.pop(str(work / ".result.starts"))
    assert len(Store.read(".result.starts").keys()) == 3
    assert after == before
    monkeypatch.setattr(starts, "rough_descent", None)  # no start is run again
    assert main(words) == 0
    assert not list(work.glob(".*"))


def test_beside_a_running_sampler_others_only_read(
    work: Path, capsys: pytest.CaptureFixture[str], coat_fit: Fit, tmp_path_factory: pytest.TempPathFactory
) -> None:
    for name in ("result", "other"):
        save_fit(coat_fit, name)
    directory = work / "result"
    words = ["sample", "result", "--walkers", "32", "--ess", "20000"]

    def seen() -> dict[str, tuple[int, int, bytes]]:
        entries = [(path, path.stat()) for path in directory.iterdir()]
        return {path.name: (stat.st_ino, stat.st_mtime_ns, path.read_bytes()) for path, stat in entries}

    def some_steps() -> bool:
        return (directory / "chain.db").is_file() and (directory / "chain.db").stat().st_size > 30_000

    with stopped(words, tmp_path_factory.getbasetemp() / "cache", some_steps) as process:
        before = seen()
        assert {"chain.db", "chain.db.lock"} < set(before)
        for other in (words, [*words, "--force"], [*MANY_STARTS, "--force"]):
            assert f"in use by another process ({process.pid})" in refusal(other, capsys)
        posterior = load_posterior(directory)
        assert main(["compare", "result", "other"]) == 0
        assert main(["report", "result", "--out", "report.html"]) == 0
        assert seen() == before
    assert process.returncode == -signal.SIGKILL
    assert posterior is not None
    loaded = load_fit(directory)
    whole = sample(loaded, walkers=32, seed=0, path=directory / "chain.db", ess=20_000)
    again = sample(loaded, walkers=32, seed=0, ess=20_000)
    assert 0 < len(posterior.chain) < len(again.chain)
    np.testing.assert_array_equal(posterior.chain, again.chain[: len(posterior.chain)])
    np.testing.assert_array_equal(whole.chain, again.chain)
    assert not (directory / "chain.db.lock").exists()


def test_a_killed_fit_goes_on_with_the_starts_that_are_done(
    work: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    done = work / ".result.starts"

    def some_starts() -> bool:
        return done.is_file() and len(Store.read(done).keys()) > 2

    with stopped(MANY_STARTS, tmp_path_factory.getbasetemp() / "cache", some_starts) as process:
        before = contents(work)
        assert f"result is in use by another process ({process.pid})" in refusal(MANY_STARTS, capsys)
        kept = len(Store.read(done).keys())
        assert contents(work) == before
    assert 2 < kept < 200
    solve, solved = starts.rough_descent, []
    monkeypatch.setattr(starts, "rough_descent", lambda *given, **how: solved.append(how) or solve(*given, **how))
    assert main(MANY_STARTS) == 0
    assert solved.count({}) == 200 - kept
    assert not list(work.glob(".*"))
    assert main([*MANY_STARTS[:-3], "whole", *MANY_STARTS[-2:]]) == 0
    for name in ("fit.json", "fitted.toml", "data.csv"):
        assert (work / "result" / name).read_bytes() == (work / "whole" / name).read_bytes()


def test_a_killed_batch_goes_on_with_the_fits_that_are_done(
    work: Path, capsys: pytest.CaptureFixture[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    (work / "scans").mkdir()
    for name in ("a.csv", "b.csv", "c.csv"):
        shutil.copy("data.csv", work / "scans" / name)
    words = ["fit-many", "scans", "--stacks", "coat.toml", "--starts", "2", "--processes", "1", "--out"]
    store = work / "out" / "batch.store"

    def one_is_done() -> bool:
        return store.is_file() and Store.read(store).get("a.csv/coat") is not None

    with stopped([*words, "out"], tmp_path_factory.getbasetemp() / "cache", one_is_done) as process:
        before = contents(work)
        assert f"in use by another process ({process.pid})" in refusal([*words, "out"], capsys)
        assert contents(work) == before
    first = before[str(work / "out" / "a.csv" / "coat" / "fit.json")]
    for out in ("out", "whole"):
        assert main([*words, out]) == 0
    assert (work / "out" / "a.csv" / "coat" / "fit.json").read_bytes() == first  # not fitted again
    for name in ("a.csv", "b.csv", "c.csv"):
        one, other = (load_fit(work / out / name / "coat") for out in ("out", "whole"))
        np.testing.assert_array_equal(one.vector, other.vector)
    assert not list((work / "out").rglob(".*"))


def test_a_chain_without_steps_is_no_posterior_yet(coat_fit: Fit, tmp_path: Path) -> None:
    save_fit(coat_fit, tmp_path / "result")
    path = tmp_path / "result" / "chain.db"
    path.write_bytes(b"")
    assert load_posterior(tmp_path / "result") is None
    with pytest.raises(ValueError, match="no steps yet"):
        load(coat_fit, path)


def test_a_chain_that_begins_again_is_not_allowed_what_the_last_one_was(coat_fit: Fit, tmp_path: Path) -> None:
    save_fit(coat_fit, tmp_path / "result")
    options = {"walkers": 16, "path": tmp_path / "result" / "chain.db"}
    save_posterior(sample(coat_fit, max_steps=200, allow_unconverged=True, **options), tmp_path / "result")
    assert load_posterior(tmp_path / "result").allow_unconverged
    sample(coat_fit, max_steps=100, resume=False, **options)
    assert not load_posterior(tmp_path / "result").allow_unconverged


def test_what_killed_processes_left_is_tidied_up(coat_fit: Fit, tmp_path: Path) -> None:
    """By the next one that writes: half of a result goes, and a result that was aside comes back."""
    directory = tmp_path / "result"
    save_fit(coat_fit, directory)
    before = contents(directory)
    directory.rename(tmp_path / ".result.layerjax-old")
    (tmp_path / ".result.layerjax-new").mkdir()
    (tmp_path / ".result.lock").write_text("1\n")
    with pytest.raises(ValueError, match="holds a result already"):
        save_fit(coat_fit, directory)
    assert contents(directory) == before
    assert [path.name for path in tmp_path.iterdir()] == ["result"]
    with writing(directory, force=True), pytest.raises(ValueError, match="in use"):
        save_fit(coat_fit, directory, force=True)
