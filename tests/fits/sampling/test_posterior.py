"""The sampler against posteriors known in closed form, and against being killed."""

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import emcee
import jax
import numpy as np
import pytest
from scipy import stats

from fits import Fit, Free, SamplerOptions, fit, sample
from fits.sampling.sample import load, walkers_of
from fits.store import Store
from tests.helpers.models import COUNT, design, line, line_data, line_fit, student_fit
from tests.helpers.places import ROOT


@pytest.fixture(scope="module")
def posterior(result: Fit):
    return sample(result, walkers=16, seed=1)


def test_the_posterior_of_a_line_is_its_regression(result: Fit, posterior) -> None:
    """Mean and covariance in closed form; tolerance 5 Monte Carlo errors of the effective samples."""
    covariance = np.linalg.inv(design(COUNT).T @ design(COUNT)) * 0.05**2
    mean = covariance @ design(COUNT).T @ result.problem.data.values[:, 0] / 0.05**2
    spread = np.sqrt(np.diagonal(covariance))
    assert posterior.converged
    count = posterior.effective_samples
    summary = posterior.summary()
    for index, name in enumerate(posterior.names):
        median, low, high, average, deviation = summary[name]
        error = 5 / np.sqrt(count[index])
        assert average == pytest.approx(mean[index], abs=error * spread[index])
        assert median == pytest.approx(mean[index], abs=1.3 * error * spread[index])
        assert deviation == pytest.approx(spread[index], rel=error)
        assert [low, high] == pytest.approx([mean[index] - spread[index], mean[index] + spread[index]], rel=error)
    kept = posterior.chain[posterior.burn_in :].reshape(-1, 2)
    assert np.corrcoef(kept.T)[0, 1] == pytest.approx(covariance[0, 1] / spread.prod(), abs=5 / np.sqrt(count.min()))


def test_it_stops_when_the_chain_is_long_enough(posterior) -> None:
    kept = len(posterior.chain) - posterior.burn_in
    assert np.all(kept >= 50 * posterior.autocorrelation_time)
    assert np.all(posterior.effective_samples >= 1000.0)
    assert np.all(posterior.r_hat <= 1.01)
    assert len(posterior.chain) < 500
    assert 0.2 < posterior.acceptance < 1.0
    again = emcee.autocorr.integrated_time(posterior.chain[posterior.burn_in :], tol=0)
    np.testing.assert_allclose(posterior.autocorrelation_time, again, rtol=0.05)  # of log-odds and of values
    assert posterior.samples.shape == (-(-kept // posterior.thin) * 16, 2)


@pytest.mark.slow
def test_it_goes_on_for_the_effective_samples_that_are_asked_for(result: Fit, posterior, tmp_path: Path) -> None:
    """A chain goes on for more of them, to the same end as one that was asked for them at once, and is left as it is
    for fewer."""
    path, shown = tmp_path / "chain", []
    sample(result, walkers=16, seed=1, path=path)
    wanted = 2.0 * posterior.effective_samples.min()
    more = sample(result, walkers=16, seed=1, path=path, ess=wanted, progress=lambda *given: shown.append(given))
    assert more.effective_samples.min() >= wanted
    assert len(more.chain) < 6 * len(posterior.chain)
    np.testing.assert_array_equal(more.chain[: len(posterior.chain)], posterior.chain)
    np.testing.assert_array_equal(sample(result, walkers=16, seed=1, ess=wanted).chain, more.chain)
    assert len(sample(result, walkers=16, seed=1, path=path, ess=1.0).chain) == len(more.chain)
    steps = [step for _, step, *_ in shown]
    assert steps == [*range(len(posterior.chain) + 1, len(more.chain) + 1), len(more.chain)]
    assert f"of {wanted:g} effective samples" in shown[0][3]
    # the steps that are left: right within a factor of two, as far as whole checks tell
    assert 0.5 < (shown[150][2] - steps[150]) / (len(more.chain) - steps[150]) < 2.0


def test_options_are_kept_with_the_chain(result: Fit, tmp_path: Path) -> None:
    options = SamplerOptions(ess=100.0, autocorrelation_times=10.0, r_hat=1.1, walkers=8, burn_in=0.25)
    posterior = sample(result, options=options, path=tmp_path / "chain")
    assert posterior.options == options
    assert posterior.burn_in == len(posterior.chain) // 4
    assert load(result, tmp_path / "chain").options == options
    assert walkers_of(20, "emcee", None) == 42  # more than twice as many as parameters


def test_a_parameter_on_its_bound_has_a_truncated_posterior() -> None:
    """b is free within [0.55, 3] and best below: given a, a Gaussian cut off at its bound."""
    data = line_data()
    rest, x = data.values[:, 0] - 1.0, design(COUNT)[:, 1]
    centre, spread = x @ rest / (x @ x), 0.05 / np.sqrt(x @ x)
    low = centre + 1.5 * spread
    fitted = fit({"a": 1.0, "b": Free(2.0, low, 3.0)}, data, transport=line, starts=2)
    assert fitted.at_bound == ("['b']",)
    posterior = sample(fitted, walkers=16, seed=2)
    law = stats.truncnorm(1.5, np.inf, centre, spread)
    median, lower, upper, mean, deviation = posterior.summary()["['b']"]
    error = 5 / np.sqrt(posterior.effective_samples[0])
    assert mean == pytest.approx(law.mean(), abs=error * law.std())
    # the fourth moment of an exponential is three times that of a Gaussian
    assert deviation == pytest.approx(law.std(), rel=2 * error)
    assert [median, lower, upper] == pytest.approx(law.ppf([0.5, 0.158655, 0.841345]), abs=2 * error * law.std())


def test_a_short_chain_reports_nothing_unless_told_to(result: Fit, tmp_path: Path) -> None:
    options = SamplerOptions(walkers=16, max_steps=100, autocorrelation_times=500.0)
    short = sample(result, seed=1, options=options, path=tmp_path / "chain")
    assert not short.converged
    for ask in (short.summary, lambda: short.inference_data):
        with pytest.raises(
            ValueError, match=r"chain of 100 steps is too short.*autocorrelation time.*larger max_steps"
        ):
            ask()
    assert set(load(result, tmp_path / "chain", allow_unconverged=True).summary()) == set(short.names)


def test_a_longer_limit_goes_on_to_the_same_end(result: Fit, posterior, tmp_path: Path) -> None:
    """By the seed alone, whatever numpy's global state, from which emcee would start."""
    np.random.seed(99)  # noqa: NPY002
    path = tmp_path / "chain"
    sample(result, walkers=16, seed=1, max_steps=150, path=path)
    whole = sample(result, walkers=16, seed=1, path=path)
    np.testing.assert_array_equal(whole.chain, posterior.chain)
    assert whole.summary() == posterior.summary()
    assert [entry.name for entry in tmp_path.iterdir()] == ["chain"]


SCRIPT = """
import sys, time
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from fits.sampling.sample import sample
from tests.helpers.models import line_fit
result = line_fit()
print("ready", flush=True)
options = {"walkers": 16, "seed": 1}
posterior = sample(result, path=sys.argv[1], progress=lambda *a: time.sleep(0.02), **options)
np.save(sys.argv[2], posterior.chain)
"""


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 3])
def test_killed_at_any_moment_it_ends_with_the_same_summary(result: Fit, posterior, tmp_path: Path, times: int) -> None:
    path, saved = tmp_path / "chain", tmp_path / "chain.npy"
    command = [sys.executable, "-c", SCRIPT, str(path), str(saved)]
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **cache}
    generator = np.random.default_rng(0)
    kills, kept = 0, 0
    while not saved.exists():
        with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == "ready"
            if kills == times:
                assert process.wait() == 0
                break
            while process.poll() is None and _stored_steps(path) <= kept:
                time.sleep(0.01)
            time.sleep(generator.uniform(0.0, 0.1))
            process.send_signal(signal.SIGKILL)
        kills, before, kept = kills + 1, kept, _stored_steps(path)
        assert kept > before
        np.testing.assert_array_equal(load(result, path).chain, posterior.chain[:kept])
    assert kills >= min(times, 2)
    np.testing.assert_array_equal(np.load(saved), posterior.chain)
    assert load(result, path).summary() == posterior.summary()


