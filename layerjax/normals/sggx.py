"""Normals of flakes in a volume: SGGX (Heitz et al. 2015, "The SGGX microflake distribution").

Both kinds of flake are symmetric about an axis a, so everything needed follows from the two squared lengths of a
direction across and along it: S = radial^2 (I - a a') + axial^2 a a', with (radial, axial) = (alpha, 1) for "surface"
flakes and (1, alpha) for "fiber" flakes.

Densities are written in tangential form (squared lengths, never 1 - cos^2): the usual form loses every digit in float32
below alpha = 1e-3.
"""

from typing import Literal

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import safe_sqrt
from layerjax.directions import Vector, add, combine, cross, dot, frame, normalize, scale

Kind = Literal["surface", "fiber"]


def squared_lengths(w: Vector, axis: Vector | None) -> tuple[Array, Array]:
    """Squared lengths of w across and along the axis (None: the z axis, at no cost)."""
    if axis is None:
        return w[0] * w[0] + w[1] * w[1], w[2] * w[2]
    along = dot(w, axis)
    across = cross(w, axis)
    return dot(across, across), along * along


def radii(kind: Kind, alpha: Array) -> tuple[Array, Array]:
    """(radial, axial) half widths of the flake ellipsoid."""
    one = jnp.ones_like(alpha)
    return (alpha, one) if kind == "surface" else (one, alpha)


def sggx_area(w: Vector, kind: Kind, alpha: Array, axis: Vector | None) -> Array:
    """Projected area sigma(w) = sqrt(w' S w) of the flakes, in [alpha, 1] (Wang 2022, Eq. 3)."""
    across, along = squared_lengths(w, axis)
    squared = alpha * alpha
    return safe_sqrt(squared * across + along if kind == "surface" else across + squared * along)


def sggx_density(m: Vector, kind: Kind, alpha: Array, axis: Vector | None) -> Array:
    """Density D(m) of flake normals, 1/sr, even in m (Wang 2022, Eq. 7 with the prefactor 1/(pi sqrt(det S))).

    Not a probability density: its mean *projected* area is 1 along the axis of surface flakes.
    """
    across, along = squared_lengths(m, axis)
    squared = alpha * alpha
    if kind == "surface":
        ratio = 1.0 / (across + squared * along)
        return (squared / jnp.pi) * ratio * ratio
    ratio = 1.0 / (squared * across + along)
    return (squared * alpha / jnp.pi) * ratio * ratio


def stretch(w: Vector, across: Array, along: Array, axis: Vector | None) -> Vector:
    """w with its part across the axis scaled by `across` and its part along it by `along`."""
    if axis is None:
        return (across * w[0], across * w[1], along * w[2])
    return combine(across, w, (along - across) * dot(w, axis), axis)


def sggx_sample(wi: Vector, kind: Kind, alpha: Array, axis: Vector | None, u1: Array, u2: Array) -> Vector:
    """Flake normal seen from wi, with density <wi, m> D(m) / sigma(wi), from two uniform numbers.

    A cosine-weighted direction about the stretched wi, stretched back: exact for both kinds and any axis.
    """
    radial, axial = radii(kind, alpha)
    v = normalize(stretch(wi, radial, axial, axis))
    tangent, bitangent = frame(v)
    radius, phi = safe_sqrt(u1), 2.0 * jnp.pi * u2
    x, y, z = radius * jnp.cos(phi), radius * jnp.sin(phi), safe_sqrt(1.0 - u1)
    local = add(combine(x, tangent, y, bitangent), scale(z, v))
    return normalize(stretch(local, radial, axial, axis))
