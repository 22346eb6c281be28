"""Execution of tasks by the workers of a dask.distributed cluster.

A worker takes one task at a time, or a group of short ones. Workers with several threads share a process between tasks,
which some libraries do not support.
"""

import asyncio
import pickle
import threading
import time
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent import futures
from contextlib import contextmanager, suppress
from typing import Any

from fits.engines.failures import MOST_DEATHS, Failure, attempt, one_line
from fits.engines.worker import configure, precision

IN_FLIGHT = 4
"""Tasks that are submitted for each thread of a worker."""

TIMEOUT = 60.0
"""Seconds to wait for the first worker."""

RECOUNT = 5.0
"""Seconds after which workers are counted again: some clusters grow."""

GROUP_SECONDS = 0.5
"""Seconds of work that go to a worker at a time if single tasks are shorter, as submitting takes milliseconds."""

SHORTEST = 1e-3
"""Least seconds that a task counts as."""

RETRIES = 3
"""Retries of a task that fails neither by its own error nor by the death of its worker."""

WITH_PORT = ("tcp", "tls", "ws", "wss", "ucx")
"""Schemes of a scheduler's address, besides those of threads of this process."""

REPEAT, REPEAT_LATER = object(), object()
"""Outcomes of tasks that are repeated, at once or at the end."""


def run_distributed(
    work: Callable[[Any, Any], Any], shared: Any, tasks: list[Any], client: Any
) -> Iterator[tuple[int, Any]]:
    """See `fits.engines.run`."""
    _require_client(client)
    import cloudpickle

    try:
        payload = cloudpickle.dumps((work, shared))
        packed = [cloudpickle.dumps(task) for task in tasks]
    except Exception as error:  # of any kind, as each class has its own
        raise ValueError(f"what tasks need cannot be pickled for the workers: {one_line(error)}") from None
    return _results(payload, packed, client)


def _results(payload: bytes, tasks: list[bytes], client: Any) -> Iterator[tuple[int, Any]]:
    if not tasks:
        return
    with connected(client) as connection:
        run = _Run(connection, payload, tasks)
        try:
            yield from run.results()
        finally:
            with suppress(Exception):  # of a scheduler that has stopped
                connection.cancel(list(run.running), force=True)


def _require_client(client: Any) -> None:
    """ValueError for what is neither a client nor the address of a scheduler."""
    try:
        from distributed import Client
        from distributed.comm.addressing import parse_address, parse_host_port
    except ImportError:
        raise ValueError('client= needs distributed: pip install "layerjax[distributed]"') from None
    wanted = "a distributed.Client, or the address of a scheduler, such as tcp://node1:8786"
    if not isinstance(client, str | Client) or getattr(client, "asynchronous", False):
        raise ValueError(f"client is {client!r}; it must be {wanted}")
    if isinstance(client, str):
        try:
            scheme, place = parse_address(client)
            host = parse_host_port(place)[0] if scheme in WITH_PORT else place if scheme == "inproc" else ""
        except ValueError:  # a client would wait a minute for it
            host = ""
        if not host:
            raise ValueError(f"client is {client!r}; it must be {wanted}")


@contextmanager
def connected(client: Any) -> Iterator[Any]:
    """A client; for an address a new one, which is closed with the block. Errors as those of `fits.engines.run`."""
    _require_client(client)
    from distributed import Client

    if not isinstance(client, str):
        yield client
        return
    address = client
    try:
        client = Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"{address}: there is no scheduler ({one_line(error)})") from None
    try:
        yield client
    finally:
        with suppress(Exception):
            client.close(timeout=1)


