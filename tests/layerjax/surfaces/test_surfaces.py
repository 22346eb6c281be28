"""Surfaces alone: energy, published forms, and a conductor against a quadrature written for the test."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj

ANGLES = [0.0, 0.4, 1.0, 1.4, 1.55]


def hemisphere_integral(function, nodes=400):
    """Integral of f(theta, phi) cos over the upper hemisphere by a product rule in numpy."""
    s, w = np.polynomial.legendre.leggauss(nodes)
    theta, w = 0.25 * np.pi * (s + 1.0), 0.25 * np.pi * w
    phi = 2 * np.pi * (np.arange(2 * nodes) + 0.5) / (2 * nodes)
    values = function(theta[:, None], phi[None, :])
    return np.sum(values * (np.sin(theta) * np.cos(theta) * w)[:, None]) * np.pi / nodes


def alone(surface):
    return lj.Stack([], base=surface)


def test_lambertian():
    stack = alone(lj.Lambertian([0.2, 0.5]))
    value = lj.evaluate(stack, lj.direction(0.3, 0.0), lj.direction(1.0, 1.0))
    np.testing.assert_allclose(value, np.array([0.2, 0.5]) / np.pi, rtol=1e-15)
    np.testing.assert_allclose(lj.albedo(stack, lj.direction(1.2, 0.0))[0], [0.2, 0.5], rtol=1e-10)


@pytest.mark.parametrize("roughness", [0.0, 1e-9, 0.3, 1.0])
@pytest.mark.parametrize("theta", ANGLES)
def test_energy_preserving_oren_nayar_keeps_all_energy_when_white(theta, roughness):
    reflected, _ = lj.albedo(alone(lj.OrenNayar(1.0, roughness)), lj.direction(theta, 0.7))
    np.testing.assert_allclose(reflected, 1.0, rtol=2e-7)


def test_oren_nayar_of_no_roughness_is_lambertian():
    for form in ("energy_preserving", "classic"):
        value = lj.evaluate(alone(lj.OrenNayar(0.6, 0.0, form)), lj.direction(1.3, 0.0), lj.direction(0.9, 2.0))
        np.testing.assert_allclose(value, 0.6 / np.pi, rtol=1e-14)


def test_classic_oren_nayar_against_its_published_angular_form():
    # Oren & Nayar 1994, Eq. 30: A + B max(0, cos dphi) sin(max) tan(min)
    sigma, albedo = 0.5, 0.7
    a, b = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33), 0.45 * sigma**2 / (sigma**2 + 0.09)
    stack = alone(lj.OrenNayar(albedo, sigma, form="classic"))
    for theta_i, theta_o, dphi in ((0.3, 1.2, 0.4), (1.4, 0.5, 3.0), (0.8, 0.8, 1.0)):
        low, high = min(theta_i, theta_o), max(theta_i, theta_o)
        expected = albedo / np.pi * (a + b * max(0.0, np.cos(dphi)) * np.sin(high) * np.tan(low))
        value = lj.evaluate(stack, lj.direction(theta_i, 0.2), lj.direction(theta_o, 0.2 + dphi))
        np.testing.assert_allclose(value[0], expected, rtol=1e-12)


def test_energy_preserving_oren_nayar_single_bounce_is_fujii():
    # for a black surface the multiple-bounce term vanishes faster: f / albedo -> A (1 + r s/t) / pi
    r, albedo = 0.8, 1e-6
    a = 1 / (1 + (0.5 - 2 / (3 * np.pi)) * r)
    wi, wo = np.asarray(lj.direction(0.9, 0.0)), np.asarray(lj.direction(0.5, 0.3))
    s = wi @ wo - wi[2] * wo[2]
    value = lj.evaluate(alone(lj.OrenNayar(albedo, r)), wi, wo)[0] / albedo
    np.testing.assert_allclose(value, a * (1 + r * s / max(wi[2], wo[2])) / np.pi, rtol=2e-6)


def walter(theta_i, theta_o, dphi, alpha, index):
    """A rough conductor in the angular form of Walter et al. 2007, Eqs. 20, 33 and 34, in numpy."""
    wi = np.array([np.sin(theta_i), 0.0 * theta_i, np.cos(theta_i)])
    wo = np.stack(np.broadcast_arrays(np.sin(theta_o) * np.cos(dphi), np.sin(theta_o) * np.sin(dphi), np.cos(theta_o)))
    h = wo + wi.reshape(3, *[1] * (wo.ndim - 1))
    h = h / np.linalg.norm(h, axis=0)
    tan2 = 1 / h[2] ** 2 - 1
    d = alpha**2 / (np.pi * h[2] ** 4 * (alpha**2 + tan2) ** 2)

    def g1(cosine):
        return 2 / (1 + np.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)))

    c = np.tensordot(wi, h, 1)
    root = np.sqrt(index**2 - (1 - c**2) + 0j)
    fresnel = 0.5 * (np.abs((c - root) / (c + root)) ** 2 + np.abs((index**2 * c - root) / (index**2 * c + root)) ** 2)
    return fresnel * d * g1(wi[2]) * g1(wo[2]) / (4 * wi[2] * wo[2])


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_conductor_values_against_walter(alpha):
    stack = alone(lj.Conductor([0.2, 1.1], [3.9, 2.5], alpha))
    for theta_i, theta_o, dphi in ((0.3, 0.5, 3.0), (1.2, 1.1, 3.1), (0.9, 0.2, 0.4)):
        value = lj.evaluate(stack, lj.direction(theta_i, 0.0), lj.direction(theta_o, dphi))
        expected = [walter(theta_i, theta_o, dphi, alpha, n) for n in (0.2 + 3.9j, 1.1 + 2.5j)]
        np.testing.assert_allclose(value, expected, rtol=1e-10)


@pytest.mark.parametrize("alpha", [0.2, 0.7])
@pytest.mark.parametrize("theta", [0.2, 1.2])
def test_conductor_albedo_against_a_product_rule(alpha, theta):
    expected = hemisphere_integral(lambda t, p: walter(theta, t, p, alpha, 0.9 + 2.5j))
    reflected, transmitted = lj.albedo(alone(lj.Conductor(0.9, 2.5, alpha)), lj.direction(theta, 0.0))
    np.testing.assert_allclose(reflected[0], expected, rtol=2e-6)
    assert transmitted[0] == 0.0


def test_surfaces_reflect_nothing_from_or_to_below():
    up, down = lj.direction(0.4, 0.0), lj.direction(2.4, 1.0)
    for surface in (lj.Lambertian(0.5), lj.OrenNayar(0.5, 0.5), lj.Conductor(0.2, 3.0, 0.3)):
        for wi, wo in ((up, down), (down, up), (down, down)):
            assert lj.evaluate(alone(surface), wi, wo)[0] == 0.0
        _, density, weight = lj.sample(alone(surface), down, jax.random.key(0))
        assert density == 0.0
        assert weight[0] == 0.0


def test_a_mirror_like_conductor_reflects_its_fresnel_share():
    reflected, _ = lj.albedo(alone(lj.Conductor(0.2, 3.9, 1e-4)), lj.direction(0.9, 0.3))
    index, c = 0.2 + 3.9j, np.cos(0.9)
    root = np.sqrt(index**2 - (1 - c**2))
    expected = 0.5 * (np.abs((c - root) / (c + root)) ** 2 + np.abs((index**2 * c - root) / (index**2 * c + root)) ** 2)
    np.testing.assert_allclose(reflected[0], expected, rtol=2e-5)  # rough by 1e-4, and the quadrature's 5e-6
    assert jnp.isfinite(reflected).all()
