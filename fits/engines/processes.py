"""Execution of tasks by processes of this machine, each on a core of its own; tasks of a killed one are repeated."""

import os
import pickle
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection, current_process, get_context, resource_tracker
from typing import Any

from fits.engines.failures import MOST_DEATHS, Failure
from fits.engines.worker import READY, Raised, environment, serve

AGAIN = 78
"""Exit code of a worker that runs its parent's script to the point where that starts workers."""

MOST_FALSE_STARTS = 10
"""Worker processes in a row that may die before they are ready: no task has caused that."""

PATIENCE = 5.0
"""Seconds that a worker has to end when no task remains."""

_environ = threading.Lock()


def run_processes(
    work: Callable[[Any, Any], Any], shared: Any, tasks: list[Any], processes: int
) -> Iterator[tuple[int, Any]]:
    """See `fits.engines.run`."""
    end_if_again()
    payload = _pickled((work, shared), "what tasks share")
    packed = [_pickled(task, "a task") for task in tasks]
    return _results(payload, packed, min(processes, len(tasks)))


def end_if_again() -> None:
    """End a worker process that runs its parent's script, which has no guard, to where that starts workers.

    To be called before anything that must not be repeated.
    """
    if getattr(current_process(), "_inheriting", False):
        sys.exit(AGAIN)


def _pickled(what: Any, called: str) -> bytes:
    try:
        return pickle.dumps(what, protocol=pickle.HIGHEST_PROTOCOL)
    except Exception as error:  # of any kind, as each class has its own
        raise ValueError(
            f"{called} cannot be pickled for other processes ({' '.join(str(error).split())}): lambdas and functions "
            "inside of functions cannot, such as a transport of that kind; processes=1 works with them"
        ) from None


class _Worker:
    """A process on a core, this end of the pipe to it, and the index of its current or first task."""

    def __init__(self, core: int | None, index: int):
        self.core, self.index, self.ready = core, index, False
        self.pipe, theirs = connection.Pipe()
        self.process = get_context("spawn").Process(target=serve, args=(theirs, core), daemon=True)
        try:
            with _worker_environment():
                self.process.start()
        finally:
            theirs.close()  # the worker's end: once it is closed the worker has ended

    def send(self, task: bytes) -> None:
        with suppress(OSError):  # it has ended, as its pipe will show
            self.pipe.send_bytes(task)

    def receive(self) -> bytes | None:
        """Its message; None: it has ended."""
        try:
            return self.pipe.recv_bytes()
        except (EOFError, OSError):
            self.process.kill()
            self.process.join()
            return None

    def end(self) -> None:
        self.pipe.close()
        self.process.kill()
        self.process.join()


class _Pool:
    """Workers, and the tasks that remain."""

    def __init__(self, payload: bytes, tasks: list[bytes]):
        self.payload, self.tasks = payload, tasks
        self.remaining = iter(range(len(tasks)))
        self.deaths: Counter[int] = Counter()
        self.false_starts = 0
        self.workers: list[_Worker] = []
        self.finished: list[_Worker] = []

    def start(self, core: int | None, index: int) -> None:
        self.workers.append(_Worker(core, index))

    def receive(self, worker: _Worker) -> tuple[int, Any] | None:
        """Receive a worker's message, or its death, and send its next task; returns a finished task."""
        index, message = worker.index, worker.receive()
        if message is None:
            return self._replace(worker)
        if message == READY:
            worker.ready, self.false_starts = True, 0
            worker.send(self.payload)
            worker.send(self.tasks[index])
            return None
        outcome = pickle.loads(message)
        if isinstance(outcome, Raised):
            raise outcome.error
        following = next(self.remaining, None)
        if following is None:
            worker.pipe.close()  # it ends by itself
            self.workers.remove(worker)
            self.finished.append(worker)
        else:
            worker.index = following
            worker.send(self.tasks[following])
        return index, outcome

    def _replace(self, worker: _Worker) -> tuple[int, Any] | None:
        """Replace a worker that has died by another with the same task, unless that has killed too many."""
        self.workers.remove(worker)
        worker.pipe.close()
        code, index = worker.process.exitcode or 0, worker.index
        if not worker.ready:
            self.false_starts += 1
            if code > 0 or self.false_starts == MOST_FALSE_STARTS:
                raise ValueError(_cannot_start(code, self.false_starts))
            self.start(worker.core, index)
            return None
        self.deaths[index] += 1
        lost = self.deaths[index] >= MOST_DEATHS
        following = next(self.remaining, None) if lost else index
        if following is not None:
            self.start(worker.core, following)
        return (index, Failure(f"its worker died {MOST_DEATHS} times ({_death(code)})")) if lost else None

    def end(self, patience: float) -> None:
        """End all workers; finished ones have so many seconds to end by themselves."""
        end = time.monotonic() + patience
        for worker in self.finished:
            worker.process.join(max(0.0, end - time.monotonic()))
        for worker in (*self.workers, *self.finished):
            worker.end()


def _results(payload: bytes, tasks: list[bytes], count: int) -> Iterator[tuple[int, Any]]:
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [None]
    pool, patience = _Pool(payload, tasks), 0.0
    try:
        for number, index in zip(range(count), pool.remaining, strict=False):
            pool.start(cores[number % len(cores)], index)
        while pool.workers:
            messages = connection.wait([worker.pipe for worker in pool.workers])
            workers = [worker for worker in pool.workers if worker.pipe in messages]
            yield from [done for worker in workers if (done := pool.receive(worker)) is not None]
        patience = PATIENCE
    finally:
        pool.end(patience)


@contextmanager
def _worker_environment() -> Iterator[None]:
    """Start processes with the environment of a worker, and with Ctrl-C blocked, which is for the parent."""
    resource_tracker.ensure_running()  # its start would unblock the signal
    masks = hasattr(signal, "pthread_sigmask")
    with _environ:
        before = dict(os.environ)
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else None
        try:
            os.environ.update(environment())
            yield
        finally:
            for name in set(os.environ) - set(before):
                del os.environ[name]
            os.environ.update(before)
            if blocked is not None:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _cannot_start(code: int, tried: int) -> str:
    if code <= 0:
        return f"{tried} worker processes in a row died as they started ({_death(code)})"
    guard = 'the statements of the script must be under `if __name__ == "__main__":`'
    if code == AGAIN:
        return f"each worker process runs the script that starts it: {guard}, or processes must be 1"
    return f"a worker process cannot start (exit code {code}, its message is above): {guard}"


def _death(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    with suppress(ValueError):
        name = signal.Signals(-code).name
        return f"{name}, which systems send when memory is short" if name == "SIGKILL" else name
    return f"signal {-code}"
