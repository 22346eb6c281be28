"""`pytest --compilations N`: the N tests and files that compile longest, with what they trace, lower and compile.

And `compiled_by`: the programs that a call compiles.
"""

import time
from collections import defaultdict
from functools import cache

import jax
import pytest

STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}
COLUMNS = ("programs", *STAGES.values(), "cpu")


def compiled_by(call):
    """Names of the programs that call() compiles, or takes out of the cache on disk."""
    programs = _programs()
    programs.clear()
    jax.block_until_ready(call())
    return list(programs)


@cache
def _programs():
    """A list to which every program adds its name: listeners stay for good, so that there is one."""
    programs = []

    def stage_ends(event, _, **known):
        if STAGES.get(event) == "compile":
            programs.append(known.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(stage_ends)
    return programs


def pytest_addoption(parser):
    parser.addoption("--compilations", type=int, metavar="N", help="print the N tests and files that compile longest")


def pytest_configure(config):
    if config.getoption("compilations"):
        config.pluginmanager.register(Compilations(config.getoption("compilations")))


class Compilations:
    """Counts in the process that runs a test, and prints in the one that reports on it: with -n they are two."""

    def __init__(self, rows):
        self.rows, self.tests = rows, {}
        self.spent, self.inner, self.began = defaultdict(float), [], 0.0
        jax.monitoring.register_event_duration_secs_listener(self.stage_ends)

    def stage_ends(self, event, seconds, **_):
        """A function's tracing holds that of the functions it calls: each second is counted where it is spent."""
        if event not in STAGES:
            return
        start, own = time.perf_counter() - seconds, seconds
        while self.inner and self.inner[-1][0] >= start:
            own -= self.inner.pop()[1]
        self.inner.append((start, seconds))
        self.spent[STAGES[event]] += own
        self.spent["programs"] += STAGES[event] == "compile"

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.spent.clear()
        self.inner.clear()
        self.began = time.process_time()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        if call.when == "teardown":
            self.spent["cpu"] = time.process_time() - self.began
            item.user_properties.append(("compilations", dict(self.spent)))
        return (yield)

    def pytest_runtest_logreport(self, report):
        if report.when == "teardown":
            self.tests[report.nodeid] = dict(report.user_properties)["compilations"]

    def pytest_terminal_summary(self, terminalreporter):
        files = defaultdict(lambda: defaultdict(float))
        for name, spent in self.tests.items():
            for column, value in spent.items():
                files[name.split("::")[0]][column] += value
                files["in all"][column] += value
        for title, table in (("tests", self.tests), ("files", files)):
            terminalreporter.section(f"{title} that compile longest: programs, seconds of each stage and of any work")
            terminalreporter.line(" ".join(f"{column:>8}" for column in COLUMNS))
            order = sorted(table, key=lambda name: -sum(table[name].get(stage, 0.0) for stage in STAGES.values()))
            for name in order[: self.rows]:
                terminalreporter.line(
                    f"{table[name].get('programs', 0):8.0f} "
                    + " ".join(f"{table[name].get(column, 0.0):8.1f}" for column in COLUMNS[1:])
                    + f"  {name}"
                )
