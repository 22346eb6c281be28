"""Tasks by threads of this process: those of JAX run beside each other, for they leave Python while they compute."""

from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Any

from fits.engines.failures import attempt


def run_threads(work: Callable[[Any, Any], Any], shared: Any, tasks: list[Any]) -> Iterator[tuple[int, Any]]:
    """See `fits.engines.run`. Whoever leaves the loop waits for the tasks that have begun."""
    from fits.problem.compiled import cores

    left = iter(enumerate(tasks))
    for index, task in islice(left, 1):  # alone: it compiles the program, which keeps one core busy
        yield index, attempt(work, shared, task)
    pool = ThreadPoolExecutor(cores())
    running: dict[Future[Any], int] = {}

    def begin(count: int) -> None:
        for index, task in islice(left, count):
            running[pool.submit(attempt, work, shared, task)] = index

    try:
        begin(cores())
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                index, result = running.pop(future), future.result()
                begin(1)
                yield index, result
    finally:
        pool.shutdown(cancel_futures=True)
