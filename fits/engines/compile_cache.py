"""Cache of compiled programs between processes: a folder of this host, for its processor and its JAX."""

import hashlib
import os
import platform
import socket
from contextlib import suppress
from importlib import metadata
from pathlib import Path

FOLDER, LEAST = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
"""Names of JAX's settings."""

LEAST_COMPILE = 1.0
"""Seconds of compilation from which a program is cached."""


def compile_cache() -> str | None:
    """Folder of programs that this JAX compiled for this processor, on this host only; None: there can be none."""
    processor = f"{platform.machine()} {platform.processor()}"
    with suppress(OSError), open("/proc/cpuinfo") as file:
        processor = next((line for line in file if line.startswith(("flags", "Features"))), processor)
    try:
        key = "\n".join((metadata.version("jaxlib"), socket.gethostname(), processor))
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = home / "layerjax" / "compiled" / hashlib.sha256(key.encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError, metadata.PackageNotFoundError):  # no home, or one that may not be written to
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


def keep_programs(least: float | None = None) -> None:
    """Cache programs that take so many seconds to compile (`LEAST_COMPILE` if None), unless this process has a cache
    already or can have none."""
    import jax

    if not jax.config.values[FOLDER] and (folder := compile_cache()):
        jax.config.update(FOLDER, folder)
        jax.config.update(LEAST, LEAST_COMPILE if least is None else least)
