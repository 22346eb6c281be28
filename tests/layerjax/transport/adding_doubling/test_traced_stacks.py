"""The default gives the same under `jit`, `grad` and `vmap` as without, and its slopes are right."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax._concrete import concrete_values
from tests.helpers.random_stacks import STRUCTURES, drawn, lengths

WI = lj.direction(np.radians(20.0), 0.0)
WO = lj.direction(np.radians([3.0, 25.0, 50.0, 60.0, 75.0]), np.pi)
TOLERANCE = 1e-3
"""What is aimed at; relative to values and a tenth of their mean."""


def assert_near(found, value, tolerance):
    value = np.asarray(value)
    assert np.max(np.abs(np.asarray(found) - value) / (value + 0.1 * value.mean())) < tolerance


def values_of(kind, transport="auto"):
    return lambda numbers: lj.evaluate(STRUCTURES[kind][1](numbers), WI, WO, transport)[:, 0]


@pytest.mark.slow
def test_a_coated_metal_under_jit():
    """Values of a walk, with three of its standard errors at most."""

    def stack(alpha):
        return lj.Stack([lj.Interface(1.5, 0.05)], lj.Conductor(0.2, 3.5, alpha))

    def values(alpha):
        return lj.evaluate(stack(alpha), WI, WO)[:, 0]

    alpha = jnp.asarray(0.05)
    walked = np.array([0.661, 7.086, 0.1806, 0.0898, 0.0541])
    plain, jitted = values(alpha), jax.jit(values)(alpha)
    np.testing.assert_allclose(plain, walked, rtol=0.01)
    assert_near(jitted, plain, TOLERANCE)
    slope = jax.jit(jax.jacfwd(values))(alpha)
    np.testing.assert_allclose(slope, [11.2, -140.0, 4.8, 2.7, 1.5], rtol=0.03, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("kind", STRUCTURES)
def test_transformations_keep_values(kind):
    """Of three stacks of a structure: jitted, where nothing is known of them, and two of them under `vmap`."""
    values = values_of(kind)
    some = [drawn(kind, seed) for seed in range(3)]
    plain, jitted = [values(numbers) for numbers in some], jax.jit(values)
    for numbers, value in zip(some, plain, strict=True):
        assert_near(jitted(numbers), value, 2.0 * TOLERANCE)
    for row, value in zip(jax.vmap(values)(jnp.stack(some[:2])), plain, strict=False):
        assert_near(row, value, 2.0 * TOLERANCE)


def slopes_by_each(kind, numbers, transport="auto"):
    """Values, and slopes (numbers, pairs): by widths and thicknesses by their share, by all others themselves."""

    def values(numbers):
        found = values_of(kind, transport)(numbers)
        return found, found

    slopes, found = jax.jacfwd(values, has_aux=True)(numbers)
    return np.asarray(found), np.asarray(slopes).T * lengths(STRUCTURES[kind][1](numbers), numbers)[:, None]


@pytest.mark.slow
@pytest.mark.parametrize("kind", STRUCTURES)
def test_values_and_slopes_under_grad(kind):
    """Slopes by each parameter are right to 1 % of the values, by widths and thicknesses for a change by their share:
    by itself a width of 0.05 changes values 20 times as much."""
    numbers = drawn(kind, 2)
    plain = values_of(kind)(numbers)
    differentiated, slopes = slopes_by_each(kind, numbers)
    assert_near(differentiated, plain, 1e-8)  # the same resolution: rounding of nearly conserving slabs alone
    fine = lj.choose_transport(STRUCTURES[kind][1](numbers), WI, WO).finer().finer()
    exact = slopes_by_each(kind, numbers, fine)[1]
    off = np.max(np.abs(slopes - exact) / (plain + 0.1 * plain.mean()), axis=1)
    assert np.all(off < 0.01), off


@pytest.mark.slow
def test_slopes_by_a_narrow_coat():
    """By the width itself 3 % of the values are left at the 6 nodes that are chosen, and 12 leave 0.3 %."""
    numbers = drawn("coated metal", 2)
    chosen = lj.choose_transport(STRUCTURES["coated metal"][1](numbers), WI, WO)
    by_nodes = {}
    for nodes in (chosen.nodes, 12, 24):
        values = values_of("coated metal", lj.AddingDoubling(nodes=nodes, modes=chosen.modes))
        by_nodes[nodes] = jax.jit(jax.jvp, static_argnums=0)(values, (numbers,), (jnp.eye(5)[1],))
    plain, exact = by_nodes[24]
    scale = np.asarray(plain + 0.1 * plain.mean())
    off = {nodes: np.max(np.abs(slope - exact) / scale) for nodes, (_, slope) in by_nodes.items()}
    assert chosen.nodes == 6
    assert off[6] < 0.035
    assert off[12] < 0.005


def test_what_is_known_under_transformations():
    seen = []

    def look(number):
        seen.append(concrete_values(lj.Interface(1.5, number).alpha))
        seen.append(concrete_values(lj.Interface(number, 0.25).alpha))
        return number

    jax.grad(look)(0.5)
    jax.jacfwd(look)(0.5)
    jax.vmap(look)(jnp.asarray([0.5, 0.75]))
    jax.jit(look)(0.5)
    jax.jit(jax.grad(look))(0.5)
    numbers = [None if one is None else one.tolist() for one in seen]
    assert numbers == [0.5, 0.25, 0.5, 0.25, [0.5, 0.75], 0.25, None, 0.25, None, 0.25]


def test_directions_written_into_a_program_stay_known():
    seen = []
    jax.jit(lambda one: seen.append(concrete_values(lj.direction(0.5, 0.0))) or one)(1.0)
    assert seen[0] is not None


def test_too_narrow_a_lobe_is_told():
    narrow = lj.Stack([lj.Interface(1.5, 0.01)], lj.Conductor(0.2, 3.5, 1e-3))
    with pytest.warns(
        lj.ResolutionWarning, match=r"too narrow for an error of 1e-3: .* nodes and .* modes, where about"
    ):
        lj.choose_transport(narrow, WI, WO)
    assert lj.choose_transport(narrow, WI, WO, lj.AddingDoubling(nodes=6)).nodes == 6


def test_a_guess_under_jit_is_told():
    """Where lobes inside are of no known width, and only there."""

    def warned(stack, transport="auto"):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            jax.eval_shape(lambda number: [number, lj.choose_transport(stack(number), WI, WO, transport)][0], 0.3)
        return [str(warning.message) for warning in caught if issubclass(warning.category, lj.ResolutionWarning)]

    guessed = {
        "metal": lambda alpha: lj.Stack([lj.Interface(1.5, 0.2)], lj.Conductor(0.2, 3.5, alpha)),
        "inner interface": lambda alpha: lj.Stack(
            [lj.Interface(1.5, 0.2), lj.Interface(1.3, alpha)], lj.Lambertian(0.5)
        ),
        "index of three": lambda ior: lj.Stack(
            [lj.Interface(1.5, 0.2), lj.Interface(1.0 + ior, 0.2), lj.Interface(1.0, 0.2)]
        ),
        "haze": lambda g: lj.Stack([lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(g))], lj.Lambertian(0.5)),
        "flakes": lambda alpha: lj.Stack([lj.Medium(1.0, 0.9, lj.SGGX("surface", alpha))], lj.Lambertian(0.5)),
    }
    known = {
        "coat over paint": lambda alpha: lj.Stack([lj.Interface(1.5, alpha)], lj.Lambertian(0.5)),
        "bare metal": lambda alpha: lj.Stack([], lj.Conductor(0.2, 3.5, alpha)),
        "thickness": lambda depth: lj.Stack([lj.Medium(depth, 0.9, lj.HenyeyGreenstein(0.5))], lj.Lambertian(0.5)),
    }
    assert {name for name, stack in (guessed | known).items() if warned(stack)} == set(guessed)
    assert "transport=lj.choose_transport(stack, wi, wo)" in warned(guessed["metal"])[0]
    assert not warned(guessed["metal"], lj.choose_transport(guessed["metal"](0.3), WI, WO))
