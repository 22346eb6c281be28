"""Worker processes: one thread each, the precision of the parent, a cache of compiled programs.

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

XLA_THREADS = "NPROC"
"""The variable from which XLA reads its number of threads; XLA_FLAGS would change results."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", XLA_THREADS)

READY = b""
"""First message of a worker."""


Warned = tuple[str, type[Warning]]
"""A warning of a task: its words and category."""


class Raised(NamedTuple):
    """An error of a task that ends the run."""

    error: Exception


def environment() -> dict[str, str]:
    """Environment variables of a worker process that differ from those of its parent."""
    variables = dict.fromkeys(ONE_THREAD, "1")
    if "XLA_PYTHON_CLIENT_PREALLOCATE" not in os.environ:  # several use one accelerator
        variables["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    jax = sys.modules.get("jax")
    from layerjax.compiling import FOLDER, LEAST, LEAST_COMPILE, compile_cache  # imports JAX: not before it is needed

    folder, least = os.environ.get(FOLDER.upper()), None
    if jax is not None:
        variables["JAX_ENABLE_X64"] = str(int(jax.config.jax_enable_x64))
        folder, least = jax.config.values[FOLDER], jax.config.values[LEAST]
    if not folder:
        folder, least = compile_cache(), LEAST_COMPILE
    if least is not None:
        variables[LEAST.upper()] = str(least)
    return variables | ({FOLDER.upper(): folder} if folder else {})


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
    os.environ.setdefault(XLA_THREADS, str(threads))
    if double is not None:
        jax.config.update("jax_enable_x64", double)
    keep_programs()


def quieten() -> None:
    """Silence warnings of libraries that do not concern the results."""
    # arviz announces its next version on import; compiled programs that cannot be kept are compiled again
    warnings.filterwarnings("ignore", category=FutureWarning, module="arviz")
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")


def serve(pipe: "connection.Connection") -> None:
    """Main loop of a worker process: it receives `work` with the common data, then tasks, and sends their results
    beside the warnings for users, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted as well, and ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    quieten()
    warned = _collect_warnings()
    call: tuple[Any, Any] | None = None
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        pipe.send_bytes(READY)
        payload = pipe.recv_bytes()
        while True:
            task = pipe.recv_bytes()
            try:
                work, common = call = call or pickle.loads(payload)
                message = pickle.dumps((attempt(work, common, pickle.loads(task)), warned))
            except Exception as error:
                error.add_note(f"in a worker process:\n{traceback.format_exc()}")
                message = pickle.dumps((_portable(error), warned))
            warned.clear()
            pipe.send_bytes(message)


def _collect_warnings() -> list[Warned]:
    """A list to which warnings for users are added from now on; others are shown as ever."""
    usual, warned = warnings.showwarning, list[Warned]()

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if not issubclass(category, UserWarning):
            usual(message, category, *where, **more)
        else:  # a class of the script that started this process cannot be sent
            warned.append((str(message), UserWarning if category.__module__ == "__mp_main__" else category))

    warnings.showwarning = show
    return warned


def _portable(error: Exception) -> Raised:
    try:
        pickle.loads(pickle.dumps(error))  # some errors can be packed only
        return Raised(error)
    except Exception:
        return Raised(RuntimeError("\n".join((f"{type(error).__name__}: {error}", *error.__notes__))))


def _end_with_parent() -> None:
    """Wait for the end of the parent, and end."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
