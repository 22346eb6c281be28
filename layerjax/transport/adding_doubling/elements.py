"""Differentiation by elements: what a layer is made of is differentiated by the layer's own few numbers.

An element (the operators of an interface, the kernel of a medium) is dear to compute and depends on a handful of
scalars, while the assembly of elements to a stack is cheap and linear in each. Derivatives of an element by each of
its scalars are therefore taken once, forward, however many parameters a Jacobian has, and its gradient is an inner
product with them: no program has to be run backwards through quadratures.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from operator import itemgetter
from typing import Any

import equinox as eqx
import jax
import jax.experimental
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from layerjax._devices import exact_products
from layerjax._jacobian import primal
from layerjax._numerics import allow_broadcasting
from layerjax.compiling import filter_jit, is_traced

enable_x64: Any = getattr(jax if hasattr(jax, "enable_x64") else jax.experimental, "enable_x64")  # noqa: B009 (by version)

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
    scalars, filled = _scalars_of(parameters, dtype)
    if len(scalars) > MOST_SCALARS:
        return function(parameters, constants)

    def of_scalars(scalars: Scalars, constants: Any) -> Any:
        return _mark_dependent(function(filled(scalars), constants), scalars)

    return _evaluate_scalars(of_scalars, scalars, constants)


def _scalars_of(parameters: Any, dtype: Any) -> tuple[Scalars, Callable[[Scalars], Any]]:
    """Every number in a tree, and the tree of others in their place; what is no array stays as it is."""
    leaves, structure = jax.tree.flatten(parameters)
    numbers = [_is_number(leaf) for leaf in leaves]
    arrays = [jnp.asarray(leaf, dtype) for leaf, is_number in zip(leaves, numbers, strict=True) if is_number]

    def filled(scalars: Scalars) -> Any:
        left, given = list(scalars), list(leaves)
        shapes = iter(arrays)
        for place, is_number in enumerate(numbers):
            if is_number:
                array = next(shapes)
                part, left = left[: array.size], left[array.size :]
                given[place] = jnp.stack(part).reshape(array.shape) if array.ndim else part[0]
        return jax.tree.unflatten(structure, given)

    return tuple(array.ravel()[k] if array.ndim else array for array in arrays for k in range(array.size)), filled


Make = Callable[..., Any]
"""Gives the element of a function of options, parameters and constants: `build_element` or `compile_element`."""


Step = Callable[[Any], float | None]
"""Of known parameters: a step over which an element is smooth; None: it may not be."""


def build_element(
    function: Callable[..., Any],
    options: tuple[Any, ...],
    parameters: Any,
    constants: Any,
    dtype: Any,
    step: Step | None = None,
) -> Any:
    """The `element` of function(*options, parameters, constants)."""
    return element(partial(function, *options), parameters, constants, dtype)


compile_element = filter_jit(exact_products(build_element))
"""The same by a program of its own, outside of ``jit``: another stack that holds such a layer finds it compiled."""


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, Array | np.ndarray | float | int) and not isinstance(leaf, bool)


class LinearElement(eqx.Module):
    """The value of an element, and its derivatives by some of its scalars, along a leading axis."""

    value: Any
    slopes: Any
    changing: tuple[int, ...] = eqx.field(static=True)


def linearize_element(
    function: Callable[..., Any],
    options: tuple[Any, ...],
    parameters: Any,
    constants: Any,
    dtype: Any,
    step: Step | None = None,
) -> LinearElement | None:
    """`compile_element` where `grad` or its like differentiates by known numbers, with the derivatives by these.

    In single precision, where the element is smooth over a `step`, they are differences in double precision: a program
    of values compiles in a fourth of the time that one of derivatives takes, and they are closer than those that are
    taken in single precision.
    None: there are too many scalars.
    """
    changing: list[int] = []
    count = 0
    for leaf in filter(_is_number, jax.tree.leaves(parameters)):
        size = np.size(leaf)
        changing += range(count, count + size) if is_traced(leaf) else ()
        count += size
    if count > MOST_SCALARS:
        return None
    known = jax.tree.map(primal, parameters)
    single = dtype == jnp.float32 and jax.default_backend() == "cpu" and not is_traced(constants)
    length = step(known) if step and changing and single else None
    if length is None:
        return _linearize(function, options, known, constants, dtype, tuple(changing))
    at, along = jax.tree.map(
        lambda leaf: np.asarray(leaf, np.float64) if _is_number(leaf) else leaf, (known, constants)
    )
    with enable_x64(True):
        found = _differences(function, options, at, along, tuple(changing), jnp.asarray(length))
    value, slopes = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float32), found)
    return LinearElement(value, slopes, tuple(changing))


@filter_jit
@exact_products
def _differences(
    function: Callable[..., Any],
    options: tuple[Any, ...],
    parameters: Any,
    constants: Any,
    changing: tuple[int, ...],
    length: Array,
) -> tuple[Any, Any]:
    """The value, and central differences by some of the scalars, on a leading axis."""
    scalars, filled = _scalars_of(parameters, jnp.float64)
    units = length * np.eye(len(scalars))[list(changing)]
    points = jnp.stack(scalars) + jnp.concatenate([jnp.zeros((1, len(scalars))), units, -units])
    found = jax.lax.map(lambda point: function(*options, filled(tuple(point)), constants), points)
    count = len(changing)

    def slopes(leaf: Array) -> Array:
        return (leaf[1 : count + 1] - leaf[count + 1 :]) / (2.0 * length)

    return jax.tree.map(itemgetter(0), found), jax.tree.map(slopes, found)


def record(make: Make, elements: list[Any]) -> Make:
    """A `Make` that appends each element to the list."""

    def recording(*numbers: Any) -> Any:
        elements.append(make(*numbers))
        return elements[-1]

    return recording


def replay(elements: Sequence[LinearElement]) -> Make:
    """A `Make` that returns the elements which another one has recorded, as functions of their scalars."""
    left = iter(elements)

    def make(function: Any, options: Any, parameters: Any, constants: Any, dtype: Any, step: Any = None) -> Any:
        one = next(left)
        scalars, _ = _scalars_of(parameters, dtype)
        return _linear(one.value, one.slopes, tuple(scalars[k] for k in one.changing)) if one.changing else one.value

    return make


@filter_jit
@exact_products
def _linearize(
    function: Callable[..., Any],
    options: tuple[Any, ...],
    parameters: Any,
    constants: Any,
    dtype: Any,
    changing: tuple[int, ...],
) -> LinearElement:
    scalars, filled = _scalars_of(parameters, dtype)

    def of_scalars(scalars: Scalars) -> Any:
        return function(*options, filled(scalars), constants)

    if not changing:
        return LinearElement(of_scalars(scalars), None, ())
    return LinearElement(*_slopes(of_scalars, scalars, changing, jnp.eye(len(changing), dtype=dtype)), changing)


@jax.custom_jvp
def _linear(value: Any, slopes: Any, scalars: Scalars) -> Any:
    return value


@_linear.defjvp
@allow_broadcasting
def _linear_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    value, slopes, _ = primals
    return value, _combine(slopes, tangents[2])


def _isolate(function: Callable[[Array], Any], scalars: Scalars, argument: Array) -> Any:
    """function(given), formed once: XLA would form what it finds again for every element of whatever uses it.

    Barriers are gone by the time that XLA fuses on a processor; what branches give is not fused with anything.
    """
    shapes = jax.eval_shape(function, argument)

    def nothing(_: Array) -> Any:
        return jax.tree.map(lambda leaf: jnp.full(leaf.shape, jnp.nan, leaf.dtype), shapes)

    return jax.lax.cond(_are_numbers(scalars), function, nothing, argument)


def _are_numbers(scalars: Scalars) -> Array:
    return reduce(jnp.logical_and, (scalar == scalar for scalar in scalars), jnp.asarray(True))


def _mark_dependent(arrays: Any, scalars: Scalars) -> Any:
    """What was found, all of it a function of the scalars in form, at no cost.

    Under `vmap` an output of a custom derivative that does not depend on them would have no batch as a value and one
    as soon as it is differentiated, and programs that are batched before that are then given the wrong shape.
    """
    is_number = _are_numbers(scalars)
    return jax.tree.map(lambda leaf: jnp.where(is_number, leaf, leaf), arrays)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _evaluate_scalars(function: Callable[[Scalars, Any], Any], scalars: Scalars, constants: Any) -> Any:
    return function(scalars, constants)


@allow_broadcasting
def _jvp(function: Callable[[Scalars, Any], Any], primals: Any, tangents: Any) -> tuple[Any, Any]:
    scalars, constants = primals
    value, slope = _differentiate_scalars(function, scalars, constants, tangents[0])
    if tangents[1] is None or isinstance(tangents[1], SymbolicZero):
        return value, slope
    more = jax.jvp(partial(function, scalars), (constants,), (tangents[1],))[1]
    return value, jax.tree.map(jnp.add, slope, more)


def _differentiate_scalars(
    function: Callable[[Scalars, Any], Any], scalars: Scalars, constants: Any, tangents: Any
) -> Any:
    """The value, and its derivative along tangents of the scalars."""
    changing = [k for k, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]
    if not changing:
        value = function(scalars, constants)
        return value, jax.tree.map(jnp.zeros_like, value)

    def slopes(units: Array) -> tuple[Any, Any]:
        return _slopes(lambda scalars: function(scalars, constants), scalars, changing, units)

    value, found = _isolate(slopes, scalars, jnp.eye(len(changing), dtype=scalars[0].dtype))
    return value, _combine(found, [tangents[k] for k in changing])


def _slopes(
    function: Callable[[Scalars], Any], scalars: Scalars, changing: Sequence[int], units: Array
) -> tuple[Any, Any]:
    """The value, and its derivatives along units of some of the scalars, on a leading axis."""

    def along(unit: Array) -> tuple[Any, Any]:
        def changed(amount: Array) -> Any:
            given = list(scalars)
            for place, k in enumerate(changing):
                given[k] = given[k] + amount[place]
            return function(tuple(given))

        return jax.jvp(changed, (jnp.zeros_like(unit),), (unit,))

    return jax.vmap(along, out_axes=(None, 0))(units)


def _combine(slopes: Any, rates: Sequence[Array]) -> Any:
    """The derivative along these rates of the scalars."""

    def combined(slopes: Array) -> Array:
        return sum((rate * slope for rate, slope in zip(rates[1:], slopes[1:], strict=True)), rates[0] * slopes[0])

    return jax.tree.map(combined, slopes)


_evaluate_scalars.defjvp(_jvp, symbolic_zeros=True)
