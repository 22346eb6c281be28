"""Colour channels: kept as separate arrays inside, stacked once on the way out."""

import operator
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from layerjax._numerics import unstack

T = TypeVar("T")

Channels = tuple[Array, ...]
"""One array for all channels, or one for each."""


def per_channel(value: Array) -> tuple[Array, ...]:
    """The scalars of a parameter: one that serves all channels, or one for each."""
    return (value,) if value.ndim == 0 else tuple(value[c] for c in range(value.shape[0]))


def pick(values: Sequence[T], channel: int) -> T:
    """The value for a channel, of one for all or one for each."""
    return values[channel] if len(values) > 1 else values[0]


def count(*values: Sequence[Any]) -> int:
    """Number of channels that the values need together."""
    return max((len(value) for value in values), default=1)


def map_channels(function: Callable[..., T], *values: Sequence[Any]) -> tuple[T, ...]:
    """The function of the values of each channel; computed once where every value serves all channels."""
    return tuple(function(*(pick(value, c) for value in values)) for c in range(max(1, count(*values))))


def vmap_channels(function: Callable[[Any], Array], tree: Any) -> Channels:
    """The function of a tree of parameters of one channel, for all channels along an axis of one program.

    It is computed once where no parameter differs between channels.
    """
    leaves, structure = jax.tree.flatten(tree)
    differing = [leaf for leaf in leaves if jnp.ndim(leaf)]
    if not differing:
        return (function(tree),)

    def of_one(numbers: list[Array]) -> Array:
        left = iter(numbers)
        return function(jax.tree.unflatten(structure, [next(left) if jnp.ndim(leaf) else leaf for leaf in leaves]))

    channels = max(len(leaf) for leaf in differing)
    return tuple(unstack(jax.vmap(of_one)([jnp.broadcast_to(leaf, channels) for leaf in differing])))


def multiply(*factors: Sequence[Array]) -> Channels:
    """Product, channel by channel."""
    return map_channels(lambda *values: reduce(operator.mul, values), *factors)


def total(parts: Sequence[Sequence[Array]], zero: Array | None = None) -> Channels:
    """Sum, channel by channel; `zero` if there is nothing to add."""
    if not parts and zero is not None:
        return (zero,)
    return map_channels(lambda *values: reduce(operator.add, values), *parts)


def select(chosen: Array, values: Sequence[Array], others: Sequence[Array] | None = None) -> Channels:
    """`values` where chosen, else `others` (0 without them)."""
    if others is None:
        return tuple(jnp.where(chosen, value, 0.0) for value in values)
    return map_channels(lambda value, other: jnp.where(chosen, value, other), values, others)


def mean(values: Sequence[Array]) -> Array:
    """Mean over channels."""
    return values[0] if len(values) == 1 else sum(values[1:], values[0]) / len(values)


def largest(values: Sequence[Array]) -> Array:
    """Largest over channels."""
    result = values[0]
    for value in values[1:]:
        result = jnp.maximum(result, value)
    return result
