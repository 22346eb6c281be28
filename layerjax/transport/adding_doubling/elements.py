"""Differentiation by elements: what a layer is made of is differentiated by the layer's own few numbers.

An element (the operators of an interface, the kernel of a medium) is dear to compute and depends on a handful of
scalars, while the assembly of elements to a stack is cheap and linear in each. Derivatives of an element by each of
its scalars are therefore taken once, forward, however many parameters a Jacobian has, and its gradient is an inner
product with them: no program has to be run backwards through quadratures.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from layerjax._devices import exact_products
from layerjax._numerics import broadcasting
from layerjax.compiling import filter_jit

Scalars = tuple[Array, ...]

MOST_SCALARS = 10
"""An element of more numbers is differentiated like anything else."""


def element(function: Callable[[Any, Any], Any], parameters: Any, constants: Any, dtype: Any) -> Any:
    """function(parameters, constants), a tree of floating arrays, differentiated by each number in the parameters.

    Args:
        function: depends on traced values through its arguments alone.
        parameters: a tree; what is no array stays as it is.
        constants: an array of any size, or None; a derivative by it (of a direction, say) runs through the function.
        dtype: of the parameters.
    """
    leaves, structure = jax.tree.flatten(parameters)
    numbers = [isinstance(leaf, Array | np.ndarray | float | int) and not isinstance(leaf, bool) for leaf in leaves]
    arrays = [jnp.asarray(leaf, dtype) for leaf, is_number in zip(leaves, numbers, strict=True) if is_number]
    if sum(array.size for array in arrays) > MOST_SCALARS:
        return function(parameters, constants)
    scalars = tuple(array.ravel()[k] if array.ndim else array for array in arrays for k in range(array.size))

    def of_scalars(scalars: Scalars, constants: Any) -> Any:
        left, filled = list(scalars), list(leaves)
        shapes = iter(arrays)
        for place, is_number in enumerate(numbers):
            if is_number:
                array = next(shapes)
                part, left = left[: array.size], left[array.size :]
                filled[place] = jnp.stack(part).reshape(array.shape) if array.ndim else part[0]
        return _tied(function(jax.tree.unflatten(structure, filled), constants), scalars)

    return _of_scalars(of_scalars, scalars, constants)


Make = Callable[..., Any]
"""Gives the element of a function of options, parameters and constants: `made` or `compiled`."""


def made(function: Callable[..., Any], options: tuple[Any, ...], parameters: Any, constants: Any, dtype: Any) -> Any:
    """The `element` of function(*options, parameters, constants)."""
    return element(partial(function, *options), parameters, constants, dtype)


compiled = filter_jit(exact_products(made))
"""`made` by a program of its own, outside of ``jit``: other stacks that hold such a layer find it compiled."""


def _by_itself(function: Callable[[Array], Any], scalars: Scalars, given: Array) -> Any:
    """function(given), formed once: XLA would form what it finds again for every element of whatever uses it.

    Barriers are gone by the time that XLA fuses on a processor; what branches give is not fused with anything.
    """
    shapes = jax.eval_shape(function, given)

    def nothing(_: Array) -> Any:
        return jax.tree.map(lambda leaf: jnp.full(leaf.shape, jnp.nan, leaf.dtype), shapes)

    return jax.lax.cond(_are_numbers(scalars), function, nothing, given)


def _are_numbers(scalars: Scalars) -> Array:
    return reduce(jnp.logical_and, (scalar == scalar for scalar in scalars), jnp.asarray(True))


def _tied(found: Any, scalars: Scalars) -> Any:
    """What was found, all of it a function of the scalars in form, at no cost.

    Under `vmap` an output of a custom derivative that does not depend on them would have no batch as a value and one
    as soon as it is differentiated, and programs that are batched before that are then given the wrong shape.
    """
    is_number = _are_numbers(scalars)
    return jax.tree.map(lambda leaf: jnp.where(is_number, leaf, leaf), found)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _of_scalars(function: Callable[[Scalars, Any], Any], scalars: Scalars, constants: Any) -> Any:
    return function(scalars, constants)


@broadcasting
def _jvp(function: Callable[[Scalars, Any], Any], primals: Any, tangents: Any) -> tuple[Any, Any]:
    scalars, constants = primals
    value, slope = _by_scalars(function, scalars, constants, tangents[0])
    if tangents[1] is None or isinstance(tangents[1], SymbolicZero):
        return value, slope
    more = jax.jvp(partial(function, scalars), (constants,), (tangents[1],))[1]
    return value, jax.tree.map(jnp.add, slope, more)


def _by_scalars(function: Callable[[Scalars, Any], Any], scalars: Scalars, constants: Any, tangents: Any) -> Any:
    """The value, and its derivative along tangents of the scalars."""
    changing = [k for k, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]
    if not changing:
        value = function(scalars, constants)
        return value, jax.tree.map(jnp.zeros_like, value)

    def along(unit: Array) -> tuple[Any, Any]:
        def changed(amount: Array) -> Any:
            given = list(scalars)
            for place, k in enumerate(changing):
                given[k] = given[k] + amount[place]
            return function(tuple(given), constants)

        return jax.jvp(changed, (jnp.zeros_like(unit),), (unit,))

    value, slopes = _by_itself(
        jax.vmap(along, out_axes=(None, 0)), scalars, jnp.eye(len(changing), dtype=scalars[0].dtype)
    )
    rates = [tangents[k] for k in changing]

    def combined(slopes: Array) -> Array:
        return sum((rate * slope for rate, slope in zip(rates[1:], slopes[1:], strict=True)), rates[0] * slopes[0])

    return value, jax.tree.map(combined, slopes)


_of_scalars.defjvp(_jvp, symbolic_zeros=True)
