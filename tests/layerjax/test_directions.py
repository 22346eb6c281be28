"""The conventions, in numbers."""

import jax
import jax.numpy as jnp
import numpy as np

import layerjax as lj
from layerjax import directions as d


def test_direction_and_angles_are_inverse():
    theta, phi = jnp.meshgrid(jnp.linspace(0.01, 3.13, 21), jnp.linspace(-3.1, 3.1, 21))
    w = lj.direction(theta, phi)
    np.testing.assert_allclose(jnp.linalg.norm(w, axis=-1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(jnp.stack(lj.angles(w)), jnp.stack([theta, phi]), atol=1e-14)


def test_known_directions():
    half = np.pi / 2
    np.testing.assert_allclose(lj.direction(0.0, 0.3), [0, 0, 1], atol=1e-16)
    np.testing.assert_allclose(lj.direction(half, 0.0), [1, 0, 0], atol=1e-16)
    np.testing.assert_allclose(lj.direction(half, half), [0, 1, 0], atol=1e-16)
    np.testing.assert_allclose(lj.direction(np.pi, 0.0), [0, 0, -1], atol=2e-16)
    assert lj.direction(0, 0).dtype == jnp.float64


def test_the_mirror_direction_is_phi_plus_pi():
    wi, wo = d.split(lj.direction(0.6, 0.4)), d.split(lj.direction(0.6, 0.4 + np.pi))
    normal = d.split(lj.direction(0.0, 0.0))
    np.testing.assert_allclose(d.reflect(wi, normal), wo, atol=1e-15)
    h, cosine = d.half_vector(wi, wo)
    np.testing.assert_allclose(h, normal, atol=1e-15)
    np.testing.assert_allclose(cosine, np.cos(0.6), rtol=1e-15)


def test_angles_at_the_pole_have_finite_gradients():
    gradient = jax.grad(lambda w: sum(lj.angles(w)))(jnp.array([0.0, 0.0, 1.0]))
    assert np.isfinite(gradient).all()


def test_frame_is_right_handed_everywhere():
    theta, phi = jnp.meshgrid(jnp.linspace(0, jnp.pi, 31), jnp.linspace(-3.1, 3.1, 31))
    n = d.split(lj.direction(theta, phi))
    t, b = d.frame(n)
    for a, c in ((t, b), (t, n), (b, n)):
        np.testing.assert_allclose(d.dot(a, c), 0.0, atol=1e-14)
    np.testing.assert_allclose(d.join(d.cross(t, b)), d.join(n), atol=1e-14)


def test_refraction_obeys_snell_and_flags_total_reflection():
    m = d.split(lj.direction(0.2, 1.0))
    for ior in (1.5, 1 / 1.5, 1.0):
        w = d.split(lj.direction(0.5, -0.3))
        t, exists = d.refract(w, m, ior)
        assert bool(exists)
        np.testing.assert_allclose(d.dot(t, t), 1.0, rtol=1e-14)
        assert d.dot(t, m) * d.dot(w, m) < 0
        sine_in, sine_out = (np.sqrt(1 - d.dot(v, m) ** 2) for v in (w, t))
        np.testing.assert_allclose(sine_in, ior * sine_out, rtol=1e-12)
    # theta 0.8, ior 1.5
    t, _ = d.refract(d.split(lj.direction(0.8, 0.0)), d.split(lj.direction(0.0, 0.0)), 1.5)
    np.testing.assert_allclose(d.join(t), [-0.47823739, 0.0, -0.87823060], atol=5e-9)
    _, exists = d.refract(d.split(lj.direction(1.0, 0.0)), d.split(lj.direction(0.0, 0.0)), 1 / 1.5)
    assert not bool(exists)
