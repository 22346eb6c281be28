"""Clear slabs, in which light is kept by total reflection: solved on two grids of nodes, and along the normal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj

WI, WO = lj.direction(0.84, 0.0), lj.direction(1.14, 2.9)


@pytest.mark.slow
def test_a_slab_of_low_index_settles() -> None:
    """Where it is known that the index below is that above, they share panels of nodes; traced, each has its own. With
    12 nodes the two differ by 3e-3, with 24 by 2e-5; a blur of rays over the edges of panels makes that 1e-2."""

    def value(ior) -> jax.Array:
        stack = lj.Stack([lj.Interface(ior, 0.55), lj.Interface(1.0, 0.2)])
        return lj.evaluate(stack, WI, WO, lj.AddingDoubling(nodes=24, modes=24))[0]

    assert float(jax.jit(value)(1.2)) == pytest.approx(float(value(1.2)), rel=5e-4)


@pytest.mark.slow
def test_derivatives_along_the_normal_are_finite() -> None:
    """In single precision too, where the sine along the normal is none, and lobes through equal indices are needles."""
    down, up = jnp.asarray([0.0, 0.0, 1.0], jnp.float32), jnp.asarray([0.0, 0.0, -1.0], jnp.float32)

    def value(alphas, wi, wo) -> jax.Array:
        stack = lj.Stack([lj.Interface(1.0001, alphas[0]), lj.Interface(1.0001, alphas[1])])
        return lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=4, modes=4))[0]

    slopes = jax.jit(jax.grad(value, (0, 1, 2)))
    for alphas in ((0.3, 0.2), (0.004, 1e-4)):
        for wi, wo in ((down, up), (up, down)):
            found = slopes(jnp.asarray(alphas, jnp.float32), wi, wo)
            assert all(np.isfinite(part).all() for part in found)
