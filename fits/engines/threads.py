"""Tasks by threads of this process: those of JAX run beside each other, for they leave Python while they compute."""

from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Any

from fits.engines.failures import attempt


def run_threads(
    work: Callable[[Any, Any], Any], shared: Any, tasks: list[Any], threads: int | None = None
) -> Iterator[tuple[int, Any]]:
    """See `fits.engines.run`. Whoever leaves the loop waits for the tasks that have begun."""
    from fits.problem.compilation import cores

    left, most = iter(enumerate(tasks)), threads or cores()
    # the first alone: it compiles the program, which keeps one core busy
    for index, task in islice(left, None if most == 1 else 1):
        yield index, attempt(work, shared, task)
    pool = ThreadPoolExecutor(most)
    running: dict[Future[Any], int] = {}

    def begin(count: int) -> None:
        for index, task in islice(left, count):
            running[pool.submit(attempt, work, shared, task)] = index

    try:
        begin(most)
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                index, result = running.pop(future), future.result()
                begin(1)
                yield index, result
    finally:
        pool.shutdown(cancel_futures=True)
