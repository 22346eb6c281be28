"""Clear slabs, in which light is kept by total reflection: a coarse solver beside a fine one, and beside walks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj

WI, WO = lj.direction(0.84, 0.0), lj.direction(1.14, 2.9)


@pytest.mark.parametrize("known", [True, False], ids=["indices known", "traced"])
def test_a_slab_of_low_index_settles(known: bool) -> None:
    """Between 12 and 24 nodes within 4e-3, as the distance of the coarser ones says, and the walk agrees with them."""

    def value(ior, nodes: int) -> jax.Array:
        stack = lj.Stack([lj.Interface(ior, 0.55), lj.Interface(1.0, 0.2)])
        return lj.evaluate(stack, WI, WO, lj.AddingDoubling(nodes=nodes, modes=nodes))[0]

    coarse, fine = (float((value if known else jax.jit(value, static_argnums=1))(1.2, nodes)) for nodes in (12, 24))
    assert coarse == pytest.approx(fine, rel=4e-3)
    stack = lj.Stack([lj.Interface(1.2, 0.55), lj.Interface(1.0, 0.2)])
    walked, error = lj.evaluate_with_error(stack, WI, WO, lj.RandomWalk(paths=2**16), key=jax.random.key(3))
    assert abs(fine - float(walked[0])) < 4.0 * float(error[0]) + 1e-3 * fine
    assert np.isfinite(jnp.asarray(fine))
