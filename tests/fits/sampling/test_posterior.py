"""The samplers against posteriors known in closed form, against each other, and against being interrupted."""

import sys
from dataclasses import replace
from importlib.util import find_spec

import emcee
import jax
import numpy as np
import pytest
from scipy import stats

from fits import Free, SamplerOptions, fit, load_posterior, sample, save_fit
from fits.sampling import chain
from fits.sampling.nuts import Nuts, _step
from fits.sampling.sample import load, walkers_of
from tests.helpers.models import COUNT, LOBE_STACK, design, line, line_data, line_fit, lobe, noisy_lobe, student_fit
from tests.helpers.refusals import refuses
from tests.helpers.tasks import stop_at

NEEDS_BLACKJAX = pytest.mark.skipif(find_spec("blackjax") is None, reason="needs blackjax")
BOTH = ["emcee", pytest.param("nuts", marks=[pytest.mark.slow, NEEDS_BLACKJAX])]
SHORT = {"sampler": "nuts", "seed": 1, "max_steps": 120}


@pytest.fixture(scope="module")
def posterior(result):
    return sample(result, walkers=16, seed=1)


def test_the_posterior_of_a_line_is_its_regression(result, posterior):
    """Mean and covariance in closed form; tolerance 5 Monte Carlo errors of the effective samples."""
    covariance = np.linalg.inv(design(COUNT).T @ design(COUNT)) * 0.05**2
    mean = covariance @ design(COUNT).T @ result.problem.data.values[:, 0] / 0.05**2
    spreads, errors = np.sqrt(np.diagonal(covariance)), 5 / np.sqrt(posterior.effective_samples)
    assert posterior.converged
    summary = posterior.summary().values()
    for (median, low, high, average, deviation), at, spread, error in zip(summary, mean, spreads, errors, strict=True):
        assert average == pytest.approx(at, abs=error * spread)
        assert median == pytest.approx(at, abs=1.3 * error * spread)
        assert deviation == pytest.approx(spread, rel=error)
        assert [low, high] == pytest.approx([at - spread, at + spread], rel=error)
    kept = posterior.chain[posterior.burn_in :].reshape(-1, 2)
    assert np.corrcoef(kept.T)[0, 1] == pytest.approx(covariance[0, 1] / spreads.prod(), abs=errors.max())