class _Run:
    """Tasks that are submitted to a scheduler."""

    def __init__(self, client: Any, payload: bytes, tasks: list[bytes]):
        self.client, self.payload, self.tasks = client, payload, tasks
        self.name = f"layerjax-{uuid.uuid4().hex[:12]}"
        self.running: dict[Any, list[int]] = {}
        self.seconds: float | None = None
        self.losses: Counter[int] = Counter()
        self.suspects: list[int] = []
        self.shared: Any = None
        self.room, self.counted = 1, float("-inf")

    def results(self) -> Iterator[tuple[int, Any]]:
        """Results of all tasks; those that ran on workers which died too often are repeated at the end, one by one."""
        with self._naming_scheduler():
            self.client.wait_for_workers(1, timeout=TIMEOUT)
        yield from self._execute(list(range(len(self.tasks))), single=False)
        for index in self.suspects:
            yield from self._execute([index], single=True)

    def _execute(self, indices: list[int], single: bool) -> Iterator[tuple[int, Any]]:
        from distributed import as_completed

        pending = deque(indices)

        def submit() -> list[Any]:
            with self._naming_scheduler():
                return [self._submit(self._group(pending)) for _ in range(self._room() - len(self.running)) if pending]

        completed = as_completed(submit(), loop=self.client.loop)
        for future in completed:
            group = self.running.pop(future)
            outcomes = self._outcomes(future, group, single)
            future.release()
            with self._naming_scheduler():
                for index, outcome in zip(group, outcomes, strict=True):
                    if outcome is REPEAT:
                        completed.add(self._submit([index]))
            completed.update(submit())
            yield from (
                (index, outcome)
                for index, outcome in zip(group, outcomes, strict=True)
                if outcome is not REPEAT and outcome is not REPEAT_LATER
            )

    def _group(self, pending: deque[int]) -> list[int]:
        """The next tasks that are submitted together: several short ones, while there are enough for all workers."""
        size = 1
        if self.seconds is not None:
            size = max(1, min(int(GROUP_SECONDS / max(self.seconds, SHORTEST)), len(pending) // self._room()))
        return [pending.popleft() for _ in range(size)]

    def _outcomes(self, future: Any, group: list[int], single: bool) -> list[Any]:
        """For each finished task its result, its failure, or that it is repeated."""
        from distributed import KilledWorker

        try:
            seconds, outcomes = future.result()
            each = seconds / len(group)
            self.seconds = each if self.seconds is None else 0.5 * (self.seconds + each)
            return list(outcomes)
        except KilledWorker as killed:
            if single:
                return [Failure(f"its worker died {getattr(killed, 'allowed_failures', MOST_DEATHS) + 1} times")]
            self.suspects += group  # another task may have killed the worker
            return [REPEAT_LATER] * len(group)
        except (futures.CancelledError, asyncio.CancelledError):
            self._require_scheduler()
            self.shared = None  # it may be lost as well
            return [self._lost(index) for index in group]
        except ImportError as error:
            raise ValueError(
                f"the workers of {self._address()} lack what this process has: {one_line(error)}"
            ) from None
        except OSError:
            self._require_scheduler()
            raise  # of the task: the disk is full

    def _lost(self, index: int) -> Any:
        self.losses[index] += 1
        return REPEAT if self.losses[index] < MOST_DEATHS else Failure(f"it was lost {MOST_DEATHS} times")

    def _submit(self, group: list[int]) -> Any:
        if self.shared is None:  # a task, not scattered data: it is repeated if the workers that hold it are killed
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Sending large graph")
                self.shared = self.client.submit(bytes, self.payload, key=f"{self.name}-shared-{self.losses.total()}")
            self._spread()
        first = group[0]
        name = f"{self.name}-{first}-{self.losses[first]}-{self.suspects.count(first)}"
        arguments = (self.shared, self.name, [self.tasks[index] for index in group], precision())
        future = self.client.submit(perform, *arguments, key=name, retries=RETRIES, pure=False)
        self.running[future] = group
        return future

    def _spread(self) -> None:
        """Replicate the shared data to all workers: a scheduler prefers workers that hold the data of a task."""
        from distributed import wait

        with suppress(Exception):  # of workers that die meanwhile; others receive it later
            wait([self.shared], timeout=TIMEOUT)
            self.client.replicate([self.shared])

    def _room(self) -> int:
        """The number of tasks that may be submitted at a time."""
        if time.monotonic() - self.counted > RECOUNT:
            self.room = IN_FLIGHT * max(1, sum(self.client.nthreads().values()))
            self.counted = time.monotonic()
        return self.room

    def _address(self) -> str:
        return str(getattr(self.client.scheduler, "address", "the cluster"))

    def _require_scheduler(self) -> None:
        if self.client.status != "running":
            raise OSError(f"{self._address()}: the scheduler has stopped") from None

    @contextmanager
    def _naming_scheduler(self) -> Iterator[None]:
        """Errors of the connection name the scheduler."""
        try:
            yield
        except TimeoutError:
            self._require_scheduler()
            raise OSError(f"{self._address()}: no worker came within {TIMEOUT:g} s") from None
        except (OSError, RuntimeError, ValueError) as error:
            self._require_scheduler()
            raise OSError(f"{self._address()}: {one_line(error)}") from None


_jobs: dict[str, Any] = {}
_jobs_lock = threading.Lock()


def perform(payload: bytes, name: str, tasks: list[bytes], double: bool | None) -> tuple[float, list[Any]]:
    """Execute tasks in a worker; returns their seconds and outcomes. The worker is configured, and unpacks the shared
    data, once for each run of this name."""
    start = time.monotonic()
    with _jobs_lock:
        if name not in _jobs:
            configure(double, _threads())
            _jobs.clear()
            _jobs[name] = pickle.loads(payload)
        work, shared = _jobs[name]
    outcomes = [attempt(work, shared, pickle.loads(task)) for task in tasks]
    return time.monotonic() - start, outcomes


def _threads() -> int:
    """Threads of this worker."""
    from distributed import get_worker

    return int(get_worker().state.nthreads)
