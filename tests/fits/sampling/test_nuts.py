"""The No-U-Turn sampler: the same posterior as emcee's, from a few chains that follow the gradient."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fits import Fit, Posterior, fit, load_posterior, sample, save_fit
from fits.sampling.nuts import Nuts, _step
from fits.sampling.sample import load, walkers_of
from tests.helpers.models import LOBE_STACK, lobe, noisy_lobe, student_fit

pytest.importorskip("blackjax")

SHORT = {"sampler": "nuts", "seed": 1, "max_steps": 120}


@pytest.fixture(scope="module")
def short(result: Fit) -> Posterior:
    return sample(result, **SHORT)


def test_divergences_are_counted_and_told(result: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize("stage", ["warm-up", "sample"])
def test_it_goes_on_from_its_file_to_the_same_end(result: Fit, short: Posterior, tmp_path: Path, stage: str) -> None:
    path = tmp_path / "chain"

    def stop(at: str, *_: object) -> None:
        if at == stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample(result, **SHORT, path=path, progress=stop)
    whole = sample(result, **SHORT, path=path)
    np.testing.assert_array_equal(whole.chain, short.chain)
    assert (whole.chain.shape, whole.divergences) == ((120, 4, 2), 0)
    assert 0.5 < whole.acceptance <= 1.0
    assert load(result, path).status == short.status == "NUTS, 0 divergences in 480 steps after the warm-up"
    assert [entry.name for entry in tmp_path.iterdir()] == ["chain"]
    with pytest.raises(ValueError, match=r"another problem \(sampler nuts, not emcee"):
        sample(result, walkers=6, seed=1, path=path)


def test_chains_and_extra_are_there(result: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (walkers_of(20, "nuts", None), walkers_of(20, "emcee", None)) == (4, 42)
    with pytest.raises(ValueError, match="walkers is 1; it must be at least 2"):
        sample(result, sampler="nuts", walkers=1)
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(ValueError, match=r'^sampler="nuts" needs blackjax: pip install "layerjax\[nuts\]"$'):
        sample(result, sampler="nuts")


def coated() -> Fit:
    """Six parameters, a GGX coat among them."""
    return fit(LOBE_STACK, noisy_lobe(0, 140), transport=lobe, starts=2)


@pytest.mark.slow
@pytest.mark.parametrize("made", [coated, student_fit])
def test_quantiles_are_those_of_emcee(made: Callable[[], Fit]) -> None:
    """Within a tenth of a deviation: by 6,000 effective samples a quantile is known to 0.04 of it at worst."""
    fitted, kept = made(), []
    for sampler in ("nuts", "emcee"):
        posterior = sample(fitted, sampler=sampler, seed=1, ess=6000)
        assert posterior.effective_samples.min() > 5000
        kept.append(posterior.chain[posterior.burn_in :].reshape(-1, len(posterior.names)))
    first, second = (np.quantile(samples, [0.158655, 0.5, 0.841345], axis=0) for samples in kept)
    assert np.max(np.abs(first - second) / kept[1].std(axis=0)) < 0.1


@pytest.mark.slow
def test_the_command_samples_with_it(work: Path, coat_fit: Fit, layerjax: Callable) -> None:
    save_fit(coat_fit, "result")
    shown = layerjax("sample result --sampler nuts --max-steps 100 --allow-unconverged", 1)
    assert "The sampler: NUTS, 0 divergences in 400 steps" in shown.out
    assert "layerjax: warm-up 300/300" in shown.err
    layerjax("sample result --max-steps 200 --allow-unconverged", 1)  # the chain's own sampler
    posterior = load_posterior("result")
    assert posterior is not None
    assert posterior.chain.shape[:2] == (200, 4)
    assert "(sampler nuts, not emcee, walkers 4, not 20)" in layerjax("sample result --sampler emcee", 2).err