def test_it_stops_when_the_chain_is_long_enough(posterior):
    kept = len(posterior.chain) - posterior.burn_in
    assert kept >= 50 * posterior.autocorrelation_time.max()
    assert posterior.effective_samples.min() >= 1000.0
    assert posterior.r_hat.max() <= 1.01
    assert len(posterior.chain) < 500
    assert 0.2 < posterior.acceptance < 1.0
    again = emcee.autocorr.integrated_time(posterior.chain[posterior.burn_in :], tol=0)
    np.testing.assert_allclose(posterior.autocorrelation_time, again, rtol=0.05)  # of log-odds and of values
    assert posterior.samples.shape == (-(-kept // posterior.thin) * 16, 2)


@pytest.mark.slow
def test_it_goes_on_for_the_effective_samples_that_are_asked_for(result, posterior, tmp_path):
    """To the same end as a chain that was asked for them at once; one that has more is left as it is."""
    how, shown = {"walkers": 16, "seed": 1, "path": tmp_path / "chain"}, []
    sample(result, **how)
    wanted = 2.0 * posterior.effective_samples.min()
    more = sample(result, **how, ess=wanted, progress=lambda *given: shown.append(given))
    assert more.effective_samples.min() >= wanted
    assert len(more.chain) < 6 * len(posterior.chain)
    np.testing.assert_array_equal(more.chain[: len(posterior.chain)], posterior.chain)
    np.testing.assert_array_equal(sample(result, walkers=16, seed=1, ess=wanted).chain, more.chain)
    assert len(sample(result, **how, ess=1.0).chain) == len(more.chain)
    steps = [step for _, step, *_ in shown]
    assert steps == [*range(len(posterior.chain) + 1, len(more.chain) + 1), len(more.chain)]
    assert f"of {wanted:g} effective samples" in shown[0][3]
    # the steps that are left: right within a factor of two, as far as whole checks tell
    assert 0.5 < (shown[150][2] - steps[150]) / (len(more.chain) - steps[150]) < 2.0


@pytest.mark.parametrize("sampler", BOTH)
def test_a_parameter_on_its_bound_has_a_truncated_posterior(sampler):
    """b is free within [0.55, 3] and best below: given a, a Gaussian cut off at its bound."""
    data = line_data()
    rest, x = data.values[:, 0] - 1.0, design(COUNT)[:, 1]
    centre, spread = x @ rest / (x @ x), 0.05 / np.sqrt(x @ x)
    low = centre + 1.5 * spread
    fitted = fit({"a": 1.0, "b": Free(2.0, low, 3.0)}, data, transport=line, starts=2)
    assert fitted.at_bound == ("['b']",)
    posterior = sample(fitted, sampler=sampler, seed=2)
    law = stats.truncnorm(1.5, np.inf, centre, spread)
    median, lower, upper, mean, deviation = posterior.summary()["['b']"]
    error = 5 / np.sqrt(posterior.effective_samples[0])
    assert mean == pytest.approx(law.mean(), abs=error * law.std())
    # the fourth moment of an exponential is three times that of a Gaussian
    assert deviation == pytest.approx(law.std(), rel=2 * error)
    assert [median, lower, upper] == pytest.approx(law.ppf([0.5, 0.158655, 0.841345]), abs=2 * error * law.std())


def test_a_short_chain_reports_nothing_unless_told_to_and_keeps_its_options(result, tmp_path):
    options = SamplerOptions(ess=100.0, r_hat=1.1, walkers=16, max_steps=100, autocorrelation_times=500.0, burn_in=0.25)
    short = sample(result, seed=1, options=options, path=tmp_path / "chain")
    assert not short.converged
    assert load(result, tmp_path / "chain").options == short.options == options
    assert short.burn_in == 25
    words = "chain of 100 steps is too short.*autocorrelation time.*larger max_steps"
    for ask in (short.summary, lambda: short.inference_data):
        refuses(words, ask)
    assert set(load(result, tmp_path / "chain", allow_unconverged=True).summary()) == set(short.names)


def test_an_interrupted_chain_goes_on_to_the_same_end(result, posterior, tmp_path, monkeypatch):
    """From its last block, by the seed alone, whatever numpy's global state, from which emcee would start."""
    monkeypatch.setattr(chain, "SECONDS", 0.0)  # a block a step
    np.random.seed(99)  # noqa: NPY002
    path, how = tmp_path / "chain", {"walkers": 16, "seed": 1, "path": tmp_path / "chain"}
    with pytest.raises(KeyboardInterrupt):
        sample(result, **how, progress=stop_at("sample", 37))
    np.testing.assert_array_equal(load(result, path).chain, posterior.chain[:37])
    assert len(sample(result, **how, max_steps=150).chain) == 150
    whole = sample(result, **how)
    np.testing.assert_array_equal(whole.chain, posterior.chain)
    assert whole.summary() == load(result, path).summary() == posterior.summary()
    assert [entry.name for entry in tmp_path.iterdir()] == ["chain"]


@pytest.mark.filterwarnings("ignore:Explicitly requested dtype float64")
def test_a_chain_of_something_else_is_refused(result, tmp_path):
    path = tmp_path / "chain"
    sample(result, walkers=16, seed=1, max_steps=100, path=path)
    other = line_fit(seed=5)
    words = r"another problem \(walkers 16, not 18, seed 1, not 2, posterior\)"
    refuses(words, sample, other, walkers=18, seed=2, path=path)
    with jax.enable_x64(False), pytest.raises(ValueError, match="precision float64, not float32"):
        load(result, path)
    assert len(sample(other, walkers=16, seed=2, path=path, resume=False, max_steps=100).chain) == 100


def test_inference_data(result, posterior):
    data = posterior.inference_data
    a, b = (data.posterior[name].to_numpy() for name in ("['a']", "['b']"))
    predicted = a[..., None, None] + b[..., None, None] * design(COUNT)[:, 1:]
    expected = stats.norm.logpdf(result.problem.data.values, predicted, 0.05)
    np.testing.assert_allclose(data.log_likelihood["value"], expected, rtol=1e-9)
    noise = (data.posterior_predictive["value"].to_numpy() - predicted) / 0.05
    assert noise.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * noise.size))
    np.testing.assert_array_equal(data.observed_data["value"], result.problem.data.values)
    assert data.log_likelihood["value"].dims == ("chain", "draw", "sample", "channel")


