"""Directional energies of rough interfaces, against integrals over facets and walks that share no code with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.microsurface.directional_albedo import (
    escape_cone_share,
    interface_energies,
    lobe_energy,
)
from tests.helpers.metals import conductor_energy

multiple = jax.jit(lambda c, a, n: interface_energies(c, a, n, True))
single = jax.jit(lambda c, a, n: interface_energies(c, a, n, False))
metal = jax.jit(lambda c, a, n, k: conductor_energy(c, a, n, k, True))
metal_single = jax.jit(lambda c, a, n, k: conductor_energy(c, a, n, k, False))

CASES = [(1.0, 0.1, 1.5), (0.5, 0.1, 1.5), (0.2, 0.5, 1.5), (0.05, 0.4, 2.0), (0.9, 0.5, 1 / 1.5), (0.3, 0.2, 0.5)]


def smith(z, alpha):
    z = np.where(z > 0, z, 1.0) * (z > 0)
    return 2 * z / (z + np.sqrt(alpha**2 * (1 - z * z) + z * z))


def snell(c, n):
    """Fresnel reflectance by Snell's law with complex angles, for any complex index."""
    inside = np.sqrt(n * n - (1 - c * c) + 0j)
    s, p = (c - inside) / (c + inside), (n * n * c - inside) / (n * n * c + inside)
    return 0.5 * (abs(s) ** 2 + abs(p) ** 2), inside.real / np.real(n)


def over_facets(cosine, alpha, n, count=1600):
    """R, T, and the lobe's cosines with their shares, by the midpoint rule over the distribution of all facets."""
    rest = ((np.arange(count) + 0.5) / count)[:, None]  # steep facets are few, but seen well: u = 1 - rest^2
    u = 1 - rest**2
    phi = (np.arange(count) + 0.5) * np.pi / count
    tan = alpha * np.sqrt(u) / rest
    mz = 1 / np.sqrt(1 + tan * tan)
    facing = np.sqrt(1 - cosine**2) * tan * mz * np.cos(phi) + cosine * mz
    weight = np.where(facing > 0, facing, 0.0) / (mz * cosine) * smith(np.array(cosine), alpha) * 2 * rest / count**2
    level, inside = snell(np.abs(facing), n)
    reflected = 2 * facing * mz - cosine
    refracted = (cosine - facing * mz) / np.real(n) + inside * mz
    lobe = weight * smith(reflected, alpha)
    return (level * lobe).sum(), ((1 - level) * weight * smith(refracted, alpha)).sum(), reflected, lobe


@pytest.mark.parametrize("case", CASES)
def test_single_scattering_equals_an_integral_over_all_facets(case):
    reflected, transmitted, _, lobe = over_facets(*case)
    energies = single(*case)
    np.testing.assert_allclose(energies[0], reflected, atol=2e-4)
    np.testing.assert_allclose(energies[1], transmitted, atol=2e-4 if case[2] > 1 else 8e-4)
    np.testing.assert_allclose(lobe_energy(*case[:2]), lobe.sum(), atol=2e-4)


@pytest.mark.parametrize(
    ("cosine", "alpha", "n", "k"), [(0.5, 0.3, 0.2, 3.9), (0.9, 0.6, 1.0, 1.0), (0.1, 0.2, 1.5, 7.5)]
)
def test_single_scattering_of_conductors_equals_an_integral_over_all_facets(cosine, alpha, n, k):
    reflected, *_ = over_facets(cosine, alpha, n + 1j * k)
    np.testing.assert_allclose(metal_single(cosine, alpha, n, k), reflected, atol=2e-4)


@pytest.mark.parametrize(
    ("angle", "alpha", "ior", "expected", "error"),
    [
        (60, 0.1, 1.5, 0.08741, 0.00012),
        (60, 0.3, 1.5, 0.06555, 0.00010),
        (75, 0.5, 1.5, 0.07518, 0.00011),
        (0, 0.1, 1.5, 1 - 0.96029, 0.00010),
        (60, 0.1, 1.5, 1 - 0.91230, 0.00014),
        (30, 0.5, 1 / 1.5, 0.38267, 0.00020),
    ],
)
def test_multiple_scattering_equals_published_walks(angle, alpha, ior, expected, error):
    reflected, transmitted = multiple(np.cos(np.radians(angle)), alpha, ior)
    np.testing.assert_allclose(reflected, expected, atol=1e-3 + 3 * error)
    np.testing.assert_allclose(reflected + transmitted, 1.0, atol=1e-15)


@pytest.mark.parametrize(("angle", "alpha", "expected"), [(60, 0.1, 0.29967), (30, 0.5, 0.16724), (45, 0.8, 0.13562)])
def test_multiple_scattering_of_a_conductor_equals_published_walks(angle, alpha, expected):
    np.testing.assert_allclose(metal(np.cos(np.radians(angle)), alpha, 1.0, 1.0), expected, atol=1e-3)


@pytest.mark.slow
def test_multiple_scattering_equals_walks_that_no_table_was_fitted_to():
    rng = np.random.default_rng(5)

    @jax.jit
    def walk(cosine, alpha, ior, key):
        wi = jnp.stack([jnp.sqrt(1 - cosine**2), 0.0, cosine])
        stack = lj.Stack([lj.Interface(ior=ior, alpha=alpha)])
        gram = lj.goniophotometer(stack, wi, key=key, paths=32768, polar=1, azimuth=1, facet_multiple_scattering=True)
        return gram.albedo[0, 0], gram.albedo_error[0, 0]

    for number in range(12):
        ior = rng.uniform(0.25, 0.95)
        case = rng.uniform(0.05, 1.0), rng.uniform(0.05, 1.0), ior if number % 2 else 1 / ior
        value, error = walk(*case, jax.random.key(number))
        np.testing.assert_allclose(multiple(*case)[0], value, atol=2e-3 + 4 * error, err_msg=str(case))


