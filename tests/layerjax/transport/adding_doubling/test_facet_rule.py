"""Quadrature of visible facets about a direction, against a fine rule about the normal of the surface."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from layerjax.transport.adding_doubling.facet_scattering import ENERGY_POINTS, Normals, facet_energies, refracted_rays
from layerjax.transport.adding_doubling.grid import Region


def slow(value):
    return pytest.param(value, marks=pytest.mark.slow)


COSINES = np.array([0.02, 0.15, 0.4, 0.6, 0.745, 0.9, 1.0])
SLOPED = COSINES[:-1]


@partial(jax.jit, static_argnames=("distribution", "points"))
def energies(cosine, ratio, alpha, distribution="ggx", points=ENERGY_POINTS):
    sine = jnp.sqrt((1.0 - cosine) * (1.0 + cosine))
    one = jnp.ones_like(cosine)
    near = Region(jnp.ones((), cosine.dtype), cosine, sine, one, one, one > 0)
    far = Region(ratio, cosine, sine, one, one, one > 0)
    normals = Normals(alpha, distribution)
    if points == ENERGY_POINTS:
        return jnp.stack(facet_energies(near, far, normals))
    _, passed = refracted_rays(near, ratio, normals, points)
    return jnp.sum(passed, axis=-1)


@partial(jax.jit, static_argnames="points")
def vmf_slopes(cosine, ratio, alpha, points=ENERGY_POINTS):
    return jax.jacfwd(lambda *given: energies(cosine, *given, "vmf", points), (0, 1))(ratio, alpha)


def fresnel(c, n):
    squared = 1 - (1 - c * c) / n**2
    t = np.sqrt(np.where(squared > 0, squared, 1.0))
    s, p = (c - n * t) / (c + n * t), (n * c - t) / (n * c + t)
    return np.where(squared > 0, 0.5 * (s * s + p * p), 1.0), t, squared > 0


def ggx_masking(z, alpha):
    z = np.where(z > 0, z, 1.0)
    return 2 / (1 + np.sqrt(1 + alpha**2 * np.maximum(1 - z * z, 0) / z**2))


def vmf_masking(z, alpha):
    """N cos / P with P of a normal distribution of <w, m> (its mean and variance are those of the whole sphere)."""
    kappa, z = 2 / alpha**2, np.where((z > 0) & (z < 1), z, 1.0)
    length = 1 / np.tanh(kappa) - 1 / kappa
    along, across = max(1 - length**2 - 2 * length / kappa, 0.0), length / kappa
    deviation = np.sqrt(z * z * along + (1 - z * z) * across + 1e-300)
    x = length * z / deviation
    area = length * z * special.ndtr(x) + deviation * np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi)
    drop, weight = special.roots_legendre(200)
    drop = 0.5 * (drop + 1) * min(1.0, 40 / kappa)
    norm = np.sum(weight * np.exp(-kappa * drop) * (1 - drop)) * 0.5 * min(1.0, 40 / kappa)
    return np.minimum(norm * kappa / -np.expm1(-2 * kappa) * z / area, 1.0)


def walked(cosine, n, alpha, distribution, points=1500):
    """The same by midpoints in the distribution of all normals: no coordinates about the direction in it."""
    v, phi = ((np.arange(points) + 0.5) / points)[:, None], np.pi * (np.arange(points) + 0.5) / points
    if distribution == "ggx":  # drawn by D cos, 1 - v^2 uniform
        masking, tangent = ggx_masking, alpha * np.sqrt((1 - v) * (1 + v)) / v
        z = 1 / np.sqrt(1 + tangent**2)
        sine_m, drawn = z * tangent, 2 * v / (points**2 * z)
    else:  # drawn by D
        masking, kappa = vmf_masking, 2 / alpha**2
        drop = -np.log1p(v * np.expm1(-kappa)) / kappa
        z, sine_m = 1 - drop, np.sqrt(drop * (2 - drop))
        drawn = 1 / (points * np.sum(z))  # the integral of D cos is 1
    sine = np.sqrt(1 - cosine**2)
    c = sine * sine_m * np.cos(phi) + cosine * z
    share = np.where(c > 0, c * masking(cosine, alpha) / cosine, 0.0) * drawn  # D <w, m> G1(w) / cos
    level, t, passes = fresnel(np.maximum(c, 0), n)
    up = 2 * c * z - cosine
    down = cosine / n - (c / n - t) * z
    reflected = np.sum(share * level * np.where(up > 0, masking(up, alpha), 0.0))
    refracted = np.sum(share * (1 - level) * np.where(passes & (down > 0), masking(down, alpha), 0.0))
    return reflected, refracted, 1 - reflected - refracted


QUICK = ((1.5, 1e-4), (1 / 1.5, 0.1), (1.5, 1.0))


@pytest.mark.parametrize(
    ("ratio", "alpha"),
    [
        pytest.param(*pair, marks=[pytest.mark.slow] * (pair not in QUICK))
        for pair in itertools.product((0.25, 1 / 1.5, 1.0, 1.5, 4.0), (1e-4, 0.02, 0.1, 0.3, 1.0))
    ],
)
def test_energies(ratio, alpha):
    """The rule is right to 4e-4, at grazing light (cosine 0.02) to 1e-3; midpoints of 1500 x 1500 to about 1e-4."""
    found = np.asarray(energies(COSINES, ratio, alpha)).T
    expected = np.array([walked(cosine, ratio, alpha, "ggx") for cosine in COSINES])
    slack = np.where(COSINES < 0.1, 1e-3, 5e-4)
    np.testing.assert_array_less(np.max(np.abs(found - expected), axis=1), slack)


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [slow(1e-4), slow(0.05), slow(0.1), 0.3, slow(0.5), slow(1.0), slow(15.0)])
@pytest.mark.parametrize("ratio", [0.7, *map(slow, (0.95, 1.0, 1.5, 2.5))])
def test_energies_of_vmf_normals(ratio, alpha):
    """Right to 1e-4, midpoints among it. Masking of wide normals, a fit, kinks where it reaches 1: to 6e-4.

    That fit alone would make up to 2 % of the light where nothing is reflected: as much passes as is there.
    """
    found = np.asarray(energies(COSINES, ratio, alpha, "vmf")).T
    reflected, refracted, lost = np.array([walked(cosine, ratio, alpha, "vmf") for cosine in COSINES]).T
    expected = np.stack([reflected, np.minimum(refracted, 1.0 - reflected), np.maximum(lost, 0.0)], axis=-1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 if alpha < 1.0 else 6e-4)


@pytest.mark.slow
def test_energies_of_vmf_normals_have_the_slopes_of_their_differences():
    """No point crosses the critical angle or the horizon as width or index change. Wide normals cross the kink of their
    masking."""
    for ratio in (1 / 2.5, 0.7, 1.5, 2.5):
        for alpha in (0.05, 0.1, 0.2, 0.3, 0.303, 0.5, 1.0):
            step = 1e-4 * alpha
            for found, apart in zip(vmf_slopes(SLOPED, ratio, alpha), step * np.eye(2), strict=True):
                ahead, back = (
                    energies(SLOPED, ratio + sign * apart[0], alpha + sign * apart[1], "vmf") for sign in (1, -1)
                )
                atol = (1e-4 if alpha < 0.5 else 1e-3) * max(1.0, np.max(np.abs(found)))
                np.testing.assert_allclose(found, (ahead - back) / (2 * step), rtol=0, atol=atol)


@pytest.mark.slow
def test_slopes_of_energies_of_vmf_normals_are_those_of_a_finer_rule():
    for ratio in (0.7, 1.5):
        for alpha in (0.05, 0.1, 0.3, 1.0):
            found = vmf_slopes(SLOPED, ratio, alpha)[1][1]
            fine = vmf_slopes(SLOPED, ratio, alpha, (40, 30))[1]
            np.testing.assert_allclose(found, fine, rtol=0, atol=2e-3 / max(alpha, 0.1))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_vmf_normals_are_finite_over_the_box(dtype):
    cosines = np.array([1e-6, 0.02, 0.745, 1.0], dtype)
    for ratio in (0.25, 1 - 2.0**-24, 1.0, 1.5, 4.0):
        for alpha in (1e-4, 0.3, 15.0):
            given = dtype(ratio), dtype(alpha)
            for leaf in (energies(cosines, *given, "vmf"), *vmf_slopes(cosines, *given)):
                assert leaf.dtype == dtype
                assert np.isfinite(leaf).all(), (ratio, alpha)


@pytest.mark.slow
def test_energies_beyond_the_critical_angle_are_smooth_in_the_index():
    """Light that only tilted facets let in: no point crosses the horizon of what they refract. Steps are a fiftieth of
    the width of the normals; alpha 0.05, index 0.7."""
    slopes = jax.jit(jax.jacfwd(energies, 1))
    step = 1e-3
    for ratio in 0.7 + step * np.arange(8):
        found = slopes(SLOPED, ratio, 0.05)
        wide, narrow = (
            (energies(SLOPED, ratio + h, 0.05) - energies(SLOPED, ratio - h, 0.05)) / (2 * h) for h in (step, step / 2)
        )
        np.testing.assert_allclose(found, (4 * narrow - wide) / 3, rtol=0, atol=1e-6)


@pytest.mark.slow
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
