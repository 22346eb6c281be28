"""What shares a program: interfaces are what they are with one each, and thicknesses of double precision do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.transport.adding_doubling import solve
from layerjax.transport.adding_doubling.resolution import Resolution

NUMBERS = jnp.asarray([1.5, 1.2, 0.3, 0.2])


def operators(numbers):
    """Of two interfaces over paint."""
    layers = [lj.Interface(numbers[k], numbers[2 + k]) for k in range(2)]
    stack = lj.Stack(layers, lj.Lambertian(0.5))
    return solve.solve(stack, solve.make_plan(stack, Resolution(2, 1, (2, 4)), False))[1]


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_thicknesses_share_a_program(dtype):
    stacks = [jax.tree.map(lambda x: jnp.asarray(x, dtype), lj.Stack([lj.Medium(tau)])) for tau in (1.0, 10.0)]
    thin, thick = (solve.make_plan(stack, Resolution(2, 1, (2, 4)), False) for stack in stacks)
    assert thin == thick


@pytest.mark.slow
def test_many_interfaces_are_what_each_is_alone(monkeypatch):
    """Values and slopes."""

    def slopes(numbers):
        return jax.jvp(operators, (numbers,), (jnp.ones_like(numbers),))

    monkeypatch.setattr(solve, "MANY", 2)
    shared = jax.jit(lambda numbers: slopes(numbers))(NUMBERS)
    monkeypatch.setattr(solve, "MANY", 99)
    alone = jax.jit(lambda numbers: slopes(numbers))(NUMBERS)
    for found, expected in zip(jax.tree.leaves(shared), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
