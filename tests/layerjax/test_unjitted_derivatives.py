"""Derivatives outside of ``jit``, which have a rule of their own, are those within it."""

import importlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax._jacobian import MOST_PARAMETERS, MOST_SLOPES, has_few_parameters
from layerjax.transport.adding_doubling.elements import linearize_element
from layerjax.transport.adding_doubling.solve import Plan, _interface, _interface_step
from tests.helpers.compilations import compiled_by

TRANSPORT = lj.AddingDoubling(nodes=3, modes=2, ordinates=(2, 4))
EVALUATING = importlib.import_module("layerjax.evaluate")
"""`layerjax.evaluate` by attribute is the function."""

WI, WO = lj.direction(0.5, 0.0), lj.direction([0.3, 0.9], 3.0)
WEIGHTS = np.array([[1.0], [2.0]])


def coat(x):
    haze = lj.Medium(x["thickness"], x["albedo"], lj.HenyeyGreenstein(0.5))
    return lj.Stack([lj.Interface(x["ior"], x["alpha"]), haze], lj.Lambertian(x["base"]))


def slab(x):
    haze = lj.Medium(x["thickness"], x["albedo"])
    return lj.Stack([lj.Interface(x["ior"], x["alpha"]), haze, lj.Interface(1.0, 0.3)])


def haze(x):
    return lj.Stack([lj.Medium(x["thickness"], x["albedo"])], lj.Lambertian(x["base"]))


def turbid(x):
    return lj.Stack([lj.TurbidMedium(0.5, x["thickness"], x["alpha"])], lj.Lambertian(x["base"]))


def varnish(x):
    return lj.Stack([lj.Interface(x["ior"], x["alpha"])], lj.Lambertian(x["base"]))


STACKS = {"coat": coat, "slab": slab, "haze": haze, "turbid": turbid, "varnish": varnish}
AT = {"ior": 1.5, "alpha": 0.2, "thickness": 0.7, "albedo": 0.9, "base": 0.4}


def total(name, transport=TRANSPORT, **others):
    def function(x):
        return jnp.sum(WEIGHTS * lj.evaluate(STACKS[name](AT | others | x), WI, WO, transport))

    return function


def same(found, expected, tolerance=1e-11):
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance)


@pytest.fixture
def ruled(monkeypatch):
    """How often the rule was used."""
    calls, rule = [], EVALUATING.differentiate_by_parameters
    monkeypatch.setattr(EVALUATING, "differentiate_by_parameters", lambda *given: calls.append(1) or rule(*given))
    return calls


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "haze" else pytest.mark.slow) for name in STACKS]
)
def test_gradients_are_those_within_jit(name, ruled):
    function = total(name)
    value, gradient = jax.value_and_grad(function)(AT)
    assert len(ruled) == 1
    expected = jax.jit(jax.value_and_grad(function))(AT)
    same((value, gradient), expected)
    assert len(ruled) == 1
    same(value, function(AT), 1e-12)


@pytest.mark.slow
def test_jacobians_forward_and_backward_are_those_within_jit(ruled):
    def values(x):
        return lj.evaluate(coat(AT | x), WI, WO, TRANSPORT)

    at = {"alpha": 0.2, "base": jnp.asarray([0.4, 0.5])}
    forward, backward = jax.jacfwd(values)(at), jax.jacrev(values)(at)
    assert len(ruled) == 2
    same(forward, jax.jit(jax.jacfwd(values))(at))
    same(backward, forward)
    assert forward["base"].shape == (2, 2, 2)
    value, change = jax.jvp(values, (at,), (jax.tree.map(jnp.ones_like, at),))
    same(change, forward["alpha"] + jnp.sum(forward["base"], axis=-1))
    same(value, values(at), 1e-12)


@pytest.mark.parametrize("number", [pytest.param("alpha", marks=pytest.mark.slow), "thickness"])
def test_a_gradient_by_one_number_agrees_with_differences(number):
    """Of the others all is known: that the resolution, and the order of indices, are chosen by them does not change."""

    def function(value):
        return total("coat", "auto")({number: value})

    step = 1e-5
    difference = (function(AT[number] + step) - function(AT[number] - step)) / (2 * step)
    same(jax.grad(function)(AT[number]), difference, 1e-6)


@pytest.mark.slow
def test_derivatives_of_derivatives(ruled):
    """One within the other, and twice by one number, are as within jit."""

    def function(albedo, thickness):
        return total("haze")({"base": albedo, "thickness": thickness})

    mixed = jax.grad(lambda albedo: jax.grad(function, 1)(albedo, 0.7))
    same(mixed(0.4), jax.jit(mixed)(0.4), 1e-9)
    hessian = jax.hessian(lambda albedo: function(albedo, 0.7))
    same(hessian(0.4), jax.jit(hessian)(0.4), 1e-9)


@pytest.mark.slow
def test_gradients_of_many_stacks_are_those_of_each(ruled):
    def function(thickness):
        return total("haze")({"thickness": thickness})

    at = jnp.asarray([0.3, 0.7])
    many = jax.vmap(jax.grad(function))(at)
    assert not ruled
    same(many, jnp.stack([jax.grad(function)(one) for one in at]))
    assert len(ruled) == 2
    same(jax.grad(lambda x: jnp.sum(jax.vmap(function)(x)))(at), many)


