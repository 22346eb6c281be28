"""emcee and NUTS sample one posterior: quantiles within a tenth of a deviation."""

import numpy as np
import pytest

from fits import Fit, Free, Posterior, fit, sample
from fits.sampling.sample import Sampler
from tests.helpers.models import COUNT, LOBE_STACK, design, line, line_data, lobe, noisy_lobe, student_fit

pytest.importorskip("blackjax")

QUANTILES = [0.158655, 0.5, 0.841345]
LEAST = 6000  # effective samples: a quantile is known to 0.04 of the deviation at worst


def coated() -> Fit:
    """Six parameters, a GGX coat among them."""
    return fit(LOBE_STACK, noisy_lobe(0, 140), transport=lobe, starts=2)


def on_a_bound() -> Fit:
    """A line whose slope is best below its lower bound."""
    return fit({"a": Free(0.9, -1.0, 3.0), "b": Free(2.0, 0.52, 3.0)}, line_data(), transport=line, starts=2)


MADE = [pytest.param(made, marks=pytest.mark.slow) for made in (coated, on_a_bound, student_fit)]


@pytest.fixture(scope="module", params=MADE, ids=lambda made: made.__name__)
def plain(request: pytest.FixtureRequest) -> Posterior:
    fitted = request.param()
    assert bool(fitted.at_bound) == (request.param is on_a_bound)
    return sample(fitted, seed=1, ess=LEAST)


def test_quantiles_of_nuts_are_those_of_emcee(plain: Posterior) -> None:
    posterior = sample(plain.fit, sampler="nuts", seed=1, ess=LEAST)
    kept = [chain.chain[chain.burn_in :].reshape(-1, len(chain.names)) for chain in (posterior, plain)]
    assert min(chain.effective_samples.min() for chain in (posterior, plain)) > LEAST - 1000
    first, second = (np.quantile(samples, QUANTILES, axis=0) for samples in kept)
    assert np.max(np.abs(first - second) / kept[1].std(axis=0)) < 0.1


@pytest.mark.parametrize("sampler", ["emcee", pytest.param("nuts", marks=pytest.mark.slow)])
def test_one_parameter(sampler: Sampler) -> None:
    fitted = fit({"a": 1.0, "b": Free(0.1, -1.0, 3.0)}, line_data(), transport=line, starts=2)
    x = design(COUNT)[:, 1]
    posterior = sample(fitted, sampler=sampler, seed=2)
    mean, spread = x @ (line_data().values[:, 0] - 1.0) / (x @ x), 0.05 / np.sqrt(x @ x)
    _, _, _, average, deviation = posterior.summary()["['b']"]
    error = 5 / np.sqrt(posterior.effective_samples.min())
    assert average == pytest.approx(mean, abs=error * spread)
    assert deviation == pytest.approx(spread, rel=error)
