"""The sampler against posteriors known in closed form, and against being killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import emcee
import h5py
import numpy as np
import pytest
from scipy import stats

from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.sampling import convergence as length
from fits.sampling.chain import FileChain, MemoryChain
from fits.sampling.ensemble import Ensemble, adapted
from fits.sampling.laplace import Approximation
from fits.sampling.sample import _walkers, identity_of, load, sample
from tests.helpers.models import COUNT, LINE, design, line, line_data, line_fit, measured
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
    assert np.all(kept > 50 * posterior.autocorrelation_time)
    assert len(posterior.chain) < 2000
    assert 0.2 < posterior.acceptance < 1.0
    again = emcee.autocorr.integrated_time(posterior.chain[posterior.burn_in :], tol=0)
    np.testing.assert_allclose(posterior.autocorrelation_time, again, rtol=0.05)  # of log-odds and of values
    assert posterior.samples.shape == (-(-kept // posterior.thin) * 16, 2)


def test_it_goes_on_for_the_effective_samples_that_are_asked_for(result: Fit, posterior, tmp_path: Path) -> None:
    """A chain goes on for more of them, to the same end as one that was asked for them at once, and is left as it is
    for fewer."""
    path, notes = tmp_path / "chain.h5", []
    sample(result, walkers=16, seed=1, path=path)
    wanted = 4.0 * posterior.effective_samples.min()
    more = sample(result, walkers=16, seed=1, path=path, ess=wanted, progress=lambda *given: notes.append(given[-1]))
    assert more.effective_samples.min() >= wanted
    assert len(more.chain) < 6 * len(posterior.chain)
    np.testing.assert_array_equal(more.chain[: len(posterior.chain)], posterior.chain)
    np.testing.assert_array_equal(sample(result, walkers=16, seed=1, ess=wanted).chain, more.chain)
    assert len(sample(result, walkers=16, seed=1, path=path, ess=1.0).chain) == len(more.chain)
    assert f"of {wanted:g} effective samples, needs" in notes[0]
    assert notes[0].endswith("s left")
    assert not notes[-1].endswith("left")


def test_a_slow_chain_is_told_of_between_its_checks(result: Fit, posterior, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = []
    monkeypatch.setattr(length, "PATIENCE", 0.0)
    again = sample(result, walkers=16, seed=1, max_steps=120, progress=lambda *given: steps.append(given[1]))
    assert steps == [*range(1, 101), 100, *range(101, 121), 120]
    np.testing.assert_array_equal(again.chain, posterior.chain[:120])


def test_the_same_seed_gives_the_same_chain_whatever_numpys_global_state(result: Fit, posterior) -> None:
    np.random.seed(99)  # noqa: NPY002  it is this state that emcee would start from
    again = sample(result, walkers=16, seed=1)
    np.testing.assert_array_equal(again.chain, posterior.chain)


def test_a_parameter_on_its_bound_has_a_truncated_posterior() -> None:
    """b is free within [0.55, 3] and best below: given a, a Gaussian cut off at its bound."""
    data = line_data()
    rest = data.values[:, 0] - 1.0
    x = design(COUNT)[:, 1]
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


@pytest.mark.parametrize("offset", [0.0, 6.0])
def test_the_approximation_is_learned_where_the_fits_own_is_poor(result: Fit, offset: float) -> None:
    """Samples of the fit's own approximation leave it in use; a Gaussian elsewhere is learned, to 1 / sqrt(samples)."""
    own = Approximation.of(result)
    generator = np.random.RandomState(0)
    law = stats.multivariate_normal(own.centre + offset, [[0.5, 0.3], [0.3, 0.4]])
    positions = law.rvs(1600, random_state=generator) if offset else own.draw(generator, 1600)
    chain = MemoryChain(16, 2)
    chain.chain, chain.iteration = positions.reshape(100, 16, 2), 100
    chosen = adapted(chain, own)
    assert (chosen is own) == (offset == 0.0)
    if offset:
        np.testing.assert_allclose(chosen.centre, law.mean, atol=5 * np.sqrt(0.5 / 800))
        np.testing.assert_allclose(chosen.root @ chosen.root.T, law.cov, atol=5 * 0.5 * np.sqrt(2 / 800))


