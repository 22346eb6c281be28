"""Fresnel reflectance of unpolarised light at smooth interfaces."""

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import safe_sqrt


def schlick(cosine: Array, f0: Array) -> Array:
    """Schlick's approximation f0 + (1 - f0) (1 - cosine)^5 for |cosine| in [0, 1] (Schlick 1994)."""
    complement = 1.0 - cosine
    squared = complement * complement
    fifth = squared * squared * complement
    return f0 + (1.0 - f0) * fifth


def dielectric(cosine: Array, ior: Array) -> Array:
    """Reflectance between two dielectrics, 1 under total internal reflection.

    Args:
        cosine: cosine between the direction of incidence and the facet normal, in [0, 1].
        ior: index on the far side over index on the side of incidence, > 0.

    The two amplitudes are formed without a difference of squares, so that ior = 1 gives exactly 0 at every angle.
    Not differentiable at the critical angle (the derivative is infinite there; 0 is returned beyond it).
    """
    squared = 1.0 - (1.0 - cosine * cosine) / (ior * ior)
    transmits = squared > 0
    refracted = jnp.sqrt(jnp.where(transmits, squared, 0.25))
    c = jnp.where(transmits, cosine, 0.5)
    tiny = jnp.finfo(squared.dtype).tiny
    perpendicular = (c - ior * refracted) / (c + ior * refracted + tiny)
    parallel = (ior * c - refracted) / (ior * c + refracted + tiny)
    reflectance = 0.5 * (perpendicular * perpendicular + parallel * parallel)
    matched = (ior == 1.0) & ~transmits  # grazing light on no interface at all
    return jnp.where(transmits, reflectance, jnp.where(matched, 0.0, 1.0))


def conductor(cosine: Array, ior: Array, k: Array) -> Array:
    """Reflectance of a conductor with complex index ior + i k relative to the medium above it.

    Args:
        cosine: cosine of incidence in [0, 1].
        ior: real part of the index, > 0.
        k: extinction coefficient, >= 0; k = 0 is a dielectric.
    """
    cos2 = cosine * cosine
    sin2 = 1.0 - cos2
    real = ior * ior - k * k - sin2
    product = ior * k
    modulus = safe_sqrt(real * real + 4.0 * product * product)  # |n^2 - sin^2|
    # Re sqrt(n^2 - sin^2): for real < 0 the textbook form cancels, its conjugate does not
    positive = real >= 0
    upper = safe_sqrt(0.5 * (modulus + jnp.where(positive, real, 0.0)))
    lower = product * jnp.sqrt(2.0) / jnp.sqrt(modulus - jnp.where(positive, -1.0, real))
    a = jnp.where(positive, upper, lower)
    even, odd = modulus + cos2, 2.0 * a * cosine
    perpendicular = (even - odd) / (even + odd)
    even, odd = modulus * cos2 + sin2 * sin2, odd * sin2
    tiny = jnp.finfo(even.dtype).tiny
    return 0.5 * perpendicular * (1.0 + (even - odd) / (even + odd + tiny))
