"""Normals of the facets of a rough surface with Student-t slopes (Ribardiere et al. 2017), Smith masking.

Slopes have the density (1 + (p^2 + q^2) / ((gamma - 1) alpha^2))^-gamma / (pi alpha^2): GGX at gamma = 2, Beckmann in
the limit of large gamma. Of facets stretched by the width s = alpha sqrt(gamma - 1), normals have the density
(gamma - 1) cos^(2 gamma - 4) / pi, a power of the cosine. Of a normal (-sin(t) cos(b), -sin(b), cos(t) cos(b)), with x
along the direction v from which it is seen, the visible density is then one of t times one of b::

    cos(t)^(k - 1) <v, (-sin(t), cos(t))>        cos(b)^(k + 1)        k = 2 gamma - 3

Areas and draws need integrals of such powers, which are regularised incomplete beta functions. These have no derivative
by k in JAX, and are taken by a Gauss rule here.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, horner, safe_sqrt
from layerjax.directions import Vector, normalize
from layerjax.quadrature import gauss_legendre

LEAST_SQUARED_COSINE = 1e-12
"""Of a normal: below it the density is that of this one."""

POINTS = 16
"""Of the Gauss rule: `power_share` is then right to 3e-10 from k = 0.1 to k = 78."""

SWITCH = 0.8
"""Tangent of t up to which powers of the cosine are integrated from 0, and beyond from pi/2."""

CROWDING = 3.0
"""Smoothness of what is integrated at pi/2, where powers begin like t^k: the points are crowded there."""

RECURRENCES = 6
"""Steps of k by 2 before the asymptotic series of `power_integral`."""

SERIES = (-1.0 / 64.0, 5.0 / 2048.0, -61.0 / 49152.0, 1385.0 / 1048576.0, -50521.0 / 20971520.0)
"""Coefficients of log(Gamma(z + 1/4) / Gamma(z + 3/4) sqrt(z)), by powers of 1/z^2 from the first on."""

STEPS = 10
"""Of Newton's method in a bracket: draws are then exact to rounding, but for 1 in 1000 at gamma = 40, within 1e-5."""

STEPS_ACROSS = 6
"""The same across the plane of incidence: within 1e-10."""

TINY = 1e-30
"""Keeps quotients finite."""


def student_density(m: Vector, alpha: Array, gamma: Array) -> Array:
    """Density D(m) of facet normals above the horizon, 1/sr; the integral of D cos over the hemisphere is 1.

    Below gamma = 2 it grows without limit towards upright facets, like cos^(2 gamma - 4).
    """
    squared = clamp_min(m[2] * m[2], LEAST_SQUARED_COSINE)
    slopes = (m[0] * m[0] + m[1] * m[1]) / squared / (alpha * alpha) / (gamma - 1.0)
    return jnp.exp(-gamma * jnp.log1p(slopes) - 2.0 * jnp.log(squared)) / (jnp.pi * alpha * alpha)


def student_area(cosine: Array, w: Vector, alpha: Array, gamma: Array) -> Array:
    """2 cos / G1(w) for w above the horizon, which has this cosine; the area goes with the length of w."""
    size, k = alpha * safe_sqrt(gamma - 1.0), 2.0 * gamma - 3.0
    return _area_below(cosine, size * safe_sqrt(w[0] * w[0] + w[1] * w[1]), k)


def _area_below(cosine: Array, sine: Array, k: Array) -> Array:
    """Twice the projected area along a direction with these components, of stretched facets."""
    tilted = sine > 0
    planar = jnp.where(tilted, sine, 1.0)
    below = cosine * (1.0 + power_share(cosine, planar, k))
    steep = planar * jnp.exp(k * jnp.log(planar / jnp.sqrt(planar * planar + cosine * cosine))) / _steepness(k)
    return jnp.where(tilted, below + steep, 2.0 * cosine)


def _steepness(k: Array) -> Array:
    return k * power_integral(k)


def power_integral(k: Array) -> Array:
    """Integral of cos(t)^k over (0, pi/2), Gamma((k + 1)/2) sqrt(pi) / (2 Gamma(k/2 + 1)), for k > 0."""
    ratio = jnp.ones_like(k)
    for step in range(RECURRENCES):
        ratio = ratio * (k + (2.0 * step + 2.0)) / (k + (2.0 * step + 1.0))
    z = 0.5 * k + (RECURRENCES + 0.25)
    inverse = 1.0 / (z * z)
    return 0.5 * jnp.sqrt(jnp.pi / z) * ratio * jnp.exp(inverse * horner(SERIES, inverse))


def power_share(sine: Array, cosine: Array, k: Array) -> Array:
    """Integral of cos^k from 0 to t, over that to pi/2, by a sine >= 0 and a cosine > 0 of t, of any common length."""
    return _power_shares(sine, cosine, _rule(k))[0]


def power_rest(sine: Array, cosine: Array, k: Array) -> Array:
    """1 less `power_share`, with its own digits towards pi/2."""
    return _power_shares(sine, cosine, _rule(k))[1]


class PowerRule(NamedTuple):
    """What the Gauss rule for powers k of a cosine does not take from the angle: of places y from 0 to 1 their squares
    and weights, lists of what has the shape of k. The first are those of the tangent, the others of the cotangent, at
    y = x^q: there the integrand begins like y^k."""

    k: Array
    inverse: Array
    near: Sequence[float]
    near_weight: Sequence[float]
    far: Sequence[Array]
    far_weight: Sequence[Array]


