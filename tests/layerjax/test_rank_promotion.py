"""Where a user forbids arrays of different ranks to broadcast, that is of their own code: values and slopes stay."""

import contextlib

import jax
import numpy as np
import pytest

import layerjax as lj

WI, WO = lj.direction(0.5, 0.0), lj.direction([0.3, 0.6], 3.1)
KEY = jax.random.key(0)


def _haze(alpha):
    return lj.Stack([lj.Medium(0.5, [0.9, 0.8, 0.7], lj.HenyeyGreenstein(0.5 * alpha))], lj.Lambertian(0.4))


def _coat(alpha):
    return lj.Stack([lj.Interface(1.5, alpha)], lj.Conductor([0.2, 0.9, 1.1], 3.9, 0.2))


def _coated_haze(alpha):
    return lj.Stack([lj.Interface(1.5, alpha), *_haze(0.5).layers], lj.Lambertian(0.4))


CASES = {
    "SingleScattering": (lj.SingleScattering(), _haze),
    "SpongeCake": (lj.SpongeCake(), _haze),
    "WeidlichWilkie": (lj.WeidlichWilkie(), _coat),
    "ENDF": (lj.ENDF(), _coat),
    "Statistical, coated metal": (lj.Statistical(), _coat),
    "Statistical, coated haze": (lj.Statistical(), _coated_haze),
    "AddingDoubling": (lj.AddingDoubling(nodes=6, modes=4), _coated_haze),
    "AddingDoubling, haze": (lj.AddingDoubling(nodes=6, modes=4), _haze),
    "RandomWalk": (lj.RandomWalk(paths=64), _coated_haze),
}


def _total(transport, stack_of):
    return lambda alpha: lj.evaluate(stack_of(alpha), WI, WO, transport, key=KEY).sum()


@contextlib.contextmanager
def _fresh():
    """Nothing that was traced before is taken for this."""
    jax.clear_caches()
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.mark.parametrize("name", CASES)
def test_values_can_be_traced(name):
    with jax.numpy_rank_promotion("raise"):
        jax.make_jaxpr(_total(*CASES[name]))(0.3)


@pytest.mark.parametrize(
    "name",
    [
        "SingleScattering",
        "WeidlichWilkie",
        "Statistical, coated metal",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("SpongeCake", "ENDF", "Statistical, coated haze", "AddingDoubling")
        ),
    ],
)
def test_slopes_can_be_traced(name):
    """Around a program as well, where its derivatives are traced by themselves."""
    with jax.numpy_rank_promotion("raise"):
        jax.make_jaxpr(jax.grad(jax.jit(_total(*CASES[name]))))(0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_values_stay(name):
    """Where the numbers of the stack are known, too."""
    total = _total(*CASES[name])
    usual = total(0.3)
    with _fresh():
        np.testing.assert_allclose(total(0.3), usual, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SingleScattering", "WeidlichWilkie", "AddingDoubling, haze"])
def test_slopes_stay(name):
    """Where the numbers of the stack are known, too: elements of the solver are then linearised apart."""
    total = _total(*CASES[name])
    functions = [jax.grad(total), jax.grad(jax.jit(total))]
    usual = [function(0.3) for function in functions]
    with _fresh():
        np.testing.assert_allclose([function(0.3) for function in functions], usual, rtol=1e-13)


@pytest.mark.parametrize("function", ["sample", "pdf", "albedo", "prepare", "unscattered"])
def test_so_do_all_other_functions(function):
    stack, transport = _haze(0.3), lj.SingleScattering()
    calls = {
        "sample": lambda: lj.sample(stack, WI, KEY, transport),
        "pdf": lambda: lj.pdf(stack, WI, WO, transport),
        "albedo": lambda: lj.albedo(stack, WI, transport, nodes=4),
        "prepare": lambda: lj.evaluate(lj.prepare(stack, transport), WI, WO),
        "unscattered": lambda: lj.unscattered(stack, WI),
    }
    with jax.numpy_rank_promotion("raise"):
        calls[function]()
