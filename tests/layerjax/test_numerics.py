"""Elementary functions against mpmath-free truth: numpy's expm1 in float64, and exact limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from layerjax import _numerics as n

ARGUMENTS = np.concatenate([[0.0], np.logspace(-12, 12, 400), [0.3, np.nextafter(0.3, 0)]])


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 4e-7), (np.float64, 8e-16)])
def test_exponential_ratios(dtype, tolerance):
    x = ARGUMENTS.astype(dtype)
    exact = -np.expm1(-x.astype(np.float64))
    with np.errstate(invalid="ignore"):
        ratio = np.where(x > 0, exact / np.where(x > 0, x, 1.0).astype(np.float64), 1.0)
    np.testing.assert_allclose(n.one_minus_exp(x), exact, rtol=tolerance)
    np.testing.assert_allclose(n.exprel(x), ratio, rtol=tolerance)
    transmitted, absorbed = n.absorb(x)
    np.testing.assert_allclose(absorbed, exact, rtol=tolerance)
    np.testing.assert_allclose(transmitted, np.exp(-x.astype(np.float64)), rtol=tolerance, atol=1e-37)


def test_gradients_of_exponential_ratios():
    x = np.logspace(-8, 2, 200)
    # d exprel/dx = (exp(-x) (1 + x) - 1) / x^2, by its series below 0.1
    series = sum((-1) ** k * k * x ** (k - 1) / np.prod(np.arange(1.0, k + 2)) for k in range(1, 20))
    exact = np.where(x < 0.1, series, (np.exp(-x) * (1 + x) - 1) / x**2)
    ratio, rest = (jax.jit(jax.vmap(jax.grad(function))) for function in (n.exprel, n.one_minus_exp))
    np.testing.assert_allclose(ratio(x), exact, rtol=2e-13)
    np.testing.assert_allclose(rest(x), np.exp(-x), rtol=1e-13)
    assert np.isfinite(ratio(jnp.array([0.0, 1e30, 1e300]))).all()


def test_safe_root_and_quotient():
    x = jnp.array([-1.0, 0.0, 4.0])
    np.testing.assert_array_equal(n.safe_sqrt(x), [0.0, 0.0, 2.0])
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.grad(n.safe_sqrt)))(x), [0.0, 0.0, 0.25])
    np.testing.assert_array_equal(n.safe_div(jnp.ones(2), jnp.array([0.0, 4.0]), 7.0), [7.0, 0.25])
    assert jax.grad(n.safe_div, 1)(1.0, 0.0) == 0.0
