"""Work for engines, importable by the processes that execute it, and programs that are started and killed."""

import errno
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tests.helpers.places import ROOT


def square(shared: Any, task: int) -> int:
    """Squares and adds what is shared; odd tasks take longer, so that they end in another order."""
    time.sleep(0.01 * (task % 2))
    return task * task + int(shared)


def picky(shared: Any, task: int) -> int:
    """Refuses some tasks, each in a way of its own."""
    if task == 1:
        raise ValueError("task is 1;\n it must not be")
    if task == 2:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", "there.csv")
    if task == 3:
        raise OSError(errno.ENOSPC, "No space left on device", "full.csv")
    if task == 4:
        raise TypeError("a mistake in the code")
    return task


def nothing(shared: Any, task: Any) -> None:
    """What it costs to ask."""


def warned(shared: Any, task: int) -> None:
    """Warns users of the same whatever the task, and once of its own."""
    from layerjax import ResolutionWarning

    for words in ("too narrow", f"task {task}"):
        warnings.warn(words, ResolutionWarning, stacklevel=1)


def deadly(shared: str, task: int) -> int:
    """The task that is given kills its worker whenever it is tried; all leave a line in a file."""
    with open(shared, "a") as file:
        file.write(f"{task}\n")
    if task == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return task


def slow(shared: str, task: int) -> int:
    """Adds a letter to a file of its process, takes a while, and squares."""
    with Path(shared, f"{os.getpid()}").open("a") as file:
        file.write(".")
    time.sleep(0.15)
    return task * task


def endless(shared: str, task: int) -> None:
    """Tells its process in a file, and takes longer than any test waits."""
    Path(shared, f"{os.getpid()}").touch()
    time.sleep(100.0)


def surroundings(shared: Any, task: Any) -> dict[str, Any]:
    """What JAX is set to where the task runs, after it has computed."""
    import jax
    import jax.numpy as jnp

    total = float(jax.jit(lambda x: (x @ x).sum())(jnp.ones((64, 64))))
    return {
        "total": total,
        "double": jnp.zeros(1).dtype == jnp.float64,
        "cache": jax.config.values["jax_compilation_cache_dir"],
        "least": jax.config.values["jax_persistent_cache_min_compile_time_secs"],
        "flags": os.environ.get("XLA_FLAGS", ""),
        "threads": os.environ.get("NPROC"),
        "interrupts": signal.getsignal(signal.SIGINT) == signal.SIG_IGN,
        "shared": shared,
    }


@contextmanager
def started(words: list[str], *paths: Path) -> Iterator[subprocess.Popen[str]]:
    """A program of Python in a process group of its own, with these paths to import from; killed in the end.

    It finds the programs that tests have compiled, and adds none: it may be killed as it writes one.
    """
    import jax

    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (*paths, ROOT)))}
    environment |= {"DASK_LOGGING__DISTRIBUTED": "critical", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "inf"}
    environment["JAX_COMPILATION_CACHE_DIR"] = str(jax.config.values["jax_compilation_cache_dir"])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job's ignoring is inherited
    try:
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        process = subprocess.Popen([sys.executable, *words], env=environment, start_new_session=True, **pipes)
    finally:
        signal.signal(signal.SIGINT, before)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def running(process: int) -> bool:
    """Whether a process is there, and no zombie."""
    with suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def wait_until(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    """Wait for a condition, or fail."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came to that"
        time.sleep(0.002)


def stop_at(stage: str, done: int = 0) -> Callable[..., None]:
    """Progress that interrupts its run when so much of a stage, whose name begins so, is done."""

    def stop(*told: Any) -> None:
        if told[0].startswith(stage) and told[1] >= done:
            raise KeyboardInterrupt

    return stop
