"""What a worker is set to: one thread on one core, precision as its parent has it, compiled programs that are kept.

Processes get most of it by their environment, which JAX and LAPACK read as they are imported. A worker of a cluster
has imported JAX, and is told.
"""

import ctypes
import hashlib
import os
import pickle
import platform
import shutil
import signal
import socket
import sys
import threading
import traceback
import warnings
from contextlib import suppress
from importlib import metadata
from multiprocessing import connection, parent_process
from pathlib import Path
from typing import Any, NamedTuple

from fits.engines.failures import attempt

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
LEAST_COMPILE = 1.0
"""Programs that took so many seconds to compile are kept."""

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
    found = dict.fromkeys(ONE_THREAD, "1")  # XLA has as many as cores that it may run on; its flags change results
    if "XLA_PYTHON_CLIENT_PREALLOCATE" not in os.environ:  # several share one accelerator
        found["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    jax = sys.modules.get("jax")
    directory: str | None = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if jax is not None:
        found["JAX_ENABLE_X64"] = str(int(jax.config.jax_enable_x64))
        directory = jax.config.values["jax_compilation_cache_dir"]
        if directory:
            least = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
            found["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(least)
    if not directory and (directory := compile_cache()):
        found["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(LEAST_COMPILE)
    return found | ({"JAX_COMPILATION_CACHE_DIR": directory} if directory else {})


def compile_cache() -> str | None:
    """Where programs compiled by this JAX for this processor are kept, on this host alone; None: they cannot be."""
    try:
        key = "\n".join((metadata.version("jaxlib"), socket.gethostname(), _processor()))
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = home / "layerjax" / "compiled" / hashlib.sha256(key.encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, metadata.PackageNotFoundError):  # no home, or one that may not be written to
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


def _processor() -> str:
    """Its kind and what it can do."""
    with suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith(("flags", "Features")):
                return line
    return f"{platform.machine()} {platform.processor()}"


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
    os.environ.setdefault("NPROC", str(threads))  # XLA reads it when it starts its threads
    if double is not None:
        jax.config.update("jax_enable_x64", double)
    if not jax.config.values["jax_compilation_cache_dir"] and (directory := compile_cache()):
        jax.config.update("jax_compilation_cache_dir", directory)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_COMPILE)


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
    if core is not None:
        _stay_on(core)
    quieten()
    call: tuple[Any, Any] | None = None
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        pipe.send_bytes(READY)
        while True:
            task = pipe.recv_bytes()
            try:
                if call is None:
                    call = pickle.loads(payload if isinstance(payload, bytes) else Path(payload).read_bytes())
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
