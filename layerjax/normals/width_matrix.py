"""GGX normals whose widths are a symmetric matrix: of lobes that have two widths along axes of their own.

The matrix S has the widths as eigenvalues, along the directions in which slopes are so wide. Slopes are those of width
1 times S, so that density, projected area and visible normals are those of width 1 along stretched directions. Unlike
two widths and a tangent it has derivatives where the widths are equal and the tangent is any.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_min, safe_sqrt
from layerjax.directions import Vector, normalize
from layerjax.normals.ggx import ggx_sample
from layerjax.normals.widths import Widths

LEAST_WIDTH = 1e-4
"""The narrowest lobe that is evaluated."""


class WidthMatrix(eqx.Module):
    """A symmetric positive matrix of widths, by its entries."""

    xx: Array
    xy: Array
    yy: Array

    @property
    def determinant(self) -> Array:
        """Product of the widths."""
        return self.xx * self.yy - self.xy * self.xy

    @property
    def mean_square(self) -> Array:
        """Mean square of the width over all azimuths."""
        return 0.5 * (self.xx * self.xx + self.yy * self.yy) + self.xy * self.xy

    @property
    def mean_width(self) -> Array:
        """Root of `mean_square`."""
        return safe_sqrt(clamp_min(self.mean_square, LEAST_WIDTH**2))

    def width_seen(self, x: Array, y: Array) -> Array:
        """Width of isotropic facets that mask light about as much, from the components of its direction in the plane.

        The width along the azimuth of the light where it is grazing, their root mean square along the normal.
        """
        half_difference = 0.5 * (self.xx * self.xx - self.yy * self.yy)
        mixed = self.xy * (self.xx + self.yy)
        square = self.mean_square + half_difference * (x * x - y * y) + 2.0 * mixed * x * y
        return jnp.sqrt(clamp_min(square, LEAST_WIDTH**2))


def isotropic(alpha: Array) -> WidthMatrix:
    """One width."""
    return WidthMatrix(alpha, jnp.zeros_like(alpha), alpha)


def width_matrix(widths: Widths) -> WidthMatrix:
    """Two widths about a tangent."""
    return WidthMatrix(*rotate(jnp.asarray(widths.alpha), jnp.asarray(widths.alpha_y), widths.tangent))


def rotate(along: Array, across: Array, tangent: Array | None) -> tuple[Array, Array, Array]:
    """Entries xx, xy, yy of the symmetric matrix that has these eigenvalues along a tangent and across it."""
    if tangent is None:
        return along, jnp.zeros_like(along * across), across
    cosine, sine = jnp.cos(tangent), jnp.sin(tangent)
    xx, yy = along * cosine * cosine + across * sine * sine, along * sine * sine + across * cosine * cosine
    return xx, (along - across) * cosine * sine, yy


def matrix_density(m: Vector, widths: WidthMatrix) -> Array:
    """Density D(m) of normals above the horizon, 1/sr; the integral of D cos over the hemisphere is 1."""
    determinant = widths.determinant
    x = (widths.yy * m[0] - widths.xy * m[1]) / determinant
    y = (widths.xx * m[1] - widths.xy * m[0]) / determinant
    square = x * x + y * y + m[2] * m[2]
    return 1.0 / (np.pi * determinant * square * square)


def matrix_area(w: Vector, widths: WidthMatrix) -> Array:
    """Projected area along w of the facets that face w and of those that turn their backs."""
    x, y, z = _stretch(w, widths)
    return safe_sqrt(x * x + y * y + z * z)


def matrix_sample(wi: Vector, widths: WidthMatrix, u1: Array, u2: Array) -> Vector:
    """Facet normal seen from wi (above the horizon), with density G1 <wi, m> D(m) / cos."""
    unit = ggx_sample(normalize(_stretch(wi, widths)), jnp.ones_like(wi[2]), u1, u2)
    return normalize(_stretch(unit, widths))


def matrix_pdf(h: Vector, wi: Vector, widths: WidthMatrix) -> Array:
    """Density, 1/sr, of directions mirrored at what `matrix_sample` draws, by their half vector with wi."""
    return matrix_density(h, widths) / (2.0 * (wi[2] + matrix_area(wi, widths)))


def _stretch(w: Vector, widths: WidthMatrix) -> Vector:
    """S times the components in the plane, and z."""
    return widths.xx * w[0] + widths.xy * w[1], widths.xy * w[0] + widths.yy * w[1], w[2]
