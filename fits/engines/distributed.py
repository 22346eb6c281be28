"""Tasks by the workers of a dask.distributed cluster, wherever they are.

A worker takes one task at a time, or a few where they are short; those of several threads share a process, which its
libraries may not bear.
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
from fits.engines.worker import precision, take_after

IN_FLIGHT = 4
"""Tasks for each thread of a worker that the scheduler knows of."""

WAITED = 60.0
"""Seconds for the first worker."""

COUNTED = 5.0
"""Seconds after which workers are counted again: some clusters grow."""

ENOUGH = 0.5
"""Seconds of work that go to a worker at a time, where single tasks are shorter: to hand one out takes milliseconds."""

SHORTEST = 1e-3
"""Seconds that a task takes at least."""

RETRIES = 3
"""Of a task that ends by an error which is neither its own nor the death of its worker."""

WITH_PORT = ("tcp", "tls", "ws", "wss", "ucx")
"""Kinds of addresses of a scheduler, beside those of threads of this process."""

AGAIN, LATER = object(), object()
"""In the place of an outcome, where the task is to be done once more."""


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


def _results(payload: bytes, tasks: list[bytes], given: Any) -> Iterator[tuple[int, Any]]:
    if not tasks:
        return
    with connected(given) as client:
        run = _Run(client, payload, tasks)
        try:
            yield from run.results()
        finally:
            with suppress(Exception):  # of a scheduler that has gone
                client.cancel(list(run.running), force=True)


def _require_client(given: Any) -> None:
    """Refuse what is no client, and no address of a scheduler."""
    try:
        from distributed import Client
        from distributed.comm.addressing import parse_address, parse_host_port
    except ImportError:
        raise ValueError('client= needs distributed: pip install "layerjax[distributed]"') from None
    wanted = "a distributed.Client, or the address of a scheduler, such as tcp://node1:8786"
    if not isinstance(given, str | Client) or getattr(given, "asynchronous", False):
        raise ValueError(f"client is {given!r}; it must be {wanted}")
    if isinstance(given, str):
        try:
            scheme, place = parse_address(given)
            host = parse_host_port(place)[0] if scheme in WITH_PORT else place if scheme == "inproc" else ""
        except ValueError:  # a client that meets this waits a minute for itself
            host = ""
        if not host:
            raise ValueError(f"client is {given!r}; it must be {wanted}")


@contextmanager
def connected(given: Any) -> Iterator[Any]:
    """A client; one of our own for an address, and it ends with the block. Errors as those of `fits.engines.run`."""
    _require_client(given)
    from distributed import Client

    if not isinstance(given, str):
        yield given
        return
    try:
        client = Client(given, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"{given}: there is no scheduler ({one_line(error)})") from None
    try:
        yield client
    finally:
        with suppress(Exception):
            client.close(timeout=1)


class _Run:
    """Tasks on their way through a scheduler."""

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
        """Tasks a few at a time; in the end, each alone, those that were in hand where workers died too often."""
        with self._reached():
            self.client.wait_for_workers(1, timeout=WAITED)
        yield from self._through(list(range(len(self.tasks))), alone=False)
        for index in self.suspects:
            yield from self._through([index], alone=True)

    def _through(self, indices: list[int], alone: bool) -> Iterator[tuple[int, Any]]:
        from distributed import as_completed

        left = deque(indices)

        def begin() -> list[Any]:
            with self._reached():
                return [self._submit(self._group(left)) for _ in range(self._room() - len(self.running)) if left]

        completed = as_completed(begin(), loop=self.client.loop)
        for future in completed:
            group = self.running.pop(future)
            outcomes = self._outcomes(future, group, alone)
            future.release()
            with self._reached():
                for index, outcome in zip(group, outcomes, strict=True):
                    if outcome is AGAIN:
                        completed.add(self._submit([index]))
            completed.update(begin())
            yield from (
                (index, outcome)
                for index, outcome in zip(group, outcomes, strict=True)
                if outcome is not AGAIN and outcome is not LATER
            )

    def _group(self, left: deque[int]) -> list[int]:
        """The next tasks that go together: short ones, while there are enough for all workers."""
        size = 1
        if self.seconds is not None:
            size = max(1, min(int(ENOUGH / max(self.seconds, SHORTEST)), len(left) // self._room()))
        return [left.popleft() for _ in range(size)]

    def _outcomes(self, future: Any, group: list[int], alone: bool) -> list[Any]:
        """Of each of the tasks that have ended its result, its failure, or when it is to be done once more."""
        from distributed import KilledWorker

        try:
            seconds, outcomes = future.result()
            each = seconds / len(group)
            self.seconds = each if self.seconds is None else 0.5 * (self.seconds + each)
            return list(outcomes)
        except KilledWorker as killed:
            if alone:
                return [Failure(f"its worker died {getattr(killed, 'allowed_failures', MOST_DEATHS) + 1} times")]
            self.suspects += group  # the worker may have died of a task beside it
            return [LATER] * len(group)
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
        return AGAIN if self.losses[index] < MOST_DEATHS else Failure(f"it was lost {MOST_DEATHS} times")

    def _submit(self, group: list[int]) -> Any:
        if self.shared is None:  # a task, not scattered data: it is done again where the workers that had it are killed
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Sending large graph")
                self.shared = self.client.submit(bytes, self.payload, key=f"{self.name}-shared-{self.losses.total()}")
            self._spread()
        first = group[0]
        name = f"{self.name}-{first}-{self.losses[first]}-{self.suspects.count(first)}"
        given = (self.shared, self.name, [self.tasks[index] for index in group], precision())
        future = self.client.submit(perform, *given, key=name, retries=RETRIES, pure=False)
        self.running[future] = group
        return future

    def _spread(self) -> None:
        """Give all workers what tasks share: a scheduler gives a task to those alone that have what it needs."""
        from distributed import wait

        with suppress(Exception):  # of workers that die meanwhile; others come to have it by and by
            wait([self.shared], timeout=WAITED)
            self.client.replicate([self.shared])

    def _room(self) -> int:
        """Tasks that may be on their way."""
        if time.monotonic() - self.counted > COUNTED:
            self.room = IN_FLIGHT * max(1, sum(self.client.nthreads().values()))
            self.counted = time.monotonic()
        return self.room

    def _address(self) -> str:
        return str(getattr(self.client.scheduler, "address", "the cluster"))

    def _require_scheduler(self) -> None:
        if self.client.status != "running":
            raise OSError(f"{self._address()}: the scheduler has gone away") from None

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """Errors on the way to the scheduler name it."""
        try:
            yield
        except TimeoutError:
            self._require_scheduler()
            raise OSError(f"{self._address()}: no worker came within {WAITED:g} s") from None
        except (OSError, RuntimeError, ValueError) as error:
            self._require_scheduler()
            raise OSError(f"{self._address()}: {one_line(error)}") from None


_kept: dict[str, Any] = {}
_keeping = threading.Lock()


def perform(payload: bytes, name: str, tasks: list[bytes], double: bool | None) -> tuple[float, list[Any]]:
    """Tasks in a worker, and their seconds; of each run that has this name it is set up, and unpacks what tasks share,
    once."""
    began = time.monotonic()
    with _keeping:
        if name not in _kept:
            take_after(double, _threads())
            _kept.clear()
            _kept[name] = pickle.loads(payload)
        work, shared = _kept[name]
    outcomes = [attempt(work, shared, pickle.loads(task)) for task in tasks]
    return time.monotonic() - began, outcomes


def _threads() -> int:
    """Those that this worker may use."""
    from distributed import get_worker

    return int(get_worker().state.nthreads)
