"""Interfaces of the solver that give back what masking loses: energies of both sides, against the walk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj

SOLVER = lj.AddingDoubling(nodes=24, modes=1, facet_multiple_scattering=True)


@pytest.mark.slow
def test_energy_from_the_denser_side():
    """Index 2, roughness 0.3: nothing is lost, at the critical angle (30 degrees) neither."""
    angle = np.radians([0.0, 10.0, 29.9, 30.0, 30.1, 35.0, 60.0, 85.0])
    inside = lj.direction(np.pi - angle, 0.0)
    reflected, transmitted = lj.albedo(lj.Stack([lj.Interface(2.0, 0.3)]), inside, SOLVER)
    np.testing.assert_allclose(reflected + transmitted, 1.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("ior", "alpha"), [(1.5, 0.1), (1.5, 0.6)])
def test_what_crosses_is_what_the_walk_counts(ior, alpha):
    """4 standard errors, and 2e-3 of the energies that decide which side the light ends on."""
    stack = lj.Stack([lj.Interface(ior, alpha)])
    wi = lj.direction(jnp.radians(jnp.array([0.0, 60.0, 85.0])), 0.0)
    seen = lj.goniophotometer(
        stack, wi, key=jax.random.key(0), paths=1 << 16, polar=1, azimuth=1, orders=1, facet_multiple_scattering=True
    )
    _, transmitted = lj.albedo(stack, wi, SOLVER)
    assert np.all(np.abs(transmitted[:, 0] - seen.albedo[:, 1, 0]) < 4 * seen.albedo_error[:, 1, 0] + 2e-3)


ENDS = {
    "smooth in dense, on the dense side": ([(2.0, 0.002)], 1e-9),
    "hazy varnish": ([(3.027, 0.00137), 0.9], 1e-9),
    "hardly there, peaked back, steps down": ([(1.0001, 0.01), -0.999, (0.25, 1e-4)], 1e-5),
    "steps down, rough": ([(0.25, 1.0), 0.0], 1e-9),
}
"""Interfaces (index, alpha) and media of depth 1 with this g, and by how much lossless energy is off at most."""


SLOW = ("hardly there, peaked back, steps down", "hazy varnish", "steps down, rough")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in ENDS])
def test_nothing_is_lost_at_the_ends(name):
    parts, error = ENDS[name]
    layers = [
        lj.Interface(*part) if isinstance(part, tuple) else lj.Medium(1.0, 1.0, lj.HenyeyGreenstein(part))
        for part in parts
    ]
    angle = jnp.array([0.0, 0.5, 1.0, 1.4, 1.56, np.pi - 1.56, 2.2, np.pi])
    reflected, transmitted = lj.albedo(lj.Stack(layers), lj.direction(angle, 0.3), SOLVER)
    passed = lj.unscattered(lj.Stack(layers), lj.direction(angle, 0.3))
    np.testing.assert_allclose(reflected + transmitted + passed, 1.0, atol=error)


WHOLE = {
    "face": lj.Stack([lj.Interface(1.5, 0.9)]),
    "varnish": lj.Stack([lj.Interface(1.5, 0.9)], lj.Lambertian(0.3)),
    "metal": lj.Stack([], lj.Conductor(0.4, 3.0, 0.9)),
    "haze on metal": lj.Stack([lj.Medium(0.3, 0.9)], lj.Conductor(0.4, 3.0, 0.9)),
}


@pytest.mark.parametrize(
    "name", ["metal", *(pytest.param(name, marks=pytest.mark.slow) for name in ("varnish", "face", "haze on metal"))]
)
def test_values_hold_the_energy_that_is_told(name):
    """All that facets give back is in the values, outside too: 1e-2 is what 32 x 32 directions and 12 nodes err."""
    x, weight = np.polynomial.legendre.leggauss(32)
    cosine, azimuth = np.meshgrid(0.5 * (x + 1.0), (np.arange(32) + 0.5) * np.pi / 32, indexing="ij")
    weights = (weight * 0.5 * (x + 1.0))[:, None] * np.full(32, np.pi / 32)
    wi = lj.direction(1.1, 0.0)
    prepared = lj.prepare(WHOLE[name], lj.AddingDoubling(nodes=12, modes=12, facet_multiple_scattering=True))
    values = lj.evaluate(prepared, wi, lj.direction(np.arccos(cosine), azimuth))[..., 0]
    reflected, _ = lj.albedo(prepared, wi)
    np.testing.assert_allclose(np.sum(weights * np.asarray(values)), reflected[0], rtol=1e-2)
