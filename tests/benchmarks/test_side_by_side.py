"""The page that says which transport to take: made from the results, and from nothing else."""

import pytest

from benchmarks.studies.error_vs_time.models import MODELS, Row
from benchmarks.studies.side_by_side import picture as side_by_side_picture
from benchmarks.studies.side_by_side import run as side_by_side
from benchmarks.suite import cases as suite


def row(stack, model, step, l2, nanoseconds, family="coated_metals", limits=False):
    return Row(
        stack=stack,
        family=family,
        model=model,
        step=step,
        pairs=1,
        l2=l2,
        worst=l2,
        albedo=l2,
        nanoseconds_per_value=nanoseconds,
        prepare_seconds=0.0,
        compile_seconds=0.0,
        operations=1,
        truth_limits=limits,
    )


def test_the_page_in_the_docs_holds_the_numbers_of_the_results():
    _, text = side_by_side.page()
    assert (side_by_side.DOCS / side_by_side.PAGE).read_text() == text


def test_the_cheapest_that_is_good_enough():
    fast = [row(name, "fast", "once", error, 5.0) for name, error in zip("abcd", (0.2, 0.2, 0.2, 0.9), strict=True)]
    slow = [row(name, "slow", "fine", 0.02, 800.0) for name in "abcd"]
    some = [row("a", "some", "once", 1e-5, 1.0)]  # of no use for the family
    cells = side_by_side.cheapest(fast + slow + some).splitlines()[2].split("|")
    assert [cell.strip() for cell in cells[1:-1]] == [
        "coated metals",
        "fast, once (5.00)",  # three of four stacks are within 30 %
        "slow, fine (800)",
        "slow, fine (800)",
        "-",
        "-",
    ]


def test_every_family_has_a_panel():
    cases = {case.name: case.family for case in suite.load()}
    assert {cases[name] for name in side_by_side_picture.SHOWN.values()} == set(suite.FAMILIES)


def test_every_model_has_words():
    assert {model.name for model in MODELS} == set(side_by_side.WORDS)


def test_without_results_it_says_what_makes_them(tmp_path):
    with pytest.raises(ValueError, match="error-vs-time"):
        side_by_side.page(tmp_path)