def test_perfect_mirrors_return_everything_and_matched_indices_nothing():
    cosine, alpha = jnp.array([1e-6, 0.1, 0.5, 1.0]), jnp.array([[1e-4], [0.3], [1.0]])
    np.testing.assert_allclose(metal(cosine, alpha, 1e-12, 0.0), 1.0, atol=1e-5)
    reflected, transmitted = multiple(cosine, alpha, 1.0)
    np.testing.assert_allclose(reflected, 0.0, atol=1e-10)
    np.testing.assert_allclose(transmitted, 1.0, atol=1e-10)


@pytest.mark.parametrize(
    ("cosine", "alpha", "ratio"), [(1.0, 0.1, 1 / 1.5), (0.8164966, 0.3, 1 / 1.5), (0.4, 0.2, 0.8)]
)
def test_retained_is_the_part_of_the_lobe_in_the_cone(cosine, alpha, ratio):
    *_, reflected, lobe = over_facets(cosine, alpha, 1.5)
    inside = reflected > np.sqrt(1 - ratio**2)
    np.testing.assert_allclose(escape_cone_share(cosine, alpha, ratio), lobe[inside].sum() / lobe.sum(), atol=3e-4)


def test_retained_at_its_limits():
    np.testing.assert_allclose(
        escape_cone_share(jnp.array([0.8164966, 0.8164966]), jnp.array([0.1, 0.3]), 1 / 1.5),
        [0.725846, 0.530590],
        atol=1e-3,
    )
    np.testing.assert_array_equal(escape_cone_share(0.7, 0.2, jnp.array([1.0, 1.5])), 1.0)
    cosine = jnp.cos(jnp.arcsin(jnp.array([0.59, 0.61])))
    np.testing.assert_allclose(escape_cone_share(cosine, 1e-4, 0.6), [1.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(escape_cone_share(0.6, 0.2, 1 - 1e-9), 1.0, atol=1e-6)


def box(dtype):
    cosine, alpha, ior = np.meshgrid([1e-6, 0.03, 0.6, 1.0], [1e-4, 0.2, 1.0], [0.25, 0.7, 1.0, 1.5, 4.0])
    return [jnp.asarray(x.ravel(), dtype) for x in (cosine, alpha, ior)]


def both_kinds(cosine, alpha, ior):
    kinds = (False, True)
    return jnp.stack([part for kind in kinds for part in interface_energies(cosine, alpha, ior, kind)])


def with_slopes(function):
    """The function with, on a first axis, its derivatives in each argument, element by element."""

    @jax.jit
    def compiled(*x):
        def along(d):
            return jax.jvp(function, x, tuple(d[j] + jnp.zeros_like(y) for j, y in enumerate(x)))

        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(x), dtype=x[0].dtype))

    return compiled


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_values_and_derivatives_are_finite_over_the_box(dtype):
    cosine, alpha, ior = box(dtype)
    k = jnp.asarray(np.resize([0.0, 1.0, 20.0], cosine.size), dtype)
    metals = jnp.where(ior == 0.25, 0.01, jnp.where(ior == 4.0, 10.0, ior))
    quantities = [
        (both_kinds, (cosine, alpha, ior)),
        (lambda c, a, n, k: conductor_energy(c, a, n, k, True), (cosine, alpha, metals, k)),
        (escape_cone_share, (cosine, alpha, ior)),
    ]
    for function, arguments in quantities:
        value, slopes = with_slopes(function)(*arguments)
        assert value.dtype == dtype
        assert np.all((np.asarray(value) >= 0) & (np.asarray(value) <= 1 + 1e-5))
        assert np.all(np.isfinite(slopes))


COSINE, ALPHA, IOR = (
    np.array([0.6, 0.999999, 0.4, 0.8]),
    np.array([0.3, 0.2, 0.15, 0.5]),
    np.array([1.5, 1.5, 0.7, 0.9]),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (both_kinds, (COSINE, ALPHA, IOR)),
        (lambda c, a, n, k: conductor_energy(c, a, n, k, True), (COSINE, ALPHA, IOR, 2.0 + 0.0 * IOR)),
        (escape_cone_share, (COSINE, ALPHA, 0.6 * IOR)),
    ],
    ids=["interfaces", "metals", "retained"],
)
def test_derivatives_equal_differences(function, arguments):
    compiled = with_slopes(function)
    _, slopes = compiled(*arguments)
    for i, slope in enumerate(slopes):
        step = 3e-7
        above, below = (
            compiled(*(x + sign * step if i == j else x for j, x in enumerate(arguments)))[0] for sign in (1, -1)
        )
        np.testing.assert_allclose(slope, (above - below) / (2 * step), rtol=2e-3, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("function", [lambda *x: single(*x)[0], escape_cone_share])
def test_reverse_derivatives_equal_forward_ones(function):
    x = jnp.array([0.6, 0.3, 0.8])
    reverse, forward = (jax.jit(mode(lambda x: function(*x)))(x) for mode in (jax.grad, jax.jacfwd))
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
