"""The evidence of posteriors that are no ellipsoids, beside quadrature over the box."""

import numpy as np
import pytest
from scipy.special import logsumexp

from fits.data.geometry import slices
from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.prediction.importance import evidence
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from tests.helpers.models import along, line

GEOMETRY = slices([10.0, 50.0], np.arange(-75.0, 76.0, 10.0))
SIGMA = 0.1


def product(stack, wi, wo):
    return (stack["a"] * stack["b"] + 0.0 * wo[:, 2])[:, None]


def fitted(transport, stack: dict[str, Free], truth: dict[str, float], starts: int = 2) -> Fit:
    """To measurements with noise."""
    exact = np.asarray(transport(truth, GEOMETRY.wi, GEOMETRY.wo))
    data = along(GEOMETRY, exact + SIGMA * np.random.default_rng(0).standard_normal(exact.shape), SIGMA)
    return fit(stack, data, transport=transport, noise=Noise(discrepancy=False), starts=starts)


CASES = {
    "a hyperbola": (product, {"a": Free(1.0, 0.1, 5.0), "b": Free(1.0, 0.1, 5.0)}, {"a": 1.0, "b": 0.8}),
    "beyond a bound": (line, {"a": Free(0.5, 0.0, 1.0), "b": Free(0.1, -1.0, 3.0)}, {"a": 1.02, "b": 0.5}),
    "nothing known": (product, {"a": Free(0.1, 0.0, 1.0), "b": Free(0.1, 0.0, 1.0)}, {"a": 0.0, "b": 0.0}),
}


@pytest.mark.parametrize("name", CASES)
def test_it_is_the_integral_over_the_box(name: str) -> None:
    transport, *_ = CASES[name]
    found = fitted(*CASES[name])
    problem, count = found.problem, 1500
    sides = [np.linspace(low, high, count + 1) for low, high in zip(problem.low, problem.high, strict=True)]
    a, b = np.meshgrid(*(0.5 * (side[1:] + side[:-1]) for side in sides), indexing="ij")
    values, one = problem.data.values[:, 0], np.ones(len(GEOMETRY))
    # both are linear in two numbers: squares of the residuals by their moments
    first, second, x = (a, b, GEOMETRY.wo[:, 2]) if transport is line else (0.0, a * b, one)
    squares = values @ values - 2.0 * first * values.sum() - 2.0 * second * (x @ values)
    squares = squares + first**2 * x.size + 2.0 * first * second * x.sum() + second**2 * (x @ x)
    logs = -0.5 * squares / SIGMA**2 - values.size * np.log(SIGMA * np.sqrt(2.0 * np.pi))
    exact = float(logsumexp(logs) - 2.0 * np.log(count))
    estimate = evidence(found)
    assert estimate.reliable
    assert abs(estimate.log_evidence - exact) < 4.0 * estimate.error
    assert estimate.error < 0.1
