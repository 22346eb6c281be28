"""Derivatives of un-jitted calls by a few numbers, from one program that finds values and Jacobian together.

Where `jax.grad` and its like are applied outside of ``jit``, the numbers that they differentiate by are known. The rule
of this module then runs a program of known numbers, the outermost one: the compiler takes options (see
`layerjax.compiling`), and compiles one program in the place of those that JAX makes for every part of a function, there
and back. Everything else is traced as ever: within ``jit`` and ``vmap``, for second derivatives, and by many numbers.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

from layerjax._devices import compile_for_devices
from layerjax.compiling import is_outermost, is_traced

MOST_PARAMETERS = 16
"""More numbers are differentiated by on the way back."""

MOST_SLOPES = 50_000
"""Values times numbers that they are differentiated by: of more, the time to run counts, not that to compile."""


def has_few_parameters(tree: Any, values: int) -> bool:
    """Whether `differentiate_by_parameters` pays: `grad` or its like differentiates so many values by few numbers."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if isinstance(leaf, Tracer)]
    if not leaves or not is_outermost() or not all(map(_is_concrete, leaves)):
        return False
    count = sum(leaf.size for leaf in leaves)
    return count <= MOST_PARAMETERS and 0 < values * count <= MOST_SLOPES


def _is_concrete(leaf: Any) -> bool:
    """Whether `grad` or its like differentiates by this number, and nothing else is done to it."""
    primal = getattr(leaf, "primal", None)
    return isinstance(primal, Array) and not isinstance(primal, Tracer) and jnp.issubdtype(leaf.dtype, jnp.floating)


def differentiate_by_parameters(function: Callable[[Any], Array], tree: Any, plain: Any) -> Array:
    """function(tree), differentiated by what is traced in the tree: see `has_few_parameters`.

    function: of a module, as it is part of the program's key. plain: a tree like it, for derivatives of derivatives.
    """
    parameters, rest = eqx.partition(tree, lambda leaf: isinstance(leaf, Tracer))
    # not within the rule, where JAX takes all numbers for traced
    found, slopes = _with_jacobian(function, jax.tree.map(primal, parameters), rest)

    @jax.custom_jvp
    def values(parameters: list[Array]) -> Array:
        return found

    @values.defjvp
    def rule(primals: tuple[list[Array]], tangents: tuple[list[Array]]) -> tuple[Array, Array]:
        if is_traced(primals):
            return jax.jvp(lambda numbers: function(_fill(plain, numbers)), primals, tangents)
        return found, _directional_derivative(jax.tree.leaves(slopes), *tangents)

    return values(jax.tree.leaves(parameters))


def _fill(tree: Any, numbers: list[Array]) -> Any:
    """The tree with these in the place of what is traced in it."""
    left = iter(numbers)
    return jax.tree.map(lambda leaf: next(left) if isinstance(leaf, Tracer) else leaf, tree)


def primal(leaf: Any) -> Any:
    """The number itself, where `grad` or its like differentiates by it."""
    return getattr(leaf, "primal", leaf) if isinstance(leaf, Tracer) else leaf


@compile_for_devices
def _with_jacobian(function: Callable[[Any], Array], parameters: Any, rest: Any) -> tuple[Array, Any]:
    def twice(parameters: Any) -> tuple[Array, Array]:
        found = function(eqx.combine(parameters, rest))
        return found, found

    slopes, found = jax.jacfwd(twice, has_aux=True)(parameters)
    return found, slopes


@jax.jit
def _directional_derivative(slopes: list[Array], rates: list[Array]) -> Array:
    """The derivative of the values along tangents of the parameters."""
    return sum(
        (jnp.tensordot(slope, rate.astype(slope.dtype), rate.ndim) for slope, rate in zip(slopes, rates, strict=True)),
        jnp.zeros((), slopes[0].dtype),
    )
