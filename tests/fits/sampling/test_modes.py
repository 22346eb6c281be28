"""Posteriors that no Gaussian describes: of two modes, known by sums over a grid, and along a ridge, by integration."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

import fits
import layerjax as lj
from fits import Free, LogUniform, Normal, Posterior, SamplerOptions, Uniform, fit, sample
from fits.reports import verdicts
from fits.reports.tables import parameter_table, posterior_table
from fits.sampling import importance
from fits.sampling.convergence import Convergence
from fits.sampling.importance import components_at, importance_draws
from fits.sampling.initial import initial_mixture
from fits.sampling.sample import load
from tests.helpers.models import COUNT, design, directions, measured

SIGMA, HIGH = 0.01, 3.0
COSINE = design(COUNT)[:, 1:]
EXACT = np.exp(-0.3 / COSINE) + np.exp(-1.5 / COSINE)
DATA = measured(EXACT + SIGMA * np.random.default_rng(0).standard_normal(EXACT.shape), SIGMA)
NARROW = 0.8  # of a normal prior on the first of two numbers, which makes one mode likelier
FEW, SPREAD, LEVEL = 40, 0.005, 0.5
SCALE = Free(1.0, 0.1, 10.0, LogUniform())
ALBEDO = Free(0.5, 0.0, 1.0)
PAINT = lj.Stack([], lj.Lambertian(ALBEDO))
HAZE = lj.Stack([lj.Medium(Free(0.2, 0.0, 2.0), 0.8)], lj.Lambertian(ALBEDO))


def pair(stack, wi, wo):
    """The same whichever of its two numbers is which."""
    return jnp.exp(-stack["p"] / wo[:, 2:]) + jnp.exp(-stack["q"] / wo[:, 2:])


def pair_fit(prior):
    return fit({"p": Free(0.5, 0.0, HIGH, prior), "q": Free(0.6, 0.0, HIGH)}, DATA, transport=pair, starts=8)


@pytest.fixture(scope="module", params=["alike", "with a prior"])
def fitted(request):
    return pair_fit(Uniform() if request.param == "alike" else Normal(0.3, NARROW))


@pytest.fixture(scope="module")
def summed(fitted):
    """By a fine grid: mean and deviation of p, the share of the mode where it is the larger, and the log-evidence."""
    x = np.linspace(0.0, HIGH, 3001)
    near = [x[np.abs(x - centre) < 0.1] for centre in (0.3, 1.5)]
    parts = []
    for p, q in (near, near[::-1]):
        f = np.exp(-p[:, None] / COSINE[:, 0])[:, None] + np.exp(-q[:, None] / COSINE[:, 0])[None]
        height = np.sum(stats.norm.logpdf(DATA.values[:, 0], f, SIGMA), axis=-1) - 2.0 * math.log(HIGH)
        if isinstance(fitted.problem.stack["p"].prior, Normal):
            whole = stats.norm(0.3, NARROW)
            height += (math.log(HIGH) + whole.logpdf(p) - math.log(whole.cdf(HIGH) - whole.cdf(0.0)))[:, None]
        parts.append((p, height))
    top = max(height.max() for _, height in parts)
    assert all(max(height[[0, -1]].max(), height[:, [0, -1]].max()) < height.max() - 12.0 for _, height in parts)
    weights = np.array([np.exp(height - top).sum(axis=1) for _, height in parts])
    p, total = np.array([p for p, _ in parts]), weights.sum()
    mean, square = (float(np.sum(weights * p**power) / total) for power in (1, 2))
    log_evidence = top + math.log(total * (x[1] - x[0]) ** 2)
    return mean, math.sqrt(square - mean**2), float(weights[1].sum() / total), log_evidence


def test_evidence_and_draws_by_weight_are_those_of_all_modes(fitted, summed):
    *_, share, log_evidence = summed
    found = fits.evidence(fitted)
    assert found.reliable
    assert found.log_evidence == pytest.approx(log_evidence, abs=4.0 * found.error)
    assert found.error < 0.05  # one mode alone of two alike is 0.69 off
    draws = importance_draws(fitted, 1000, np.random.RandomState(0)).resample(np.random.RandomState(1), 1000)
    larger = draws[:, 0] > special.logit(0.9 / HIGH)
    assert np.mean(larger) == pytest.approx(share, abs=4.0 * math.sqrt(share * (1.0 - share) / 500.0))


@pytest.mark.parametrize("sampler", ["emcee", pytest.param("nuts", marks=pytest.mark.slow)])
def test_chains_visit_all_modes_as_often_as_they_are_likely(fitted, summed, sampler, tmp_path):
    if sampler == "nuts":
        pytest.importorskip("blackjax")
    mean, deviation, share, _ = summed
    posterior = sample(fitted, sampler=sampler, seed=1, path=tmp_path / "chain")
    assert posterior.converged
    _, _, _, average, spread = posterior.summary()["['p']"]
    error = 4.0 / math.sqrt(posterior.effective_samples.min())
    assert average == pytest.approx(mean, abs=error * deviation)
    # a single mode has a deviation a hundred times smaller
    assert spread == pytest.approx(deviation, rel=error)
    shares = {round(mode.values["['p']"], 1): mode.share for mode in posterior.modes}
    assert shares == {1.5: pytest.approx(share, abs=error), 0.3: pytest.approx(1.0 - share, abs=error)}
    assert all(0.0 < mode.error < 0.5 * error for mode in posterior.modes)
    for words in (" ".join(verdicts.sampled(posterior)), posterior_table(posterior).note, repr(posterior)):
        assert "2 modes" in words
    assert load(fitted, tmp_path / "chain").modes == posterior.modes


def test_both_minima_are_reported_and_whose_errors_are_given(fitted):
    (other,) = fitted.alternatives
    apart = 1e-4 if isinstance(fitted.problem.stack["p"].prior, Uniform) else 0.05
    assert list(other.values.values()) == pytest.approx(list(fitted.values.values())[::-1], rel=apart)
    lines, _, sound = verdicts.verdict(fitted)
    assert not sound
    assert "standard errors are those of the best one only" in lines[1]
    assert parameter_table(fitted).note == "Errors are those of the best minimum only."
    assert "errors are conditional on this local minimum" in fitted.status


def test_minima_that_hold_next_to_nothing_are_no_modes():
    found = pair_fit(Normal(0.3, 0.25))  # the other is 11 lower in the log-posterior
    assert len(found.minima) >= 2
    assert initial_mixture(found, 8).mode_count == 1


def test_walkers_that_stay_where_they_are_have_not_converged():
    """Two modes, a walker in each or changing at every step: autocorrelation within walkers is no difference."""
    generator, options = np.random.default_rng(0), SamplerOptions()
    for stays in (True, False):
        which = np.arange(8) % 2 if stays else generator.integers(0, 2, (1000, 8))
        found = Convergence.of((which + 0.01 * generator.standard_normal((1000, 8)))[..., None], options)
        assert found.autocorrelation_time < 2.0
        assert (found.r_hat > 1.5) == stays
        assert (found.ess < 50.0) == stays
        assert found.is_finished(options) == (not stays)


def test_it_is_said_where_shares_of_modes_are_not_known(fitted):
    generator = np.random.default_rng(1)
    at = np.array([[0.3, 1.5], [1.5, 0.3]])[np.arange(8) % 2]
    values = at + 0.003 * generator.standard_normal((200, 8, 2))
    modes = tuple(fits.Mode(0.5, 0.18, dict(zip(fitted.problem.names, one, strict=True))) for one in at[:2])
    posterior = Posterior(fitted, values, np.zeros((200, 8)), np.ones(2), 0.5, False, modes=modes)
    words = " ".join(verdicts.sampled(posterior))
    assert "R-hat is above 1.01: the shares of the modes are uncertain" in words
    assert "R-hat of at most 1.01 are needed" in words
    with pytest.raises(ValueError, match=r"with R-hat of at most 1.01 \(it is [1-9]"):
        posterior.summary()


def paint(seed):
    noise = np.random.default_rng(seed).standard_normal((FEW, 1))
    return measured(LEVEL / np.pi * (1.0 + 0.01 * noise), SPREAD)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_haze_and_albedo_times_scale(seed):
    """By integration over thickness and albedo, with the scale integrated as the Gaussian that it nearly is."""
    fitted = fit(HAZE, paint(seed), scale=SCALE, transport=lj.SingleScattering(), starts=8, seed=seed)
    posterior = sample(fitted, seed=seed, max_steps=5000)
    assert posterior.converged
    thickness, albedo = 0.08 * (np.arange(400) + 0.5) / 400, (np.arange(200) + 0.5) / 200
    wi, wo, values = directions(FEW, 1), directions(FEW, 2), paint(seed).values[:, 0]

    @jax.jit
    def model(t, a):
        return lj.evaluate(lj.Stack([lj.Medium(t, 0.8)], lj.Lambertian(a)), wi, wo, lj.SingleScattering())[:, 0]

    f = np.asarray(jax.vmap(lambda t: jax.vmap(lambda a: model(t, a))(jnp.asarray(albedo)))(jnp.asarray(thickness)))
    square, product = np.sum(f * f, axis=-1), f @ values
    scale = product / square
    ends = np.array([0.1, 10.0])[:, None, None]
    within = np.diff(stats.norm.cdf((ends - scale) * np.sqrt(square) / SPREAD), axis=0)[0]
    misfit = np.sum((values - scale[..., None] * f) ** 2, axis=-1) / SPREAD**2
    density = np.exp(-0.5 * (misfit - misfit.min())) / (scale * np.sqrt(square)) * within
    shares, error = [0.1, 0.3, 0.5, 0.7, 0.9], 1.0 / np.sqrt(posterior.effective_samples.min())
    for axis, name, grid in ((0, "base.albedo", albedo), (1, "layers[0].thickness", thickness)):
        below = np.cumsum(density.sum(axis=axis))
        levels = np.interp(shares, below / below[-1], grid + 0.5 * (grid[1] - grid[0]))
        values = posterior.chain[posterior.burn_in :, :, posterior.names.index(name)].ravel()
        # the product is known to half a per cent
        np.testing.assert_allclose(np.mean(values[:, None] < levels, axis=0), shares, atol=2.0 * error + 0.005)


def test_a_mixture_grows_from_any_draws():
    """From two draws, and where the information has no finite values: the spread of the draws takes its place."""
    fitted = fit(PAINT, paint(0), scale=SCALE, transport=lj.SingleScattering(), starts=2)
    draws = importance_draws(fitted, 2, np.random.RandomState(0))
    assert draws.effective_sample_size > 300
    where = draws.mixture.centre[-3:]
    assert np.isfinite(components_at(fitted.problem, where, np.zeros((2, 2))).log_density(where)).all()
    with pytest.MonkeyPatch.context() as patch:
        rows = np.full((FEW, 2), np.nan)
        patch.setattr(importance, "local_information", lambda problem, unit: (rows, np.full(2, np.inf), 0.0))
        blind = components_at(fitted.problem, where, np.diag([1.0, 4.0]))
    assert np.isfinite(blind.log_density(where)).all()
    assert np.all(blind.root @ np.swapaxes(blind.root, 1, 2) <= 4.0 * np.diag([1.0, 4.0]) + 1e-12)
