"""Tasks end alike whoever does them, and one that fails costs itself alone."""

import errno
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fits.engines import Failure, run
from fits.engines.processes import _death
from tests.helpers import tasks
from tests.helpers.places import ROOT

ENGINES: dict[str, dict[str, Any]] = {"threads": {}, "processes": {"processes": 2}}


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> dict[str, Any]:
    return ENGINES[request.param]


@pytest.fixture(autouse=True)
def no_child() -> Iterator[None]:
    """Whatever happens, no process is left behind."""
    yield
    assert multiprocessing.active_children() == []


def running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_results_come_as_they_end(engine: dict[str, Any]) -> None:
    found = list(run(tasks.square, 5, range(12), **engine))
    assert sorted(found) == [(index, index * index + 5) for index in range(12)]


def test_a_single_thread_is_that_of_the_caller() -> None:
    found = run(lambda shared, task: threading.get_ident(), None, range(4), threads=1)
    assert list(found) == [(index, threading.get_ident()) for index in range(4)]


def test_what_is_refused_or_fails(engine: dict[str, Any]) -> None:
    """A task that fails costs itself alone; a full disk and a mistake end the run, and a mistake says where it is."""
    assert list(run(tasks.square, 5, [], **engine)) == []
    with pytest.raises(ValueError, match="processes is 0; it must be at least 1"):
        run(tasks.square, 5, [1], processes=0)
    found = dict(run(tasks.picky, None, [0, 1, 2, 5], **engine))
    assert (found[0], found[3]) == (0, 5)
    assert found[1] == Failure("task is 1; it must not be")
    assert found[2] == Failure("there.csv: no such file or directory")
    with pytest.raises(OSError, match="No space left") as full:
        list(run(tasks.picky, None, [0, 3, 5], **engine))
    assert (full.value.errno, full.value.filename) == (errno.ENOSPC, "full.csv")
    with pytest.raises(TypeError, match="a mistake in the code") as error:
        list(run(tasks.picky, None, [0, 4, 5], **engine))
    if engine:
        assert "in picky" in "".join(error.value.__notes__)


def test_a_task_that_kills_its_worker_costs_itself_alone(tmp_path: Path) -> None:
    found = dict(run(tasks.deadly, str(tmp_path / "tried"), range(6), processes=2))
    assert found.pop(2) == Failure("its worker died 3 times (SIGKILL, which systems send when memory is short)")
    assert found == {index: index for index in (0, 1, 3, 4, 5)}
    tried = Counter((tmp_path / "tried").read_text().split())
    assert tried == {"2": 3, "0": 1, "1": 1, "3": 1, "4": 1, "5": 1}


def test_workers_may_be_killed_at_any_moment(tmp_path: Path) -> None:
    """As they start, while they work, and between: each loses what it has in hand, which is done again."""
    generator, over = random.Random(3), threading.Event()
    killed = []

    def killer() -> None:
        while not over.wait(0.2 + 0.3 * generator.random()) and len(killed) < 8:
            for child in generator.sample(multiprocessing.active_children(), 1):
                if child.pid is not None:
                    os.kill(child.pid, signal.SIGKILL)
                    killed.append(child.pid)

    thread = threading.Thread(target=killer)
    found = run(tasks.slow, str(tmp_path), range(30), processes=2)
    thread.start()
    try:
        results = dict(found)
    finally:
        over.set()
        thread.join()
    assert len(killed) >= 4
    failed = {index for index, result in results.items() if isinstance(result, Failure)}
    assert len(failed) <= 1  # three of eight kills may meet one task
    assert {index: results[index] for index in results if index not in failed} == {
        index: index * index for index in range(30) if index not in failed
    }


def starting(kills: int) -> tuple[threading.Thread, threading.Event]:
    """A thread that kills so many workers, each as soon as it is there."""
    over, killed = threading.Event(), set[int]()

    def killer() -> None:
        while len(killed) < kills and not over.wait(0.001):
            for child in multiprocessing.active_children():
                if child.pid is not None and child.pid not in killed and len(killed) < kills:
                    with suppress(ProcessLookupError):  # it has ended by itself
                        os.kill(child.pid, signal.SIGKILL)
                    killed.add(child.pid)

    thread = threading.Thread(target=killer)
    thread.start()
    return thread, over


@pytest.mark.parametrize("kills", [6, 1000])
def test_no_task_is_blamed_for_workers_that_are_killed_as_they_start(tmp_path: Path, kills: int) -> None:
    thread, over = starting(kills)
    try:
        if kills == 6:  # three and more of each task
            assert dict(run(tasks.slow, str(tmp_path), range(2), processes=2)) == {0: 0, 1: 1}
        else:
            with pytest.raises(ValueError, match=r"10 worker processes in a row died as they started \(SIGKILL"):
                list(run(tasks.slow, str(tmp_path), range(2), processes=2))
    finally:
        over.set()
        thread.join()


