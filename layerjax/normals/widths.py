"""Facets with two widths, as of a brushed metal: isotropic facets of width 1, stretched along two axes.

Slopes of facets are those of width 1 times alpha along the tangent and alpha_y across it (Heitz 2014). So density,
projected area and visible normals are those of width 1 along stretched directions; what the stretch does to solid angle
is a factor.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._checks import abbreviate
from layerjax._numerics import safe_sqrt
from layerjax._parameters import as_floating, check_range, is_placeholder
from layerjax.directions import Vector, normalize
from layerjax.quadrature import gauss_legendre

LEAST_TANGENT = 1e-6
"""Length of what a tangent has in the plane of the surface."""


class StudentWidth(eqx.Module):
    """A width, and the exponent gamma of Student-t slopes (`layerjax.normals.student`)."""

    alpha: Array
    gamma: Array


class Widths(eqx.Module):
    """Widths along a tangent and across it, and the azimuth of the tangent, in radians (None: 0).

    gamma: exponent of Student-t slopes, None of others.
    """

    alpha: Array
    alpha_y: Array
    tangent: Array | None = None
    gamma: Array | None = None


OneWidth = Array | StudentWidth
"""One width, with all that its distribution needs."""

Width = OneWidth | Widths
"""One width, or two."""


def narrowest(width: Width) -> Array:
    """The smaller of the widths."""
    if isinstance(width, StudentWidth):
        return jnp.asarray(width.alpha)
    return jnp.minimum(width.alpha, width.alpha_y) if isinstance(width, Widths) else jnp.asarray(width)


def cast_width(width: OneWidth, dtype: Any) -> OneWidth:
    """A width in a floating type."""
    if isinstance(width, StudentWidth):
        return StudentWidth(jnp.asarray(width.alpha, dtype), jnp.asarray(width.gamma, dtype))
    return jnp.asarray(width, dtype)


def unit_width(widths: Widths, like: Array) -> OneWidth:
    """The width of the facets that two widths stretch."""
    return jnp.ones_like(like) if widths.gamma is None else StudentWidth(jnp.ones_like(like), widths.gamma)


def stretch(w: Vector, widths: Widths) -> Vector:
    """A direction w as facets of width 1 see it, not of unit length: its components, times the widths, and z."""
    x, y = _turn(w, widths, 1.0)
    return widths.alpha * x, widths.alpha_y * y, w[2]


def shrink(m: Vector, widths: Widths) -> Vector:
    """A normal m as one of facets of width 1, not of unit length: its components, over the widths, and z."""
    x, y = _turn(m, widths, 1.0)
    return x / widths.alpha, y / widths.alpha_y, m[2]


def from_unit_width(m: Vector, widths: Widths) -> Vector:
    """The normal that one of facets of width 1 stands for."""
    x, y = _turn((widths.alpha * m[0], widths.alpha_y * m[1], m[2]), widths, -1.0)
    return normalize((x, y, m[2]))


def _turn(w: Vector, widths: Widths, sign: float) -> tuple[Array, Array]:
    """x and y in the frame of the tangent (sign 1), or back from it."""
    if widths.tangent is None:
        return w[0], w[1]
    cosine, sine = jnp.cos(widths.tangent), sign * jnp.sin(widths.tangent)
    return cosine * w[0] + sine * w[1], cosine * w[1] - sine * w[0]


def unit_grid(polar: int, azimuths: int, *, round_axis: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Uniform numbers u1, u2 by which visible normals are drawn, as a quadrature: with their weights, (points,) each.

    round_axis: u1 is an azimuth, and u2 a cap from its pole to its rim, as of GGX normals; else both are quantiles of
    slopes, which reach far at their ends.
    """
    s, w = gauss_legendre(polar)
    if round_axis:
        second, weight = s * s, 2.0 * s * w
        first, even = (np.arange(azimuths) + 0.5) / azimuths, np.full(azimuths, 1.0 / azimuths)
    else:
        second, weight = _spread(s, w)
        first, even = _spread(*gauss_legendre(azimuths))
    u1, u2 = np.meshgrid(first, second, indexing="ij")
    return u1.ravel(), u2.ravel(), np.outer(even, weight).ravel()


def _spread(s: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points crowded at both ends of (0, 1), and their weights."""
    return s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) * w


def azimuth_of_tangent(name: str, tangent: Any) -> Any:
    """The azimuth of a tangent, in radians, which may be given as a vector, of any length, in the plane of the surface.

    An array whose last axis is 3 counts as vectors.
    """
    if tangent is None or is_placeholder(tangent):
        return tangent
    array = as_floating(name, tangent)
    if array.shape[-1:] == (3,):
        x, y = array[..., 0], array[..., 1]
        if not isinstance(array, jax.core.Tracer) and np.any(np.hypot(np.asarray(x), np.asarray(y)) < LEAST_TANGENT):
            raise ValueError(f"{name}: {abbreviate(tangent)} has no part in the plane of the surface")
        array = jnp.arctan2(y, x)
    elif array.ndim and isinstance(tangent, list | tuple):
        raise ValueError(f"{name}: {abbreviate(tangent)} is neither an azimuth nor a vector (x, y, z)")
    check_range(name, array)
    return array


def length(v: Vector) -> Array:
    """Length of a vector."""
    return safe_sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
