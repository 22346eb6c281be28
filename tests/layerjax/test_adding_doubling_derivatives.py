"""Derivatives of adding-doubling: against differences, and finite over the documented box."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import layerjax as lj
from layerjax import HenyeyGreenstein, Interface, Lambertian, Medium, Stack

SMALL = lj.AddingDoubling(nodes=5, modes=4, ordinates=(4, 4))
STEP = 1e-6
"""Short, for the facets that a change of index takes across the critical angle, where the slope is infinite."""

STACKS = {
    "haze, albedo 1 and thickness 0": Stack([Medium([1.3, 0.0], [1.0, 0.9], HenyeyGreenstein(0.5))]),
    "flakes over nothing over paint": Stack(
        [Medium(0.8, 0.9, lj.SGGX("surface", 0.3), f0=0.1), Medium(0.0, 1.0, HenyeyGreenstein(0.2))], Lambertian(0.6)
    ),
    "plate": Stack([Interface(1.4, 0.2), Medium(0.7, 0.9, HenyeyGreenstein(0.2)), Interface(1.1, 0.3)]),
    "coated metal": Stack([Interface(1.3, 0.3)], lj.Conductor(0.3, 3.0, 0.3)),
    "tilted fibers": Stack([Medium(0.7, 1.0, lj.SGGX("fiber", 0.4, axis=(0.4, 0.3, 0.8)), f0=0.3)], Lambertian(0.5)),
}

QUICK = ("haze, albedo 1 and thickness 0",)
"""Those whose derivatives compile fast."""


def pairs(stack):
    wi = lj.direction(jnp.asarray([0.3, 1.0, 0.6, 2.4]), jnp.asarray([0.0, 0.3, 0.1, 1.0]))
    wo = lj.direction(jnp.asarray([0.7, 0.4, 2.2, 2.6]), jnp.asarray([2.0, 3.3, 1.0, 4.0]))
    if stack.base is None:
        return wi, wo
    return tuple(w.at[:, 2].set(jnp.abs(w[:, 2])) for w in (wi, wo))


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in STACKS]
)
def test_derivatives_by_differences(name):
    stack = STACKS[name]
    start, build = ravel_pytree(stack)
    wi, wo = pairs(stack)
    weight = jnp.asarray(np.random.default_rng(0).uniform(0.5, 1.0, (4, stack.channels)))

    def value(parameters):
        return jnp.sum(weight * lj.evaluate(build(parameters), wi, wo, SMALL))

    compiled = jax.jit(value)
    reverse = np.asarray(jax.jit(jax.grad(value))(start))
    differences = []
    for index, number in enumerate(np.asarray(start)):
        step = STEP * max(abs(number), 0.1)
        move = jnp.zeros_like(start).at[index].set(step)
        if number in (0.0, 1.0):  # on an edge of the box: one-sided, of second order
            move = move if number == 0.0 else -move
            rise = -3 * compiled(start) + 4 * compiled(start + move) - compiled(start + 2 * move)
            differences.append(float(rise / (2 * move[index])))
        else:
            differences.append(float((compiled(start + move) - compiled(start - move)) / (2 * step)))
    # 1e-5 of each derivative; rounding leaves 1e-16 / STEP of the value in a difference
    np.testing.assert_allclose(reverse, differences, rtol=1e-5, atol=1e-8 * np.abs(differences).max())


def test_both_modes_agree():
    stack = STACKS["haze, albedo 1 and thickness 0"]
    start, build = ravel_pytree(stack)
    wi, wo = pairs(stack)

    def value(parameters):
        return jnp.sum(lj.evaluate(build(parameters), wi, wo, SMALL))

    np.testing.assert_allclose(
        jax.jit(jax.grad(value))(start), jax.jit(jax.jacfwd(value))(start), rtol=1e-9, atol=1e-14
    )


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


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [
        ("faces", "float32"),
        pytest.param("metal", "float64", marks=pytest.mark.slow),
        pytest.param("tilted", "float32", marks=pytest.mark.slow),
        pytest.param("media", "float32", marks=pytest.mark.slow),
        pytest.param("media", "float64", marks=pytest.mark.slow),
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
