"""Threads and processes give the same results; a task that fails, or kills its worker, costs itself alone."""

import errno
import multiprocessing
import os
import random
import signal
import threading
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest

from fits.engines import Failure, run
from fits.engines.compile_cache import FOLDER, LEAST, compile_cache, keep_programs
from tests.helpers import tasks
from tests.helpers.tasks import running, started, wait_until

SCRIPT = """
from fits.engines import run
from tests.helpers import tasks
{guard}for result in run(tasks.{work}, {folder!r}, range(4), processes=2): print(*result, flush=True)
"""


@pytest.fixture(params=[1, 2], ids=["threads", "processes"])
def processes(request):
    return request.param


@pytest.fixture(autouse=True)
def no_child():
    """Whatever happens, no process is left behind."""
    yield
    assert multiprocessing.active_children() == []


def test_results_and_failures_do_not_depend_on_the_engine(processes):
    """A task that fails costs itself alone; a full disk and a mistake end the run, and a mistake is located."""
    assert dict(run(tasks.square, 5, range(12), processes=processes)) == {task: task * task + 5 for task in range(12)}
    assert list(run(tasks.square, 5, [], processes=processes)) == []
    with pytest.raises(ValueError, match="processes is 0; it must be at least 1"):
        run(tasks.square, 5, [1], processes=0)
    outcomes = dict(run(tasks.picky, None, [0, 1, 2, 5], processes=processes))
    failures = {1: Failure("task is 1; it must not be"), 2: Failure("there.csv: no such file or directory")}
    assert outcomes == failures | {0: 0, 3: 5}
    with pytest.raises(OSError, match="No space left") as full:
        list(run(tasks.picky, None, [0, 3, 5], processes=processes))
    assert (full.value.errno, full.value.filename) == (errno.ENOSPC, "full.csv")
    with pytest.raises(TypeError, match="a mistake in the code") as error:
        list(run(tasks.picky, None, [0, 4, 5], processes=processes))
    assert processes == 1 or "in picky" in "".join(error.value.__notes__)


def test_a_single_thread_is_that_of_the_caller():
    results = run(lambda shared, task: threading.get_ident(), None, range(4), threads=1)
    assert list(results) == [(index, threading.get_ident()) for index in range(4)]


def test_what_cannot_be_sent_is_named():
    transport = lambda stack, wi, wo: None  # noqa: E731
    assert list(run(tasks.nothing, {"transport": transport}, [1])) == [(0, None)]
    with pytest.raises(ValueError, match=r"what tasks have in common cannot be pickled.*lambda.*processes=1 works"):
        run(tasks.nothing, {"transport": transport}, [1], processes=2)
    with pytest.raises(ValueError, match="a task cannot be pickled"):
        run(tasks.nothing, None, [transport], processes=2)


def test_a_task_that_kills_its_worker_costs_itself_alone(tmp_path):
    outcomes = dict(run(tasks.deadly, str(tmp_path / "tried"), range(6), processes=2))
    assert outcomes.pop(2) == Failure("its worker died 3 times (SIGKILL, which systems send when memory is short)")
    assert outcomes == {index: index for index in (0, 1, 3, 4, 5)}
    tried = Counter((tmp_path / "tried").read_text().split())
    assert tried == {"2": 3, "0": 1, "1": 1, "3": 1, "4": 1, "5": 1}


