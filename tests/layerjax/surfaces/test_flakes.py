"""Projected areas of von Mises-Fisher flakes against quadrature, in both precisions and at the ends."""

import jax
import jax.numpy as jnp
import numpy as np

import layerjax as lj
from layerjax.directions import split
from layerjax.surfaces.vmf_diffuse.flakes import areas


def along(cosine, phi=0.0):
    return lj.direction(jnp.arccos(jnp.asarray(cosine)), phi)


# cosine, alpha, cross-section
CROSS_SECTIONS = [
    (0.3, 0.1, 0.29850013984),
    (0.0, 0.1, 0.028156503395),
    (-0.1, 0.1, 0.0025196686477),
    (-0.2, 0.25, 0.011586864989),
    (1.0, 0.5, 0.87504203130),
    (-0.6, 0.5, 0.0068921962337),
    (0.7, 0.9, 0.48319627030),
    (-1.0, 0.9, 0.024391700171),
    (1.0, 2.0, 0.33705804447),
]


def test_cross_section_against_quadrature():
    cosine, alpha, expected = np.array(CROSS_SECTIONS).T
    seen = jax.jit(jax.vmap(areas))(split(along(np.abs(cosine), 0.8)), 2.0 / alpha**2)
    np.testing.assert_allclose(np.where(cosine >= 0, seen.ahead, seen.facing_away), expected, rtol=1e-10)
    np.testing.assert_allclose(seen.mean, 0.5 * (seen.ahead + seen.facing_away), rtol=1e-14)


def test_cross_section_in_single_precision_and_at_its_limits():
    k = np.array([0.0, 1e-6, 1e-3, 0.3, 1.0, 5.0, 80.0, 1e4, 1e8, 2e16])
    w = along([0.0, 1e-6, 1e-3, 0.1, 0.6, 1.0], 0.3)
    seen = jax.jit(jax.vmap(areas, (None, 0)))
    exact, rounded = seen(split(w), k), seen(split(w.astype(jnp.float32)), k.astype(np.float32))
    for single, double in zip(rounded, exact, strict=True):
        assert single.dtype == jnp.float32
        np.testing.assert_allclose(single, double, atol=3e-7)
    np.testing.assert_allclose(exact.ahead[0], 0.25, rtol=1e-14)  # flakes of all directions
    np.testing.assert_allclose(exact.ahead[-1], w[:, 2], atol=1e-8)  # flat: alpha / (2 sqrt(pi)) at grazing
