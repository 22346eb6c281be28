"""Execution of tasks by the workers of a dask.distributed cluster.

A worker takes one task at a time, or a group of short ones. Workers with several threads use a process for several
tasks, which some libraries do not support.
"""

import asyncio
import pickle
import threading
import time
import uuid
import warnings
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent import futures
from contextlib import contextmanager, suppress
from typing import Any

from fits.engines.failures import MOST_DEATHS, Failure, attempt, one_line
from fits.engines.worker import configure, precision

IN_FLIGHT = 4
"""Tasks that are submitted for each thread of a worker."""

TIMEOUT, RECOUNT = 60.0, 5.0
"""Seconds to wait for the first worker, and after which workers are counted again: some clusters grow."""

GROUP_SECONDS, SHORTEST = 0.5, 1e-3
"""Seconds of work that go to a worker at a time if single tasks are shorter, as submitting takes milliseconds; and the
least that a task counts as."""

RETRIES = 3
"""Retries of a task that fails neither by its own error nor by the death of its worker."""

WITH_PORT = ("tcp", "tls", "ws", "wss", "ucx")
"""Schemes of a scheduler's address, besides those of threads of this process."""


def run_distributed(work: Any, shared: Any, tasks: list[Any], client: Any) -> Iterator[tuple[int, Any]]:
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
    valid = isinstance(client, Client) and not client.asynchronous
    if isinstance(client, str):
        with suppress(ValueError):  # a client would wait a minute for a host that there cannot be
            scheme, place = parse_address(client)
            valid = bool(parse_host_port(place)[0] if scheme in WITH_PORT else scheme == "inproc" and place)
    if not valid:
        wanted = "a distributed.Client, or the address of a scheduler, such as tcp://node1:8786"
        raise ValueError(f"client is {client!r}; it must be {wanted}")


@contextmanager
def connected(client: Any) -> Iterator[Any]:
    """A client; for an address a new one, which is closed with the block. Errors as those of `fits.engines.run`."""
    _require_client(client)
    from distributed import Client

    if not isinstance(client, str):
        yield client
        return
    try:
        new = Client(client, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"{client}: there is no scheduler ({one_line(error)})") from None
    try:
        yield new
    finally:
        with suppress(Exception):
            new.close(timeout=1)


class _Run:
    """Tasks that are submitted to a scheduler; running: the indices of those that each future executes."""

    def __init__(self, client: Any, payload: bytes, tasks: list[bytes]):
        self.client, self.payload, self.tasks = client, payload, tasks
        self.name = f"layerjax-{uuid.uuid4().hex[:12]}"
        self.running: dict[Any, list[int]] = {}
        self.submitted = 0
        self.seconds: float | None = None
        self.shared: Any = None
        self.room, self.counted = 1, float("-inf")

    def results(self) -> Iterator[tuple[int, Any]]:
        """Results of all tasks; those that ran on workers which died too often are repeated at the end, one by one:
        another task may have killed the worker."""
        if self.tasks:
            with self._naming_scheduler():
                self.client.wait_for_workers(1, timeout=TIMEOUT)
        suspects: list[int] = []
        yield from self._execute(range(len(self.tasks)), suspects)
        for index in suspects:
            yield from self._execute([index], None)

    def _execute(self, indices: Iterable[int], suspects: list[int] | None) -> Iterator[tuple[int, Any]]:
        from distributed import KilledWorker, as_completed

        pending, completed = deque(indices), as_completed(loop=self.client.loop)

        def submit() -> None:
            with self._naming_scheduler():
                while pending and len(self.running) < self._room():
                    completed.add(self._submit(self._group(pending)))

        submit()
        for future in completed:
            group, outcomes = self.running.pop(future), []
            try:
                seconds, outcomes = future.result()
                each = seconds / len(group)
                self.seconds = each if self.seconds is None else 0.5 * (self.seconds + each)
            except KilledWorker as killed:
                if suspects is None:
                    died = getattr(killed, "allowed_failures", MOST_DEATHS) + 1
                    outcomes = [Failure(f"its worker died {died} times")]
                else:
                    suspects += group
            except (futures.CancelledError, asyncio.CancelledError):
                self._require_scheduler()
                outcomes = [Failure("the scheduler has cancelled it")] * len(group)
            except ImportError as error:
                lacking = f"the workers of {self._address()} lack what this process has: {one_line(error)}"
                raise ValueError(lacking) from None
            except OSError:
                self._require_scheduler()
                raise  # of the task: the disk is full
            future.release()
            submit()
            yield from zip(group, outcomes, strict=False)

    def _group(self, pending: deque[int]) -> list[int]:
        """The next tasks that are submitted together: several short ones, while there are enough for all workers."""
        size = 1
        if self.seconds is not None:
            size = max(1, min(int(GROUP_SECONDS / max(self.seconds, SHORTEST)), len(pending) // self._room()))
        return [pending.popleft() for _ in range(size)]

    def _submit(self, group: list[int]) -> Any:
        if self.shared is None:  # a task, not scattered data: it is repeated if the workers that hold it are killed
            from distributed import wait

            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Sending large graph")
                self.shared = self.client.submit(bytes, self.payload, key=f"{self.name}-shared-{self.submitted}")
            with suppress(Exception):  # a scheduler prefers workers that hold the data; those that die get them later
                wait([self.shared], timeout=TIMEOUT)
                self.client.replicate([self.shared])
        self.submitted += 1
        arguments = (self.shared, self.name, [self.tasks[index] for index in group], precision())
        key = f"{self.name}-{self.submitted}"
        future = self.client.submit(perform, *arguments, key=key, retries=RETRIES, pure=False)
        self.running[future] = group
        return future

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
        except (OSError, RuntimeError, ValueError) as error:
            self._require_scheduler()
            no_worker = f"no worker came within {TIMEOUT:g} s"
            words = no_worker if isinstance(error, TimeoutError) else one_line(error)
            raise OSError(f"{self._address()}: {words}") from None


_jobs: dict[str, Any] = {}
_jobs_lock = threading.Lock()


def perform(payload: bytes, name: str, tasks: list[bytes], double: bool | None) -> tuple[float, list[Any]]:
    """Execute tasks in a worker; returns their seconds and outcomes. The worker is configured, and unpacks the common
    data, once for each run of this name."""
    from distributed import get_worker

    start = time.monotonic()
    with _jobs_lock:
        if name not in _jobs:
            configure(double, int(get_worker().state.nthreads))
            _jobs.clear()
            _jobs[name] = pickle.loads(payload)
        work, shared = _jobs[name]
    outcomes = [attempt(work, shared, pickle.loads(task)) for task in tasks]
    return time.monotonic() - start, outcomes
