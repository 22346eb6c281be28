"""What a folder holds, and disks that fill up."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax


def contents(folder: Path) -> dict[str, bytes]:
    """Every file under a folder, by its path."""
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file can grow beyond this, in bytes: a full disk for those who may not mount a small one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    setting = "jax_persistent_cache_min_compile_time_secs"
    usual = jax.config.values[setting]
    jax.config.update(setting, float("inf"))  # compiled programs that other tests share are not to be cut off
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))  # Python ignores the signal, so that `write` fails
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        jax.config.update(setting, usual)
