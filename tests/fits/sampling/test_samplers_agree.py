"""emcee by itself, delayed acceptance and NUTS sample one posterior: quantiles within a tenth of a deviation."""

import numpy as np
import pytest
from scipy import special, stats

from fits.optimise.fit import fit
from fits.optimise.result import Fit
from fits.problem.noise import Noise
from fits.problem.parameters import Free
from fits.sampling.delayed_acceptance import DelayedAcceptance
from fits.sampling.mixture import Mixture
from fits.sampling.posterior import Posterior
from fits.sampling.sample import sample
from fits.sampling.surrogate import Evaluated, evaluate
from fits.sampling.surrogate import fitted as with_polynomial
from tests.helpers.models import COUNT, LINE, LOBE_STACK, design, line, line_data, lobe, measured, noisy_lobe

SAMPLERS = {"delayed acceptance": {"surrogate": True}, "NUTS": {"sampler": "nuts"}}
QUANTILES = [0.158655, 0.5, 0.841345]
LEAST = 6000  # effective samples: a quantile is known to 0.04 of the deviation at worst


def coated() -> Fit:
    """Six parameters, a GGX coat among them."""
    return fit(LOBE_STACK, noisy_lobe(0, 140), transport=lobe, starts=2)


def on_a_bound() -> Fit:
    """A line whose slope is best below its lower bound."""
    return fit({"a": Free(0.9, -1.0, 3.0), "b": Free(2.0, 0.52, 3.0)}, line_data(), transport=line, starts=2)


def with_a_free_level() -> Fit:
    """A line, the level of its noise, and tails of Student's."""
    noise = Noise(relative=0.0, floor=Free(0.1, 1e-3, 1.0), tails="student")
    return fit(LINE, measured(line_data().values), transport=line, noise=noise, starts=4)


MADE = [pytest.param(made, marks=pytest.mark.slow) for made in (coated, on_a_bound, with_a_free_level)]


@pytest.fixture(scope="module", params=MADE, ids=lambda made: made.__name__)
def plain(request: pytest.FixtureRequest) -> Posterior:
    fitted = request.param()
    assert bool(fitted.at_bound) == (request.param is on_a_bound)
    return sample(fitted, seed=1, ess=LEAST, surrogate=False)


@pytest.mark.parametrize("name", SAMPLERS)
def test_quantiles_are_those_of_emcee_by_itself(plain: Posterior, name: str) -> None:
    if name == "NUTS":
        pytest.importorskip("blackjax")
    posterior = sample(plain.fit, seed=1, ess=LEAST, **SAMPLERS[name])
    kept = [chain.chain[chain.burn_in :].reshape(-1, len(chain.names)) for chain in (posterior, plain)]
    assert min(chain.effective_samples.min() for chain in (posterior, plain)) > LEAST - 1000
    first, second = (np.quantile(samples, QUANTILES, axis=0) for samples in kept)
    assert np.max(np.abs(first - second) / kept[1].std(axis=0)) < 0.1
    if name == "delayed acceptance":
        assert posterior.status.startswith("proposals from a surrogate of degree")
        an_evaluation = [chain.effective_samples.min() / chain.chain[..., 0].size for chain in (posterior, plain)]
        assert an_evaluation[0] > 1.2 * an_evaluation[1]


@pytest.mark.parametrize("name", SAMPLERS)
def test_one_parameter(name: str) -> None:
    """The slope of a line through a known point: mean and deviation in closed form."""
    if name == "NUTS":
        pytest.importorskip("blackjax")
    fitted = fit({"a": 1.0, "b": Free(0.1, -1.0, 3.0)}, line_data(), transport=line, starts=2)
    x = design(COUNT)[:, 1]
    posterior = sample(fitted, seed=2, **SAMPLERS[name])
    mean, spread = x @ (line_data().values[:, 0] - 1.0) / (x @ x), 0.05 / np.sqrt(x @ x)
    _, _, _, average, deviation = posterior.summary()["['b']"]
    error = 5 / np.sqrt(posterior.effective_samples.min())
    assert average == pytest.approx(mean, abs=error * spread)
    assert deviation == pytest.approx(spread, rel=error)


@pytest.mark.parametrize("name", [pytest.param("delayed acceptance", marks=pytest.mark.slow), "NUTS"])
def test_a_direction_that_is_open_fills_its_box(name: str) -> None:
    if name == "NUTS":
        pytest.importorskip("blackjax")
    fitted = fit({**LINE, "c": Free(0.5, 0.0, 1.0)}, line_data(), transport=line, starts=2)
    posterior = sample(fitted, seed=3, **SAMPLERS[name])
    kept = posterior.chain[posterior.burn_in :, :, posterior.names.index("['c']")]
    error = 5 / np.sqrt(posterior.effective_samples.min())
    assert kept.mean() == pytest.approx(0.5, abs=error * np.sqrt(1 / 12))
    assert kept.std() == pytest.approx(np.sqrt(1 / 12), rel=error)


def product(stack, wi, wo):
    """Data that know a product of two parameters alone."""
    return stack["a"] * stack["b"] * (1.0 + 0.0 * wo[:, :1])


def test_walks_of_a_surrogate_follow_a_thin_curved_ridge() -> None:
    """Hundreds of times as long as it is wide: walks move along it, and leave the posterior as it is, whose
    marginal is known by sums over a grid."""
    data = measured(np.full((COUNT, 1), 0.5), 0.01)
    fitted = fit({"a": Free(0.7, 0.3, 1.5), "b": Free(0.7, 0.3, 1.5)}, data, transport=product, starts=2)
    a, b = np.linspace(0.334, 1.499, 2001), np.linspace(0.3, 1.5, 4001)
    density = np.exp(-0.5 * COUNT * ((a[:, None] * b - 0.5) / 0.01) ** 2).sum(axis=1)
    cumulated = np.cumsum(density) / density.sum()
    generator = np.random.RandomState(0)
    along = np.interp(generator.uniform(size=512), cumulated, a)
    vectors = np.stack([along, (0.5 + 0.001 * generator.standard_normal(512)) / along], axis=-1)
    positions = special.logit((np.clip(vectors, 0.3001, 1.4999) - 0.3) / 1.2)
    exact = fitted.problem.call(evaluate, positions)
    model = with_polynomial(fitted.problem.model, 2, Evaluated(positions, *(np.asarray(part) for part in exact)))
    root = np.linalg.cholesky(np.cov(positions.T))
    mixture = Mixture.through(positions, generator)
    ends, _, _ = DelayedAcceptance(model, root, mixture).walk(positions, generator)
    after = 0.3 + 1.2 * special.expit(ends[:, 0])
    assert abs(np.corrcoef(along, after)[0, 1]) < 0.9
    assert stats.kstest(np.interp(after, a, cumulated), "uniform").pvalue > 1e-3
