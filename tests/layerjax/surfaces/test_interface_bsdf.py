"""The rough dielectric interface: energy against sampled facets, reciprocity, and finite values over the box."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import split
from layerjax.surfaces.interface import interface_pdf, interface_reflection, interface_sample, interface_transmission
from tests.helpers.interfaces import integrated_energies, pairs

DRAWS = 400_000
ALPHAS = 10.0 ** np.array([-4, -2.5, -1, 0])


def sampled_energies(wi, ior, alpha, seed):
    """Reflected and transmitted energy, with standard errors, from facets drawn by slope (Walter 2007, Eq. 35, 41)."""
    random = np.random.default_rng(seed)
    u1, phi = random.random(DRAWS), 2 * np.pi * random.random(DRAWS)
    tangent = alpha * np.sqrt(u1 / (1 - u1))
    mz = 1 / np.sqrt(1 + tangent**2)
    m = np.stack([mz * tangent * np.cos(phi), mz * tangent * np.sin(phi), mz], axis=-1)
    cosine = m @ wi
    facing = cosine > 0
    cosine = np.where(facing, cosine, 0.5)

    def masking(z):
        return 2 / (1 + np.sqrt(1 + alpha**2 * (1 - z**2) / z**2))

    root = 1 - (1 - cosine**2) / ior**2
    transmits = root > 0
    refracted = np.sqrt(np.maximum(root, 0))
    s = (cosine - ior * refracted) / (cosine + ior * refracted)
    p = (ior * cosine - refracted) / (ior * cosine + refracted)
    fresnel = np.where(transmits, 0.5 * (s**2 + p**2), 1.0)
    weight = facing * cosine * masking(wi[2]) / (wi[2] * mz)
    up = (2 * cosine[:, None] * m - wi)[:, 2]
    down = ((cosine / ior - refracted)[:, None] * m - wi / ior)[:, 2]
    reflected = np.where(up > 0, weight * fresnel * masking(np.where(up > 0, up, 0.5)), 0)
    passed = np.where(down < 0, weight * (1 - fresnel) * masking(np.where(down < 0, down, 0.5)), 0)
    return [(np.mean(x), np.std(x) / np.sqrt(DRAWS)) for x in (reflected, passed)]


@pytest.mark.parametrize("ior", [1.5, 1 / 1.5, 4.0, 0.25, 1.1])
def test_energies(ior):
    for theta, alpha in itertools.product((0.0, 0.6, 1.2), (0.3, 0.8)):
        wi = lj.direction(theta, 0.4)
        found = integrated_energies(wi, jnp.asarray(ior), jnp.asarray(alpha))
        for value, (mean, error) in zip(found, sampled_energies(np.asarray(wi), ior, alpha, 5), strict=True):
            assert abs(value - mean) < 4 * error + 2e-4


def test_reciprocity():
    wi, wo, ior, alpha = pairs(np.random.default_rng(3), 20_000, ALPHAS)
    forth, back = interface_reflection(wi, wo, ior, alpha), interface_reflection(wo, wi, ior, alpha)
    np.testing.assert_allclose(forth, back, rtol=1e-12)
    below = (wo[0], wo[1], -wo[2])
    turned = (wi[0], wi[1], -wi[2])
    keep = np.abs(ior - 1) > 1e-3  # nearer to 1 the rounding of 1 / ior itself moves the lobe
    forth = interface_transmission(wi, below, ior, alpha) / ior
    back = interface_transmission(wo, turned, 1 / ior, alpha) * ior
    rtol = 1e-14 / (np.abs(ior - 1) + 1e-3) / alpha**2 + 1e-9
    np.testing.assert_array_less((np.abs(forth - back) - rtol * forth)[keep], 1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_and_gradients_are_finite(dtype):
    wi, wo, ior, alpha = pairs(np.random.default_rng(8), 20_000, ALPHAS, dtype)
    below = (wo[0], wo[1], -wo[2])
    for function, towards in ((interface_reflection, wo), (interface_transmission, below)):
        one = jax.value_and_grad(function, argnums=(0, 1, 2, 3))
        for leaf in jax.tree.leaves(jax.jit(jax.vmap(one))(wi, towards, ior, alpha)):
            assert np.isfinite(leaf).all()
        assert (function(wi, towards, ior, alpha) >= 0).all()


def test_an_interface_that_is_not_there():
    wi, wo, _, alpha = pairs(np.random.default_rng(2), 1000, ALPHAS)
    one = jnp.ones(1000)
    assert not interface_reflection(wi, wo, one, alpha).any()
    assert not interface_transmission(wi, (wo[0], wo[1], -wo[2]), one, alpha).any()


@pytest.mark.parametrize("ior", [1.5, 1 / 1.5])
def test_samples_follow_their_density(ior):
    alpha = jnp.asarray(0.5)
    wi = split(jnp.broadcast_to(lj.direction(0.9, 0.3), (DRAWS, 3)))
    u = jax.random.uniform(jax.random.key(2), (3, DRAWS))
    wo, leaves = interface_sample(wi, jnp.asarray(ior), alpha, *u)
    above = wo[2] > 0
    upper = (wo[0], wo[1], jnp.where(above, wo[2], 0.5))
    lower = (wo[0], wo[1], jnp.where(above, -0.5, wo[2]))
    f = jnp.where(
        above, interface_reflection(wi, upper, ior, alpha), interface_transmission(wi, lower, jnp.asarray(ior), alpha)
    )
    density = interface_pdf(f, wi, wo, jnp.asarray(ior), alpha)
    weight = jnp.where(leaves & (density > 0), f * jnp.abs(wo[2]) / jnp.where(density > 0, density, 1.0), 0.0)
    expected = integrated_energies(lj.direction(0.9, 0.3), jnp.asarray(ior), alpha)
    for side, value in zip((above, ~above), expected, strict=True):
        x = jnp.where(side, weight, 0.0)
        assert abs(x.mean() - value) < 4.5 * x.std() / np.sqrt(DRAWS) + 1e-4
