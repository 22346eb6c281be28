"""Interfaces of the solver that give back what masking loses: energies of both sides, against the walk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj

SOLVER = lj.AddingDoubling(nodes=24, modes=1, microfacets="multiple")


def test_energy_from_the_denser_side():
    """Index 2, roughness 0.3: nothing is lost, at the critical angle (30 degrees) neither; 1e-3 is what facets err."""
    angle = np.radians([0.0, 10.0, 29.9, 30.0, 30.1, 35.0, 60.0, 85.0])
    inside = lj.direction(np.pi - angle, 0.0)
    reflected, transmitted = lj.albedo(lj.Stack([lj.Interface(2.0, 0.3)]), inside, SOLVER)
    np.testing.assert_allclose(reflected + transmitted, 1.0, atol=1e-3)


@pytest.mark.parametrize(("ior", "alpha"), [(1.5, 0.1), (1.5, 0.6)])
def test_what_crosses_is_what_the_walk_counts(ior, alpha):
    """4 standard errors, and 2e-3 of the energies that decide which side the light ends on."""
    stack = lj.Stack([lj.Interface(ior, alpha)])
    wi = lj.direction(jnp.radians(jnp.array([0.0, 60.0, 85.0])), 0.0)
    seen = lj.goniophotometer(
        stack, wi, key=jax.random.key(0), paths=1 << 16, polar=1, azimuth=1, orders=1, microfacets="multiple"
    )
    _, transmitted = lj.albedo(stack, wi, SOLVER)
    assert np.all(np.abs(transmitted[:, 0] - seen.albedo[:, 1, 0]) < 4 * seen.albedo_error[:, 1, 0] + 2e-3)
