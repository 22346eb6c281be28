"""What a folder holds, and disks that fill up or may not be written to."""

import os
import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import pytest


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


@contextmanager
def mounted(folder: Path, *options: str) -> Iterator[None]:
    try:
        done = subprocess.run(["mount", *options, str(folder)], capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount")
    if done.returncode:
        pytest.skip("mounting is not permitted")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    if os.geteuid() == 0:  # whom permissions do not stop
        with mounted(folder, "--bind", str(folder)):
            subprocess.run(["mount", "-o", "remount,ro,bind", str(folder)], check=True)
            yield
        return
    folder.chmod(0o555)
    yield
    folder.chmod(0o755)
