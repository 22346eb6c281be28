"""Fresnel reflectance of unpolarised light at smooth interfaces.

Arguments broadcast against each other; a reflectance has their common shape and lies in [0, 1].
"""

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, horner, safe_div, safe_sqrt
from layerjax.directions import squared_cosine_of_refraction

ROUNDED_ROOT = (308 / 1536, 1080 / 1536, 924 / 1536, -432 / 1536, -660 / 1536, 120 / 1536, 196 / 1536)
"""Coefficients of r^0 ... r^6 of what stands for the root of r on (-1, 1): with its value and two derivatives at 1, all
three 0 at -1, and with its mean."""


def schlick(cosine: Array, f0: Array | float) -> Array:
    """Schlick's approximation f0 + (1 - f0) (1 - cosine)^5 (Schlick 1994).

    Args:
        cosine: cosine between the direction of incidence and the facet normal, in [0, 1].
        f0: reflectance along the normal, in [0, 1].
    """
    complement = clamp_min(1.0 - cosine, 0.0)  # a cosine may round to just above 1
    squared = complement * complement
    fifth = squared * squared * complement
    return f0 + (1.0 - f0) * fifth


def dielectric(cosine: Array, ior: Array, blur: Array | None = None) -> Array:
    """Reflectance between two dielectrics, 1 under total internal reflection.

    Args:
        cosine: cosine between the direction of incidence and the facet normal, in [0, 1].
        ior: index on the far side over index on the side of incidence, > 0.
        blur: of the squared cosine of refraction, half the width about 0 over which the critical angle is rounded off,
            or less, so that grazing light keeps its reflectance.

    The two amplitudes are formed without a difference of squares, so that ior = 1 gives exactly 0 at every angle.
    Not differentiable at the critical angle (the derivative is infinite there; 0 is returned beyond it), unless that
    is rounded off.
    """
    return dielectric_towards(cosine, ior, *cosine_of_refraction(cosine, ior, blur))


def dielectric_towards(cosine: Array, ior: Array, refracted: Array, transmits: Array) -> Array:
    """`dielectric` where the cosine of refraction is known, and whether there is such light."""
    refracted = jnp.where(transmits, refracted, 0.5)
    c = jnp.where(transmits, cosine, 0.5)
    tiny = jnp.finfo(refracted.dtype).tiny
    perpendicular = (c - ior * refracted) / (c + ior * refracted + tiny)
    parallel = (ior * c - refracted) / (ior * c + refracted + tiny)
    reflectance = 0.5 * (perpendicular * perpendicular + parallel * parallel)
    matched = (ior == 1.0) & ~transmits  # grazing light on no interface at all
    return jnp.where(transmits, reflectance, jnp.where(matched, 0.0, 1.0))


def cosine_of_refraction(cosine: Array, ior: Array, blur: Array | None = None) -> tuple[Array, Array]:
    """Cosine of refraction at a smooth interface, and whether there is such light; arguments as of `dielectric`."""
    squared = squared_cosine_of_refraction(cosine, ior)
    transmits = squared > 0
    refracted = jnp.sqrt(jnp.where(transmits, squared, 1.0))
    if blur is None:
        return refracted, transmits
    blur = clamp_max(blur, 0.5 * clamp_min((1.0 - ior) * (1.0 + ior), 0.0) / (ior * ior))
    near = jnp.abs(squared) < blur
    width = jnp.where(near, blur, 1.0)
    rounded = jnp.sqrt(width) * horner(ROUNDED_ROOT, jnp.where(near, squared, 0.0) / width)
    return jnp.where(near, rounded, refracted), transmits | near


def conductor(cosine: Array, ior: Array, k: Array) -> Array:
    """Reflectance of a conductor with complex index ior + i k relative to the medium above it.

    Args:
        cosine: cosine between the direction of incidence and the facet normal, in [0, 1].
        ior: real part of the index, > 0.
        k: extinction coefficient, >= 0; k = 0 is a dielectric.
    """
    cos2 = cosine * cosine
    sin2 = 1.0 - cos2
    real = (ior - 1.0) * (ior + 1.0) - k * k + cos2  # ior^2 - k^2 - sin2: at a matched index cos2 to its own digits
    product = ior * k
    modulus = safe_sqrt(real * real + 4.0 * product * product)
    # a + i b = sqrt(n^2 - sin^2): the larger part by a sum, the other from their product, so that nothing cancels
    larger = 0.5 * (modulus + jnp.abs(real))
    smaller = product * safe_div(product, larger)
    # the root of a square is written as its base: at k = 0 under total reflection its derivative is not 0
    root = safe_sqrt(larger)
    a, b2 = jnp.where(real > 0, root, safe_div(product, root)), jnp.where(real > 0, smaller, larger)
    perpendicular, below = (a - cosine) ** 2 + b2, (a + cosine) ** 2 + b2
    ratio, under = (a * cosine - sin2) ** 2 + b2 * cos2, (a * cosine + sin2) ** 2 + b2 * cos2
    return safe_div(0.5 * perpendicular * (under + ratio), below * under)  # one division for both polarisations
