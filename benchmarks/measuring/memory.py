"""Compiled programs are dropped before a process holds too many: XLA ends one that may map no more pieces of memory."""

import ctypes
import ctypes.util
import gc
import os
from pathlib import Path

import jax

MOST_BYTES = 6e9
MOST_PIECES = 20_000
"""Mapped pieces of memory, of the 65,530 that Linux allows: every program has some, and one stack thousands."""


def resident() -> int:
    """Bytes of this process in memory; 0 where the system does not report it."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else 0


def pieces() -> int:
    """Mapped pieces of memory of this process; 0 where the system does not report it."""
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 0


def forget_programs() -> None:
    """Drop all compiled programs, and give their memory back."""
    jax.clear_caches()
    gc.collect()
    libc = ctypes.util.find_library("c")
    if libc is not None and hasattr(ctypes.CDLL(libc), "malloc_trim"):  # else freed memory stays with the process
        ctypes.CDLL(libc).malloc_trim(0)


def keep_within() -> bool:
    """Drop them if they hold too much, and whether they did."""
    if resident() <= MOST_BYTES and pieces() <= MOST_PIECES:
        return False
    forget_programs()
    return True
