"""The budget of programs: what counts for which folder, and when a run fails."""

from types import SimpleNamespace

from tests.helpers.budget import Budget, folder_of


def reported(budget: Budget, test: str, programs: int) -> None:
    report = SimpleNamespace(nodeid=test, when="teardown", user_properties=[("programs", programs)])
    budget.pytest_runtest_logreport(report)


def test_programs_count_for_the_deepest_folder_that_is_named() -> None:
    folders = {"tests": 1, "tests/fits": 1}
    tests = (
        "tests/fits/data/test_a.py::test[x/y]",
        "tests/layerjax/test_b.py::test",
        "tests/test_c.py::test",
        "other.py",
    )
    assert [folder_of(test, folders) for test in tests] == ["tests/fits", "tests", "tests", None]


def test_a_run_that_compiles_more_fails_and_says_where() -> None:
    budget = Budget({"tests/a": 5, "tests/b": 5})
    session = SimpleNamespace(exitstatus=0, config=SimpleNamespace())
    for folder, programs in (("a", 3), ("a", 2), ("b", 5)):
        reported(budget, f"tests/{folder}/test_it.py::test", programs)
    budget.pytest_sessionfinish(session)
    assert session.exitstatus == 0
    reported(budget, "tests/b/test_it.py::test_more", 1)
    budget.pytest_sessionfinish(session)
    assert session.exitstatus == 1
    assert budget.over() == ["tests/b compiles 6 programs, of 5 at most (tests/helpers/budget.py)"]
