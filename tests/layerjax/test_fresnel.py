"""Reflectances against published values, complex arithmetic and limits."""

import jax
import jax.numpy as jnp
import numpy as np

from layerjax import fresnel

# compiled whole: outside `jit` every operation is a program of its own
dielectric, conductor = jax.jit(fresnel.dielectric), jax.jit(fresnel.conductor)
COSINES = np.concatenate([np.linspace(1e-3, 1.0, 200), [1e-6]])


def complex_reflectance(cosine, index):
    """Fresnel's equations for a complex index, in numpy's complex numbers."""
    root = np.sqrt(index**2 - (1.0 - cosine**2) + 0j)
    perpendicular = (cosine - root) / (cosine + root)
    parallel = (index**2 * cosine - root) / (index**2 * cosine + root)
    return 0.5 * (np.abs(perpendicular) ** 2 + np.abs(parallel) ** 2)


def test_published_dielectric_values():
    cases = {(0.5, 1.5): 0.08918671280, (1.0, 1.5): 0.04, (1.0, 2.0): 1 / 9, (0.5, 1 / 1.5): 1.0}
    for (cosine, ior), expected in cases.items():
        np.testing.assert_allclose(dielectric(jnp.asarray(cosine), jnp.asarray(ior)), expected, rtol=1e-9)


def test_dielectric_against_complex_arithmetic():
    for ior in (0.25, 0.8, 1.0 + 1e-9, 1.33, 4.0):
        expected = complex_reflectance(COSINES, ior)
        np.testing.assert_allclose(dielectric(COSINES, jnp.asarray(ior)), expected, rtol=1e-9, atol=1e-14)


def test_no_interface_reflects_nothing_at_any_angle():
    slope = jax.jit(jax.grad(fresnel.dielectric, 1))
    for cosine in (0.0, 1e-6, 0.3, 1.0):
        assert dielectric(jnp.asarray(cosine), jnp.asarray(1.0)) == 0.0
        assert np.isfinite(slope(cosine, 1.0))


def test_conductor_against_complex_arithmetic():
    for ior, k in ((0.2, 3.9), (0.05, 0.0), (1.0, 1e-6), (1.5, 0.0), (5.0, 10.0), (0.5, 0.5), (2.7, 1e-8)):
        expected = complex_reflectance(COSINES, ior + 1j * k)
        value = conductor(COSINES, jnp.asarray(ior), jnp.asarray(k))
        np.testing.assert_allclose(value, expected, rtol=1e-8, atol=1e-13)
        assert (value >= 0).all()


def test_conductor_keeps_the_digits_of_grazing_light_at_nearly_matched_indices():
    cosine = jnp.asarray([0.0, 1e-6, 1e-4, 1e-2, 0.3, 1.0], jnp.float32)
    assert not conductor(cosine, jnp.float32(1.0), jnp.float32(0.0)).any()
    for ior, k in ((1.0, 1e-4), (1.0 + 2.0**-13, 1e-3)):
        expected = complex_reflectance(np.asarray(cosine, float), ior + 1j * k)
        np.testing.assert_allclose(conductor(cosine, jnp.float32(ior), jnp.float32(k)), expected, rtol=1e-3, atol=1e-7)


def test_gradients_are_finite_and_right():
    derivative = jax.jit(jax.vmap(jax.grad(fresnel.conductor, (0, 1, 2)), (0, None, None)))
    for ior, k in ((0.2, 3.9), (1.5, 0.0), (0.5, 0.0), (1.0, 0.0), (1.0, 1e-6)):
        for dtype in (np.float32, np.float64):
            cosines = np.array([*COSINES, 1e-9, 0.0], dtype)
            assert np.isfinite(derivative(cosines, dtype(ior), dtype(k))).all()
    step = 1e-6
    numeric = (complex_reflectance(COSINES, 0.2 + step + 3.9j) - complex_reflectance(COSINES, 0.2 - step + 3.9j)) / (
        2 * step
    )
    np.testing.assert_allclose(derivative(COSINES, 0.2, 3.9)[1], numeric, rtol=1e-6, atol=1e-9)


def test_schlick():
    np.testing.assert_allclose(fresnel.schlick(jnp.array([1.0, 0.5, 0.0]), 0.04), [0.04, 0.04 + 0.96 / 32, 1.0])
