"""Parallel execution of independent tasks: by threads, by processes of this machine, or by a Dask cluster.

A function, data that all tasks share, and the tasks go in; results come out as they finish. A task that fails does not
affect the others; the tasks of a worker that is killed are repeated.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from fits.engines.failures import Failure as Failure


@contextmanager
def connected(client: Any) -> Iterator[Any]:
    """The client for several calls of `run`; for the address of a scheduler, one that is closed with the block.

    Raises:
        ValueError: no client and no address, or no `distributed`.
        OSError: no such scheduler.
    """
    if client is None:
        yield None
        return
    from fits.engines.distributed import connected

    with connected(client) as connection:
        yield connection


def run(
    work: Callable[[Any, Any], Any],
    shared: Any,
    tasks: Iterable[Any],
    *,
    processes: int = 1,
    client: Any = None,
    threads: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Execute all tasks; yields the index and result of each as it finishes.

    Args:
        work: called as `work(shared, task)`; for processes and clusters a function that can be imported there.
        shared: data of all tasks; each worker receives them once.
        tasks: any number of them.
        processes: 1: threads of this process, one a core; the first task runs by itself, as it compiles. More: so many
            processes, each on a core of its own with one thread: a script then needs
            ``if __name__ == "__main__":``.
        client: a `distributed.Client`, or the address of a scheduler (``"tcp://..."``), in place of processes. Its
            workers have layerjax installed and one thread each (``--nthreads 1``).
        threads: threads of this process; None: one a core. With 1 the calling thread executes the tasks.

    Yields:
        (index, result). The result is a `Failure` if `work` raised ValueError or OSError, or its worker died three
        times. A full disk and all other errors end the run. Leaving the loop ends the workers.

    Raises:
        ValueError: processes < 1; `work`, `shared` or a task that cannot be sent to a worker; a worker that cannot
            start; no `distributed`.
        OSError: no such scheduler, or one that has stopped.
    """
    if processes < 1:
        raise ValueError(f"processes is {processes}; it must be at least 1")
    tasks = list(tasks)
    if client is not None:
        from fits.engines.distributed import run_distributed

        return run_distributed(work, shared, tasks, client)
    if processes > 1:
        from fits.engines.processes import run_processes

        return run_processes(work, shared, tasks, processes)
    from fits.engines.threads import run_threads

    return run_threads(work, shared, tasks, threads)
