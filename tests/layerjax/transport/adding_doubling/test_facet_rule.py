"""Quadrature of visible facets about a direction, against a fine rule about the normal of the surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from layerjax.transport.adding_doubling.facet_light import Normals, facet_energies
from layerjax.transport.adding_doubling.grid import Region


def slow(value):
    return pytest.param(value, marks=pytest.mark.slow)


COSINES = np.array([0.02, 0.15, 0.4, 0.6, 0.745, 0.9, 1.0])


@jax.jit
def energies(cosine, ratio, alpha):
    sine = jnp.sqrt((1.0 - cosine) * (1.0 + cosine))
    one = jnp.ones_like(cosine)
    near = Region(jnp.ones(()), cosine, sine, one, one, one > 0)
    far = Region(ratio, cosine, sine, one, one, one > 0)
    return jnp.stack(facet_energies(near, far, Normals(alpha, "ggx")))


def fresnel(c, n):
    squared = 1 - (1 - c * c) / n**2
    t = np.sqrt(np.where(squared > 0, squared, 1.0))
    s, p = (c - n * t) / (c + n * t), (n * c - t) / (n * c + t)
    return np.where(squared > 0, 0.5 * (s * s + p * p), 1.0), t, squared > 0


def masking(z, alpha):
    z = np.where(z > 0, z, 1.0)
    return 2 / (1 + np.sqrt(1 + alpha**2 * np.maximum(1 - z * z, 0) / z**2))


def walked(cosine, n, alpha, points=1500):
    """The same by midpoints in the slopes' distribution, 1 - v^2: no coordinates about the direction in it."""
    v, phi = ((np.arange(points) + 0.5) / points)[:, None], np.pi * (np.arange(points) + 0.5) / points
    tangent = alpha * np.sqrt((1 - v) * (1 + v)) / v
    z = 1 / np.sqrt(1 + tangent**2)
    sine = np.sqrt(1 - cosine**2)
    c = sine * z * tangent * np.cos(phi) + cosine * z
    # normals are drawn by D cos: what remains is <w, m> G1(w) / (cos cos_m)
    share = np.where(c > 0, c * masking(cosine, alpha) / (cosine * z), 0.0) * 2 * v / points**2
    level, t, passes = fresnel(np.maximum(c, 0), n)
    up = 2 * c * z - cosine
    down = cosine / n - (c / n - t) * z
    reflected = np.sum(share * level * np.where(up > 0, masking(up, alpha), 0.0))
    refracted = np.sum(share * (1 - level) * np.where(passes & (down > 0), masking(down, alpha), 0.0))
    return reflected, refracted, 1 - reflected - refracted


@pytest.mark.parametrize("alpha", [1e-4, slow(0.02), 0.1, slow(0.3), 1.0])
@pytest.mark.parametrize("ratio", [slow(0.25), 1 / 1.5, slow(1.0), 1.5, slow(4.0)])
def test_energies(ratio, alpha):
    """The rule is right to 4e-4, at grazing light (cosine 0.02) to 1e-3; midpoints of 1500 x 1500 to about 1e-4."""
    found = np.asarray(energies(COSINES, ratio, alpha)).T
    expected = np.array([walked(cosine, ratio, alpha) for cosine in COSINES])
    slack = np.where(COSINES < 0.1, 1e-3, 5e-4)
    np.testing.assert_array_less(np.max(np.abs(found - expected), axis=1), slack)


def test_derivatives_are_finite_and_those_of_the_values():
    slopes = jax.jit(jax.jacfwd(energies, (0, 1, 2)))
    for ratio in (0.25, 1.0 - 1e-7, 1.0, 1.5):
        for alpha in (1e-4, 0.3, 1.0):
            found = slopes(jnp.asarray([1e-6, *COSINES[:-1]]), ratio, alpha)
            assert all(np.isfinite(part).all() for part in found)
    step = 1e-5
    for ratio, alpha in ((1.5, 0.2), (0.7, 0.4)):
        _, by_ratio, by_alpha = slopes(COSINES[:-1], ratio, alpha)
        for found, ahead, back in (
            (by_alpha, (ratio, alpha + step), (ratio, alpha - step)),
            (by_ratio, (ratio + step, alpha), (ratio - step, alpha)),
        ):
            difference = (energies(COSINES[:-1], *ahead) - energies(COSINES[:-1], *back)) / (2 * step)
            np.testing.assert_allclose(found, difference, atol=1e-6)
