"""Parallel execution of independent tasks: by threads, by processes of this machine, or by a Dask cluster.

A function, data that all tasks have in common, and the tasks go in; results come out as they finish. A task that fails
does not affect the others; the tasks of a worker that is killed are repeated. Processes of this machine are a cluster
of Dask as well, whose workers have one thread each, the precision of their parent and its compiled programs.
"""

import asyncio
import ctypes
import errno
import logging
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent import futures
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from multiprocessing import current_process
from typing import Any, NamedTuple

TIMEOUT = 60.0  # seconds to wait for the first worker

FULL = (errno.ENOSPC, errno.EDQUOT)  # errors of a full disk, which affect every task

LOCAL = {
    "distributed.admin.tick.interval": "1s",
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.worker-saturation": 1.0,
}
"""Settings of a cluster on this machine: no statistics, which take a twentieth of every core, and no second task that
waits in a worker, where a first that kills the worker would count against it."""

MOST_TOGETHER, TURNS = 8, 8
"""Short tasks that are sent at once, at most, and how often each worker comes round at least."""

Work = Callable[[Any, Any], Any]


class Failure(NamedTuple):
    """Result of a task that failed; error: what it raised, on one line, or how its workers died."""

    error: str


def run(
    work: Work,
    shared: Any,
    tasks: Iterable[Any],
    *,
    processes: int = 1,
    client: Any = None,
    threads: int | None = None,
    short: bool = False,
) -> Iterator[tuple[int, Any]]:
    """Execute all tasks; yields the index and result of each as it finishes.

    Args:
        work: called as `work(shared, task)`; a function that workers can import, if it is not sent with its code.
        shared: data of all tasks; each worker receives them once.
        tasks: any number of them.
        processes, client: see `connected`; without either, threads of this process.
        threads: so many; None: one a core. With 1 the calling thread executes the tasks.
        short: whether tasks take less than a second. Several of many are then sent to a worker at once.

    Yields:
        (index, result): a `Failure` if `work` raised ValueError or OSError, or its worker died four times. A full disk,
        all other errors, and a scheduler that stops end the run.
    """
    with connected(client, processes) as connection:
        if connection is None:
            from fits.problem.compilation import as_finished

            # threads of JAX run beside each other, for they leave Python while they compute
            yield from as_finished(partial(attempt, work, shared), tasks, threads)
        else:
            yield from _run_cluster(work, shared, list(tasks), connection, short)


@contextmanager
def connected(client: Any, processes: int = 1) -> Iterator[Any]:
    """A client for several calls of `run`, which is closed with the block if it was made here; None: threads.

    Args:
        client: a `distributed.Client`, or the address of a scheduler (``"tcp://..."``). Its workers have layerjax
            installed and one thread each (``--nthreads 1``).
        processes: without a client, so many processes of this machine with one thread each, if there are several: a
            script then needs ``if __name__ == "__main__":``.

    ValueError: no client and no address; no `distributed`; workers that cannot start. OSError: no such scheduler.
    """
    if client is None and processes == 1:
        yield None
        return
    if getattr(current_process(), "_inheriting", False):  # a worker that runs its parent's script, which has no guard
        sys.exit(78)
    try:
        from distributed import Client
    except ImportError:
        needs = "processes > 1 needs" if client is None else "client= needs"
        raise ValueError(f'{needs} distributed: pip install "layerjax[distributed]"') from None
    if client is None:
        with local_cluster(processes) as connection:
            yield connection
    elif isinstance(client, Client) and not client.asynchronous:
        yield client
    elif isinstance(client, str) and "://" in client:
        try:
            connection = Client(client, set_as_default=False)
        except (OSError, ValueError) as error:
            raise OSError(f"{client}: there is no scheduler ({one_line(error)})") from None
        try:
            yield connection
        finally:
            with suppress(Exception):
                connection.close(timeout=1)
    else:
        wanted = "a distributed.Client, or the address of a scheduler, such as tcp://node1:8786"
        raise ValueError(f"client is {client!r}; it must be {wanted}")


@contextmanager
def local_cluster(processes: int) -> Iterator[Any]:
    """A client of so many processes of this machine with one thread each."""
    from dask import config
    from distributed import Client, LocalCluster

    try:
        with config.set(LOCAL):
            cluster = LocalCluster(
                n_workers=processes,
                threads_per_worker=1,
                memory_limit=0,
                dashboard_address=":0",
                silence_logs=logging.CRITICAL,  # of workers that are killed and started again
                env=environment(),
                preload=__name__,
            )
    except Exception as error:  # its kind differs between versions
        guard = 'something ends them, or a script has no `if __name__ == "__main__":` around its statements'
        raise ValueError(f"worker processes cannot start ({one_line(error)}): {guard}") from None
    with cluster, Client(cluster, set_as_default=False) as client:
        yield client


# ---- one task ----


