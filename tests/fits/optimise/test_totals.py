"""Totals in a likelihood: against closed forms of slabs, and beside values along directions."""

import numpy as np
import pytest
from scipy.special import expn

import layerjax as lj
from fits import Free, Instrument, Joint, Noise, Problem, Totals, fit, simulate, slices

SINGLE = lj.SingleScattering()
ANGLES = np.array([0.0, 60.0])
COSINE = np.cos(np.radians(ANGLES))
DEPTH = Free(0.5, 0.01, 5.0)


def predicted(stack, transport=SINGLE, **kinds):
    problem = Problem(stack, Totals.of(ANGLES, **kinds), transport)
    return np.asarray(problem.predict(problem.start))[:, 0].reshape(-1, len(ANGLES))


def test_slabs_and_bases_in_closed_form():
    stack = lj.Stack([lj.Medium(DEPTH, 0.0)])
    reflected, passed, unscattered = predicted(stack, reflectance=[0, 0], transmittance=[0, 0], unscattered=[0, 0])
    np.testing.assert_allclose(passed, np.exp(-0.5 / COSINE), rtol=1e-12)
    np.testing.assert_allclose(unscattered, passed, rtol=1e-12)
    np.testing.assert_allclose(reflected, 0.0, atol=1e-15)
    hazy = lj.Stack([lj.Medium(DEPTH, 0.8, lj.HenyeyGreenstein(0.7))])  # what is unscattered has no albedo
    np.testing.assert_allclose(predicted(hazy, unscattered=[0, 0])[0], np.exp(-0.5 / COSINE), rtol=1e-12)
    painted = lj.Stack([lj.Medium(DEPTH, 0.0)], lj.Lambertian(0.7))
    reflected, passed = predicted(painted, reflectance=[0, 0], transmittance=[0, 0])
    np.testing.assert_allclose(reflected, 0.7 * np.exp(-0.5 / COSINE) * 2 * expn(3, 0.5), rtol=1e-5)
    np.testing.assert_allclose(passed, 0.0)


def test_all_that_is_left_of_a_lossless_slab_leaves():
    stack = lj.Stack([lj.Medium(DEPTH, 1.0, lj.HenyeyGreenstein(0.3))])
    both = predicted(stack, lj.AddingDoubling(nodes=8, modes=8), reflectance=[0, 0], transmittance=[0, 0])
    np.testing.assert_allclose(both.sum(axis=0), 1.0, atol=1e-3)  # of 8 nodes


@pytest.mark.slow
def test_totals_and_values_together_tell_more_than_either():
    stack = lj.Stack([lj.Medium(DEPTH, Free(0.5, 0.0, 1.0), lj.HenyeyGreenstein(0.2))])
    true = lj.Stack([lj.Medium(0.8, 0.6, lj.HenyeyGreenstein(0.2))])
    near, far = (np.asarray(side)[0] for side in lj.albedo(true, np.array([0.0, 0.0, 1.0]), SINGLE))
    noise = np.random.default_rng(4).standard_normal(2)
    read = np.array([near, far + np.exp(-0.8)]) + 0.003 * noise
    totals = Problem(stack, Totals.of(reflectance=read[0], transmittance=read[1], sigma=0.003), SINGLE)
    view = simulate(true, slices((20, 50)), transport=SINGLE, noise=0.05, seed=2)
    values = Problem(stack, view, SINGLE, Noise(relative=0.05, discrepancy=False))
    alone = [fit(p.stack, p.data, transport=SINGLE, noise=p.noise, starts=3) for p in (totals, values)]
    joint = fit(Joint({"sphere": totals, "angles": values}, shared=["layers"]), starts=3)
    for name, truth in (("layers[0].thickness", 0.8), ("layers[0].albedo", 0.6)):
        assert joint.standard_errors[name] < min(one.standard_errors[name] for one in alone)
        assert abs(joint.values[name] - truth) < 3.5 * joint.standard_errors[name]
    # information adds where the model is as good as linear
    first, second, both = (np.linalg.inv(one.covariance) for one in (*alone, joint))
    size = np.sqrt(np.diagonal(both))
    np.testing.assert_allclose((first + second) / np.outer(size, size), both / np.outer(size, size), atol=0.05)


def test_bad_totals_are_named():
    for wrong, words in (
        ({}, "give reflectance, transmittance or unscattered"),
        ({"incidence": 95.0, "reflectance": 0.1}, r"incidence is \[95.0\], must be in \[0, 90\)"),
        ({"reflectance": -0.1}, "values holds -0.1, must be at least 0"),
        ({"incidence": [0, 30], "reflectance": [0.1, 0.2, 0.3]}, r"reflectance has shape \(3,\)"),
        ({"reflectance": 0.1, "sigma": {"transmittance": 0.1}}, "sigma has nothing for reflectance"),
        ({"reflectance": [[0.1, 0.2]], "transmittance": 0.3}, "must be as many for every kind"),
    ):
        with pytest.raises(ValueError, match=words):
            Totals.of(**wrong)
    stack, given = lj.Stack([], lj.Lambertian(Free(0.5, 0.0, 1.0))), Totals.of(reflectance=0.5)
    for more in ({"instrument": Instrument(detector_aperture=1.0)}, {"noise": Noise(discrepancy=True)}):
        with pytest.raises(ValueError, match=rf"{next(iter(more))}.* is given, but the data are totals"):
            Problem(stack, given, **more)
