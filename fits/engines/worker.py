"""Configuration of workers: one thread on one core, the precision of the parent, a cache of compiled programs.

Processes receive most of it by their environment, which JAX and LAPACK read on import. A worker of a cluster has
imported JAX and is configured by a call.
"""

import ctypes
import os
import pickle
import signal
import sys
import threading
import traceback
import warnings
from contextlib import suppress
from multiprocessing import connection, parent_process
from typing import Any, NamedTuple

from fits.engines.failures import attempt

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
XLA_THREADS = "NPROC"
"""The variable from which XLA reads its number of threads."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
THRESHOLD = 1 << 25
"""Bytes: the largest value that glibc itself adapts the second of them to."""

READY = b""
"""First message of a worker."""


class Raised(NamedTuple):
    """An error of a task that ends the run."""

    error: Exception


def environment() -> dict[str, str]:
    """Environment variables of a worker process that differ from those of its parent."""
    variables = dict.fromkeys((*ONE_THREAD, XLA_THREADS), "1")  # not by XLA_FLAGS, which change results
    if "XLA_PYTHON_CLIENT_PREALLOCATE" not in os.environ:  # several share one accelerator
        variables["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    jax = sys.modules.get("jax")
    from layerjax.compiling import FOLDER, LEAST, LEAST_COMPILE, compile_cache  # imports JAX: not before it is needed

    directory: str | None = os.environ.get(FOLDER.upper())
    if jax is not None:
        variables["JAX_ENABLE_X64"] = str(int(jax.config.jax_enable_x64))
        directory = jax.config.values[FOLDER]
        if directory:
            variables[LEAST.upper()] = str(jax.config.values[LEAST])
    if not directory and (directory := compile_cache()):
        variables[LEAST.upper()] = str(LEAST_COMPILE)
    return variables | ({FOLDER.upper(): directory} if directory else {})


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
    _keep_memory()
    os.environ.setdefault(XLA_THREADS, str(threads))
    if double is not None:
        jax.config.update("jax_enable_x64", double)
    keep_programs()


def _keep_memory() -> None:
    """Do not return memory to the system after every computation, as dask configures its workers: to allocate it again
    costs more than the overhead of short tasks."""
    if "MALLOC_TRIM_THRESHOLD_" in os.environ:
        with suppress(OSError, AttributeError):  # of another C library
            mallopt = ctypes.CDLL(None).mallopt
            mallopt(M_TRIM_THRESHOLD, THRESHOLD)
            mallopt(M_MMAP_THRESHOLD, THRESHOLD)


def quieten() -> None:
    """Silence warnings of libraries that do not concern the results."""
    # arviz announces its next version on import; compiled programs that cannot be kept are compiled again
    warnings.filterwarnings("ignore", category=FutureWarning, module="arviz")
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")


def serve(pipe: "connection.Connection", core: int | None) -> None:
    """Main loop of a worker process: it receives `work` with the shared data, then tasks, and sends their results,
    until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted as well, and ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    quieten()
    call: tuple[Any, Any] | None = None
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        pipe.send_bytes(READY)
        payload = pipe.recv_bytes()
        while True:
            task = pipe.recv_bytes()
            try:
                if call is None:
                    call = pickle.loads(payload)
                    _pin(core)
                work, shared = call
                outcome = attempt(work, shared, pickle.loads(task))
            except Exception as error:
                error.add_note(f"in a worker process:\n{traceback.format_exc()}")
                outcome = Raised(error)
            pipe.send_bytes(_packed(outcome))


def _packed(outcome: Any) -> bytes:
    try:
        packed = pickle.dumps(outcome)
        if isinstance(outcome, Raised):
            pickle.loads(packed)  # some errors can be packed only
        return packed
    except Exception as error:
        if isinstance(outcome, Raised):
            text = f"{type(outcome.error).__name__}: {outcome.error}"
            return pickle.dumps(Raised(RuntimeError(f"{text}\n{''.join(outcome.error.__notes__)}")))
        text = f"the result of a task, a {type(outcome).__name__}, cannot be pickled: {error}"
        return pickle.dumps(Raised(ValueError(text)))


def _pin(core: int | None) -> None:
    """Pin all threads, and those that they will start, to one core, after XLA has started its compilation threads, one
    a core that it may run on: with a single one, half a gigabyte of programs would queue up behind it."""
    if "jax" in sys.modules:
        import jax

        jax.block_until_ready(jax.jit(jax.numpy.sin)(1.0))
    if core is None:
        return
    threads = [0]
    with suppress(OSError, ValueError):
        threads = [int(name) for name in os.listdir("/proc/self/task")]
    for thread in threads:
        with suppress(OSError):
            os.sched_setaffinity(thread, {core})


def _end_with_parent() -> None:
    """Wait for the end of the parent, and end."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
