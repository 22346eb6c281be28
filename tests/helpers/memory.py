"""Long runs keep within memory: compiled programs are forgotten as a process grows, and made again where needed."""

import ctypes
import ctypes.util
import gc
import os
from pathlib import Path

import jax

MOST = 6e9
"""Bytes that a process may hold before it forgets its programs."""


def resident():
    """Bytes of this process in memory; 0 where the system does not tell."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else 0


def forget_programs():
    jax.clear_caches()
    gc.collect()
    libc = ctypes.util.find_library("c")
    if libc is not None and hasattr(ctypes.CDLL(libc), "malloc_trim"):  # else freed memory stays with the process
        ctypes.CDLL(libc).malloc_trim(0)


def pytest_runtest_teardown():
    if resident() > MOST:
        forget_programs()
