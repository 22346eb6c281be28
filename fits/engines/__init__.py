"""Many tasks that do not need each other: by threads of this process, by processes of this machine, or by a cluster.

A function, what all tasks share, and the tasks go in; results come out as they end. A task that fails costs
itself alone, a worker that is killed what it had in hand, which is done again.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from fits.engines.failures import Failure as Failure


@contextmanager
def connected(client: Any) -> Iterator[Any]:
    """The client for many calls of `run`: where the address of a scheduler is given, one that ends with the block.

    Raises:
        ValueError: no client and no address, or no `distributed`.
        OSError: no such scheduler.
    """
    if client is None:
        yield None
        return
    from fits.engines.distributed import connected

    with connected(client) as found:
        yield found


def run(
    work: Callable[[Any, Any], Any],
    shared: Any,
    tasks: Iterable[Any],
    *,
    processes: int = 1,
    client: Any = None,
    threads: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Do all tasks; yields the index of each, and what `work` made of it, as they end.

    Args:
        work: called as `work(shared, task)`. Of processes and clusters, a function that can be imported there.
        shared: what all tasks need; each worker gets it once.
        tasks: any number of them.
        processes: 1: threads of this process, one a core, of which the first task has none beside it (it compiles). Of
            more each is a process of its own on a core of its own, with one thread: a script that asks for them does
            so under ``if __name__ == "__main__":``.
        client: a `distributed.Client`, or the address of a scheduler (``"tcp://..."``), in place of processes. Its
            workers have layerjax, and take one task at a time: one thread each (``--nthreads 1``).
        threads: of this process, where they do it; None: one a core. By a single one it is done by whoever calls.

    Yields:
        (index, result). In the place of a result stands a `Failure` where `work` raised ValueError or OSError, or its
        worker died three times. A full disk and all other errors end the run. Whoever leaves the loop ends the workers.

    Raises:
        ValueError: processes < 1; `work`, `shared` or a task that cannot be sent to a worker; a worker that cannot
            start; no `distributed`.
        OSError: no such scheduler, or one that has gone away.
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
