"""Stiff and extreme stacks: lossless ones keep all energy, and many layers stay finite with their derivatives."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj

SOLVER = lj.AddingDoubling(nodes=12, modes=1, facet_multiple_scattering=True)
ANGLES = jnp.concatenate([polar := jnp.linspace(0.0, 1.56, 9), np.pi - polar])


@jax.jit
def missing(ior, alpha, below, thickness, g):
    """Energy that a lossless slab loses or gains, for light from either side."""
    medium = lj.Medium(thickness, jnp.ones_like(thickness), lj.HenyeyGreenstein(g))
    stack = lj.Stack([lj.Interface(ior, alpha), medium, lj.Interface(below, alpha)])
    reflected, transmitted = lj.albedo(stack, lj.direction(ANGLES, 0.2), SOLVER)
    return jnp.max(jnp.abs(reflected + transmitted - 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.3, 1e-4, 0.02, 0.1, 1.0])
def test_lossless_slabs_keep_their_energy(alpha):
    """Rounding alone is lost: 1e-12, and 3e-7 of the finest roughness next to an index of 1, where what is turned back
    is known to a table's rounding."""
    for ior, below in ((1.5, 1.0), (4.0, 1.0), (4.0, 1.5), (1.2, 1.0), (1.05, 1.0), (0.5, 1.0), (0.25, 1.0),
                       (1.5, 1.5 + 1e-7), (1.0 + 1e-7, 1.0), (1.0 - 1e-7, 1.0), (1.0, 1.0)):  # fmt: skip
        assert missing(ior, alpha, below, 1.0, 0.3) < 1e-6, (ior, below)


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [1e-4, 1.0])
def test_lossless_media_in_a_slab_keep_their_energy(alpha):
    """Peaks too narrow for the nodes among them, whose energy interpolation takes below 0 on one side."""
    for thickness, g in itertools.product((1e-8, 1.0, 1e4), (-0.999, 0.0, 0.999)):
        for ior, below in ((1.5, 1.0), (1.0, 1.0), (4.0, 1.5)):
            assert missing(ior, alpha, below, thickness, g) < 1e-6, (ior, below, thickness, g)


@pytest.mark.slow
def test_twelve_layers():
    """Extreme ones upon one another: finite values and gradients, and all energy is kept."""
    iors = jnp.asarray([1.5, 4.0, 1.5, 1.5 + 1e-7, 4.0, 1.0])
    alphas = jnp.asarray([1e-4, 0.1, 1.0, 0.2, 1e-3, 0.3])
    thicknesses = jnp.asarray([1e4, 1e-8, 1.0, 1e-3, 0.0, 10.0])
    peaks = jnp.asarray([0.999, -0.999, 0.0, 0.5, 0.9, -0.5])
    given = (iors, alphas, thicknesses, peaks)

    def stack(iors, alphas, thicknesses, peaks):
        layers = []
        for k in range(6):
            layers.append(lj.Interface(iors[k], alphas[k]))
            layers.append(lj.Medium(thicknesses[k], jnp.ones(()), lj.HenyeyGreenstein(peaks[k])))
        return lj.Stack(layers, lj.Lambertian(1.0))

    solver = lj.AddingDoubling(nodes=6, modes=4, facet_multiple_scattering=True)
    wi, wo = lj.direction(jnp.asarray([0.0, 0.7, 1.5]), 0.0), lj.direction(jnp.asarray([0.1, 0.7, 1.4]), 2.0)

    @jax.jit
    def both(*given):
        def total(*given):
            values = lj.evaluate(stack(*given), wi, wo, solver)
            return jnp.sum(values), values

        return jax.grad(total, (0, 1, 2, 3), has_aux=True)(*given)

    slopes, values = both(*given)
    assert np.isfinite(values).all()
    assert (np.asarray(values) >= 0).all()
    for slope in slopes:
        assert np.isfinite(slope).all()
    reflected, _ = jax.jit(lambda *given: lj.albedo(stack(*given), wi, solver))(*given)
    np.testing.assert_allclose(reflected, 1.0, atol=1e-6)
