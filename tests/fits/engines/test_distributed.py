"""Tasks by a cluster of two workers on this machine, which are killed (a scheduler: `maps/test_failures`)."""

import os
import signal
import sys
import threading
from collections import Counter

import numpy as np
import pytest

from fits.engines import Failure, run
from tests.helpers import tasks
from tests.helpers.places import ROOT
from tests.helpers.tasks import wait_until

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(scope="module")
def client():
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": ":0"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT))
        patch.setenv("DASK_LOGGING__DISTRIBUTED", "critical")
        with (
            distributed.LocalCluster(silence_logs=50, **options) as cluster,
            distributed.Client(cluster, set_as_default=False) as client,  # what is passed must be enough
        ):
            yield client


def test_results_and_failures_are_those_of_the_other_engines(client):
    assert sorted(run(tasks.square, 5, range(30), client=client)) == sorted(run(tasks.square, 5, range(30)))
    by_address = list(run(tasks.square, 5, range(3), client=client.scheduler.address))
    assert sorted(by_address) == [(0, 5), (1, 6), (2, 9)]
    assert list(run(tasks.square, 5, [], client=client)) == []
    wanted = dict(run(tasks.picky, None, [0, 1, 2, 5]))
    assert dict(run(tasks.picky, None, [0, 1, 2, 5], client=client)) == wanted
    with pytest.raises(OSError, match="No space left"):
        list(run(tasks.picky, None, [0, 3, 5], client=client))
    with pytest.raises(TypeError, match="a mistake in the code"):
        list(run(tasks.picky, None, [0, 4, 5], client=client))
    transport = {"transport": lambda stack, wi, wo: None}  # where other engines need what can be imported
    assert dict(run(tasks.nothing, transport, [1], client=client)) == {0: None}


def test_short_tasks_are_grouped_and_each_has_its_own_result(client, monkeypatch):
    submit, sent = client.submit, []
    monkeypatch.setattr(client, "submit", lambda *call, **rest: sent.append(call) or submit(*call, **rest))
    outcomes = dict(run(tasks.picky, None, [5] * 300 + [1] + [5] * 300, client=client))
    assert [index for index, result in outcomes.items() if isinstance(result, Failure)] == [300]
    assert len(outcomes) == 601 > 4 * len(sent)


def test_a_worker_has_the_precision_of_the_caller_and_a_cache(client):
    large = np.arange(10_000.0)
    ((_, worker),) = run(tasks.surroundings, large, [0], client=client)
    assert (worker["double"], worker["total"]) == (True, 64.0**3)
    assert worker["cache"]
    np.testing.assert_array_equal(worker["shared"], large)


def test_a_worker_that_is_killed_costs_nothing(client, tmp_path):
    def kill():
        wait_until(lambda: len(list(tmp_path.iterdir())) >= 2)
        os.kill(int(next(tmp_path.iterdir()).name), signal.SIGKILL)  # what it held is sent again

    thread = threading.Thread(target=kill)
    thread.start()
    outcomes = dict(run(tasks.slow, str(tmp_path), range(30), client=client))
    thread.join()
    assert outcomes == {index: index * index for index in range(30)}


@pytest.mark.slow
def test_a_task_that_kills_its_worker_costs_itself_alone(client, tmp_path, monkeypatch):
    """Those that died beside it are not blamed: each suspect is repeated by itself."""
    monkeypatch.setattr(client.cluster.scheduler, "allowed_failures", 1)  # the least time to wait for new workers
    outcomes = dict(run(tasks.deadly, str(tmp_path / "tried"), range(6), client=client))
    assert outcomes.pop(2) == Failure("its worker died 2 times")
    assert outcomes == {index: index for index in (0, 1, 3, 4, 5)}
    assert Counter((tmp_path / "tried").read_text().split())["2"] <= 4


def test_leaving_the_loop_cancels_what_was_submitted(client, tmp_path):
    results = run(tasks.slow, str(tmp_path), range(1000), client=client)
    next(results)
    results.close()
    wait_until(lambda: not any(client.processing().values()), 10.0)


def test_what_is_no_cluster_is_refused(monkeypatch):
    import dask

    for address in (3, "", "head", "8786", "tcp://:8786", "http://head:8786"):
        with pytest.raises(ValueError, match=f"client is {address!r}; it must be a distributed.Client, or the address"):
            run(tasks.nothing, None, [1], client=address)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(OSError, match=r"tcp://127\.0\.0\.1:9: there is no scheduler"),
    ):
        list(run(tasks.nothing, None, [1], client="tcp://127.0.0.1:9"))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r'pip install "layerjax\[distributed\]"'):
        run(tasks.nothing, None, [1], client="tcp://127.0.0.1:9")
