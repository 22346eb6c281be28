"""The logarithm of measurements, which becomes a straight line where they are no larger than their noise.

g(x) = asinh(x / s): log(2 x / s) for x far above s, x / s below, and defined for measurements that are not positive. It
is the generalised logarithm of Durbin, Hardin, Hawkins & Rocke 2002, Bioinformatics 18, S105.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

LINEAR_BELOW = 4.0
"""Standard deviations of the noise, without its relative part, below which it is linear."""

LEAST = 1e-6
"""Of the median measurement: s is not below that, where nothing is said of additive noise."""


def softness(values: ArrayLike, additive: ArrayLike) -> NDArray[np.float64]:
    """s of measurements, in 1/sr, from the standard deviation of their additive noise, which broadcasts against
    them."""
    values = np.asarray(values, float)
    typical = LEAST * float(np.median(np.abs(values))) or 1.0
    return np.maximum(np.broadcast_to(LINEAR_BELOW * np.asarray(additive, float), values.shape), typical)


def logarithm(x: Any, s: Any) -> Array:
    """g(x)."""
    return jnp.arcsinh(x / s)


def size(x: Any, s: Any) -> Array:
    """1 / g'(x), in the unit of x: by so much does x change with an error of 1 in the logarithm."""
    return jnp.hypot(x, s)
