"""The walk of light on a rough surface, from facet to facet, over GGX facets.

After Heitz, Hanika, d'Eon & Dachsbacher 2016, "Multiple-scattering microfacet BSDFs with the Smith model".

Under the Smith assumption a rough surface is a medium of facets without a bottom. In the coordinate
height = -log C1(h) >= 0 (C1: the distribution of heights) it is homogeneous: a ray along w meets a facet after a free
path with extinction A(w) / |w_z|, A(w) = (sigma(w) - w_z) / 2 the projected area of the facets that face it, and has
left where the coordinate would fall below 0. Passing through a facet turns the surface over, C1 -> 1 - C1.

Directions are local to the side that the ray is on: z is positive away from the surface.
"""

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import safe_sqrt
from layerjax.directions import Vector, dot, flip, refract
from layerjax.normals.ggx import ggx_sample


def facing_area(w: Vector, alpha: Array) -> Array:
    """Projected area A(w) of the facets that face a ray along w: (sigma - w_z) / 2, without cancellation; above 0."""
    spread = alpha * alpha * (w[0] * w[0] + w[1] * w[1])
    sigma = safe_sqrt(spread + w[2] * w[2])
    floor = jnp.finfo(sigma.dtype).tiny * 1e4
    return 0.5 * jnp.where(w[2] > 0, (spread + floor) / (sigma + jnp.maximum(w[2], 0.0) + floor), sigma - w[2])


def next_height(w: Vector, height: Array, alpha: Array, free_path: Array) -> Array:
    """Height of a ray along w after a free path, which counts the facets met on average; below 0 it has left."""
    return height - w[2] * free_path / facing_area(w, alpha)


def optical_depth(w: Vector, height: Array, alpha: Array) -> Array:
    """Facets met on average on the way out along w, Lambda(w) height; infinite for light that goes down."""
    rises = w[2] > 0
    return jnp.where(rises, height * facing_area(w, alpha) / jnp.where(rises, w[2], 1.0), jnp.inf)


def escape_probability(w: Vector, height: Array, alpha: Array) -> Array:
    """Probability that light along w leaves the surface from this height without meeting a facet."""
    return jnp.exp(-optical_depth(w, height, alpha))


def opposite_height(height: Array) -> Array:
    """Height counted from the other side of the surface, -log(1 - exp(-height)), to rounding at both ends."""
    height = jnp.maximum(height, jnp.finfo(height.dtype).tiny)  # 0 would lie infinitely deep on the other side
    small = height < 0.6931
    return -jnp.where(small, jnp.log(-jnp.expm1(-height)), jnp.log1p(-jnp.exp(-height)))


def meet_facet(wi: Vector, alpha: Array, u1: Array, u2: Array) -> tuple[Vector, Array]:
    """Normal of the facet that light from wi (on either side of the horizon) meets, and its cosine with wi."""
    m = ggx_sample(wi, alpha, u1, u2)
    return m, jnp.clip(dot(wi, m), 0.0, 1.0)


def pass_through(wi: Vector, m: Vector, ior: Array, height: Array) -> tuple[Vector, Array, Array]:
    """Direction and height of light refracted at a facet, both as seen from the other side, and whether it exists."""
    refracted, exists = refract(wi, m, ior)
    return flip(refracted), opposite_height(height), exists