def test_parameters_tied_together_on_one_bound() -> None:
    """Two parameters at a bound, both traded against a third: mean and deviation by brute force."""
    x = design(COUNT)[:, 1:]
    stack = {"a": Free(0.9, -1.0, 3.0), "b": Free(0.5, 0.0, 0.5), "c": Free(0.5, 0.0, 0.5)}

    def steep(stack, wi, wo):
        return (stack["a"] + (stack["b"] + stack["c"]) * wo[:, 2])[:, None]

    noise = 0.02 * np.random.default_rng(3).standard_normal((COUNT, 1))
    fitted = fit(stack, measured(1.0 + 1.01 * x + noise, 0.02), transport=steep, starts=4)
    posterior = sample(fitted, walkers=16, seed=5)
    assert posterior.converged
    assert len(posterior.chain) < 3000
    # the same posterior by brute force: weights of uniform draws of b and c, with a integrated in closed form
    generator = np.random.default_rng(0)
    b, c = generator.uniform(0.3, 0.5, (2, 200_000))
    rest = fitted.problem.data.values - (b + c) * x
    weights = np.exp(-0.5 * (COUNT * np.var(rest, axis=0) - np.min(COUNT * np.var(rest, axis=0))) / 0.02**2)
    mean = np.average(b, weights=weights)
    spread = np.sqrt(np.average((b - mean) ** 2, weights=weights))
    _, _, _, average, deviation = posterior.summary()["['b']"]
    error = 5 / np.sqrt(posterior.effective_samples.min())
    assert average == pytest.approx(mean, abs=error * spread)
    assert deviation == pytest.approx(spread, rel=2 * error)


def test_a_short_chain_reports_nothing_unless_told_to(result: Fit, tmp_path: Path) -> None:
    short = sample(result, walkers=16, seed=1, max_steps=100, path=tmp_path / "chain.h5")
    assert not short.converged
    with pytest.raises(ValueError, match=r"chain of 100 steps is too short.*autocorrelation time.*larger max_steps"):
        short.summary()
    with pytest.raises(ValueError, match="too short"):
        _ = short.inference_data
    told = load(result, tmp_path / "chain.h5", allow_unconverged=True)
    assert set(told.summary()) == set(short.names)


