"""Legendre moments of a phase function that depends on the angle of deflection alone.

chi_l is the mean of the Legendre polynomial P_l of the cosine of deflection over p, which is the sum of
(2 l + 1) chi_l P_l / (4 pi).
"""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax.directions import Vector

SPARE = 128
"""Nodes beyond two a moment, which resolve peaks as narrow as the box has them."""


def moments_by_quadrature(pdf: Callable[[Vector, Vector], Array], count: int, dtype: Any) -> Array:
    """chi_0 ... chi_(count - 1) of pdf(wi, wo), (count,), by nodes that crowd where peaks lie, forward and back."""
    cosine, sine, weights = (jnp.asarray(part, dtype) for part in _rule(count))
    zero = jnp.zeros_like(cosine)
    return weights @ pdf((zero, zero, zero + 1.0), (sine, zero, -cosine))


@functools.cache
def _rule(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines and sines of deflection, and the matrix from values of p there to moments."""
    x, w = np.polynomial.legendre.leggauss(2 * count + SPARE)
    angle = 0.5 * np.pi * (1.0 + np.sin(0.5 * np.pi * x))
    solid = 0.5 * np.pi**3 * w * np.cos(0.5 * np.pi * x) * np.sin(angle)
    return np.cos(angle), np.sin(angle), np.polynomial.legendre.legvander(np.cos(angle), count - 1).T * solid
