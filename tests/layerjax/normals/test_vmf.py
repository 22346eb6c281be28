"""Von Mises-Fisher normals: reference values of Guo et al. 2015 and by quadrature, float32, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from layerjax.normals import vmf
from tests.helpers.derivatives import with_slopes

# compiled whole: outside `jit` every operation is a program of its own
resultant, convolve, concentration_of = (jax.jit(f) for f in (vmf.resultant, vmf.convolve, vmf.concentration_of))
projected_area, masking = (jax.jit(f, static_argnums=2) for f in (vmf.projected_area, vmf.masking))
hemisphere_norm, hemisphere_sample, hemisphere_density = map(
    jax.jit, (vmf.hemisphere_norm, vmf.hemisphere_sample, vmf.hemisphere_density)
)

KAPPAS = np.array([1e-2, 0.3, 0.49, 0.51, 0.99, 1.01, 2.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e6, 1e8])
X, W = np.polynomial.legendre.leggauss(60)
X, W = 0.5 * (X + 1), 0.5 * W


def over_the_sphere(kappa, cosine, least):
    """Integral of M <o, m>+ over normals with m.z > least, by a product rule that follows the lobe.

    Where facets begin to look away, the integrand has a kink in 1 - m.z = end s^2: there the range of s is split.
    """
    end = min(1.0 - least, 40.0 / kappa)
    kink = np.sqrt(np.minimum(np.array([1 - np.sqrt(1 - cosine**2), 1 + np.sqrt(1 - cosine**2)]) / end, 1.0))
    edges = np.array([0.0, *kink, 1.0])
    smooth = X * X * (3 - 2 * X)  # crowded at the kinks, where the integrand goes like a power of 3/2
    s = (edges[:-1, None] + np.diff(edges)[:, None] * smooth).ravel()
    ws = (np.diff(edges)[:, None] * 6 * X * (1 - X) * W).ravel()
    drop = end * s * s
    mass = np.exp(-kappa * drop) * kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * 2 * end * s * ws
    level = cosine * (1 - drop)
    swing = np.sqrt((1 - cosine**2) * drop * (2 - drop))
    # the integral over azimuth of (level + swing cos phi)+ is elementary
    ratio = np.clip(-level / np.where(swing > 0, swing, 1.0), -1.0, 1.0)
    rim = np.where(level >= swing, np.pi, np.where(level <= -swing, 0.0, np.arccos(ratio)))
    return np.sum(mass * 2 * (level * rim + swing * np.sin(rim)))


def test_mean_resultant_length():
    kappa = jnp.array([1e-4, 0.5, 1.0, 10.0])
    length, rest = resultant(kappa)
    expected = np.array([3.33333333111e-5, 0.163953413739, 0.313035285499, 0.900000004122])
    np.testing.assert_allclose(length, expected, rtol=1e-10)
    np.testing.assert_allclose(rest, 1 - expected, rtol=1e-10)
    np.testing.assert_allclose(resultant(jnp.asarray(1e8))[1], 1e-8, rtol=1e-12)


def test_concentration_of_a_mean_resultant_length():
    length = jnp.array([1e-4, 0.3, 0.9, 0.96, 0.999999])
    rest = jnp.array([1 - 1e-4, 0.7, 0.1, 0.04, 1e-6])
    expected = [3e-4 + 1.8e-12, 0.95314947285741, 9.999999587769, 25.0, 1e6]
    np.testing.assert_allclose(concentration_of(length, rest), expected, rtol=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-6), (np.float64, 2e-14)])
def test_the_inverse_inverts(dtype, tolerance):
    kappa = jnp.asarray(KAPPAS, dtype)
    found = concentration_of(*resultant(kappa))
    np.testing.assert_allclose(found, kappa, rtol=tolerance)
    # three turns one after the other, against the same in float64
    pairs = [resultant(jnp.asarray(np.roll(KAPPAS, shift), dtype)) for shift in (0, 4, 9)]
    truth = [resultant(jnp.asarray(np.roll(KAPPAS, shift))) for shift in (0, 4, 9)]
    wanted = concentration_of(*convolve(*truth))
    np.testing.assert_allclose(concentration_of(*convolve(*pairs)), wanted, rtol=20 * tolerance)


def test_projected_area_of_the_normals_above_the_horizon():
    kappa = jnp.array([1e-4, 0.5, 1.0, 10.0])
    expected = [0.250016666875, 0.337058044466, 0.42545906412, 0.900004541848]
    np.testing.assert_allclose(hemisphere_norm(kappa), expected, rtol=1e-11)
    found = [over_the_sphere(k, 1.0, 0.0) for k in KAPPAS]
    np.testing.assert_allclose(hemisphere_norm(jnp.asarray(KAPPAS)), found, rtol=1e-10)
    narrow = hemisphere_norm(jnp.asarray(KAPPAS, jnp.float32))
    np.testing.assert_allclose(narrow, found, rtol=1e-6)


AREAS = [(1.0, 60, 0.3259057832), (10.0, 75, 0.2709988233), (100.0, 85, 0.0969007649), (1e3, 89, 0.0231989680)]
PAPER = [(1.0, 60, 0.32657375), (10.0, 75, 0.27271310), (100.0, 85, 0.09117877), (1e3, 89, 0.01795231)]


def test_projected_area_along_a_direction():
    kappa, degrees, expected = np.array([*AREAS, (100.0, 90, 0.0397441530)]).T
    cosine = np.cos(np.deg2rad(degrees))
    exact = [over_the_sphere(k, c, -1.0) for k, c in zip(kappa, cosine, strict=True)]
    np.testing.assert_allclose(exact, expected, rtol=2e-9)
    found = projected_area(jnp.asarray(cosine), jnp.asarray(kappa))
    np.testing.assert_array_less(np.abs(found / expected - 1), [0.06, 0.02, 3e-3, 1e-3, 3e-3])
    kappa, degrees, expected = np.array([*PAPER, (100.0, 90, 0.00520111)]).T
    cosine = np.cos(np.deg2rad(degrees))
    found = projected_area(jnp.asarray(cosine), jnp.asarray(kappa), "paper")
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("kappa", "error"), [(1.0, 0.075), (2.0, 0.03), (3.0, 0.02), (10.0, 0.011), (100.0, 0.0011), (1e3, 1.1e-4)]
)
def test_masking_is_as_exact_as_it_is_said_to_be(kappa, error):
    cosine = np.cos(np.deg2rad(np.linspace(0.0, 89.9, 40)))
    exact = np.array([c * over_the_sphere(kappa, 1.0, 0.0) / over_the_sphere(kappa, c, 0.0) for c in cosine])
    found = masking(jnp.asarray(cosine), jnp.asarray(kappa))
    assert np.abs(found - exact).max() < error
    assert found.max() < 1.0 + 1e-15


def test_density_and_draws():
    random = np.random.default_rng(2)
    for kappa in (1e-2, 1.0, 40.0, 1e8):
        u = jnp.asarray(random.random((2, 100_000)))
        x, y, z = hemisphere_sample(jnp.asarray(kappa), u[0], u[1])
        np.testing.assert_allclose(x * x + y * y + z * z, 1.0, rtol=1e-12)
        # 1 - z is exponential, cut at 1; the azimuth is uniform
        drop = (x * x + y * y) / (1.0 + z)
        share = np.expm1(-kappa * np.asarray(drop)) / np.expm1(-kappa)
        assert scipy.stats.kstest(share, "uniform").pvalue > 1e-3
        assert scipy.stats.kstest(np.arctan2(y, x) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3
        density = hemisphere_density((x, y, z), jnp.asarray(kappa)) * hemisphere_norm(jnp.asarray(kappa))
        expected = np.exp(-kappa * drop) * kappa / (2 * np.pi * -np.expm1(-2 * kappa))
        np.testing.assert_allclose(density, expected, rtol=1e-10)
    np.testing.assert_allclose(vmf.upper_share(jnp.asarray(1.0)), 1 / (1 + np.exp(-1)), rtol=1e-14)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gradients_are_finite_and_right(dtype):
    kappa, cosine = np.meshgrid(KAPPAS, [0.0, 1e-6, 1e-3, 0.3, 0.9, 1.0, 1.0005])  # as long as directions may be
    kappa, cosine = jnp.asarray(kappa.ravel(), dtype), jnp.asarray(cosine.ravel(), dtype)
    names = ("masking", "paper", "draws", "area", "norm", "inverse")

    def values(c, k):
        turned = vmf.convolve(vmf.resultant(k), vmf.resultant(0.5 * k))
        found = (vmf.masking(c, k), vmf.masking(c, k, "paper"), sum(vmf.hemisphere_sample(k, 0.999 * c, c)))
        return jnp.stack([*found, vmf.projected_area(c, k), vmf.hemisphere_norm(k), vmf.concentration_of(*turned)])

    value, slopes = jax.jit(jax.vmap(with_slopes(values, (0, 1), "forward")))(cosine, kappa)
    for index, name in enumerate(names):
        assert np.isfinite(value[:, index]).all(), name
        assert all(np.isfinite(slope[:, index]).all() for slope in slopes), name
    if dtype == np.float64:
        step, smooth = 1e-5, slice(3, None)
        evaluated = jax.jit(jax.vmap(values))
        up, down = (evaluated(cosine, kappa * (1 + sign * step)) for sign in (1, -1))
        difference = ((up - down) / (2 * step * kappa[:, None]) - slopes[1]) * kappa[:, None] / value
        np.testing.assert_array_less(np.abs(difference[:, smooth]), 2e-6)


def test_the_norm_has_finite_derivatives_at_any_concentration():
    kappa = jnp.logspace(-4, 12, 33, dtype=jnp.float32)
    for derivative in (jax.grad, jax.jacfwd):
        assert np.isfinite(jax.jit(jax.vmap(derivative(vmf.hemisphere_norm)))(kappa)).all()
