"""Stable elementary functions, safe in value and in gradient.

Every guard here sanitises the *input* of the branch that is not taken (with an interior stand-in) and only then
selects: a clamp or a ``where`` after the fact still gives NaN gradients.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

SERIES_LIMIT = 0.3
"""Below this argument `exprel` and `one_minus_exp` use a Taylor series."""


P = ParamSpec("P")
T = TypeVar("T")


def allow_broadcasting(function: Callable[P, T]) -> Callable[P, T]:
    """The function with arrays of different ranks broadcast, as this package writes them.

    Where a user forbids that of their own code (``jax_numpy_rank_promotion``), what is traced here is not theirs.
    """

    @functools.wraps(function)
    def call(*arguments: P.args, **options: P.kwargs) -> T:
        with jax.numpy_rank_promotion("allow"):
            return function(*arguments, **options)

    return call


def safe_sqrt(x: Array) -> Array:
    """Square root that is 0, with gradient 0, for x <= 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_div(numerator: Array, denominator: Array, otherwise: float = 0.0) -> Array:
    """Quotient that is `otherwise`, with gradient 0, where the denominator is 0."""
    nonzero = denominator != 0
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1.0), otherwise)


def mean_decay(a: Array, b: Array) -> Array:
    """(exp(-a) - exp(-b)) / (b - a) for a, b >= 0, equal to exp(-a) at a = b; smooth there in both.

    Near a = b it is written without |a - b| and min(a, b), whose derivatives at a tie depend on how a compiler rounds.
    """
    difference, middle = a - b, 0.5 * (a + b)
    near = jnp.abs(difference) < 1.0
    square = jnp.where(near, 0.25 * difference * difference, 0.25)
    terms = 7 if jnp.finfo(square.dtype).bits == 64 else 4  # the omitted terms are below half a unit of rounding
    total = horner([1.0 / math.factorial(2 * n + 1) for n in range(terms)], square)  # sinh(x) / x
    smaller, apart = jnp.where(a < b, a, b), jnp.where(near, 2.0, jnp.abs(difference))
    ratio = jnp.where(near, total, (1.0 - jnp.exp(-apart)) / apart)
    return jnp.exp(-jnp.where(near, middle, smaller)) * ratio


def clamp_min(x: Array, low: Array | float) -> Array:
    """x, or `low` (with derivative 0 in x) where x is smaller; where they are equal, the derivative is that of x.

    In place of jnp.maximum, whose derivative asks which argument *equals* the result: compiled, both may have been
    computed again and rounded otherwise, and then the derivative is lost. What is 0 at the end of a range (a rest of
    several events over a black base, say) has the derivative that leads into the range.
    """
    return jnp.where(x >= low, x, low)


def clamp_nonnegative(x: Array) -> Array:
    """x, or 0 where it is negative; with the derivative of x where rounding alone may have made it so.

    For what is a difference of numbers of the order of 1, and 0 at the end of a range.
    """
    rounding = 64.0 * float(jnp.finfo(x.dtype).eps)
    inside = x >= -rounding
    return jnp.where(inside, x - jax.lax.stop_gradient(jnp.minimum(x, 0.0)), 0.0)


def clamp_max(x: Array, high: Array | float) -> Array:
    """x, or `high` (with derivative 0 in x) where x is larger; where they are equal, the derivative is that of x."""
    return jnp.where(x <= high, x, high)


def smooth_step(x: Array) -> Array:
    """0 up to -1, 1 from 1 on, 1/2 at 0, twice differentiable."""
    t = jnp.clip(0.5 * (x + 1.0), 0.0, 1.0)
    return t * t * t * (10.0 + t * (6.0 * t - 15.0))


def horner(coefficients: Array | Sequence[Any], x: Array) -> Array:
    """Polynomial in x, from the coefficients of its powers: numbers, or arrays that broadcast with x."""
    return functools.reduce(lambda total, coefficient: coefficient + x * total, coefficients[::-1])


def unstack(x: Array) -> list[Array]:
    """The rows of an array; their derivatives are stacked again, and not a sum of arrays of which most is 0."""
    return [row.squeeze(0) for row in jax.lax.split(x, (1,) * x.shape[0])]


def exprel(x: Array) -> Array:
    """(1 - exp(-x)) / x for x >= 0, equal to 1 at x = 0; relative error of a few units of rounding."""
    small = x < SERIES_LIMIT
    tame, inner = jnp.where(small, 1.0, x), jnp.where(small, x, 0.5 * SERIES_LIMIT)
    return jnp.where(small, _series(inner), (1.0 - jnp.exp(-tame)) / tame)


def one_minus_exp(x: Array) -> Array:
    """1 - exp(-x) for x >= 0, to a few units of rounding at any x."""
    return absorb(x)[1]


@jax.custom_jvp
def absorb(x: Array) -> tuple[Array, Array]:
    """(exp(-x), 1 - exp(-x)) for x >= 0, both to a few units of rounding, with one exponential."""
    small = x < SERIES_LIMIT
    transmitted = jnp.exp(-x)
    inner = jnp.where(small, x, 0.5 * SERIES_LIMIT)
    return transmitted, jnp.where(small, inner * _series(inner), 1.0 - transmitted)


@absorb.defjvp
def _absorb_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    # the derivative is the exponential that is there already: no need to differentiate the series
    shares = absorb(*primals)
    change = shares[0] * tangents[0]
    return shares, (-change, change)


@jax.custom_jvp
def scale_tangent(x: Array, factor: Array) -> Array:
    """x, broadcast with the factor, whose derivative counts that many times."""
    return jnp.broadcast_to(x, jnp.broadcast_shapes(x.shape, factor.shape))


@scale_tangent.defjvp
@allow_broadcasting
def _scale_tangent_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    return scale_tangent(*primals), primals[1] * tangents[0]


def horizon(dtype: jnp.dtype) -> float:
    """Cosines below this count as lying in the tangent plane: their squares must not overflow when divided by."""
    return 1e-9 if jnp.finfo(dtype).bits >= 32 else 1e-3


def _series(x: Array) -> Array:
    """Sum of (-x)^n / (n + 1)!; the omitted terms are below half a unit of rounding up to SERIES_LIMIT."""
    terms = 12 if jnp.finfo(x.dtype).bits == 64 else 7
    return horner([(-1.0) ** n / math.factorial(n + 1) for n in range(terms)], x)