def test_refused(result):
    named = replace(result, problem=replace(result.problem, objective="cosine_l2"))
    refuses("walkers is 4; it must be even and at least 6", sample, result, walkers=4)  # twice the parameters, and 2
    refuses("max_steps: 10 is not a whole number of at least 100", sample, result, max_steps=10)
    refuses("sample: a fit of 'cosine_l2' has no noise model, and so no posterior", sample, named)


@pytest.fixture(scope="module")
def short(result):
    return sample(result, **SHORT)


@NEEDS_BLACKJAX
def test_divergences_are_counted_and_told(result, tmp_path, monkeypatch):
    """Half of the chains diverge at every step, as the chain's records have it."""
    on_all_cores = Nuts._on_all_cores

    def diverging(self, function, positions, **given):
        *found, last = on_all_cores(self, function, positions, **given)
        return *found, last | (np.arange(len(last)) < 2) if function is _step else last

    monkeypatch.setattr(Nuts, "_on_all_cores", diverging)
    sample(result, **SHORT, path=tmp_path / "chain")
    posterior = load(result, tmp_path / "chain")
    assert posterior.divergences == 240
    assert "240 divergences in 480 steps after the warm-up, near which it may have missed" in posterior.status


@NEEDS_BLACKJAX
@pytest.mark.parametrize("stage", ["warm-up", "sample"])
def test_it_goes_on_from_its_file_to_the_same_end(result, short, tmp_path, stage):
    path = tmp_path / "chain"
    with pytest.raises(KeyboardInterrupt):
        sample(result, **SHORT, path=path, progress=stop_at(stage))
    whole = sample(result, **SHORT, path=path)
    np.testing.assert_array_equal(whole.chain, short.chain)
    assert (whole.chain.shape, whole.divergences) == ((120, 4, 2), 0)
    assert 0.5 < whole.acceptance <= 1.0
    assert load(result, path).status == short.status == "NUTS, 0 divergences in 480 steps after the warm-up"
    assert [entry.name for entry in tmp_path.iterdir()] == ["chain"]
    refuses(r"another problem \(sampler nuts, not emcee", sample, result, walkers=6, seed=1, path=path)


@NEEDS_BLACKJAX
def test_chains_and_extra_are_there(result, monkeypatch):
    assert (walkers_of(20, "nuts", None), walkers_of(20, "emcee", None)) == (4, 42)
    refuses("walkers is 1; it must be at least 2", sample, result, sampler="nuts", walkers=1)
    monkeypatch.setitem(sys.modules, "blackjax", None)
    refuses(r'^sampler="nuts" needs blackjax: pip install "layerjax\[nuts\]"$', sample, result, sampler="nuts")


def coated():
    return fit(LOBE_STACK, noisy_lobe(0, 140), transport=lobe, starts=2)


@NEEDS_BLACKJAX
@pytest.mark.slow
@pytest.mark.parametrize("made", [coated, student_fit])
def test_quantiles_are_those_of_emcee(made):
    """Within a tenth of a deviation: by 6,000 effective samples a quantile is known to 0.04 of it at worst."""
    fitted, kept = made(), []
    for sampler in ("nuts", "emcee"):
        posterior = sample(fitted, sampler=sampler, seed=1, ess=6000)
        assert posterior.effective_samples.min() > 5000
        kept.append(posterior.chain[posterior.burn_in :].reshape(-1, len(posterior.names)))
    first, second = (np.quantile(samples, [0.158655, 0.5, 0.841345], axis=0) for samples in kept)
    assert np.max(np.abs(first - second) / kept[1].std(axis=0)) < 0.1


@NEEDS_BLACKJAX
@pytest.mark.slow
def test_the_command_samples_with_it(work, coat_fit, layerjax):
    save_fit(coat_fit, "result")
    shown = layerjax("sample result --sampler nuts --max-steps 100 --allow-unconverged", 1)
    assert "The sampler: NUTS, 0 divergences in 400 steps" in shown.out
    assert "layerjax: warm-up 300/300" in shown.err
    layerjax("sample result --max-steps 200 --allow-unconverged", 1)  # the chain's own sampler
    posterior = load_posterior("result")
    assert posterior is not None
    assert posterior.chain.shape[:2] == (200, 4)
    assert "(sampler nuts, not emcee, walkers 4, not 20)" in layerjax("sample result --sampler emcee", 2).err