def _rule(k: Array) -> PowerRule:
    x, w = (array.tolist() for array in gauss_legendre(POINTS))
    crowding = 1.0 + CROWDING / (k + 1.0)
    return PowerRule(
        k,
        1.0 / power_integral(k),
        [part * part for part in x],
        w,
        [jnp.exp((2.0 * math.log(part)) * crowding) for part in x],
        [
            weight * crowding * jnp.exp((crowding * (k + 1.0) - 1.0) * math.log(part))
            for part, weight in zip(x, w, strict=True)
        ],
    )


def _power_shares(sine: Array, cosine: Array, rule: PowerRule) -> tuple[Array, Array]:
    """`power_share` and `power_rest`."""
    near = sine < SWITCH * cosine
    z = jnp.where(near, sine, cosine) / jnp.where(near, cosine, sine)
    squared, exponent = z * z, -(0.5 * rule.k + 1.0)
    total = jnp.zeros_like(squared * exponent)
    for close, close_weight, away, away_weight in zip(*rule[2:], strict=True):
        y = squared * jnp.where(near, close, away)
        total = total + jnp.where(near, close_weight, away_weight) * jnp.exp(exponent * jnp.log(1.0 + y))
    # z^(1 + k) by its logarithm; of z = 0, where t is 0, the power is 1
    power = jnp.exp(rule.k * jnp.log(jnp.where(near, 1.0, z)))
    share = z * power * total * rule.inverse
    return jnp.where(near, share, 1.0 - share), jnp.where(near, 1.0 - share, share)


def student_sample(wi: Vector, alpha: Array, gamma: Array, u1: Array, u2: Array) -> Vector:
    """Facet normal seen from wi (above the horizon), with density G1 <wi, m> D(m) / cos, from two uniform numbers."""
    size, k = alpha * safe_sqrt(gamma - 1.0), 2.0 * gamma - 3.0
    v = normalize((size * wi[0], size * wi[1], wi[2]))
    sine = safe_sqrt(v[0] * v[0] + v[1] * v[1])
    tilted = sine > 0
    inverse = 1.0 / jnp.where(tilted, sine, 1.0)
    x, y = jnp.where(tilted, v[0] * inverse, 1.0), jnp.where(tilted, v[1] * inverse, 0.0)
    steep, (across, upward) = _angle_seen(v[2], sine, k, u1), _angle_across(k, u2)
    along, height = jnp.cos(steep) * upward, jnp.sin(steep) * upward
    return normalize((size * (along * x + across * y), size * (along * y - across * x), height))


def _angle_seen(cosine: Array, sine: Array, k: Array, u: Array) -> Array:
    """pi/2 + t of normals seen along a direction, from a uniform number: small for steep ones that face it."""

    def below(angle: Array, cosine: Array, sine: Array, rule: PowerRule) -> tuple[Array, Array]:
        """Twice the area up to an angle, and its derivative by that."""
        s, c = jnp.sin(angle), jnp.cos(angle)
        facing = c > 0
        share, rest = _power_shares(jnp.where(facing, c, -c), s, rule)
        power = jnp.exp(rule.k * jnp.log(s)) * rule.inverse
        area = cosine * jnp.where(facing, rest, 1.0 + share) + sine * power / rule.k
        return area, power / s * (cosine * s + sine * c)

    # an angle of pi itself has no sine
    last = clamp_max(0.5 * jnp.pi + jnp.arctan2(cosine, sine), np.pi * (1.0 - 4.0 * float(jnp.finfo(cosine.dtype).eps)))
    wanted = u * _area_below(cosine, sine, k)
    return _solve(below, (cosine, sine, _rule(k)), wanted, last, STEPS)


def _angle_across(k: Array, u: Array) -> tuple[Array, Array]:
    """Sine and cosine of b, from a uniform number."""

    def share_within(angle: Array, rule: PowerRule) -> tuple[Array, Array]:
        """Share of the b closer to pi/2 than by this angle, and its derivative by that."""
        s, c = jnp.sin(angle), jnp.cos(angle)
        return _power_shares(clamp_min(c, 0.0), s, rule)[1], jnp.exp(rule.k * jnp.log(s)) * rule.inverse

    signed = 2.0 * u - 1.0
    angle = _solve(share_within, (_rule(k + 1.0),), 1.0 - jnp.abs(signed), jnp.full_like(k, 0.5 * jnp.pi), STEPS_ACROSS)
    return jnp.where(signed < 0, -1.0, 1.0) * jnp.cos(angle), jnp.sin(angle)


def _solve(
    function: Callable[..., tuple[Array, Array]], numbers: tuple[Any, ...], wanted: Array, last: Array, steps: int
) -> Array:
    """The angle in (0, last) at which function(angle, *numbers), a rising one from 0 on, is `wanted`, by Newton's
    method for their logarithms, in a bracket: near 0 it is a power of the angle."""
    at, target, end = jax.lax.stop_gradient((numbers, clamp_min(wanted, TINY), last))

    def step(_: int, bracket: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, angle = bracket
        found, slope = function(angle, *at)
        found, slope = clamp_min(found, TINY), clamp_min(slope, TINY)
        less = found < target
        low, high = jnp.where(less, angle, low), jnp.where(less, high, angle)
        move = jnp.log(target / found) * found / (angle * slope)
        onward = angle * jnp.exp(jnp.clip(move, -60.0, 60.0))
        return low, high, jnp.where((onward >= low) & (onward <= high), onward, 0.5 * (low + high))

    low = jnp.full_like(end * target, 1e-35)
    high = end * jnp.ones_like(low)
    angle = jax.lax.fori_loop(0, steps, step, (low, high, 0.5 * high))[2]
    # one more step has the derivative of what was solved
    found, slope = function(angle, *numbers)
    return angle + (clamp_min(wanted, TINY) - found) / jax.lax.stop_gradient(clamp_min(slope, TINY))
