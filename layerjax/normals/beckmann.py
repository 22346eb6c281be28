"""Normals of the facets of a rough surface whose slopes are Gaussian: Beckmann (Walter et al. 2007), Smith masking.

Slopes have the density exp(-(p^2 + q^2) / alpha^2) / (pi alpha^2).
"""

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.special import erf, erfinv

from layerjax._numerics import clamp_max, clamp_min, safe_sqrt
from layerjax.directions import Vector, normalize

LEAST_SQUARED_COSINE = 1e-12
"""Of a normal: beyond it the density is 0 at any width."""

MOST_EXPONENT = 80.0
"""exp of minus this is 0, also in single precision."""

MOST_RATIO = 10.0
"""Of the cotangent over alpha: from there on nothing is masked, to all digits."""

STEPS = 12
"""Of Newton's method in a bracket: slopes are then exact to rounding."""


def beckmann_density(m: Vector, alpha: Array) -> Array:
    """Density D(m) of facet normals above the horizon, 1/sr; the integral of D cos over the hemisphere is 1."""
    squared = clamp_min(m[2] * m[2], LEAST_SQUARED_COSINE)
    exponent = (m[0] * m[0] + m[1] * m[1]) / squared / (alpha * alpha) + 2.0 * jnp.log(squared)
    return jnp.exp(-clamp_max(exponent, MOST_EXPONENT)) / (jnp.pi * alpha * alpha)


def beckmann_area(cosine: Array, w: Vector, alpha: Array) -> Array:
    """2 cos / G1(w) for w above the horizon, which has this cosine (Walter 2007, Eq. 27, G1 exact)."""
    sine = safe_sqrt(w[0] * w[0] + w[1] * w[1])
    steep = cosine < MOST_RATIO * alpha * sine
    ratio = jnp.where(steep, cosine, 0.0) / jnp.where(steep, alpha * sine, 1.0)
    masked = cosine * (1.0 + erf(ratio)) + alpha * sine * jnp.exp(-ratio * ratio) / jnp.sqrt(jnp.pi)
    return jnp.where(steep, masked, 2.0 * cosine)


def beckmann_sample(wi: Vector, alpha: Array, u1: Array, u2: Array) -> Vector:
    """Facet normal seen from wi (above the horizon), with density G1 <wi, m> D(m) / cos (Heitz & d'Eon 2014).

    Of a surface of alpha 1, stretched, the slope p against wi has the density (cot - p) exp(-p^2) below cot(theta): its
    cumulative distribution is solved for erf(p). The slope across is Gaussian.
    """
    v = normalize((alpha * wi[0], alpha * wi[1], wi[2]))
    sine = safe_sqrt(v[0] * v[0] + v[1] * v[1])
    tilted = sine > 0
    inverse = 1.0 / jnp.where(tilted, sine, 1.0)
    x, y = jnp.where(tilted, v[0] * inverse, 1.0), jnp.where(tilted, v[1] * inverse, 0.0)
    against = _slope_seen(v[2], sine, u1)
    across = erfinv(_clip_level(2.0 * u2 - 1.0))
    p, q = against * x - across * y, against * y + across * x
    return normalize((-alpha * p, -alpha * q, jnp.ones_like(p)))


def _slope_seen(cosine: Array, sine: Array, u: Array) -> Array:
    """Slope with the density (cosine - p sine) exp(-p^2), where that is positive, from a uniform number."""

    def below(level: Array, cosine: Array, sine: Array) -> tuple[Array, Array]:
        """Twice what lies below the slope p, by erf(p), and its derivative by that."""
        p = erfinv(level)
        return cosine * (1.0 + level) + sine * jnp.exp(-p * p) / jnp.sqrt(jnp.pi), cosine - p * sine

    steep = cosine < MOST_RATIO * sine
    last = jnp.where(steep, erf(jnp.where(steep, cosine, 0.0) / jnp.where(steep, sine, 1.0)), 1.0)
    last = _clip_level(last)
    wanted = u * below(last, cosine, sine)[0]

    def step(_: int, bracket: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, level = bracket
        found, slope = below(level, *at)
        less = found < target
        low, high = jnp.where(less, level, low), jnp.where(less, high, level)
        onward = level + (target - found) / clamp_min(slope, 1e-30)
        return low, high, jnp.where((onward >= low) & (onward <= high), onward, 0.5 * (low + high))

    at, target = jax.lax.stop_gradient((cosine, sine)), jax.lax.stop_gradient(wanted)
    first = jax.lax.stop_gradient(_clip_level(-jnp.ones_like(last)))
    end = jax.lax.stop_gradient(last)
    level = jax.lax.fori_loop(0, STEPS, step, (first, end, 0.5 * (first + end)))[2]
    # one more step has the derivative of what was solved
    found, slope = below(level, cosine, sine)
    return erfinv(_clip_level(level + (wanted - found) / jax.lax.stop_gradient(clamp_min(slope, 1e-30))))


def _clip_level(level: Array) -> Array:
    """A number in (-1, 1) that `erfinv` takes."""
    most = 1.0 - jnp.finfo(level.dtype).eps
    return jnp.clip(level, -most, most)
