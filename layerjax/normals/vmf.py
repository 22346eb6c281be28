"""Normals with a von Mises-Fisher distribution: density, mean resultant length, masking and sampling.

M(m) = kappa / (2 pi (1 - exp(-2 kappa))) exp(-kappa |m - n|^2 / 2) over the sphere (Guo et al. 2015, Eq. 5, in a form
that neither overflows nor cancels). As facets of a surface only those above the horizon exist, so that the density is
D = M / N with N the projected area of that half (Eq. 6 divides by that of the whole sphere, and loses or makes energy
below kappa = 10). A width alpha like GGX's stands for kappa = 2 / alpha^2.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.special import ndtr

from layerjax._numerics import clamp_max, clamp_min, exprel, safe_sqrt
from layerjax.directions import Vector

Masking = Literal["normal", "paper"]
"""Fits of the projected area: by a normal distribution of <o, m>; by Eq. (8) of Guo et al. 2015."""

LEAST_AREA = 1e-7
"""Floor of a projected area: Eq. (8) rounds to 0 at the horizon."""

SERIES = 1.0
"""Below this concentration the mean resultant length comes from its continued fraction."""


def concentration(alpha: Array) -> Array:
    """kappa of normals as wide as GGX normals of width alpha."""
    return 2.0 / (alpha * alpha)


def sphere_density(squared: Array, kappa: Array) -> Array:
    """M, 1/sr, from the squared distance |m - mu|^2 to the mean direction (Guo 2015, Eq. 5)."""
    return jnp.exp(-0.5 * kappa * squared) / (4.0 * jnp.pi * exprel(2.0 * kappa))


def hemisphere_norm(kappa: Array) -> Array:
    """N: projected area, along the mean, of the normals above the horizon; 1/4 at kappa = 0, 1 at infinity."""
    small = kappa < 0.5
    inner, outer = jnp.where(small, kappa, 0.25), jnp.where(small, 1.0, kappa)
    series = jnp.ones_like(inner)
    for n in range(14, 2, -1):
        series = 1.0 - series * inner * (1.0 / n)
    # 2 (kappa - 1 + exp(-kappa)) / kappa^2, without the square: its own square overflows in derivatives
    share = jnp.where(small, series, 2.0 * (1.0 + jnp.expm1(-outer) / outer) / outer)
    return 0.25 * share / exprel(2.0 * kappa)


def hemisphere_density(m: Vector, kappa: Array) -> Array:
    """Density D(m), 1/sr, of facet normals above the horizon; the integral of D cos over the hemisphere is 1."""
    flat = m[0] * m[0] + m[1] * m[1]
    drop = flat / (1.0 + m[2])  # 1 - cos, without cancellation
    return sphere_density(flat + drop * drop, kappa) / hemisphere_norm(kappa)


def resultant(kappa: Array) -> tuple[Array, Array]:
    """Mean resultant length A3 = coth(kappa) - 1 / kappa, and 1 - A3, both to a few units of rounding."""
    small = kappa < SERIES
    inner, outer = jnp.where(small, kappa, 0.5), jnp.where(small, 2.0, kappa)
    squared, fraction = inner * inner, jnp.full_like(inner, 23.0)
    for n in range(21, 1, -2):
        fraction = n + squared / fraction
    low = inner / fraction
    decay = jnp.exp(-2.0 * outer)
    rest = 1.0 / outer - 2.0 * decay / (1.0 - decay)
    return jnp.where(small, low, 1.0 - rest), jnp.where(small, 1.0 - low, rest)


def resultant_slope(kappa: Array) -> Array:
    """Derivative of A3 by kappa, equal to 1 - A3^2 - 2 A3 / kappa, without cancellation."""
    small = kappa < 0.5 * SERIES
    x = jnp.where(small, kappa * kappa, 0.25)
    terms = (
        -3617.0 / 10854718875.0,
        4.0 / 1403325.0,
        -1382.0 / 58046625.0,
        2.0 / 10395.0,
        -1.0 / 675.0,
        2.0 / 189.0,
        -1.0 / 15.0,
        1.0 / 3.0,
    )
    series = jnp.zeros_like(x)
    for term in terms:
        series = series * x + term
    outer = jnp.where(small, 2.0, kappa)
    decay = jnp.exp(-2.0 * outer)
    return jnp.where(small, series, 1.0 / (outer * outer) - 4.0 * decay / (1.0 - decay) ** 2)


def convolve(*pairs: tuple[Array, Array]) -> tuple[Array, Array]:
    """(R, 1 - R) of independent turns that follow each other: R is the product of theirs."""
    length, rest = pairs[0]
    for other, missing in pairs[1:]:
        rest = rest + missing * length
        length = length * other
    return length, rest


@jax.custom_jvp
def concentration_of(length: Array, rest: Array) -> Array:
    """kappa with A3(kappa) = length; `rest` is 1 - length with its own digits (Newton from a closed-form start)."""
    missing = clamp_min(rest, 1e-30)
    kappa = length * (3.0 - length * length) / (missing * (1.0 + length))
    for _ in range(4):
        value, left = resultant(kappa)
        residual = jnp.where(length < 0.5, value - length, missing - left)
        kappa = kappa - residual / resultant_slope(kappa)
    # from 12 on exp(-2 kappa) is below rounding: kappa = 1 / rest
    return jnp.where(missing * 12.0 < 1.0, 1.0 / missing, kappa)


@concentration_of.defjvp
def _concentration_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    kappa = concentration_of(*primals)
    # of the two arguments one carries the digits; their changes are opposite
    change = jnp.where(primals[0] < 0.5, tangents[0], -tangents[1])
    return kappa, change / resultant_slope(kappa)


def projected_area(cosine: Array, kappa: Array, masking: Masking = "normal") -> Array:
    """Projected area P of the facets that face a direction, by its cosine >= 0 with the mean.

    "normal": <o, m> taken as normally distributed, with its own mean and variance; G1 is then exact within 0.03 from
    kappa = 2 on (0.001 at 100). "paper": Guo 2015, Eq. (8), off by 0.06 at kappa = 3 and by 0.4 at 100 near grazing.
    """
    cosine = clamp_max(cosine, 1.0)  # directions may be longer than 1 by `UNIT_SLACK`
    length, _ = resultant(kappa)
    if masking == "paper":
        a, b = 0.25 * (length + 1.0) ** 2, jnp.cbrt(length)
        sine = safe_sqrt((1.0 - cosine) * (1.0 + cosine))
        return a * jnp.cos(b * jnp.arctan2(sine, cosine))
    mean = length * cosine
    squared = cosine * cosine
    # A3 / kappa is 1/3 at kappa = 0
    across = length / clamp_min(kappa, 1e-12)
    deviation = safe_sqrt(squared * resultant_slope(kappa) + (1.0 - squared) * across)
    z = mean / deviation
    return mean * ndtr(z) + deviation * jnp.exp(-0.5 * z * z) / jnp.sqrt(2.0 * jnp.pi)


def masking(cosine: Array, kappa: Array, form: Masking = "normal") -> Array:
    """Smith masking G1 = N cos / P, at most 1, for a cosine >= 0 with the mean."""
    return cosine * masking_over_cosine(cosine, kappa, form)


def masking_over_cosine(cosine: Array, kappa: Array, form: Masking = "normal") -> Array:
    """G1 / cos = N / P, without dividing by a cosine that may be 0."""
    norm = hemisphere_norm(kappa)
    area = clamp_min(projected_area(cosine, kappa, form), LEAST_AREA)
    return norm / clamp_min(area, norm * cosine)


def hemisphere_sample(kappa: Array, u1: Array, u2: Array) -> Vector:
    """Normal above the horizon with density M / (its integral there, `upper_share`), from two uniform numbers."""
    drop = -jnp.log1p(-u1 * -jnp.expm1(-kappa)) / kappa  # 1 - cos
    sine = safe_sqrt(drop * (2.0 - drop))
    phi = 2.0 * jnp.pi * u2
    return sine * jnp.cos(phi), sine * jnp.sin(phi), 1.0 - drop


def upper_share(kappa: Array) -> Array:
    """Integral of M over the upper hemisphere, 1 / (1 + exp(-kappa))."""
    return 1.0 / (1.0 + jnp.exp(-kappa))