def test_a_longer_limit_goes_on_to_the_same_end(result: Fit, posterior, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    sample(result, walkers=16, seed=1, max_steps=150, path=path)
    whole = sample(result, walkers=16, seed=1, path=path)
    np.testing.assert_array_equal(whole.chain, posterior.chain)
    assert whole.summary() == posterior.summary()
    backend = emcee.backends.HDFBackend(path, read_only=True)
    assert backend.iteration == len(whole.chain)
    np.testing.assert_array_equal(backend.get_log_prob(), whole.log_probability)
    assert not path.with_suffix(".journal").exists()


def test_a_torn_journal_costs_one_step(result: Fit, posterior, tmp_path: Path) -> None:
    """The last record cut off and another one damaged: what comes before them is kept."""

    class Stop(Exception):
        pass

    path = tmp_path / "chain.h5"

    def stop(stage, done, total, info):
        raise Stop

    with pytest.raises(Stop):
        sample(result, walkers=16, seed=1, path=path, progress=stop)
    chain = FileChain(path, 16, 2, identity_of(result.problem, 16, 1))
    Ensemble(result, chain, 1).sampler().run_mcmc(chain.get_last_sample(), 7, skip_initial_state_check=True)
    chain.close()
    journal = path.with_suffix(".journal")
    whole = journal.read_bytes()
    journal.write_bytes(whole[:-5])
    torn = load(result, path)
    assert len(torn.chain) == 106
    np.testing.assert_array_equal(torn.chain, posterior.chain[:106])
    journal.write_bytes(whole[: len(whole) // 2] + b"\x00" + whole[len(whole) // 2 + 1 :])
    assert len(load(result, path).chain) == 103
    assert sample(result, walkers=16, seed=1, path=path).summary() == posterior.summary()


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


def test_killed_at_any_moment_it_ends_with_the_same_summary(result: Fit, posterior, tmp_path: Path) -> None:
    path, saved = tmp_path / "chain.h5", tmp_path / "chain.npy"
    root = ROOT
    command = [sys.executable, "-c", SCRIPT, str(path), str(saved)]
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    environment = {**os.environ, "PYTHONPATH": str(root), **cache}
    generator = np.random.default_rng(0)
    kills, kept = 0, 0
    while not saved.exists():
        with subprocess.Popen(command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == "ready"
            if kills == 3:
                assert process.wait() == 0
                break
            while process.poll() is None and _stored_steps(path) <= kept:
                time.sleep(0.001)
            time.sleep(generator.uniform(0.0, 0.1))
            process.send_signal(signal.SIGKILL)
        kills, before, kept = kills + 1, kept, _stored_steps(path)
        assert kept > before
        np.testing.assert_array_equal(load(result, path).chain, posterior.chain[:kept])
    assert kills >= 2
    np.testing.assert_array_equal(np.load(saved), posterior.chain)
    assert load(result, path).summary() == posterior.summary()


def _stored_steps(path: Path) -> int:
    """Steps in the file and whole records in its journal, by arithmetic rather than by the code under test."""
    if not path.exists():
        return 0
    with h5py.File(path) as file:
        steps = int(file["mcmc"].attrs["iteration"])
    journal = path.with_suffix(".journal")
    record = 8 + 8 + 16 * 2 * 8 + 16 * 8 + 16 + 624 * 4 + 8 + 8 + 8 + 4
    content = journal.read_bytes() if journal.exists() else b""
    last = len(content) // record - 1
    return max(steps, int.from_bytes(content[last * record + 8 :][:8], "little")) if last >= 0 else steps


def test_a_chain_of_something_else_is_refused(result: Fit, tmp_path: Path) -> None:
    path = tmp_path / "chain.h5"
    sample(result, walkers=16, seed=1, max_steps=100, path=path)
    with pytest.raises(ValueError, match=r"another problem or setting \(posterior differs\)"):
        sample(line_fit(seed=5), walkers=16, seed=1, path=path)
    with pytest.raises(ValueError, match=r"\(seed differs\)"):
        sample(result, walkers=16, seed=2, path=path)
    with pytest.raises(ValueError, match=r"\(walkers differs\)"):
        sample(result, walkers=18, seed=1, path=path)
    fresh = sample(line_fit(seed=5), walkers=16, seed=2, path=path, resume=False, max_steps=100)
    assert len(fresh.chain) == 100
    path.write_bytes(b"not HDF5")
    with pytest.raises(ValueError, match="is not a chain of layerjax"):
        sample(result, walkers=16, seed=1, path=path)


@pytest.mark.parametrize(("one", "other"), [("chain_0.1", "chain_0.2"), ("chain", "chain.1")])
def test_chains_whose_names_differ_after_a_dot_have_nothing_in_common(one: str, other: str, tmp_path: Path) -> None:
    first, second = (FileChain(tmp_path / name, 4, 1, {}) for name in (one, other))
    assert {path.name for path in tmp_path.glob("*.journal")} == {f"{one}.journal", f"{other}.journal"}
    first.close()
    second.close()


def test_inference_data(result: Fit, posterior) -> None:
    data = posterior.inference_data
    assert set(data.groups()) == {"posterior", "log_likelihood", "posterior_predictive", "observed_data"}
    a, b = (data.posterior[name].to_numpy() for name in ("['a']", "['b']"))
    predicted = a[..., None, None] + b[..., None, None] * design(COUNT)[:, 1:]
    expected = stats.norm.logpdf(result.problem.data.values, predicted, 0.05)
    np.testing.assert_allclose(data.log_likelihood["value"], expected, rtol=1e-9)
    noise = (data.posterior_predictive["value"].to_numpy() - predicted) / 0.05
    assert noise.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * noise.size))
    np.testing.assert_array_equal(data.observed_data["value"], result.problem.data.values)
    assert data.log_likelihood["value"].dims == ("chain", "draw", "sample", "channel")


def test_free_student_noise_is_sampled() -> None:
    """A smoke test of the widest likelihood: the level's posterior agrees with its maximum-likelihood error."""
    noise = Noise(relative=0.0, floor=Free(0.1, 1e-3, 1.0), tails="student")
    fitted = fit(LINE, measured(line_data().values), transport=line, noise=noise, starts=4)
    summary = sample(fitted, walkers=16, seed=4).summary()
    for name, (median, *_, deviation) in summary.items():
        assert abs(median - fitted.values[name]) < fitted.standard_errors[name]
        assert deviation == pytest.approx(fitted.standard_errors[name], rel=0.3)  # asymptotic, for 100 data


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"walkers": 4}, "walkers is 4; it must be even and at least 6"),
        ({"walkers": 17}, "walkers is 17"),
        ({"ess": 0.0}, "ess is 0.0; it must be above 0"),
        ({"max_steps": 10}, "max_steps is 10; it must be at least 100"),
    ],
)
def test_refused(result: Fit, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sample(result, **options)


def test_there_are_enough_walkers_for_many_parameters() -> None:
    assert _walkers("emcee", None, 3) == 32
    assert _walkers("emcee", None, 20) == 42
    assert _walkers("nuts", None, 20) == 4


def test_a_named_objective_has_no_posterior() -> None:
    named = fit(LINE, line_data(), transport=line, objective="cosine_l2", starts=1)
    with pytest.raises(ValueError, match="'cosine_l2' is no likelihood, so there is no posterior"):
        sample(named)
