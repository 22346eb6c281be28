"""How many programs the tests of a folder may compile: a whole run of `pytest` with more fails, and says where.

A program takes 0.05 to 10 s, which is nearly all that tests take. Programs out of the cache on disk count as well, so
that a second run has as many; two workers compile some both.
"""

from collections import Counter
from pathlib import PurePosixPath

import jax
import pytest

BUDGET: dict[str, int] = {
    "tests/benchmarks": 300,
    "tests/fits/data": 150,
    "tests/fits/exports": 400,
    "tests/fits/optimise": 1000,
    "tests/fits/prediction": 800,
    "tests/fits/problem": 1600,
    "tests/fits/sampling": 250,
    "tests/layerjax": 2600,
    "tests/layerjax/microsurface": 800,
    "tests/layerjax/normals": 300,
    "tests/layerjax/precompute": 200,
    "tests/layerjax/surfaces": 1100,
    "tests/layerjax/transport": 900,
    "tests/layerjax/transport/adding_doubling": 1900,
    "tests/layerjax/transport/endf": 300,
    "tests/layerjax/transport/random_walk": 450,
    "tests/layerjax/transport/statistical": 1200,
}
"""By folder, half as many again as one process compiles; what lies deeper counts for the deepest that is named."""

_compiled = 0


def _count(event, _, **__):
    global _compiled
    _compiled += event == "/jax/core/compile/backend_compile_duration"


jax.monitoring.register_event_duration_secs_listener(_count)


def folder_of(test: str, folders) -> str | None:
    parents = map(str, PurePosixPath(test.split("::")[0]).parents)
    return next((parent for parent in parents if parent in folders), None)


class Budget:
    """Counts in the process that runs a test, and adds up in the one that reports on it: with -n they are two."""

    def __init__(self, budget: dict[str, int]):
        self.budget, self.spent, self.before = budget, Counter(), 0

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self):
        self.before = _compiled
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        if call.when == "teardown":
            item.user_properties.append(("programs", _compiled - self.before))
        return (yield)

    def pytest_runtest_logreport(self, report):
        if report.when == "teardown":
            self.spent[folder_of(report.nodeid, self.budget)] += dict(report.user_properties)["programs"]

    def over(self) -> list[str]:
        return [
            f"{folder} compiles {self.spent[folder]} programs, of {most} at most (tests/helpers/budget.py)"
            for folder, most in self.budget.items()
            if self.spent[folder] > most
        ]

    def pytest_sessionfinish(self, session):
        if self.over() and not session.exitstatus and not hasattr(session.config, "workerinput"):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        for line in self.over():
            terminalreporter.line(line, red=True)


def pytest_configure(config):
    config.pluginmanager.register(Budget(BUDGET if not config.invocation_params.args else {}))
