"""Parallel execution of independent tasks: by threads, by processes of this machine, or by a Dask cluster.

A function, data that all tasks have in common, and the tasks go in; results come out as they finish. A task that fails
does not affect the others; the tasks of a worker that is killed are repeated.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from typing import Any

from fits.engines.failures import Failure as Failure
from fits.engines.failures import attempt

Work = Callable[[Any, Any], Any]


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
    work: Work,
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
            processes with one thread each: a script then needs ``if __name__ == "__main__":``.
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
    return _run_threads(work, shared, tasks, threads)


def _run_threads(work: Work, shared: Any, tasks: list[Any], threads: int | None) -> Iterator[tuple[int, Any]]:
    """Threads of JAX run beside each other, for they leave Python while they compute."""
    from fits.problem.compilation import cores
    from layerjax._numerics import broadcasting

    pending, most = iter(enumerate(tasks)), threads or cores()
    # the first by itself: it compiles the program, which keeps one core busy
    for index, task in islice(pending, None if most == 1 else 1):
        yield index, attempt(work, shared, task)
    running: dict[Future[Any], int] = {}
    pool = ThreadPoolExecutor(most)
    try:
        while True:
            for index, task in islice(pending, most - len(running)):
                running[pool.submit(broadcasting(attempt), work, shared, task)] = index
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()
    finally:
        pool.shutdown(cancel_futures=True)  # waits for the tasks that have begun