def test_whoever_leaves_the_loop_ends_the_workers_at_once(tmp_path: Path) -> None:
    found = run(tasks.slow, str(tmp_path), range(1000), processes=2)
    next(found)
    found.close()  # type: ignore[attr-defined]
    assert sum(len(path.read_text()) for path in tmp_path.iterdir()) < 1000
    assert multiprocessing.active_children() == []


def test_what_cannot_be_sent_is_named(engine: dict[str, Any]) -> None:
    transport = lambda stack, wi, wo: None  # noqa: E731
    if not engine:
        assert list(run(tasks.nothing, {"transport": transport}, [1])) == [(0, None)]
        return
    with pytest.raises(ValueError, match=r"what tasks share cannot be pickled.*lambda.*processes=1 works"):
        run(tasks.nothing, {"transport": transport}, [1], **engine)
    with pytest.raises(ValueError, match="a task cannot be pickled"):
        run(tasks.nothing, None, [transport], **engine)
    with pytest.raises(ValueError, match="the result of a task, a function, cannot be pickled"):
        list(run(tasks.unpicklable, None, [1], **engine))


def test_a_worker_is_set_as_its_parent_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Precision and compile cache; one core each, deaf to Ctrl-C."""
    import jax

    large = np.arange(10_000.0)
    found = [result for _, result in run(tasks.surroundings, large, [0, 1], processes=2)]
    for seen in found:
        assert seen["total"] == 64.0**3
        assert seen["double"]
        assert seen["cache"] == jax.config.values["jax_compilation_cache_dir"]
        assert seen["least"] == 0.2
        assert seen["flags"] == os.environ.get("XLA_FLAGS", "")  # with others, results differ in their last digits
        assert seen["interrupts"]
        np.testing.assert_array_equal(seen["shared"], large)
    allowed = os.sched_getaffinity(0)
    assert {core for seen in found for core in seen["cores"]} <= allowed
    assert all(len(seen["cores"]) == 1 for seen in found)


SCRIPT = """
import sys, time
from fits.engines import run
from tests.helpers import tasks
{guard}for found in run(tasks.{work}, {folder!r}, range(4), processes=2):
    {indent}print(*found, flush=True)
"""


def script(folder: Path, guard: bool, work: str) -> list[str]:
    line = 'if __name__ == "__main__":\n    ' if guard else ""
    text = SCRIPT.format(folder=str(folder), work=work, guard=line, indent="    " * guard)
    (folder / "script.py").write_text(text)
    return [sys.executable, str(folder / "script.py")]


def begun(words: list[str]) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job's ignoring would be inherited
    try:
        return subprocess.Popen(
            words, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
    finally:
        signal.signal(signal.SIGINT, ours)


def test_a_script_that_has_no_main_guard_is_told_so(tmp_path: Path) -> None:
    with begun(script(tmp_path, guard=False, work="slow")) as process:
        output, error = process.communicate(timeout=60)
    assert process.returncode == 1
    assert output == ""
    assert error.count("Traceback") == 1
    last = error.strip().splitlines()[-1]
    assert last.startswith("ValueError: each worker process runs the script that starts it")
    assert '`if __name__ == "__main__":`' in last


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL], ids=lambda sent: sent.name)
def test_workers_end_with_their_parent(tmp_path: Path, sent: signal.Signals) -> None:
    """In the midst of a task. Ctrl-C goes to all processes of a terminal; a parent that is killed can tell nobody."""
    with begun(script(tmp_path, guard=True, work="endless")) as process:
        assert process.stderr is not None
        workers: list[int] = []
        end = time.monotonic() + 30
        while len(workers) < 2:
            assert time.monotonic() < end, "they never began"
            time.sleep(0.01)
            workers = [int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()]
        assert any(map(running, workers))
        if sent == signal.SIGINT:
            os.killpg(process.pid, sent)
        else:
            process.kill()
        process.wait(timeout=10)
        end = time.monotonic() + 10
        while any(map(running, workers)):
            assert time.monotonic() < end, "a worker lingers"
            time.sleep(0.01)
        error = process.stderr.read()
    assert process.returncode == -sent
    assert error.count("KeyboardInterrupt") == (sent == signal.SIGINT)


def test_deaths_are_told_by_name() -> None:
    assert _death(-signal.SIGSEGV) == "SIGSEGV"
    assert _death(1) == "exit code 1"
    assert _death(-99) == "signal 99"
