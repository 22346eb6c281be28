"""Combinations that data cannot separate, from information matrices written by hand."""

import numpy as np
import pytest

from fits.optimise.uncertainty import unidentified_directions


def test_a_sum_that_alone_is_known_is_told_from_its_parts():
    """Rows (x + y) / 0.01 and (x - y) / 2 in boxes; x has 10 times the width of y in physical units, z is known."""
    root = np.array([[100.0, 100.0, 0.0], [0.5, -0.5, 0.0], [0.0, 0.0, 50.0]])
    (combination,) = unidentified_directions(root, ("x", "y", "z"), np.array([10.0, 1.0, 1.0]))
    assert combination.error == pytest.approx(np.sqrt(2.0))  # the row x - y of length 1 / sqrt(2)
    assert combination.unconstrained
    assert list(combination.weights) == ["x", "y"]
    assert combination.weights["x"] == pytest.approx(-combination.weights["y"])
    assert combination.weights["x"] ** 2 == pytest.approx(0.5)
    # each alone: 1 / sqrt(100^2 + 0.5^2) boxes
    assert combination.conditional_errors == pytest.approx({"x": 0.1, "y": 0.01}, rel=1e-4)


def test_a_small_weight_that_makes_up_an_error_belongs():
    """z moves by a fiftieth along the open direction, yet owes it nearly all of its error."""
    along = np.array([0.6, 0.8, 0.02])
    along = along / np.linalg.norm(along)
    others = np.linalg.svd(along[None])[2][1:]
    root = np.vstack([along / 0.5, others / 1e-4])
    (combination,) = unidentified_directions(root, ("x", "y", "z"), np.ones(3))
    assert combination.error == pytest.approx(0.5)
    assert not combination.unconstrained
    assert combination.weights == pytest.approx({"y": along[1], "x": along[0], "z": along[2]})
    assert list(combination.weights) == ["y", "x", "z"]


def test_several_come_worst_first_and_fewer_data_than_parameters_are_no_trouble():
    found = unidentified_directions(np.array([[1.0, 0.0, 0.0], [0.0, 5.0, 0.0]]), ("x", "y", "z"), np.ones(3))
    assert [(one.error, list(one.weights)) for one in found] == [(np.inf, ["z"]), (1.0, ["x"]), (0.2, ["y"])]
    assert [one.conditional_errors[next(iter(one.weights))] for one in found] == [np.inf, 1.0, 0.2]
    # what is known to a tenth of its bounds is identified
    assert unidentified_directions(np.diag([10.5, 200.0]), ("x", "y"), np.ones(2)) == ()
