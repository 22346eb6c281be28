"""What a fit decides by itself: its resolution, by the noise of its data, and whether discrepancy is modelled."""

from dataclasses import replace

import numpy as np
import pytest

import layerjax as lj
from fits import Discrepancy, Free, Noise, Posterior, Problem, fit, simulate, slices
from fits.optimise import multi_start as starts_module
from fits.optimise import resolution as resolution_module
from fits.optimise.options import DEFAULT
from fits.optimise.resolution import LEAST_SCATTER, resolutions, spread
from fits.problem.discrepancy import log_scales, places
from fits.reports import results, verdicts
from tests.helpers.models import LINE, POSITIVE_LINE, TRUTH, along, line, line_data
from tests.helpers.tasks import stop_at

GEOMETRY = slices(incidence=(20, 50), outgoing=np.arange(-60, 61, 20))
NARROW, WIDE = 0.8, 0.3
COARSE, FINE = lj.AddingDoubling(nodes=12, modes=16, ordinates=(8, 12)), lj.AddingDoubling(nodes=32, modes=48)
SCANS = slices([10.0, 50.0], np.arange(-80.0, 81.0, 4.0))
EXACT = np.asarray(line({"a": 1.0, "b": 0.5}, SCANS.wi, SCANS.wo))
NOISE = Noise(relative=0.02, floor=1e-4)


def hazy(g):
    """Haze on paint: its forward peak is what nodes must resolve. It compiles faster than an interface."""
    return lj.Stack([lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(g))], base=lj.Lambertian(0.3))


STACK = hazy(Free(WIDE, -0.5, 0.95))  # wide where it starts: 12 nodes will do there


def measured(g, noise):
    return simulate(hazy(g), GEOMETRY, transport=FINE, noise=noise, seed=0)


@pytest.fixture(scope="module")
def sharp():
    return measured(NARROW, 0.003)


@pytest.fixture(scope="module")
def refined(sharp, tmp_path_factory):
    kept = tmp_path_factory.mktemp("starts") / "kept"
    return fit(STACK, sharp, starts=2, checkpoint=kept), kept


@pytest.mark.slow
def test_a_fit_is_refined_until_its_error_is_a_tenth_of_the_noise(refined, sharp):
    found, _ = refined
    transport = found.problem.transport
    assert isinstance(transport, lj.AddingDoubling)
    assert transport.nodes > COARSE.nodes
    assert found.numerical_error <= DEFAULT.numerical_error
    assert found.resolution == f"{transport.nodes} nodes, {transport.modes} modes"
    assert f"numerical error of the model: {found.numerical_error:.2g} sigma at most" in found.status
    # against the resolution that made the data, the error is what is said, within the factor of one more rung
    exact = lj.evaluate(hazy(found.values["layers[0].phase.g"]), sharp.wi, sharp.wo, FINE)
    assert np.max(np.abs(found.predicted - exact) / sharp.sigma) < 2.0 * DEFAULT.numerical_error
    assert abs(found.values["layers[0].phase.g"] - NARROW) < 3.0 * found.standard_errors["layers[0].phase.g"]
    assert found.converged
    assert found.minima[0].count == 2


@pytest.mark.slow
def test_a_coarse_one_stays_where_it_will_do():
    found = fit(STACK, measured(WIDE, 0.05), starts=1)
    assert found.resolution == "12 nodes, 16 modes"
    assert found.numerical_error <= DEFAULT.numerical_error


def test_a_resolution_that_is_given_stays_and_its_error_is_told(sharp):
    found = fit(STACK, sharp, transport=COARSE, starts=1)
    assert found.problem.transport == COARSE
    assert found.numerical_error > DEFAULT.numerical_error
    assert "sigma at most at 12 nodes, 16 modes, as given" in found.status
    _, remarks, sound = verdicts.verdict(found)
    assert not sound
    assert any("numerical error" in sentence for sentence in remarks)


def test_the_finest_resolution_is_told(sharp, monkeypatch):
    monkeypatch.setattr(resolution_module, "FINEST_NODES", COARSE.nodes)
    monkeypatch.setattr(resolution_module, "FINEST_MODES", COARSE.modes)
    found = fit(STACK, sharp, starts=1)
    assert found.resolution == "12 nodes, 16 modes, the finest tried"


def test_a_fit_resumes_after_its_starts_and_is_kept_with_its_resolution(refined, sharp, monkeypatch, tmp_path):
    found, kept = refined
    monkeypatch.setattr(starts_module, "rough_descent", pytest.fail)  # no start is run again
    again = fit(STACK, sharp, starts=2, checkpoint=kept)
    results.save_fit(found, tmp_path / "fit")
    for other in (again, results.load_fit(tmp_path / "fit")):
        np.testing.assert_array_equal(other.vector, found.vector)
        assert other.problem.transport == found.problem.transport
        assert (other.resolution, other.numerical_error) == (found.resolution, found.numerical_error)