def _stored_steps(path: Path) -> int:
    return sum(len(block["coords"]) for block in Store.read(path).all("steps")) if path.exists() else 0


@pytest.mark.filterwarnings("ignore:Explicitly requested dtype float64")
def test_a_chain_of_something_else_is_refused(result: Fit, tmp_path: Path) -> None:
    path = tmp_path / "chain"
    sample(result, walkers=16, seed=1, max_steps=100, path=path)
    other = line_fit(seed=5)
    for one, walkers, seed, words in (
        (other, 16, 1, "another problem (posterior)"),
        (result, 16, 2, "(seed 1, not 2)"),
        (result, 18, 1, "(walkers 16, not 18)"),
    ):
        with pytest.raises(ValueError, match=re.escape(words)):
            sample(one, walkers=walkers, seed=seed, path=path)
    with jax.enable_x64(False), pytest.raises(ValueError, match="precision float64, not float32"):
        load(result, path)
    assert len(sample(other, walkers=16, seed=2, path=path, resume=False, max_steps=100).chain) == 100
    path.write_bytes(b"not SQLite")
    with pytest.raises(ValueError, match="no store of this version"):
        sample(result, walkers=16, seed=1, path=path)


def test_inference_data(result: Fit, posterior) -> None:
    data = posterior.inference_data
    a, b = (data.posterior[name].to_numpy() for name in ("['a']", "['b']"))
    predicted = a[..., None, None] + b[..., None, None] * design(COUNT)[:, 1:]
    expected = stats.norm.logpdf(result.problem.data.values, predicted, 0.05)
    np.testing.assert_allclose(data.log_likelihood["value"], expected, rtol=1e-9)
    noise = (data.posterior_predictive["value"].to_numpy() - predicted) / 0.05
    assert noise.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * noise.size))
    np.testing.assert_array_equal(data.observed_data["value"], result.problem.data.values)
    assert data.log_likelihood["value"].dims == ("chain", "draw", "sample", "channel")


def test_free_student_noise_is_sampled() -> None:
    summary = sample(fitted := student_fit(), walkers=16, seed=4).summary()
    for name, (median, *_, deviation) in summary.items():
        assert abs(median - fitted.values[name]) < fitted.standard_errors[name]
        assert deviation == pytest.approx(fitted.standard_errors[name], rel=0.3)  # asymptotic, for 100 data


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"walkers": 4}, "walkers is 4; it must be even and at least 6"),
        ({"ess": 0.0}, r"ess is 0.0; it must be a number in \(0, inf\)"),
        ({"max_steps": 10}, "max_steps: 10 is not a whole number of at least 100"),
        ({"objective": "cosine_l2"}, "sample: a fit of 'cosine_l2' has no noise model, and so no posterior"),
    ],
)
def test_refused(result: Fit, options: dict, message: str) -> None:
    if "objective" in options:
        result = replace(result, problem=replace(result.problem, objective=options.pop("objective")))
    with pytest.raises(ValueError, match=message):
        sample(result, **options)
