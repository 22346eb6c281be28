"""Tables of energies against quadratures over facets, their derivatives, and the ends of the box."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from layerjax.microsurface import directional_albedo as by_quadrature
from layerjax.microsurface import energy_tables as tables
from layerjax.microsurface.splines import fit_splines, read
from tests.helpers.metals import conductor_energy

COUNT = 2000


def rough(seed: int = 0, narrowest: float = 1e-4) -> tuple[np.ndarray, np.ndarray]:
    """Cosines, half of them in the layer at grazing that is as wide as the surface is rough, and widths."""
    rng = np.random.default_rng(seed)
    alpha = narrowest ** rng.uniform(0.0, 1.0, COUNT)
    layer = np.minimum(alpha * 10.0 ** rng.uniform(-1.0, 2.0, COUNT), 1.0)
    return np.maximum(np.where(rng.uniform(size=COUNT) < 0.5, rng.uniform(size=COUNT), layer), 1e-3), alpha


def indices(below: bool) -> np.ndarray:
    return 4.0 ** (np.random.default_rng(1).uniform(0.0, 1.0, COUNT) * (-1.0 if below else 1.0))


def near(found, wanted, root_mean_square: float, largest: float) -> None:
    """The errors that the tables state."""
    apart = np.abs(np.asarray(found) - np.asarray(wanted))
    assert np.sqrt(np.mean(apart**2)) < root_mean_square
    assert np.max(apart) < largest


def test_mirrors_and_metals() -> None:
    cosine, alpha = rough()
    near(tables.mirror_energy(cosine, alpha), by_quadrature.lobe_energy(cosine, alpha, points=24), 1e-4, 6e-4)
    rng = np.random.default_rng(2)
    ior, k = 0.02 * 500.0 ** rng.uniform(size=COUNT), 0.3 + 20.0 * rng.uniform(size=COUNT) ** 1.5
    for multiple, errors in ((False, (1e-3, 7e-3)), (True, (2e-3, 3e-2))):
        (found,) = tables.conductor_energies(cosine, alpha, (jnp.asarray(ior),), (jnp.asarray(k),), multiple)
        near(found, conductor_energy(cosine, alpha, ior, k, multiple, points=24), *errors)


@pytest.mark.parametrize("below", [False, True])
def test_interfaces(below: bool) -> None:
    (cosine, alpha), ior = rough(), indices(below)
    found = tables.interface_energies(cosine, alpha, ior, False)
    wanted = by_quadrature.interface_energies(cosine, alpha, ior, False, points=16)
    for mine, other in zip(found, wanted, strict=True):
        near(mine, other, 2e-3, 3e-2)
    near(tables.single_reflectance(cosine, alpha, ior), wanted[0], 2e-3, 3e-2)
    reflected, passed = tables.interface_energies(cosine, alpha, ior, True)
    np.testing.assert_allclose(reflected + passed, 1.0, rtol=1e-12)
    wide = alpha > 0.01  # what walks have told of
    wanted = by_quadrature.interface_energies(cosine, alpha, ior, True, points=16)[0]
    near(reflected[wide], wanted[wide], 2e-3, 3e-2)


def test_retained_light() -> None:
    cosine, alpha = rough()
    rng = np.random.default_rng(3)
    ratio = 1.0 - 0.75 * rng.uniform(size=COUNT) ** 2.5
    critical = np.sqrt(1.0 - ratio**2)
    layer = np.clip(critical + 2.0 * alpha * rng.normal(size=COUNT), 1e-3, 1.0)
    cosine = np.where(rng.uniform(size=COUNT) < 0.5, cosine, layer)
    near(
        tables.escape_cone_share(cosine, alpha, ratio),
        by_quadrature.escape_cone_share(cosine, alpha, ratio, points=24),
        1.5e-3,
        1.2e-2,
    )
    np.testing.assert_array_equal(
        tables.escape_cone_share(jnp.asarray(0.5), jnp.asarray(0.2), jnp.array([1.0, 2.0])), 1.0
    )


def test_derivatives_are_continuous_across_cells() -> None:
    """Cubic splines: values, slopes and curvatures; and slopes are those of differences."""
    rng = np.random.default_rng(4)
    flat = rng.normal(size=(9, 8)).ravel()
    edges = jnp.arange(1, 6) / 6.0

    @jax.jit
    def along(x):
        return read(flat, 0, (9, 8), (x, jnp.full_like(x, 0.37)))[0]

    slope = jax.jit(jax.vmap(jax.grad(along)))
    for function in (along, slope, jax.jit(jax.vmap(jax.grad(lambda x: slope(x[None])[0])))):
        before, after = function(edges - 1e-9), function(edges + 1e-9)
        np.testing.assert_allclose(before, after, atol=1e-5 * np.abs(flat).max())
    x, step = jnp.linspace(0.05, 0.95, 40), 1e-5
    np.testing.assert_allclose(slope(x), (along(x + step) - along(x - step)) / (2 * step), atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.jacfwd(along)))(x), slope(x), rtol=1e-12)


def test_cubics_are_found_again() -> None:
    x = np.linspace(0.0, 1.0, 20)
    values = (1.0 + x[:, None] ** 3) * (2.0 - x**2)
    coefficients = fit_splines(values, (7, 6)).ravel()
    places = jnp.asarray(np.random.default_rng(5).uniform(size=(2, 50)))
    found = read(coefficients, 0, (7, 6), tuple(places))[0]
    np.testing.assert_allclose(found, (1.0 + places[0] ** 3) * (2.0 - places[1] ** 2), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_ends_of_the_box(dtype) -> None:
    """Finite, in [0, 1], and with finite derivatives of both modes, everywhere."""
    axes = np.meshgrid([1e-6, 1e-3, 0.3, 1.0], [1e-4, 0.1, 1.0], [0.25, 1.0 - 1e-6, 1.0, 1.0 + 1e-6, 4.0])
    c, a, n = (jnp.asarray(axis.ravel(), dtype) for axis in axes)

    def energies(c, a, n):
        metal = tables.conductor_energies(c, a, (n,), (3.0 * n,), True)
        metal += tables.conductor_energies(c, a, (n,), (0.0 * n,), False)
        faces = (*tables.interface_energies(c, a, n, False), *tables.interface_energies(c, a, n, True))
        return jnp.stack([*metal, *faces, tables.mirror_energy(c, a), tables.escape_cone_share(c, a, n)])

    found = jax.jit(jax.vmap(energies))(c, a, n)
    assert found.dtype == dtype
    assert jnp.all((found >= 0.0) & (found <= 1.0))
    for mode in (jax.jacfwd, jax.jacrev):
        assert all(
            jnp.all(jnp.isfinite(part)) for part in jax.jit(jax.vmap(mode(energies, argnums=(0, 1, 2))))(c, a, n)
        )
