"""Tasks by a cluster of two workers on this machine, which are killed, and whose scheduler goes away."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fits.engines import Failure, run
from tests.helpers import tasks
from tests.helpers.places import ROOT

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
QUIET = {"DASK_LOGGING__DISTRIBUTED": "critical"}


def distributed_patience(connect: str) -> Any:
    import dask

    return dask.config.set({"distributed.comm.timeouts.connect": connect})


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": ":0"}
    before = {name: os.environ.get(name) for name in ("PYTHONPATH", *QUIET)}
    os.environ.update(QUIET | {"PYTHONPATH": str(ROOT)})
    try:
        with (
            distributed.LocalCluster(silence_logs=50, **options) as cluster,
            distributed.Client(cluster, set_as_default=False) as client,  # what is given must be enough
        ):
            yield client
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


def test_results_are_those_of_the_other_engines(client: Any) -> None:
    found = list(run(tasks.square, 5, range(30), client=client))
    assert sorted(found) == sorted(run(tasks.square, 5, range(30)))
    by_address = list(run(tasks.square, 5, range(3), client=client.scheduler.address))
    assert sorted(by_address) == [(0, 5), (1, 6), (2, 9)]
    assert list(run(tasks.square, 5, [], client=client)) == []


def test_short_tasks_go_together_and_each_has_its_own_result(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    submit, sent = client.submit, []
    monkeypatch.setattr(client, "submit", lambda *given, **rest: sent.append(given) or submit(*given, **rest))
    found = list(run(tasks.square, 5, range(600), client=client))
    assert sorted(found) == [(index, index * index + 5) for index in range(600)]
    assert len(sent) < 150
    sent.clear()
    bad = dict(run(tasks.picky, None, [5] * 200 + [1] + [5] * 200, client=client))
    assert [index for index, result in bad.items() if isinstance(result, Failure)] == [200]
    assert len(bad) == 401 > 2 * len(sent)


def test_failures_are_those_of_the_other_engines(client: Any) -> None:
    wanted = dict(run(tasks.picky, None, [0, 1, 2, 5]))
    assert dict(run(tasks.picky, None, [0, 1, 2, 5], client=client)) == wanted
    with pytest.raises(OSError, match="No space left"):
        list(run(tasks.picky, None, [0, 3, 5], client=client))
    with pytest.raises(TypeError, match="a mistake in the code"):
        list(run(tasks.picky, None, [0, 4, 5], client=client))


def test_lambdas_go_where_others_are(client: Any) -> None:
    assert dict(run(tasks.nothing, {"transport": lambda stack, wi, wo: None}, [1], client=client)) == {0: None}


def test_a_worker_has_the_precision_of_who_asks_and_a_cache(client: Any) -> None:
    large = np.arange(10_000.0)
    ((_, seen),) = run(tasks.surroundings, large, [0], client=client)
    assert seen["double"]
    assert seen["total"] == 64.0**3
    assert seen["cache"]
    np.testing.assert_array_equal(seen["shared"], large)


def test_a_worker_that_is_killed_costs_nothing(client: Any, tmp_path: Path) -> None:
    def kill() -> None:
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.01)
        for path in list(tmp_path.iterdir()):  # both, one after the other: what was sent to them is sent again
            os.kill(int(path.name), signal.SIGKILL)
            time.sleep(1.0)

    thread = threading.Thread(target=kill)
    thread.start()
    found = dict(run(tasks.slow, str(tmp_path), range(30), client=client))
    thread.join()
    assert found == {index: index * index for index in range(30)}


@pytest.mark.slow
def test_a_task_that_kills_its_worker_costs_itself_alone(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that died beside it are not blamed: what is suspected is tried alone."""
    monkeypatch.setattr(client.cluster.scheduler, "allowed_failures", 1)  # the least time to wait for new workers
    found = dict(run(tasks.deadly, str(tmp_path / "tried"), range(6), client=client))
    assert found.pop(2) == Failure("its worker died 2 times")
    assert found == {index: index for index in (0, 1, 3, 4, 5)}
    assert Counter((tmp_path / "tried").read_text().split())["2"] <= 4


def test_leaving_the_loop_takes_back_what_was_sent(client: Any, tmp_path: Path) -> None:
    found = run(tasks.slow, str(tmp_path), range(1000), client=client)
    next(found)
    found.close()  # type: ignore[attr-defined]
    end = time.monotonic() + 10
    while any(client.processing().values()):
        assert time.monotonic() < end
        time.sleep(0.05)


def test_what_is_no_cluster_is_refused() -> None:
    with pytest.raises(ValueError, match=r"client is 3; it must be a distributed.Client, or the address"):
        run(tasks.nothing, None, [1], client=3)
    for address in ("", "head", "8786", "tcp://:8786", "http://head:8786"):
        with pytest.raises(ValueError, match=f"client is '{address}'; it must be a distributed.Client, or the address"):
            run(tasks.nothing, None, [1], client=address)
    with distributed_patience("1s"), pytest.raises(OSError, match=r"tcp://127\.0\.0\.1:9: there is no scheduler"):
        list(run(tasks.nothing, None, [1], client="tcp://127.0.0.1:9"))


def test_without_distributed_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r'pip install "layerjax\[distributed\]"'):
        run(tasks.nothing, None, [1], client="tcp://127.0.0.1:9")


def test_a_scheduler_that_goes_away_is_named(tmp_path: Path) -> None:
    place = tmp_path / "scheduler.json"
    environment = os.environ | QUIET | {"PYTHONPATH": str(ROOT)}
    python, where = [sys.executable, "-m"], ["--no-dashboard", "--scheduler-file", str(place)]
    words = [
        [*python, "distributed.cli.dask_scheduler", "--port", "0", *where],
        [*python, "distributed.cli.dask_worker", "--nthreads", "1", *where],
    ]
    started = [subprocess.Popen(one, env=environment, stderr=subprocess.DEVNULL) for one in words]
    try:
        while not place.exists():
            time.sleep(0.05)
        (tmp_path / "seen").mkdir()
        with distributed.Client(scheduler_file=str(place), timeout=2) as own:
            found = run(tasks.slow, str(tmp_path / "seen"), range(1000), client=own)
            next(found)
            started[0].kill()
            with pytest.raises(OSError, match=r"tcp://\S+: the scheduler has stopped"):
                list(found)
    finally:
        for process in started:
            process.kill()
            process.wait()
