"""Threads and a cluster give the same results; a task that fails, or kills its worker, costs itself alone."""

import errno
import multiprocessing
import os
import re
import signal
import sys
import threading
from contextlib import contextmanager

import jax
import numpy as np
import pytest

from fits.engines import Failure, connected, local_cluster, run
from layerjax.compiling import CACHE_DIRECTORY, CACHE_LEAST_TIME
from tests.helpers import tasks
from tests.helpers.places import ROOT
from tests.helpers.refusals import refuses
from tests.helpers.tasks import running, started, wait_until

dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@contextmanager
def script(folder, work, guard=""):
    """A program that runs four of these tasks in two processes."""
    loop = f"for result in run(tasks.{work}, {str(folder)!r}, range(4), processes=2): print(*result, flush=True)"
    (folder / "script.py").write_text(f"from fits.engines import run\nfrom tests.helpers import tasks\n{guard}{loop}\n")
    with started([str(folder / "script.py")]) as process:
        yield process


@pytest.fixture(scope="module")
def client():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT))
        with local_cluster(2) as client:
            yield client
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("cluster", [False, True])
def test_results_and_failures_do_not_depend_on_the_engine(request, cluster):
    """A task that fails costs itself alone; a full disk and a mistake end the run."""
    engine = {"client": request.getfixturevalue("client") if cluster else None}
    assert dict(run(tasks.square, 5, range(12), **engine)) == {task: task * task + 5 for task in range(12)}
    assert list(run(tasks.square, 5, [], **engine)) == []
    outcomes = dict(run(tasks.picky, None, [0, 1, 2, 5], **engine))
    failures = {1: Failure("task is 1; it must not be"), 2: Failure("there.csv: no such file or directory")}
    assert outcomes == failures | {0: 0, 3: 5}
    many = dict(run(tasks.picky, None, [0, 1, 2, 5] * 16, short=True, **engine))
    assert many == {index: outcomes[index % 4] for index in range(64)}
    with pytest.raises(OSError, match="No space left") as full:
        list(run(tasks.picky, None, [0, 3, 5], **engine))
    assert (full.value.errno, full.value.filename) == (errno.ENOSPC, "full.csv")
    refuses("a mistake in the code", list, run(tasks.picky, None, [0, 4, 5], **engine), error=TypeError)
    transport = {"transport": lambda stack, wi, wo: None}
    assert dict(run(tasks.nothing, transport, [1], **engine)) == {0: None}
    if not cluster:  # a single thread is that of the caller
        results = run(lambda shared, task: threading.get_ident(), None, range(4), threads=1)
        assert list(results) == [(index, threading.get_ident()) for index in range(4)]


def test_a_worker_has_the_settings_of_its_parent(client):
    """By the address of the scheduler: precision, compile cache, one thread, deaf to Ctrl-C."""
    large = np.arange(10_000.0)
    for _, worker in run(tasks.surroundings, large, [0, 1], client=client.scheduler.address):
        assert (worker["total"], worker["double"]) == (64.0**3, True)
        for name, setting in (("cache", CACHE_DIRECTORY), ("least", CACHE_LEAST_TIME)):
            assert worker[name] == jax.config.values[setting]
        assert worker["flags"] == os.environ.get("XLA_FLAGS", "")  # with others, results differ in their last digits
        assert (worker["threads"], worker["interrupts"]) == ("1", True)
        np.testing.assert_array_equal(worker["shared"], large)


@pytest.mark.slow
def test_a_task_that_kills_its_worker_costs_itself_alone(client, tmp_path):
    """What else the worker held is sent again."""
    outcomes = dict(run(tasks.deadly, str(tmp_path / "tried"), range(6), client=client))
    assert outcomes.pop(2) == Failure("its worker died 4 times")
    assert outcomes == {index: index for index in (0, 1, 3, 4, 5)}
    assert (tmp_path / "tried").read_text().split().count("2") == 4


def test_a_scheduler_that_stops_is_named(tmp_path):
    options = {"n_workers": 1, "processes": False, "dashboard_address": ":0", "silence_logs": 50}
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        results = run(tasks.slow, str(tmp_path), range(100), client=client)
        next(results)
        cluster.sync(cluster.scheduler.close)
        refuses("the scheduler has stopped", list, results, error=OSError)


def test_leaving_the_loop_cancels_what_was_submitted(client, tmp_path):
    results = run(tasks.slow, str(tmp_path), range(1000), client=client)
    next(results)
    results.close()
    wait_until(lambda: not any(client.processing().values()))


@pytest.mark.slow
def test_a_script_without_a_main_guard_is_refused(tmp_path):
    with script(tmp_path, "slow") as process:
        output, error = process.communicate(timeout=60)
    assert (process.returncode, output) == (1, "")
    last = error.strip().splitlines()[-1]
    assert re.match(r"ValueError: worker processes cannot start \(.*`if __name__ == \"__main__\":`", last)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL], ids=lambda sent: sent.name)
def test_workers_end_with_their_parent(tmp_path, sent):
    """While they work. Ctrl-C goes to all processes of a terminal; a parent that is killed can end nobody."""
    with script(tmp_path, "endless", 'if __name__ == "__main__":\n    ') as process:
        wait_until(lambda: sum(path.name.isdigit() for path in tmp_path.iterdir()) == 2, 60.0)
        workers = [int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()]
        assert any(map(running, workers))
        os.killpg(process.pid, sent) if sent == signal.SIGINT else process.kill()
        process.wait(timeout=20)
        wait_until(lambda: not any(map(running, workers)), 10.0)
        error = process.stderr.read()
    assert process.returncode == -sent
    assert error.count("KeyboardInterrupt") == (sent == signal.SIGINT)


def test_what_is_no_cluster_is_refused(client, monkeypatch):
    def refused(message, error=ValueError, **more):
        refuses(message, list, run(tasks.nothing, None, [1], **more), error=error)

    for address in (3, "", "head", "8786"):
        refused(f"client is {address!r}; it must be a distributed.Client, or the address", client=address)
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        refused(r"tcp://127\.0\.0\.1:9: there is no scheduler", OSError, client="tcp://127.0.0.1:9")
    refuses("cannot be pickled for the workers", list, run(tasks.nothing, threading.Lock(), [1], client=client))
    monkeypatch.setitem(sys.modules, "distributed", None)
    refused(r'client= needs distributed: pip install "layerjax\[distributed\]"', client="tcp://127.0.0.1:9")
    refused("processes > 1 needs distributed", processes=2)
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(SystemExit), connected(None, 2):
        pass
