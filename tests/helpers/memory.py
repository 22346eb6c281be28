"""Long runs keep within memory: compiled programs are forgotten as a process grows, and made again where needed."""

from benchmarks.measuring.memory import keep_within


def pytest_runtest_teardown():
    keep_within()
