"""What a worker is set to: one thread on one core, precision as its parent has it, compiled programs that are kept.

Processes get most of it by their environment, which JAX and LAPACK read as they are imported. A worker of a cluster
has imported JAX, and is told.
"""

import ctypes
import os
import pickle
import shutil
import signal
import sys
import threading
import traceback
import warnings
from contextlib import suppress
from multiprocessing import connection, parent_process
from pathlib import Path
from typing import Any, NamedTuple

from fits.engines.compile_cache import FOLDER, LEAST, LEAST_COMPILE, compile_cache, keep_programs
from fits.engines.failures import attempt

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
XLA_THREADS = "NPROC"
"""A variable that XLA reads when it starts the threads that compute: so many."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
KEPT = 1 << 25
"""Bytes: the most that glibc comes to by itself for the second of them."""

READY = b""
"""What a worker sends first."""


class Raised(NamedTuple):
    """An error of a task that ends the run."""

    error: Exception


def environment() -> dict[str, str]:
    """Variables of a worker process that are not those of this one."""
    found = dict.fromkeys((*ONE_THREAD, XLA_THREADS), "1")  # not by XLA_FLAGS, which change results
    if "XLA_PYTHON_CLIENT_PREALLOCATE" not in os.environ:  # several share one accelerator
        found["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    jax = sys.modules.get("jax")
    directory: str | None = os.environ.get(FOLDER.upper())
    if jax is not None:
        found["JAX_ENABLE_X64"] = str(int(jax.config.jax_enable_x64))
        directory = jax.config.values[FOLDER]
        if directory:
            found[LEAST.upper()] = str(jax.config.values[LEAST])
    if not directory and (directory := compile_cache()):
        found[LEAST.upper()] = str(LEAST_COMPILE)
    return found | ({FOLDER.upper(): directory} if directory else {})


def precision() -> bool | None:
    """Whether this process computes in double precision; None: it has not imported JAX."""
    jax = sys.modules.get("jax")
    return None if jax is None else bool(jax.config.jax_enable_x64)


def take_after(double: bool | None, threads: int) -> None:
    """Set the JAX of a worker that has it already to the precision of who asks, with a cache where it has none; and to
    so many threads, unless it has computed before."""
    import jax

    quieten()
    _keep_memory()
    os.environ.setdefault(XLA_THREADS, str(threads))
    if double is not None:
        jax.config.update("jax_enable_x64", double)
    keep_programs()


def _keep_memory() -> None:
    """Do not give memory back to the system after every computation, as dask has its workers do: to be given it again
    costs more than short tasks otherwise do beside their work."""
    if "MALLOC_TRIM_THRESHOLD_" in os.environ:
        with suppress(OSError, AttributeError):  # of another C library
            mallopt = ctypes.CDLL(None).mallopt
            mallopt(M_TRIM_THRESHOLD, KEPT)
            mallopt(M_MMAP_THRESHOLD, KEPT)


def quieten() -> None:
    """Of what others warn, keep back what is no concern of who reads the results."""
    # arviz announces its next version on import; compiled programs that cannot be kept are compiled again
    warnings.filterwarnings("ignore", category=FutureWarning, module="arviz")
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")


def serve(pipe: "connection.Connection", payload: bytes | str, core: int | None) -> None:
    """The life of a worker process: tasks come in and results go out until the other end is closed.

    payload: `work` and what tasks share, pickled, or the file that holds it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted as well, and ends its workers
    threading.Thread(target=_end_with_parent, args=(payload,), daemon=True).start()
    quieten()
    call: tuple[Any, Any] | None = None
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        pipe.send_bytes(READY)
        while True:
            task = pipe.recv_bytes()
            try:
                if call is None:
                    call = pickle.loads(payload if isinstance(payload, bytes) else Path(payload).read_bytes())
                    _settle(core)
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


def _settle(core: int | None) -> None:
    """Stay on a core, with threads that compile for each that there is.

    XLA has as many as cores that it may run on when it first compiles. While one of them compiles what the main thread
    hands to it, half a gigabyte of that piles up.
    """
    if "jax" in sys.modules:
        import jax

        jax.block_until_ready(jax.jit(jax.numpy.sin)(1.0))
    if core is not None:
        _stay_on(core)


def _stay_on(core: int) -> None:
    """Keep every thread that there is, and those that they will start, on one core."""
    threads = [0]
    with suppress(OSError, ValueError):
        threads = [int(name) for name in os.listdir("/proc/self/task")]
    for thread in threads:
        with suppress(OSError):
            os.sched_setaffinity(thread, {core})


def _end_with_parent(payload: bytes | str) -> None:
    """Wait for it, take away the file that it cannot take away any more, and end."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        if isinstance(payload, str):
            shutil.rmtree(Path(payload).parent, ignore_errors=True)
        os._exit(1)
