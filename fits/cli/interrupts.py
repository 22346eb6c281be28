"""Ctrl-C, so that it always arrives."""

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

AGAIN_AFTER = 0.05  # seconds: the callback has returned


@contextmanager
def raised_again() -> Iterator[None]:
    """Within it, an interrupt that Python drops, as it does in callbacks of the garbage collector, is raised again.

    JAX has such a callback, and a long computation spends time in it.
    """
    usual = sys.unraisablehook

    def hook(dropped: Any) -> None:
        if dropped.exc_type is KeyboardInterrupt:
            threading.Timer(AGAIN_AFTER, _interrupt).start()
        else:
            usual(dropped)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = usual


def _interrupt() -> None:
    """Interrupt the main thread, in the midst of a system call if it is in one."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()


@contextmanager
def hint(what: str) -> Iterator[None]:
    """An interrupt in the block says what became of the work."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(what) from None