def test_what_auto_is_does_not_follow_from_the_start():
    """An interface that starts without effect is one, and a roughness counts with its value at the start."""
    geometry = slices(incidence=(20,), outgoing=(0, 30))
    data = simulate(lj.Stack([], base=lj.Lambertian(albedo=0.5)), geometry, noise=0.1)
    flakes = lj.Medium(thickness=1.0, albedo=0.9, phase=lj.SGGX("surface", alpha=Free(0.1, 0.05, 1.0)))
    passing = resolutions(Problem(lj.Stack([lj.Interface(Free(1.0, 1.0, 2.0), 0.1), flakes]), data))
    assert passing.open
    assert not passing.tilted
    assert passing.chosen.nodes > passing.far.nodes == resolution_module.FAR["nodes"]
    bare = lj.Stack([lj.Medium(thickness=Free(0.0, 0.0, 1.0), albedo=0.0)], base=lj.Lambertian(albedo=0.5))
    assert resolutions(Problem(bare, data)) is None
    # what is given in part stays
    given = lj.AddingDoubling(modes=4)
    chosen = lj.AddingDoubling(nodes=12, modes=4, ordinates=(6, 8))
    known = resolution_module.Resolutions(given, chosen, tilted=False)
    assert known.open
    assert known.in_words(known.finer(chosen)) == "16 nodes, 4 modes"
    tilted = resolution_module.Resolutions(lj.AddingDoubling(nodes=8, modes=8), chosen, tilted=True)
    assert tilted.open
    assert tilted.in_words(tilted.finer(chosen)) == "8 cosines, 12 azimuths"


def test_errors_count_in_fitted_noise_levels_or_the_scatter_about_a_named_objective():
    data = line_data()
    level = Problem(LINE, data, line, Noise(floor=Free(0.05, 0.01, 1.0), use_sigma=False))
    vector = np.array([*TRUTH, 0.2])
    np.testing.assert_allclose(spread(level, vector, np.asarray(level.predict(vector))), 0.2)
    named = Problem(LINE, data, line, objective="cosine_l2")
    predicted, cosine = np.asarray(named.predict(TRUTH)), data.wi[:, 2:]
    scatter = np.sqrt(np.sum((cosine * (predicted - data.values)) ** 2) / (len(data) - 2))
    np.testing.assert_allclose(spread(named, TRUTH, predicted), scatter)
    # noise-free data, which any error would be large beside
    least = LEAST_SCATTER * np.sqrt(np.mean((cosine * data.values) ** 2))
    np.testing.assert_allclose(spread(named, TRUTH, data.values), least)


def with_wave(wave):
    """Measurements of the line, times one plus a wave along the viewing angle, with noise of 2 %."""
    angle = np.arctan2(SCANS.wo[:, :1], SCANS.wo[:, 2:])
    noise = 0.02 * np.random.default_rng(0).standard_normal(EXACT.shape)
    return along(SCANS, EXACT * (1.0 + wave * np.sin(8.0 * angle) + noise))


def fitted(wave=0.1, noise=NOISE, starts=2, **how):
    return fit(POSITIVE_LINE, with_wave(wave), transport=line, noise=noise, starts=starts, **how)


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
    shared = at.amplitude * np.exp(at.grazing_exponent * np.asarray(log_scales(places(SCANS.wi, SCANS.wo))))
    # of 1024 draws, and a regression on nodes between them
    scatter = np.log(simulated / wrong.predicted).std(axis=0)[:, 0]
    np.testing.assert_allclose(scatter, np.hypot(shared, 0.02), rtol=0.1)


def test_a_right_one_is_not():
    found = fitted(0.0)
    assert found.without_discrepancy is None
    assert not found.problem.noise.discrepancy
    assert list(found.values) == ["['a']", "['b']"]
    assert not verdicts.verdict(found).remarks


def test_where_they_cannot_be_counted_they_are_not():
    assert fitted(noise=replace(NOISE, tails="student"), starts=1).without_discrepancy is None
    assert fitted(noise=Noise(), objective="cube_root", starts=1).without_discrepancy is None


def test_a_killed_fit_goes_on_in_either_part(tmp_path, wrong, monkeypatch):
    kept = tmp_path / "starts"
    with pytest.raises(KeyboardInterrupt):
        fitted(progress=stop_at("with model discrepancy", 2), checkpoint=kept)
    run, end = [], starts_module.rough_descent
    monkeypatch.setattr(starts_module, "rough_descent", lambda *given: run.append(given) or end(*given))
    np.testing.assert_array_equal(fitted(checkpoint=kept).vector, wrong.vector)
    assert len(run) == 1  # of two starts and, with model discrepancy, three
    assert {path.name for path in tmp_path.iterdir()} >= {"starts", "starts-discrepancy"}
