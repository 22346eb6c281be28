"""Derivatives of adding-doubling are finite over the documented box; `test_derivatives` compares them with values."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax import HenyeyGreenstein, Interface, Medium, Stack
from layerjax.transport.adding_doubling.elements import element

SMALL = lj.AddingDoubling(nodes=5, modes=4, ordinates=(4, 4))


def edge(generator, low, high):
    """A number in the box, half of the time on its edge."""
    return generator.choice([low, high, generator.uniform(low, high), generator.uniform(low, high)])


def extreme_stack(kind, generator):
    def haze():
        g = edge(generator, -0.999, 0.999)
        thickness = generator.choice([0.0, 1e-6, 1.0, 1e4])
        return Medium(thickness, edge(generator, 0.0, 1.0), HenyeyGreenstein(g), f0=edge(generator, 0.0, 1.0))

    def flakes(axis):
        alpha = 10.0 ** edge(generator, -4.0, 0.0)
        return Medium(
            generator.choice([0.0, 1.0, 1e4]),
            edge(generator, 0.0, 1.0),
            lj.SGGX("surface" if axis is None else "fiber", alpha, axis),
        )

    def face():
        return Interface(generator.choice([0.25, 1.0, 1.0001, 1.5, 4.0]), 10.0 ** edge(generator, -4.0, 0.0))

    if kind == "media":
        return Stack([haze(), flakes(None)], lj.OrenNayar(edge(generator, 0.0, 1.0), edge(generator, 0.0, 1.0)))
    if kind == "faces":
        return Stack([face(), haze(), face()])
    if kind == "metal":
        return Stack(
            [haze(), face()], lj.Conductor(0.2, edge(generator, 0.0, 20.0), 10.0 ** edge(generator, -4.0, 0.0))
        )
    return Stack([flakes((1.0, 0.0, 0.0)), haze(), flakes((0.3, 0.2, 0.9))])


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
def test_derivatives_of_many_stacks_side_by_side(mode):
    """Of a batch as a whole, for what the operators of a layer depend on: its index and its phase function."""

    def value(x):
        stack = Stack([Interface(1.2 + x, 0.3), Medium(0.5, 0.9, HenyeyGreenstein(x))], lj.Lambertian(0.5))
        return lj.evaluate(stack, wi, wo, lj.AddingDoubling(nodes=4, modes=2))[0, 0]

    wi, wo = jnp.asarray([[0.0, 0.6, 0.8]]), jnp.asarray([[0.6, 0.0, 0.8]])
    x = jnp.asarray([0.3, 0.4])
    together = jax.jit(mode(lambda x: jnp.sum(jax.vmap(value)(x))))(x)
    values, step = jax.jit(jax.vmap(value)), 1e-5
    np.testing.assert_allclose(together, (values(x + step) - values(x - step)) / (2.0 * step), rtol=1e-6)


@pytest.mark.slow
def test_elements_are_differentiated_by_directions_too():
    """By the numbers that they are made of and by what they are asked for, forward and backward."""

    def value(x, asked):
        return jnp.sum(element(lambda numbers, at: numbers * jnp.sin(at), x, asked, jnp.float64))

    x, asked = jnp.asarray(2.0), jnp.asarray([0.3, 0.5])
    expected = jnp.sum(jnp.sin(asked)), x * jnp.cos(asked)
    for mode in (jax.grad, jax.jacfwd):
        for found, slope in zip(mode(value, (0, 1))(x, asked), expected, strict=True):
            np.testing.assert_allclose(found, slope, rtol=1e-12)
        np.testing.assert_allclose(mode(value, 1)(x, asked), expected[1], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "dtype"),
    [
        ("faces", "float32"),
        ("metal", "float64"),
        ("tilted", "float32"),
        ("media", "float32"),
        ("media", "float64"),
    ],
)
def test_finite_over_the_box(kind, dtype):
    generator = np.random.default_rng(3)
    polar = jnp.asarray([0.0, 0.7, 1.3, np.pi / 2 - 1e-6, np.pi / 2, 2.0, np.pi], dtype)
    i, o, phi = (array.ravel() for array in jnp.meshgrid(polar, polar, jnp.asarray([0.0, 2.0, np.pi], dtype)))
    wi, wo = lj.direction(i, jnp.zeros_like(i)), lj.direction(o, phi)

    def value(stack, wi, wo):
        values = lj.evaluate(stack, wi, wo, SMALL)
        return jnp.sum(jnp.where(values < 1e12, values, 0.0)), values

    both = eqx.filter_jit(eqx.filter_grad(lambda triple: value(*triple), has_aux=True))
    for _ in range(8):
        stack = jax.tree.map(lambda leaf: leaf.astype(dtype), extreme_stack(kind, generator))
        slopes, values = both((stack, wi, wo))
        assert np.isfinite(values).all(), stack
        assert (np.asarray(values) >= 0).all(), stack
        for leaf in jax.tree.leaves(slopes):
            assert np.isfinite(leaf).all(), stack
