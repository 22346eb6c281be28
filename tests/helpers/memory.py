"""Long runs keep within memory: compiled programs are forgotten as a process grows, and made again where needed."""

import jax

from benchmarks.measuring.memory import keep_within

_compiled: list[str] = []
"""Programs since the last look: it reads a list of thousands of pieces of memory, which most tests leave as it was."""


def _note(event, _, **__):
    if event == "/jax/core/compile/backend_compile_duration":
        _compiled.append(event)


jax.monitoring.register_event_duration_secs_listener(_note)


def pytest_runtest_teardown():
    if _compiled:
        _compiled.clear()
        keep_within()
