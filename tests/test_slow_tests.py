"""Turns of the slow tests: each test has one, neighbours share it, and consecutive commits go round."""

from types import SimpleNamespace

import pytest

from tools.slow_tests import (
    UNKNOWN,
    WINDOW,
    WORKERS,
    Recorder,
    Row,
    collected,
    commit_number,
    pytest_runtest_setup,
    read,
    summary,
    turns,
    write,
)

TESTS = [f"tests/test_{file}.py::test_it[{case}]" for file in "abcd" for case in range(50)]
ROOM = WINDOW * WORKERS


def test_each_test_has_one_turn_and_none_is_overfull() -> None:
    table = {test: Row(7.0 + 40.0 * (test[-3:] == "[3]")) for test in TESTS}
    dealt = turns(TESTS, table, ROOM)
    assert sorted(test for turn in dealt for test in turn) == sorted(TESTS)
    assert max(sum(table[test].seconds for test in turn) for turn in dealt) <= ROOM
    assert [test for turn in dealt for test in turn] == TESTS  # neighbours stay together


def test_what_takes_longer_than_the_window_has_a_turn_by_itself() -> None:
    table = {TESTS[3]: Row(1.01 * WINDOW)}
    dealt = turns(TESTS, table, ROOM)
    assert dealt[-1] == [TESTS[3]]
    assert len(dealt) == 1 + -(-len(TESTS[1:]) // (ROOM // UNKNOWN))


def test_tables_are_read_as_they_are_written(tmp_path) -> None:
    path = tmp_path / "table.csv"
    table = {'a.py::test_b["x, y"]': Row(1.5, 12, "failed"), "a.py::test_a": Row(2.0, 3, "passed")}
    assert read(path) == {}
    write(table, path)
    assert read(path) == table
    assert path.read_text().splitlines()[0] == "a.py::test_a,2.0,3,passed"


def test_what_waits_and_what_failed_is_listed() -> None:
    table = {"a.py::test_a": Row(1.0, 7, "failed"), "a.py::test_b": Row(1.0, 9, "passed")}
    lines = list(
        summary(["a.py::test_c[1]", "a.py::test_c[2]"], ["a.py::test_b", "a.py::test_a", "a.py::test_d"], table)
    )
    assert lines[0].split() == ["2", "of", "a.py::test_c"]
    assert [line.split()[-1] for line in lines[2:5]] == ["a.py::test_d", "a.py::test_a", "a.py::test_b"]
    assert lines[5:] == ["failed when they ran last: 1", "     7 a.py::test_a"]


def test_outcomes_are_recorded_with_all_that_they_took() -> None:
    recorder = Recorder({"b": Row(5.0, 1, "passed")}, 8)
    for name, when, outcome in (
        ("a", "setup", "passed"),
        ("a", "call", "passed"),
        ("a", "teardown", "passed"),
        ("b", "setup", "skipped"),  # no time was left
        ("c", "setup", "failed"),
        ("d", "call", "passed"),
        ("d", "teardown", "failed"),
    ):
        report = {"skipped": outcome == "skipped", "failed": outcome == "failed"}
        recorder.pytest_runtest_logreport(
            SimpleNamespace(nodeid=name, when=when, outcome=outcome, duration=1.0, **report)
        )
    assert recorder.table == {
        "a": Row(2.0, 8, "passed"),
        "b": Row(5.0, 1, "passed"),
        "c": Row(1.0, 8, "failed"),
        "d": Row(2.0, 8, "failed"),
    }


def test_a_turn_ends_with_its_window(monkeypatch) -> None:
    pytest_runtest_setup()
    monkeypatch.setenv("SLOW_TESTS_UNTIL", "1.0")
    with pytest.raises(pytest.skip.Exception, match="no time left"):
        pytest_runtest_setup()


def test_commits_are_numbered() -> None:
    assert commit_number() > 0  # in a folder without history too


@pytest.mark.slow
def test_slow_tests_are_collected_by_their_whole_names() -> None:
    """Whatever options the project gives to pytest."""
    found = collected("tests/test_site.py")
    assert found
    assert all(name.startswith("tests/test_site.py::test_") for name in found)
