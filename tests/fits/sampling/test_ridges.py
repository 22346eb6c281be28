"""Posteriors along a ridge, of which the data know a product: marginals by integration, and mixtures that follow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import layerjax as lj
from fits import Free, LogUniform, fit, sample
from fits.sampling import importance
from fits.sampling.importance import components_at, importance_draws
from tests.helpers.models import directions, measured

COUNT, SIGMA, LEVEL = 40, 0.005, 0.5
SCALE = Free(1.0, 0.1, 10.0, LogUniform())
ALBEDO = Free(0.5, 0.0, 1.0)
PAINT = lj.Stack([], lj.Lambertian(ALBEDO))
HAZE = lj.Stack([lj.Medium(Free(0.2, 0.0, 2.0), 0.8)], lj.Lambertian(ALBEDO))


def paint(seed):
    noise = np.random.default_rng(seed).standard_normal((COUNT, 1))
    return measured(LEVEL / np.pi * (1.0 + 0.01 * noise), SIGMA)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_haze_and_albedo_times_scale(seed):
    """By integration over thickness and albedo, with the scale integrated as the Gaussian that it nearly is."""
    fitted = fit(HAZE, paint(seed), scale=SCALE, transport=lj.SingleScattering(), starts=8, seed=seed)
    posterior = sample(fitted, seed=seed, max_steps=5000)
    assert posterior.converged
    thickness, albedo = 0.08 * (np.arange(400) + 0.5) / 400, (np.arange(200) + 0.5) / 200
    wi, wo, values = directions(COUNT, 1), directions(COUNT, 2), paint(seed).values[:, 0]

    @jax.jit
    def model(t, a):
        return lj.evaluate(lj.Stack([lj.Medium(t, 0.8)], lj.Lambertian(a)), wi, wo, lj.SingleScattering())[:, 0]

    f = np.asarray(jax.vmap(lambda t: jax.vmap(lambda a: model(t, a))(jnp.asarray(albedo)))(jnp.asarray(thickness)))
    square, product = np.sum(f * f, axis=-1), f @ values
    scale = product / square
    ends = np.array([0.1, 10.0])[:, None, None]
    within = np.diff(stats.norm.cdf((ends - scale) * np.sqrt(square) / SIGMA), axis=0)[0]
    misfit = np.sum((values - scale[..., None] * f) ** 2, axis=-1) / SIGMA**2
    density = np.exp(-0.5 * (misfit - misfit.min())) / (scale * np.sqrt(square)) * within
    shares, error = [0.1, 0.3, 0.5, 0.7, 0.9], 1.0 / np.sqrt(posterior.effective_samples.min())
    for axis, name, grid in ((0, "base.albedo", albedo), (1, "layers[0].thickness", thickness)):
        below = np.cumsum(density.sum(axis=axis))
        levels = np.interp(shares, below / below[-1], grid + 0.5 * (grid[1] - grid[0]))
        values = posterior.chain[posterior.burn_in :, :, posterior.names.index(name)].ravel()
        # the product is known to half a per cent
        np.testing.assert_allclose(np.mean(values[:, None] < levels, axis=0), shares, atol=2.0 * error + 0.005)


def test_a_mixture_grows_from_any_draws() -> None:
    """From two draws, and where the information has no finite values: the spread of the draws takes its place."""
    fitted = fit(PAINT, paint(0), scale=SCALE, transport=lj.SingleScattering(), starts=2)
    draws = importance_draws(fitted, 2, np.random.RandomState(0))
    assert draws.effective_sample_size > 300
    where = draws.mixture.centre[-3:]
    assert np.isfinite(components_at(fitted.problem, where, np.zeros((2, 2))).log_density(where)).all()
    with pytest.MonkeyPatch.context() as patch:
        rows = np.full((COUNT, 2), np.nan)
        patch.setattr(importance, "local_information", lambda problem, unit: (rows, np.full(2, np.inf), 0.0))
        blind = components_at(fitted.problem, where, np.diag([1.0, 4.0]))
    assert np.isfinite(blind.log_density(where)).all()
    assert np.all(blind.root @ np.swapaxes(blind.root, 1, 2) <= 4.0 * np.diag([1.0, 4.0]) + 1e-12)
