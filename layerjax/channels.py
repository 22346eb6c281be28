"""Colour channels: kept as separate arrays inside, stacked once on the way out."""

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

Channels = tuple[Array, ...]
"""One array for all channels, or one for each."""


def per_channel(value: Array) -> tuple[Array, ...]:
    """The scalars of a parameter: one that serves all channels, or one for each."""
    return (value,) if value.ndim == 0 else tuple(value[c] for c in range(value.shape[0]))


def pick(values: Sequence[Array], channel: int) -> Array:
    """The value for a channel, of one for all or one for each."""
    return values[channel] if len(values) > 1 else values[0]


def count(*values: Sequence[Array]) -> int:
    """Number of channels that the values need together."""
    return max((len(value) for value in values), default=1)


def mean(values: Sequence[Array]) -> Array:
    """Mean over channels."""
    return values[0] if len(values) == 1 else sum(values[1:], values[0]) / len(values)


def largest(values: Sequence[Array]) -> Array:
    """Largest over channels."""
    result = values[0]
    for value in values[1:]:
        result = jnp.maximum(result, value)
    return result
