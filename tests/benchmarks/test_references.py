"""The table of speeds: its rows, a process of its own, and the peer on a base."""

import time

import numpy as np
import pytest

import layerjax as lj
from benchmarks.measuring.writing import NOT_REACHED
from benchmarks.peers import disort
from benchmarks.studies.references import cold, speed


@pytest.mark.slow
def test_a_tiny_table_of_speeds() -> None:
    """Paths with one event alone, which are cheap: every resolution is as good."""
    size = speed.Size(rounds=1, resolutions=((2, 1), (4, 4)), orders="first", cold=("value",))
    rows = speed.rows(size, with_disort=False, report=lambda line: None)
    names = ["value, error 0.001", "value and Jacobian of 6 parameters", "compile, value, cold"]
    assert [row.what for row in rows] == names
    assert all(row.measured > 0 and row.verdict != NOT_REACHED for row in rows)
    assert rows[0].note.startswith("2 x 1, largest error")
    text = speed.markdown(rows)
    assert all(f"| {name} " in text for name in names)


WORK = cold.Work(2, 1, "first", starts=2, ess=50.0)


@pytest.mark.slow
def test_a_fit_and_its_posterior_are_timed() -> None:
    found = cold.fitting(WORK, time.time() - 1000.0)
    assert found["cold"] > 1000.0
    assert min(found["warm"], found["sample"], found["evaluations"]) > 0
    assert found["effective"] >= 50.0
    assert len(speed.cold_rows("fit", found, WORK)) == 3


def test_a_fit_has_a_row_cold_one_warm_and_one_of_its_posterior() -> None:
    found = {"cold": 8.0, "warm": 0.4, "sample": 70.0, "effective": 1200.0, "evaluations": 5e3, "acceptance": 0.9}
    rows = speed.cold_rows("fit", found, WORK)
    assert [(row.measured, row.verdict) for row in rows] == [(8.0, "met"), (0.4, "aim met"), (70.0, "**not met**")]
    assert "2 starts" in rows[0].what
    assert rows[2].what.startswith("50 effective samples")


def test_first_and_later_calls_have_a_row_each() -> None:
    found = {"seconds": 1.5, "second": 0.9, "later": 3e-3, "next": 0.3, "statistical": 1e-3}
    rows = speed.cold_rows("evaluate", found, WORK)
    assert [(row.measured, row.unit, row.verdict) for row in rows] == [
        (1.5, "s", "met"),
        (0.9, "s", "met"),
        (0.3, "s", "aim met"),
        (3.0, "ms", "**not met**"),
        (1.0, "ms", "aim met"),
    ]
    assert [row.measured for row in speed.cold_rows("grad", found, WORK)] == [1.5, 0.9, 3.0]


def test_what_is_less_exact_than_asked_for_meets_no_bar() -> None:
    assert speed.row("value", "ms", 0.1, speed.VALUE).verdict == "aim met"
    assert speed.row("value", "ms", 0.1, speed.VALUE, reached=False).verdict == NOT_REACHED


@pytest.mark.peers
def test_discrete_ordinates_agree_over_a_diffuse_base() -> None:
    """Tolerance: 32 streams, and interpolation between them."""
    reason = disort.why_not()
    if reason is not None:
        pytest.skip(reason)
    stack = lj.Stack([lj.Medium(1.0, 0.95, lj.HenyeyGreenstein(0.5))], lj.Lambertian(0.3))
    cosines, azimuths = np.array([0.9, 0.6, 0.3]), np.array([0.0, np.pi])
    wi, wo = lj.direction(np.arccos(0.7), 0.0), lj.direction(np.arccos(cosines)[:, None], azimuths)
    ours = np.asarray(lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=24, modes=32)))[..., 0]
    theirs = disort.bsdf(1.0, 0.5, 0.95, 0.7, azimuths, 32, cosines, reflection_only=True, base=0.3)
    np.testing.assert_allclose(theirs, ours, rtol=2e-4)
