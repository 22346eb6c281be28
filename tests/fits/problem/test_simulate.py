"""Simulated data: the right values, with noise of the size that it states."""

import numpy as np
from scipy import stats

import layerjax as lj
from fits import simulate, slices

ALBEDO = np.array([0.2, 0.4, 0.6])
PAINT = lj.Stack([], base=lj.Lambertian(albedo=ALBEDO))


def test_values_and_noise_are_as_stated():
    plain = simulate(PAINT, slices(incidence=[20, 60]))
    np.testing.assert_allclose(plain.values, np.broadcast_to(ALBEDO / np.pi, plain.values.shape), rtol=1e-12)
    assert plain.sigma is None
    assert plain.mask.all()
    assert plain.channels == ("red", "green", "blue")
    data = simulate(PAINT, slices(outgoing=np.linspace(-80, 80, 400)), noise=0.05, floor=0.01, seed=3)
    expected = np.sqrt((0.05 * ALBEDO / np.pi) ** 2 + 0.01**2)
    np.testing.assert_allclose(data.sigma, np.broadcast_to(expected, data.sigma.shape))
    z = (data.values - ALBEDO / np.pi) / data.sigma
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3  # a fixed seed: passes or fails for good


def test_seeds_repeat_and_samples_without_light_are_masked():
    first, again, other = (simulate(PAINT, slices(), noise=0.1, seed=seed).values for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()
    data = simulate(PAINT, slices(incidence=[30], outgoing=[10, 120]), noise=0.05)
    np.testing.assert_array_equal(data.mask, [True, False])  # nothing passes an opaque base
