"""What tells one fit of a map from another: functions by what they do, wherever they are in memory."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fits.maps.identity import digest


def scaled(factor):
    return lambda stack, wi, wo: factor * wi


def nested(factor):
    return lambda stack, wi, wo: jax.tree.map(lambda one: factor * one, wi)


def recursive(limit):
    def down(count):
        return 0 if count > limit else down(count + 1)

    return down


class Scaled:
    def __init__(self, factor):
        self.factor = jnp.asarray(factor)

    def __repr__(self):
        return f"Scaled({self.factor})"

    def transport(self, stack, wi, wo):
        return self.factor * wi


KINDS = {
    "closure": scaled,
    "array": lambda factor: scaled(factor * np.arange(3.0)),
    "nested": nested,
    "partial": lambda factor: functools.partial(scaled(1.0), wi=factor),
    "compiled": lambda factor: jax.jit(scaled(factor)),
    "recursive": recursive,
    "method": lambda factor: Scaled(factor).transport,
    "of a function": lambda factor: scaled(scaled(factor)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_function_is_known_again_by_what_it_holds(kind):
    made = KINDS[kind]
    assert digest({"of": made(2.0)}) == digest({"of": made(2.0)}) != digest({"of": made(3.0)})


def test_a_function_is_told_from_others_of_its_name_by_what_it_does():
    bodies = [
        *(lambda x: jnp.sin(x), lambda x: jnp.cos(x), lambda x: 2.0 * jnp.sin(x), lambda x, y=1.0: jnp.sin(x)),
        *(lambda x, y=2.0: jnp.sin(x), lambda x: [3.0 * one for one in x], lambda x: [4.0 * one for one in x]),
    ]
    assert len({one.__qualname__ for one in bodies}) == 1
    assert len({digest(one) for one in bodies}) == len(bodies)


def test_what_has_no_name_but_a_place_in_memory_is_known_again():
    assert digest(scaled(object())) == digest(scaled(object()))
