"""Slow tests in turns: `python -m tools.slow_tests` runs those that this commit has drawn; `--all` runs all of them.

They are dealt into turns that take about `WINDOW` seconds each; a test that takes longer has a turn by itself. Which
turn it is follows from how many commits there are, so that runs of commits in a row go round. `tests/slow_tests.csv`
says of every test how long it takes, when it ran last (the number of the commit) and whether it passed: every run
writes it anew, and whoever has run some commits it. A turn ends with its window; a test may take three times as long as
it took.
"""

import argparse
import csv
import faulthandler
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "tests" / "slow_tests.csv"
WINDOW, WORKERS, UNKNOWN = 300.0, 2, 10.0
"""Seconds that a turn may take, processes that share them, and seconds of a test that has not been timed."""
ROOM = 0.8 * WORKERS * WINDOW
"""Importing, and what the last test takes longer than the others, need the rest."""


class Row(NamedTuple):
    """What is known of a test: its seconds, the number of the commit it ran at last (0: never), and its outcome."""

    seconds: float = UNKNOWN
    last: int = 0
    outcome: str = ""


def read(path: Path = TABLE) -> dict[str, Row]:
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        return {name: Row(float(seconds), int(last), outcome) for name, seconds, last, outcome in csv.reader(file)}


def write(table: dict[str, Row], path: Path = TABLE) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows((name, *row) for name, row in sorted(table.items()))


def turns(tests: Iterable[str], table: dict[str, Row], room: float) -> list[list[str]]:
    """Neighbours stay together, as far as they fit: they share programs."""
    dealt: list[list[str]] = []
    long: list[list[str]] = []
    filled = room
    for test in tests:
        seconds = table.get(test, Row()).seconds
        if seconds > room / WORKERS:
            long.append([test])
            continue
        if filled + seconds > room:
            dealt.append([])
            filled = 0.0
        dealt[-1].append(test)
        filled += seconds
    return dealt + long


def commit_number() -> int:
    """Number of commits up to this one; without history, the number of the day."""
    try:
        count = subprocess.run(["git", "rev-list", "--count", "HEAD"], cwd=ROOT, capture_output=True, text=True)
        shallow = (ROOT / ".git" / "shallow").exists()
    except OSError:  # no git
        return int(time.time() // 86400)
    return int(count.stdout) if count.returncode == 0 and not shallow else int(time.time() // 86400)


def collected(folder: str = "tests") -> list[str]:
    command = [sys.executable, "-m", "pytest", "-o", "addopts=", "-m", "slow", "--collect-only", "-q", folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return [line for line in done.stdout.splitlines() if "::" in line]


def summary(drawn: list[str], tests: list[str], table: dict[str, Row]) -> Iterable[str]:
    yield from (f"  {count:4d} of {name}" for name, count in Counter(test.split("[")[0] for test in drawn).items())
    waiting = sorted((table.get(test, Row()).last, test) for test in set(tests) - set(drawn))
    yield "not run for longest (number of the commit):"
    yield from (f"  {last:4d} {test}" for last, test in waiting[:10])
    failed = [test for test in tests if table.get(test, Row()).outcome == "failed"]
    yield f"failed when they ran last: {len(failed)}"
    yield from (f"  {table[test].last:4d} {test}" for test in failed)


class Recorder:
    """A plugin of the process that reports: times and outcomes go into the table."""

    def __init__(self, table: dict[str, Row], now: int) -> None:
        self.table, self.now = table, now
        self.seconds: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        name = report.nodeid
        self.seconds[name] = self.seconds.get(name, 0.0) + report.duration
        if report.failed or (report.when == "call" and not report.skipped):
            self.table[name] = Row(round(self.seconds[name], 1), self.now, str(report.outcome))


def pytest_runtest_setup() -> None:
    """In each worker, which gets this module by `-p`: what the turn has no time for waits for another, and a test that
    hangs ends its worker, which counts as a failure."""
    if time.time() > float(os.environ.get("SLOW_TESTS_UNTIL", "inf")):
        pytest.skip("this turn has no time left")
    if limit := float(os.environ.get("SLOW_TESTS_LIMIT", "0")):
        faulthandler.dump_traceback_later(limit, exit=True, file=2)


def pytest_runtest_teardown() -> None:
    faulthandler.cancel_dump_traceback_later()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.slow_tests", description=__doc__)
    parser.add_argument("--all", action="store_true", help="all slow tests, however long they take")
    parser.add_argument("--turn", type=int, help="another turn than that of the commit")
    options = parser.parse_args(arguments)
    tests, now = collected(), commit_number()
    if not tests:
        print("no slow test was found")
        return 1
    table = {test: row for test, row in read().items() if test in set(tests)}
    dealt = [tests] if options.all else turns(tests, table, ROOM)
    turn = (now if options.turn is None else options.turn) % len(dealt)
    drawn = dealt[turn]
    seconds = [table.get(test, Row()).seconds for test in drawn]
    print(f"turn {turn} of {len(dealt)}: {len(drawn)} of {len(tests)} slow tests, {sum(seconds):.0f} s of one process")
    print("\n".join(summary(drawn, tests, table)), flush=True)
    if not options.all:
        until, limit = time.time() + WINDOW, max(WINDOW, 3.0 * max(seconds))
        os.environ |= {"SLOW_TESTS_UNTIL": str(until), "SLOW_TESTS_LIMIT": str(limit)}
    code = pytest.main(["-m", "slow", "-p", "tools.slow_tests", *drawn], [Recorder(table, now)])
    write(table)
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