@pytest.mark.parametrize(("work", "kills"), [("working", 8), ("starting", 6), ("starting", 1000)])
def test_workers_may_be_killed_at_any_moment(tmp_path, work, kills):
    """As they start, while they work, and between: each loses its current task, which is repeated."""
    generator, over, killed = random.Random(3), threading.Event(), set()

    def killer():
        while len(killed) < kills and not over.wait(0.2 + 0.3 * generator.random() if work == "working" else 0.001):
            children = [child for child in multiprocessing.active_children() if child.pid not in killed]
            for child in generator.sample(children, min(1, len(children))):
                child.kill()
                killed.add(child.pid)

    thread, count = threading.Thread(target=killer), 30 if work == "working" else 2
    thread.start()
    try:
        if kills == 1000:
            with pytest.raises(ValueError, match=r"10 worker processes died as they started \(SIGKILL"):
                list(run(tasks.slow, str(tmp_path), range(count), processes=2))
            return
        outcomes = dict(run(tasks.slow, str(tmp_path), range(count), processes=2))
    finally:
        over.set()
        thread.join()
    assert len(killed) >= 4
    failed = {index for index, result in outcomes.items() if isinstance(result, Failure)}
    assert len(failed) <= (work == "working")  # three of eight kills may meet one task; none is blamed for a start
    assert outcomes == {index: outcomes[index] if index in failed else index * index for index in range(count)}


def test_leaving_the_loop_ends_the_workers_at_once(tmp_path):
    results = run(tasks.slow, str(tmp_path), range(1000), processes=2)
    next(results)
    results.close()
    assert sum(len(path.read_text()) for path in tmp_path.iterdir()) < 1000
    assert multiprocessing.active_children() == []


def test_a_worker_has_the_settings_of_its_parent():
    """Precision and compile cache; one thread each, deaf to Ctrl-C."""
    large = np.arange(10_000.0)
    for _, worker in run(tasks.surroundings, large, [0, 1], processes=2):
        assert worker["total"] == 64.0**3
        assert worker["double"]
        assert (worker["cache"], worker["least"]) == (jax.config.values[FOLDER], 0.2)
        assert worker["flags"] == os.environ.get("XLA_FLAGS", "")  # with others, results differ in their last digits
        assert (worker["threads"], worker["interrupts"]) == ("1", True)
        np.testing.assert_array_equal(worker["shared"], large)


def test_a_script_without_a_main_guard_is_refused(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT.format(guard="", work="slow", folder=str(tmp_path)))
    with started([str(tmp_path / "script.py")]) as process:
        output, error = process.communicate(timeout=60)
    assert (process.returncode, output, error.count("Traceback")) == (1, "", 1)
    last = error.strip().splitlines()[-1]
    assert last.startswith("ValueError: a worker process cannot start (it runs the script that starts it)")
    assert '`if __name__ == "__main__":`' in last


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL], ids=lambda sent: sent.name)
def test_workers_end_with_their_parent(tmp_path, sent):
    """While they work. Ctrl-C goes to all processes of a terminal; a parent that is killed can end nobody."""
    guard = 'if __name__ == "__main__":\n    '
    (tmp_path / "script.py").write_text(SCRIPT.format(guard=guard, work="endless", folder=str(tmp_path)))
    with started([str(tmp_path / "script.py")]) as process:
        wait_until(lambda: sum(path.name.isdigit() for path in tmp_path.iterdir()) == 2, 60.0)
        workers = [int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()]
        assert any(map(running, workers))
        os.killpg(process.pid, sent) if sent == signal.SIGINT else process.kill()
        process.wait(timeout=10)
        wait_until(lambda: not any(map(running, workers)), 10.0)
        error = process.stderr.read()
    assert process.returncode == -sent
    assert error.count("KeyboardInterrupt") == (sent == signal.SIGINT)


def test_programs_are_kept_unless_a_process_keeps_them_already(tmp_path, monkeypatch):
    before = {name: jax.config.values[name] for name in (FOLDER, LEAST)}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    try:
        keep_programs()
        assert {name: jax.config.values[name] for name in (FOLDER, LEAST)} == before  # those of the user
        jax.config.update(FOLDER, None)
        keep_programs()
        assert jax.config.values[FOLDER] == compile_cache()
        assert tmp_path in Path(compile_cache()).parents
        jax.config.update(FOLDER, None)
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
        keep_programs()
        assert jax.config.values[FOLDER] is None
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
