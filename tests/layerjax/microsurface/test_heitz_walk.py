"""Flight from facet to facet, against closed forms of the Smith model."""

import jax.numpy as jnp
import numpy as np
import pytest

from layerjax.directions import dot
from layerjax.microsurface.heitz_walk import (
    escape_probability,
    facing_area,
    meet_facet,
    next_height,
    opposite_height,
    optical_depth,
    pass_through,
)
from layerjax.normals.facets import masking

ALPHA = jnp.asarray(0.4)


def ray(theta, phi=0.7):
    return jnp.sin(theta) * jnp.cos(phi), jnp.sin(theta) * jnp.sin(phi), jnp.cos(theta)


@pytest.mark.parametrize("theta", [0.3, 1.2, 1.55])
def test_light_from_anywhere_on_the_surface_escapes_as_smith_masking_says(theta):
    w = ray(jnp.asarray(theta))
    x, weight = np.polynomial.legendre.leggauss(64)
    below = 0.5 + 0.5 * x  # C1, uniform over the facets
    escaped = np.sum(0.5 * weight * escape_probability(w, -jnp.log(below), ALPHA))
    np.testing.assert_allclose(escaped, masking(w, ALPHA, "ggx"), rtol=1e-4)


def test_facets_seen_from_both_sides_differ_by_the_flat_surface():
    up = ray(jnp.linspace(0.0, 1.57, 9))
    down = (-up[0], -up[1], -up[2])
    np.testing.assert_allclose(facing_area(down, ALPHA) - facing_area(up, ALPHA), up[2], atol=1e-15)


def test_a_free_path_as_long_as_the_way_out_ends_at_the_top():
    w, height = ray(jnp.asarray([0.2, 1.0, 1.5])), jnp.asarray([0.1, 1.0, 5.0])
    np.testing.assert_allclose(next_height(w, height, ALPHA, optical_depth(w, height, ALPHA)), 0.0, atol=1e-14)
    assert np.all(np.isinf(optical_depth(ray(jnp.asarray([1.6, 3.1])), height[:2], ALPHA)))


def test_turning_the_surface_over_twice_gives_the_height_back():
    height = jnp.asarray([1e-12, 1e-3, 0.5, 0.7, 3.0, 30.0])
    np.testing.assert_allclose(opposite_height(opposite_height(height)), height, rtol=1e-12)
    np.testing.assert_allclose(jnp.exp(-height) + jnp.exp(-opposite_height(height)), 1.0, rtol=1e-14)


def test_light_passes_straight_through_facets_between_equal_indices():
    wi = ray(jnp.full(100, 0.9))
    rng = np.random.default_rng(1)
    m, cosine = meet_facet(wi, ALPHA, *jnp.asarray(rng.uniform(size=(2, 100))))
    np.testing.assert_allclose(cosine, dot(wi, m), atol=1e-14)
    assert np.all(cosine > 0)
    through, height, exists = pass_through(wi, m, jnp.ones(100), jnp.full(100, 0.2))
    assert np.all(exists)
    np.testing.assert_allclose(jnp.stack(through), jnp.stack([-wi[0], -wi[1], wi[2]]), atol=1e-12)
    np.testing.assert_allclose(height, opposite_height(jnp.asarray(0.2)), rtol=1e-14)
