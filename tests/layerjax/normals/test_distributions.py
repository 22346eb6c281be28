"""Normal distributions: what must hold whatever the formula, by a product rule over the sphere."""

import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.directions import normalize, split
from layerjax.normals.ggx import ggx_density, ggx_masking
from layerjax.normals.sggx import sggx_area, sggx_density
from tests.helpers.interfaces import sphere


@pytest.mark.parametrize("kind", ["surface", "fiber"])
@pytest.mark.parametrize("alpha", [1.0, 0.5, 0.1, 0.03])
def test_projected_area_is_the_projection_of_the_density(kind, alpha):
    # Eq. (3): integral of <w, m> D(m) over the sphere
    m, weight = sphere(600)
    density = sggx_density(split(jnp.asarray(m)), kind, jnp.asarray(alpha), None)
    for theta in (0.0, 0.4, 1.1, 1.5):
        w = np.asarray(lj.direction(theta, 0.3))
        projected = np.sum(np.maximum(m @ w, 0.0) * np.asarray(density) * weight)
        area = sggx_area(split(jnp.asarray(w)), kind, jnp.asarray(alpha), None)
        np.testing.assert_allclose(area, projected, rtol=3e-5)  # the kink at m.w = 0 limits the rule


@pytest.mark.parametrize("kind", ["surface", "fiber"])
def test_a_tilted_distribution_is_a_rotated_one(kind):
    axis = normalize(tuple(jnp.asarray(x) for x in (0.4, 0.2, 0.9)))
    a, alpha = np.asarray(axis), jnp.asarray(0.2)
    tangent = np.cross(a, [1.0, 0, 0]) / np.linalg.norm(np.cross(a, [1.0, 0, 0]))
    rows = np.stack([np.cross(tangent, a), tangent, a])  # world -> flake frame, up to a turn about the axis
    w = lj.direction(np.linspace(0, 3, 50), np.linspace(-3, 3, 50))
    local = jnp.asarray(np.asarray(w) @ rows.T)
    for function in (sggx_area, sggx_density):
        tilted = function(split(w), kind, alpha, axis)
        np.testing.assert_allclose(tilted, function(split(local), kind, alpha, None), rtol=1e-12)


@pytest.mark.parametrize("alpha", [1.0, 0.3, 0.05])
def test_ggx_is_normalised_and_masking_conserves_area(alpha):
    m, weight = sphere(600)
    up = m[..., 2] > 0
    density = np.where(up, ggx_density(split(jnp.asarray(m)), jnp.asarray(alpha)), 0.0)
    np.testing.assert_allclose(np.sum(density * m[..., 2] * weight), 1.0, rtol=1e-9)
    for theta in (0.2, 0.9, 1.4):
        w = np.asarray(lj.direction(theta, 0.3))
        visible = np.sum(np.maximum(m @ w, 0.0) * density * weight)
        masking = ggx_masking(split(jnp.asarray(w)), jnp.asarray(alpha))
        np.testing.assert_allclose(masking * visible, w[2], rtol=3e-5)


def test_float32_densities_keep_their_digits_at_small_alpha():
    # the direction is exact in float32; truth in float64
    m = np.asarray([[3e-4, -2e-4, 1.0], [1e-3, 0.0, 1.0], [2e-5, 1e-5, 1.0]], dtype=np.float32)
    for alpha in (1e-1, 1e-2, 1e-3, 1e-4):
        a32 = np.float32(alpha)
        exact = sggx_density(split(jnp.asarray(m, jnp.float64)), "surface", jnp.float64(a32), None)
        single = sggx_density(split(jnp.asarray(m)), "surface", jnp.float32(a32), None)
        np.testing.assert_allclose(single, exact, rtol=2e-6)