def attempt(work: Work, shared: Any, task: Any) -> Any:
    """The result of a task, or its failure; errors that end the run are raised."""
    try:
        return work(shared, task)
    except (ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno in FULL:
            raise
        return Failure(one_line(error))


def one_line(error: BaseException) -> str:
    """An error as the command line prints it."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split()) or type(error).__name__


# ---- the workers of a cluster ----


def _run_cluster(work: Work, shared: Any, tasks: list[Any], client: Any, short: bool) -> Iterator[tuple[int, Any]]:
    """A worker takes one task at a time: for several, workers with several threads use a process."""
    import cloudpickle
    from distributed import KilledWorker, as_completed

    try:
        payload, pickled = cloudpickle.dumps((work, shared)), [cloudpickle.dumps(task) for task in tasks]
    except Exception as error:  # of any kind, as each class has its own
        raise ValueError(f"what tasks need cannot be pickled for the workers: {one_line(error)}") from None
    if not tasks:
        return
    address, submitted = str(getattr(client.scheduler, "address", "the cluster")), dict[Any, range]()

    def require_scheduler() -> None:
        if client.status != "running":
            raise OSError(f"{address}: the scheduler has stopped") from None

    try:
        client.wait_for_workers(1, timeout=TIMEOUT)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sending large graph")
            # a task, not scattered data: it is repeated if the workers that hold it are killed
            sent = client.submit(bytes, payload, pure=False)
            with client.as_current():
                sent.result(timeout=TIMEOUT)
                client.replicate([sent])  # a scheduler prefers workers that hold the data
            together = max(1, min(MOST_TOGETHER, len(tasks) // (TURNS * len(client.nthreads())))) if short else 1
            for at in range(0, len(tasks), together):
                group = range(at, min(at + together, len(tasks)))
                future = client.submit(perform, sent, pickled[at : at + together], precision(), pure=False)
                submitted[future] = group
        for future in as_completed(list(submitted), loop=client.loop):
            group = submitted.pop(future)
            try:
                results = future.result()
            except KilledWorker as killed:
                words = f"its worker died {getattr(killed, 'allowed_failures', 3) + 1} times"
                results = [Failure(words)] * len(group)
            except (futures.CancelledError, asyncio.CancelledError):
                require_scheduler()
                results = [Failure("the scheduler has cancelled it")] * len(group)
            future.release()
            yield from zip(group, results, strict=True)
    except TimeoutError:
        raise OSError(f"{address}: no worker came within {TIMEOUT:g} s") from None
    except (OSError, RuntimeError):
        require_scheduler()
        raise  # of the task
    finally:
        with suppress(Exception):  # of a scheduler that has stopped
            client.cancel(list(submitted), force=True)


def perform(payload: bytes, tasks: list[bytes], double: bool | None) -> list[Any]:
    """Execute tasks in a worker, whatever the number of its threads."""
    with _unpacking:
        work, shared = unpacked(payload, double)
    return [attempt(work, shared, pickle.loads(task)) for task in tasks]


_unpacking = threading.Lock()


@lru_cache(maxsize=1)
def unpacked(payload: bytes, double: bool | None) -> Any:
    """What all tasks have in common, in a worker that is configured for them."""
    from distributed import get_worker

    configure(double, int(get_worker().state.nthreads))
    return pickle.loads(payload)


def precision() -> bool | None:
    """Whether this process computes in double precision; None: JAX is not imported."""
    jax = sys.modules.get("jax")
    return None if jax is None else bool(jax.config.jax_enable_x64)


def configure(double: bool | None, threads: int) -> None:
    """Configure a worker that has imported JAX: precision of the caller, a compilation cache, and this number of
    threads, unless it has computed before."""
    import jax

    from layerjax.compiling import keep_programs

    quieten()
    if "MALLOC_TRIM_THRESHOLD_" in os.environ:  # of dask: to return memory costs more than a short task; no glibc: none
        with suppress(OSError, AttributeError):
            for parameter in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
                ctypes.CDLL(None).mallopt(parameter, 1 << 25)
    os.environ.setdefault("NPROC", str(threads))  # from which XLA reads it; XLA_FLAGS would change results
    if double is not None:
        jax.config.update("jax_enable_x64", double)
    keep_programs()


def environment() -> dict[str, str]:
    """Environment variables of a worker process of this machine: one thread, and the programs of its parent."""
    from layerjax.compiling import CACHE_DIRECTORY, CACHE_LEAST_TIME

    variables = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC"), "1")
    if "XLA_PYTHON_CLIENT_PREALLOCATE" not in os.environ:  # several use one accelerator
        variables["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    values = sys.modules["jax"].config.values
    if values[CACHE_DIRECTORY]:
        variables |= {
            CACHE_DIRECTORY.upper(): values[CACHE_DIRECTORY],
            CACHE_LEAST_TIME.upper(): str(values[CACHE_LEAST_TIME]),
        }
    return variables


def dask_setup(worker: Any) -> None:
    """Called by a worker process of this machine as it starts, for it preloads this module: Ctrl-C is for the parent,
    which ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def quieten() -> None:
    """Silence warnings of libraries that do not concern the results."""
    # arviz announces its next version on import; compiled programs that cannot be kept are compiled again
    warnings.filterwarnings("ignore", category=FutureWarning, module="arviz")
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")