def test_within_programs_nothing_is_ruled(ruled):
    function = total("haze")
    for program in (
        lambda: jax.jit(jax.grad(function))(AT),
        lambda: jax.grad(jax.jit(function))(AT),
        lambda: jax.grad(jax.checkpoint(function))(AT),
    ):
        jax.eval_shape(program)
        assert not ruled


def test_precision_is_that_of_the_directions(ruled):
    wi, wo = (jnp.asarray(w, jnp.float32) for w in (WI, WO))
    found = jax.grad(lambda x: jnp.sum(WEIGHTS * lj.evaluate(haze(AT | x), wi, wo, TRANSPORT)))({"base": 0.4})
    assert len(ruled) == 1
    assert found["base"].dtype == jnp.float64
    same(found, jax.grad(total("haze"))({"base": 0.4}), 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("ior", "alpha"), [(1.5, 0.01), (0.8, 0.2)])
def test_single_precision_derivatives_of_interfaces_are_right_to_single_precision(ior, alpha):
    """They are differences in double precision. Differentiated in single precision they would be off by 5e-4."""
    plan = Plan(nodes=6, modes=2, azimuths=None, ranks=None, multiple=False)
    options = (plan, "ggx", True, "diffuse", 0)
    cosines = np.array([1.0, 0.5, 0.1])
    at = (1.0, float(np.float32(ior))), float(np.float32(alpha))

    def linear(dtype):
        numbers = jax.tree.map(lambda number: jnp.asarray(number, dtype), at)
        along, found = jnp.asarray(cosines, dtype), []
        jax.linearize(lambda ior: found.append(element(ior, numbers, along, dtype)) or ior, numbers[0][1])
        return jax.tree.leaves(found[0].slopes)

    def element(ior, numbers, along, dtype):
        parameters = (numbers[0][0], ior), numbers[1]
        return linearize_element(_interface, options, parameters, along, dtype, _interface_step)

    for single, double in zip(linear(jnp.float32), linear(jnp.float64), strict=True):
        assert single.dtype == jnp.float32
        np.testing.assert_allclose(single, double, rtol=0.0, atol=1e-5 * float(jnp.max(jnp.abs(double))))


@pytest.mark.parametrize(("ior", "alpha"), [(1.0, 0.2), (1.5, 1.0), (1.5, 1e-4)])
def test_where_derivatives_are_one_sided_no_differences_are_taken(ior, alpha):
    assert _interface_step(((1.0, ior), alpha)) is None


def test_many_numbers_and_large_batches_are_differentiated_on_the_way_back():
    seen = []

    def function(x, values):
        seen.append(has_few_parameters({"known": 1.0, "x": x}, values))
        return jnp.sum(x)

    jax.grad(function)(jnp.ones(MOST_PARAMETERS), 10)
    jax.grad(function)(jnp.ones(MOST_PARAMETERS + 1), 10)
    jax.grad(function)(jnp.ones(2), MOST_SLOPES)
    jax.vmap(jax.grad(function), (0, None))(jnp.ones((2, 2)), 10)
    jax.jit(jax.grad(function), static_argnums=1)(jnp.ones(2), 10)
    function(jnp.ones(2), 10)
    assert seen == [True, False, False, False, False, False]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "transport"),
    [
        ("haze", lj.Statistical()),
        ("coat", lj.Statistical()),
        ("haze", lj.SpongeCake()),
        ("varnish", lj.WeidlichWilkie()),
    ],
)
def test_published_models_have_the_rule_too(name, transport, ruled):
    function = total(name, transport)
    same(jax.value_and_grad(function)(AT), jax.jit(jax.value_and_grad(function))(AT))
    assert len(ruled) == 1


@pytest.mark.slow
def test_of_mirrors_statistical_is_traced(ruled):
    """Known to be as narrow as can be, they have a closed form."""

    def function(ior):
        return jnp.sum(
            lj.evaluate(lj.Stack([lj.Interface(ior, 1e-4)], lj.Conductor(0.2, 3.0, 0.3)), WI, WO, lj.Statistical())
        )

    same(jax.grad(function)(1.5), jax.jit(jax.grad(function))(1.5))
    assert not ruled


def test_of_other_transports_all_is_traced(ruled):
    function = total("haze", lj.SingleScattering())
    same(jax.grad(function)(AT), jax.jit(jax.grad(function))(AT))
    assert not ruled


@pytest.mark.slow
def test_another_stack_finds_its_interface_compiled():
    wi, wo = (jnp.asarray(w, jnp.float32) for w in (WI, WO))

    def value(stack):
        return lj.evaluate(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), stack), wi, wo, TRANSPORT)

    def gradient(stack):
        return eqx.filter_grad(lambda stack: jnp.sum(value(stack)))(stack)

    interface, haze = lj.Interface(1.5, 0.2), lj.Medium(0.7, 0.9, lj.HenyeyGreenstein(0.5))
    for call in (value, gradient):
        call(lj.Stack([interface, haze], lj.Lambertian(0.4)))
        others = lj.Stack([interface, haze], lj.OrenNayar(0.4, 0.3)), lj.Stack([interface], lj.Lambertian(0.4))
        for other in others:
            programs = compiled_by(lambda call=call, other=other: call(other))
            assert programs
            assert not [name for name in programs if "at_once" in name]
