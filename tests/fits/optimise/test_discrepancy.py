"""Whether a fit counts errors that readings share, where that is left to the residuals."""

from dataclasses import replace

import numpy as np
import pytest

from fits import Discrepancy, Free, Noise, Posterior, fit, slices
from fits.optimise import multi_start as starts_module
from fits.problem.discrepancy import log_scales, places
from fits.reports import verdicts
from tests.helpers.models import along, line

STACK = {"a": Free(0.9, 0.1, 3.0), "b": Free(0.1, -1.0, 3.0)}
GEOMETRY = slices([10.0, 50.0], np.arange(-80.0, 81.0, 4.0))
EXACT = np.asarray(line({"a": 1.0, "b": 0.5}, GEOMETRY.wi, GEOMETRY.wo))
NOISE = Noise(relative=0.02, floor=1e-4)


def readings(wave):
    """Of the line, times one plus a wave along the viewing angle, with noise of 2 %."""
    angle = np.arctan2(GEOMETRY.wo[:, :1], GEOMETRY.wo[:, 2:])
    noise = 0.02 * np.random.default_rng(0).standard_normal(EXACT.shape)
    return along(GEOMETRY, EXACT * (1.0 + wave * np.sin(8.0 * angle) + noise))


def fitted(wave=0.1, noise=NOISE, starts=2, **how):
    return fit(STACK, readings(wave), transport=line, noise=noise, starts=starts, **how)


@pytest.fixture(scope="module")
def wrong():
    return fitted()


def test_a_wrong_shape_is_fitted_with_them_and_both_are_told(wrong):
    plain, before = fitted(noise=replace(NOISE, discrepancy=False)), wrong.without_discrepancy
    assert wrong.problem.noise.discrepancy == Discrepancy()
    assert plain.without_discrepancy is None
    assert before.values == pytest.approx(plain.values, rel=1e-6)
    assert before.chi_square == pytest.approx(plain.chi_square)
    assert before.residual_autocorrelation > 0.8
    assert wrong.log_likelihood > plain.log_likelihood + 20.0
    assert 0.03 < wrong.values["noise.discrepancy.amplitude"] < 0.3
    for name in plain.values:
        assert wrong.standard_errors[name] > 2.0 * plain.standard_errors[name]
    words = " ".join(verdicts.verdict(wrong).remarks)
    assert "neighbouring residuals correlate by +0." in words
    assert "Set `discrepancy = false` to disable it" in words
    assert f"Model discrepancy: {100.0 * wrong.values['noise.discrepancy.amplitude']:.2g} % of the BSDF" in words
    # two starts with independent noise, then one from each of their minima and two more with the discrepancy
    starts = sum(wrong.start_outcomes.values())
    assert starts > 2
    assert f"{wrong.minima[0].count} of {starts} starts converged to the best" in wrong.status


@pytest.mark.slow
def test_simulated_readings_share_errors(wrong):
    chain = np.tile(wrong.vector, (64, 16, 1))
    posterior = Posterior(wrong, chain, chain[..., 0], np.ones(chain.shape[-1]), 1.0, converged=True)
    simulated = posterior.inference_data.posterior_predictive["value"].to_numpy().reshape(-1, *wrong.predicted.shape)
    at = wrong.problem.build(wrong.vector).correlation
    shared = at.amplitude * np.exp(at.grazing_exponent * np.asarray(log_scales(places(GEOMETRY.wi, GEOMETRY.wo))))
    # of 1024 draws, and a regression on nodes between them
    scatter = np.log(simulated / wrong.predicted).std(axis=0)[:, 0]
    np.testing.assert_allclose(scatter, np.hypot(shared, 0.02), rtol=0.1)


def test_a_right_one_is_not():
    found = fitted(0.0)
    assert found.without_discrepancy is None
    assert not found.problem.noise.discrepancy
    assert list(found.values) == ["['a']", "['b']"]
    assert not verdicts.verdict(found).remarks


@pytest.mark.parametrize(
    "how", [{"noise": Noise(relative=0.02, floor=1e-4, tails="student")}, {"noise": Noise(), "objective": "cube_root"}]
)
def test_where_they_cannot_be_counted_they_are_not(how):
    assert fitted(**how, starts=1).without_discrepancy is None


def test_a_killed_fit_goes_on_in_either_part(tmp_path, wrong, monkeypatch):
    kept = tmp_path / "starts"

    def stop(stage, done, total=None, info=""):
        if stage.startswith("with model discrepancy") and done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fitted(progress=stop, checkpoint=kept)
    run = []
    end = starts_module.rough_descent
    monkeypatch.setattr(starts_module, "rough_descent", lambda *given: run.append(given) or end(*given))
    np.testing.assert_array_equal(fitted(checkpoint=kept).vector, wrong.vector)
    assert len(run) == 1  # of two starts and, with model discrepancy, three
    assert {path.name for path in tmp_path.iterdir()} >= {"starts", "starts-discrepancy"}
