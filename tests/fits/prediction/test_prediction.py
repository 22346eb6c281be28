"""Predictions beside what is known of them, and their scores by held-out measurements."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fits import Discrepancy, Fit, Free, Measurements, Noise, fit, predict, sample, scores, slices
from fits.data.scans import select
from fits.prediction.predict import LEVELS
from fits.reports.tables import UNRELIABLE, scores_table
from tests.helpers.models import COUNT, POSITIVE_LINE, along, design, directions, line, measured, wrong_line
from tests.helpers.refusals import refuses

SIGMA = 0.02


def split(seed: int, wrong: float, sigma: float = SIGMA) -> tuple[Measurements, Measurements]:
    """Two incidences, and two that are held out, of the line with smooth errors relative to it, and noise."""
    data = wrong_line(seed, Discrepancy(max(wrong, 1e-6), 12.0, 12.0, 0.0), sigma)
    held = select(data, "incidence=30,70")
    return data.where(~held), data.where(held)


def test_intervals_of_a_line_are_those_of_regression(result: Fit) -> None:
    at = predict(result, result.problem.data, draws=4000)
    columns = design(COUNT)
    expected = 0.05 * np.sqrt(np.sum(columns @ np.linalg.inv(columns.T @ columns) * columns, axis=-1))
    # 4,000 draws: 1.5 % of a standard deviation, at 4 standard errors
    np.testing.assert_allclose(at.latent.sd[:, 0], expected, rtol=0.06)
    np.testing.assert_allclose(at.predictive.sd[:, 0], np.sqrt(expected**2 + 0.05**2), rtol=0.05)
    np.testing.assert_allclose(at.latent.mean, result.predicted, atol=0.1 * expected.max())
    wide = at.predictive.quantiles[-1] - at.predictive.quantiles[0]
    np.testing.assert_allclose(wide[:, 0], 2 * stats.norm.ppf(0.975) * np.hypot(expected, 0.05), rtol=0.06)
    # a chain says the same
    by_chain = predict(sample(result, walkers=16, max_steps=4000), result.problem.data, draws=1000)
    np.testing.assert_allclose(by_chain.predictive.sd, at.predictive.sd, rtol=0.08)
    np.testing.assert_allclose(by_chain.latent.mean, at.latent.mean, atol=0.2 * at.latent.sd.max())
    # draws that may miss a part are said to
    for one, unreliable in ((at, False), (by_chain, False), (replace(at, pareto_k=0.8), True)):
        assert one.reliable != unreliable
        assert (UNRELIABLE in scores_table(one, result.problem.data, "").note) == unreliable


@pytest.mark.slow
def test_quantiles_are_those_of_the_draws_and_hold_what_they_say() -> None:
    (fitted, held_out), noise = split(3, 0.1), Noise(relative=SIGMA, floor=1e-4, discrepancy=True)
    at = predict(fit(POSITIVE_LINE, fitted, transport=line, noise=noise, starts=2), held_out)
    assert not np.array_equal(at.mean, at.latent.mean)
    # a measurement adds independent noise: of the logarithm, which is the relative deviation here
    np.testing.assert_allclose(at.scales**2, at.discrepancy_sd**2 + SIGMA**2, rtol=1e-3)
    # by 2,048 draws: the standard error of a quantile is at most 0.06 sd, at 4 or 5 of them
    for level, of_bsdf, of_measurement in zip(LEVELS, at.bsdf.quantiles, at.predictive.quantiles, strict=True):
        np.testing.assert_allclose(at.quantile(level), of_bsdf, atol=0.3 * at.sd.max())
        np.testing.assert_allclose(at.cdf(at.predictive_quantile(level)), level, atol=1e-9)
        np.testing.assert_allclose(at.predictive_quantile(level), of_measurement, atol=0.25 * at.predictive.sd.max())
    low, high = (at.predictive_quantile(level) for level in (0.025, 0.975))
    expected = np.mean((held_out.used().values > low) & (held_out.used().values < high))
    assert at.scores.coverage[0.95] == pytest.approx(expected)
    assert at.scores == scores(at, held_out)
    assert expected > 0.9
    # the truth is known, as the discrepancy is drawn before the noise: of a stack that is wrong by 10 % the interval
    # holds few of it, that of the BSDF, with its discrepancy, what it says
    truth = split(3, 0.1, sigma=0.0)[1].used().values
    within = [np.mean((of.quantiles[0] < truth) & (truth < of.quantiles[-1])) for of in (at.latent, at.bsdf)]
    assert within[0] < 0.6
    assert within[1] > 0.85
    assert np.median(np.abs(at.mean / truth - 1.0)) < 0.9 * np.median(np.abs(at.latent.mean / truth - 1.0))


def test_directions_below_an_opaque_stack_are_refused(coat_fit: Fit) -> None:
    for at in (slices([95.0]), slices([90.0]), slices([30.0], [10.0, 120.0])):
        refuses(r"sees nothing of an opaque stack; its polar angle must be in \[0, 90\)", predict, coat_fit, at)
    assert np.all(predict(coat_fit, slices([89.9]), draws=8).mean > 0.0)


def test_noise_elsewhere_is_that_of_what_was_fitted() -> None:
    fitted, _ = split(2, 0.0)
    known = replace(fitted, sigma=SIGMA * fitted.values)
    found = fit(POSITIVE_LINE, known, transport=line, starts=2)
    at, again = (predict(found, slices([30.0], [-60.0, -20.0, 0.0, 40.0])) for _ in range(2))
    np.testing.assert_allclose(at.scales, SIGMA * np.abs(at.means), rtol=0.05)
    np.testing.assert_array_equal(at.predictive.quantiles, again.predictive.quantiles)


def test_bad_requests_are_refused(result: Fit) -> None:
    data, at = result.problem.data, predict(result, slices([30.0]), draws=2)
    named = replace(result, problem=replace(result.problem, objective="cube_root"))
    for call, message in (
        (lambda: at.quantile(0.0), r"level is 0.0; it must be a number in \(0, 1\)"),
        (lambda: at.predictive_quantile(1.0), r"level is 1.0; it must be a number in \(0, 1\)"),
        (lambda: at.scores, "a Geometry was predicted"),
        (lambda: scores(at, data), "the measurements have other directions"),
        (lambda: predict(result, data, draws=1), "draws: 1 is not a whole number of at least 2"),
        (lambda: predict(named, data), "a fit of 'cube_root' has no noise model"),
        (lambda: predict(result, along(data, channels="rgb")), "measurements have the channels r, g, b, the fit c0"),
    ):
        refuses(message, call)


@pytest.mark.parametrize("sigma", [0.02, 0.001])
def test_intervals_of_a_product_hold_though_its_factors_are_unidentified(sigma) -> None:
    """The posterior is a hyperbola, the narrower the less noise there is, far from what a fit's covariance says."""

    def product(stack, wi, wo):
        return (stack["a"] * stack["b"] * (1.0 + 0.5 * wo[:, 2]))[:, None]

    exact = np.asarray(product({"a": 2.0, "b": 0.45}, directions(100, 1), directions(100, 2)))
    noise = sigma * np.random.default_rng(0).standard_normal(exact.shape)
    data = measured(exact + noise, sigma)
    found = fit({"a": Free(1.0, 0.1, 10.0), "b": Free(0.9, 0.0, 10.0)}, data, transport=product, starts=4)
    at = predict(found, data, draws=1000)
    ratio = at.latent.sd[:, 0] / (exact[:, 0] * sigma / np.sqrt(np.sum(exact**2)))
    # reliable weights have some hundred effective draws, 4 standard errors of whose deviation are 0.2; others make
    # intervals wider, never narrower
    assert np.all(ratio > 0.8)
    assert np.all(ratio < (1.2 if at.reliable else 10.0))
    assert np.all(np.abs(at.latent.mean - found.predicted)[:, 0] < at.latent.sd[:, 0])
