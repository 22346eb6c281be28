"""Widths of lobes as variances that add (Belcour 2018, Sec. 4), and how a refracting interface changes them.

A variance here is f(alpha), the "linear variance" of a GGX lobe in the space of roughness: it has no unit, and is not
the second moment on the disc of directions.
"""

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, safe_sqrt
from layerjax.directions import squared_cosine_of_refraction

EXPONENT = 1.1
"""Exponent of the map between roughness and variance (Eq. 6)."""

WIDEST = 0.9999
"""Roughness that stands for all above, where the variance grows without bound."""

NARROWEST = 1e-6
"""Roughness that stands for all below (interfaces are wider)."""

LEAST_G = 1e-3
"""Stands for all asymmetries below, backward ones too: the variance of a phase function is that of its forward lobe."""


def variance(alpha: Array) -> Array:
    """f(alpha) = alpha^1.1 / (1 - alpha^1.1) (Belcour 2018, Eq. 6)."""
    # Eq. (6)
    return 1.0 / jnp.expm1(-EXPONENT * jnp.log(clamp_max(clamp_min(alpha, NARROWEST), WIDEST)))


def roughness(sigma: Array) -> Array:
    """The roughness of a variance, the inverse of `variance`."""
    return jnp.exp(-1.0 / EXPONENT * jnp.log1p(1.0 / clamp_min(sigma, NARROWEST**EXPONENT)))


def phase_variance(g: Array) -> Array:
    """Variance of the forward lobe of a Henyey-Greenstein phase function (Belcour 2018, Eq. 21)."""
    g = clamp_min(g, LEAST_G)
    return jnp.exp(0.8 * (jnp.log1p(-g) - jnp.log(g))) / (1.0 + g)


def transmission_scale(cosine: Array, ior: Array, refracted: Array) -> Array:
    """Roughness of a refracted lobe over that of the interface (Belcour 2018, Eq. 10, with its sign put right).

    Args:
        cosine: of incidence.
        ior: index on the far side over that on the side of incidence.
        refracted: cosine of refraction.
    """
    difference = 1.0 - cosine / (ior * refracted)
    return 0.5 * safe_sqrt(difference * difference + 1e-12)  # |.|, smooth where an interface vanishes


def bounded_refracted_cosine(cosine: Array, ior: Array, steepest: float) -> tuple[Array, Array]:
    """Cosine behind an interface, and whether there is one.

    Where ior < 1 `steepest` is the largest sine, which stands in beyond the critical angle; elsewhere every cosine has
    its own, grazing ones too.
    """
    squared = squared_cosine_of_refraction(cosine, ior)
    floor = jnp.where(ior < 1.0, 1.0 - steepest * steepest, 0.0)
    return jnp.sqrt(clamp_min(squared, floor)), squared > 0
