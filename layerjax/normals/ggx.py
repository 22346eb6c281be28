"""Normals of the facets of a rough surface: GGX (Walter et al. 2007), with Smith masking.

They are the "surface" flakes of `layerjax.normals.sggx` about the normal of the surface, cut at the horizon.
"""

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import safe_sqrt
from layerjax.directions import Vector, normalize
from layerjax.normals.sggx import sggx_area, sggx_density


def ggx_density(m: Vector, alpha: Array) -> Array:
    """Density D(m) of facet normals above the horizon, 1/sr; the integral of D cos over the hemisphere is 1."""
    return sggx_density(m, "surface", alpha, None)


def ggx_area(w: Vector, alpha: Array) -> Array:
    """Projected area sigma(w) along w of the facets that face w and of those that turn their backs, in [alpha, 1]."""
    return sggx_area(w, "surface", alpha, None)


def ggx_masking(w: Vector, alpha: Array) -> Array:
    """Smith masking G1(w) = 2 cos / (cos + sigma(w)) for w above the horizon (Walter 2007, Eq. 34)."""
    cosine = w[2]
    return 2.0 * cosine / (cosine + ggx_area(w, alpha))


def ggx_sample(wi: Vector, alpha: Array, u1: Array, u2: Array) -> Vector:
    """Facet normal seen from wi (above the horizon), with density G1 <wi, m> D(m) / cos (Dupuy & Benyoub 2023)."""
    v = normalize((alpha * wi[0], alpha * wi[1], wi[2]))
    phi = 2.0 * jnp.pi * u1
    z = (1.0 - u2) * (1.0 + v[2]) - v[2]
    sine = safe_sqrt(1.0 - z * z)
    h = (sine * jnp.cos(phi) + v[0], sine * jnp.sin(phi) + v[1], z + v[2])
    return normalize((alpha * h[0], alpha * h[1], h[2]))
