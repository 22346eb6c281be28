"""Execution of tasks by processes of this machine with one thread each; tasks of a killed one are repeated.

The standard library's pool of processes ends as a whole when one of them is killed. Here each has a pipe of its own:
one that is closed says that its process has died, and with which task.
"""

import os
import pickle
import signal
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from multiprocessing import connection, current_process, get_context, resource_tracker
from typing import Any

from fits.engines.failures import MOST_DEATHS, Failure
from fits.engines.worker import READY, Raised, environment, serve

SCRIPT_REPEATED = 78
"""Exit code of a worker that runs its parent's script to the point where that starts workers."""

MOST_FALSE_STARTS = 10
"""Worker processes that may die before they are ready: no task has caused that."""


def run_processes(work: Any, shared: Any, tasks: list[Any], processes: int) -> Iterator[tuple[int, Any]]:
    """See `fits.engines.run`."""
    end_repeated_script()
    payload = _pickled((work, shared), "what tasks have in common")
    return _results(payload, [_pickled(task, "a task") for task in tasks], min(processes, len(tasks)))


def end_repeated_script() -> None:
    """End a worker process that runs its parent's script, which has no guard, to where that starts workers.

    To be called before anything that must not be repeated.
    """
    if getattr(current_process(), "_inheriting", False):
        sys.exit(SCRIPT_REPEATED)


def _pickled(what: Any, called: str) -> bytes:
    try:
        return pickle.dumps(what, protocol=pickle.HIGHEST_PROTOCOL)
    except Exception as error:  # of any kind, as each class has its own
        raise ValueError(
            f"{called} cannot be pickled for other processes ({' '.join(str(error).split())}): lambdas and functions "
            "inside of functions cannot, such as a transport of that kind; processes=1 works with them"
        ) from None


def _results(payload: bytes, tasks: list[bytes], count: int) -> Iterator[tuple[int, Any]]:
    pending, deaths, false_starts = iter(range(len(tasks))), Counter[int](), 0
    workers: dict[Any, _Worker] = {}  # by their pipes

    def start(indices: Iterator[int]) -> None:
        for index in indices:
            worker = _Worker(index)
            workers[worker.pipe] = worker

    try:
        start(islice(pending, count))
        while workers:
            results = []
            for pipe in connection.wait(list(workers)):
                worker = workers[pipe]
                index, message = worker.index, worker.receive()
                if message == READY:
                    worker.send(payload, tasks[index])
                elif message is None:  # it has died: another takes its task, unless that has killed too many
                    del workers[pipe]
                    code = worker.process.exitcode or 0
                    if worker.ready:
                        deaths[index] += 1
                    else:
                        false_starts += 1
                        if code > 0 or false_starts == MOST_FALSE_STARTS:
                            raise ValueError(_cannot_start(code, false_starts))
                    lost = deaths[index] == MOST_DEATHS
                    start(islice(pending, 1) if lost else iter([index]))
                    if lost:
                        results.append((index, Failure(f"its worker died {MOST_DEATHS} times ({_death(code)})")))
                else:
                    results.append((index, _outcome(message)))
                    if (following := next(pending, None)) is None:
                        workers.pop(pipe).end()
                    else:
                        worker.index = following
                        worker.send(tasks[following])
            yield from results
    finally:
        for worker in workers.values():
            worker.end()


def _outcome(message: bytes) -> Any:
    """The result that a worker sends; what it warns of is a warning of this process, and its error raised here."""
    outcome, warned = pickle.loads(message)
    for words, category in warned:
        warnings.warn(words, category, stacklevel=1)
    if isinstance(outcome, Raised):
        raise outcome.error
    return outcome


class _Worker:
    """A process, this end of the pipe to it, and the index of its current or first task."""

    def __init__(self, index: int):
        self.index, self.ready = index, False
        self.pipe, theirs = connection.Pipe()
        self.process = get_context("spawn").Process(target=serve, args=(theirs,), daemon=True)
        try:
            with _worker_environment():
                self.process.start()
        finally:
            theirs.close()  # the worker's end: once it is closed the worker has ended

    def send(self, *messages: bytes) -> None:
        with suppress(OSError):  # it has ended, as its pipe will show
            for message in messages:
                self.pipe.send_bytes(message)

    def receive(self) -> bytes | None:
        """Its message; None: it has ended."""
        try:
            message: bytes = self.pipe.recv_bytes()
            self.ready = True
            return message
        except (EOFError, OSError):
            self.end()
            return None

    def end(self) -> None:
        """Kill it, if it has not ended."""
        self.pipe.close()
        self.process.kill()
        self.process.join()


@contextmanager
def _worker_environment() -> Iterator[None]:
    """Start a process with the environment of a worker, and with Ctrl-C blocked, which is for the parent."""
    resource_tracker.ensure_running()  # its start would unblock the signal
    has_masks, before = hasattr(signal, "pthread_sigmask"), dict(os.environ)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if has_masks else None
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
        return f"{tried} worker processes died as they started ({_death(code)})"
    why = "it runs the script that starts it" if code == SCRIPT_REPEATED else f"exit code {code}, its message is above"
    guard = 'the statements of the script must be under `if __name__ == "__main__":`, or processes must be 1'
    return f"a worker process cannot start ({why}): {guard}"


def _death(code: int) -> str:
    killed = ", which systems send when memory is short" if code == -signal.SIGKILL else ""
    return f"exit code {code}" if code >= 0 else f"{signal.Signals(-code).name}{killed}"
