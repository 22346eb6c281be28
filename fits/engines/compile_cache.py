"""Cache of compiled programs between processes: a folder of this host, for its processor and its JAX."""

import hashlib
import os
import platform
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path

FOLDER, LEAST = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
"""Names of JAX's settings."""

LEAST_COMPILE = 1.0
"""Seconds of compilation from which a program is cached."""


def compile_cache() -> str | None:
    """Folder of programs that this JAX compiled for this processor, on this host only; None: there can be none."""
    try:
        key = "\n".join((metadata.version("jaxlib"), socket.gethostname(), _processor()))
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = home / "layerjax" / "compiled" / hashlib.sha256(key.encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, metadata.PackageNotFoundError):  # no home, or one that may not be written to
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


def _processor() -> str:
    """Kind and features of the processor."""
    with suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith(("flags", "Features")):
                return line
    return f"{platform.machine()} {platform.processor()}"


def keep_programs(least: float | None = None) -> bool:
    """Cache programs that take so many seconds to compile (`LEAST_COMPILE` if None), unless this process has a cache.

    Returns whether it kept nothing before, and does now.
    """
    import jax

    if jax.config.values[FOLDER] or not (directory := compile_cache()):
        return False
    jax.config.update(FOLDER, directory)
    jax.config.update(LEAST, LEAST_COMPILE if least is None else least)
    return True


@contextmanager
def programs_kept() -> Iterator[None]:
    """Cache programs compiled within the block, for later processes, and use cached ones."""
    import jax
    from jax.experimental.compilation_cache.compilation_cache import reset_cache

    before = {name: jax.config.values[name] for name in (FOLDER, LEAST)}
    if not keep_programs():
        yield
        return
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        reset_cache()
