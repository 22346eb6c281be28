"""Problems as they are put together: any callable stands for a transport, and what does not fit is refused."""

from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from fits.problem.parameters import Free
from fits.problem.problem import Problem
from fits.problem.simulate import simulate, slices

PAINT = lj.Stack([], lj.Lambertian(Free(0.4, 0.0, 1.0)))
DATA = simulate(lj.Stack([], lj.Lambertian(0.6)), slices(incidence=[20], outgoing=[-40, 10, 70]), noise=0.1)


def lambert(stack: lj.Stack, wi: jax.Array, wo: jax.Array, gain: float = 1.0) -> jax.Array:
    return jnp.broadcast_to(gain * stack.base.albedo / jnp.pi, (len(wi), 1))


@dataclass(frozen=True)
class Plain:
    gain: float

    def __call__(self, stack: lj.Stack, wi: jax.Array, wo: jax.Array) -> jax.Array:
        return lambert(stack, wi, wo, self.gain)


class Module(eqx.Module):
    gain: jax.Array

    def __call__(self, stack: lj.Stack, wi: jax.Array, wo: jax.Array) -> jax.Array:
        return lambert(stack, wi, wo, self.gain)


CALLABLES = {
    "function": (lambert, 1.0),
    "lambda": (lambda stack, wi, wo: lambert(stack, wi, wo, 2.0), 2.0),
    "compiled": (jax.jit(lambert), 1.0),
    "partial": (partial(lambert, gain=0.5), 0.5),
    "bound method": (Plain(3.0).__call__, 3.0),
    "object": (Plain(3.0), 3.0),
    "equinox module": (Module(jnp.asarray(0.25)), 0.25),
}


@pytest.mark.parametrize(("transport", "gain"), CALLABLES.values(), ids=CALLABLES)
def test_any_callable_stands_for_a_transport(transport, gain: float) -> None:
    problem = Problem(PAINT, DATA, transport=transport)
    np.testing.assert_allclose(problem.predict([0.3]), np.full((3, 1), gain * 0.3 / np.pi), rtol=1e-12)
    assert np.isfinite(problem.log_likelihood([0.3]))
    seen = simulate(lj.Stack([], lj.Lambertian(0.3)), slices(incidence=[20], outgoing=[10]), transport=transport)
    np.testing.assert_allclose(seen.values, [[gain * 0.3 / np.pi]], rtol=1e-12)


@pytest.mark.parametrize("transport", [lj.Statistical, "walk", 3])
def test_what_is_no_transport_is_refused(transport) -> None:
    with pytest.raises(ValueError, match=r'transport: .* is not a Transport or "auto"'):
        Problem(PAINT, DATA, transport=transport)


def test_maps_of_stacks_are_refused_by_name() -> None:
    """Also where a parameter makes one; neither fits nor simulations know of texels."""
    rough = lj.Stack([], lj.OrenNayar(Free(0.4, 0.0, 1.0), np.array([0.1, 0.2, 0.3])))
    free = lj.Stack([], lj.OrenNayar(0.4, Free([0.1, 0.2, 0.3], 0.0, 1.0)))
    for stack in (rough, free):
        with pytest.raises(ValueError, match=r"takes one stack; base.roughness of shape \(3,\) makes it a map"):
            Problem(stack, DATA, transport=lj.SingleScattering())
    with pytest.raises(ValueError, match=r"takes one stack; base.roughness of shape \(3,\)"):
        simulate(lj.Stack([], lj.OrenNayar(0.4, np.array([0.1, 0.2, 0.3]))), slices(incidence=[20], outgoing=[10]))


def test_what_holds_channels_together_has_no_weight_beside_a_named_objective() -> None:
    stack = lj.Stack([], lj.Lambertian(Free((0.4, 0.4), 0.0, 1.0, random_walk_sd=0.1)))
    both = replace(DATA, values=np.repeat(DATA.values, 2, axis=1), sigma=None, channels=("a", "b"))
    with pytest.raises(ValueError, match=r"Free.random_walk_sd is 0.1, but has no weight beside objective 'cosine_l2'"):
        Problem(stack, both, objective="cosine_l2")


def test_what_follows_from_a_problem() -> None:
    problem = Problem(PAINT, DATA, scale=Free(1.0, 0.5, 2.0))
    assert problem.names == ("base.albedo", "scale")
    assert (problem.count, problem.units) == (3, {"base.albedo": "1", "scale": "1"})
    np.testing.assert_array_equal([problem.low, problem.start, problem.high], [[0.0, 0.5], [0.4, 1.0], [1.0, 2.0]])
    assert problem.model is problem.model
