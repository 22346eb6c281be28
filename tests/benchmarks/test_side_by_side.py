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


def cheapest(rows, limits):
    """The cells of the one family that the rows are of."""
    return [cell.strip() for cell in side_by_side.cheapest(rows, limits).splitlines()[2].split("|")[1:-1]]


def test_the_page_in_the_docs_holds_the_numbers_of_the_results():
    _, text = side_by_side.page()
    assert (side_by_side.DOCS / side_by_side.PAGE).read_text() == text


def test_the_cheapest_that_is_good_enough():
    fast = [row(name, "fast", "once", error, 5.0) for name, error in zip("abcd", (0.2, 0.2, 0.2, 0.9), strict=True)]
    slow = [row(name, "slow", "fine", 0.02, 800.0) for name in "abcd"]
    some = [row("a", "some", "once", 1e-5, 1.0)]  # of no use for the family
    assert cheapest(fast + slow + some, dict.fromkeys("abcd", 1e-6)) == [
        "coated metals",
        "fast, once (5.00)",  # three of four stacks are within 30 %
        "slow, fine (800)",
        "slow, fine (800)",
        "-",
        "-",
    ]


def test_a_truth_that_is_not_known_so_well_judges_nobody():
    rows = [row(name, "fast", "once", 0.02, 5.0, limits=name == "d") for name in "abcd"]
    limits = {"a": 1e-6, "b": 1e-6, "c": 1e-6, "d": 0.05}
    assert cheapest(rows, limits)[1:] == [
        "fast, once (5.00)",
        "fast, once (5.00)",
        "fast, once (5.00, 3 of 4)",
        "-",
        "-",
    ]
    cells = side_by_side.examples(
        [MODELS[0]], [row("fabric", MODELS[0].name, "x", 1e-9, 5.0, limits=True)], {"fabric": 0.05}
    )
    assert "| <= 5.0 % (5.00 ns) |" in cells


def test_every_family_has_a_panel():
    cases = {case.name: case.family for case in suite.load()}
    assert {cases[name] for name in side_by_side_picture.SHOWN.values()} == set(suite.FAMILIES)


def test_every_model_has_words():
    assert {model.name for model in MODELS} == set(side_by_side.WORDS)


def test_without_results_it_says_what_makes_them(tmp_path):
    with pytest.raises(ValueError, match="error-vs-time"):
        side_by_side.page(tmp_path)
