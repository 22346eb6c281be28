"""Variances of lobes with two widths: a symmetric tensor in the tangent plane, which adds as variances do.

An isotropic variance is a multiple of the unit tensor, so that arrays may be added to tensors. What tensors are
multiplied by and divided by are arrays: shares of light, and factors of refraction.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_max, clamp_min
from layerjax.normals.width_matrix import LEAST_WIDTH, WidthMatrix, rotate
from layerjax.normals.widths import Widths
from layerjax.transport.lobes.variance import EXPONENT, NARROWEST, variance

SPLIT = {32: 5e-3, 64: 6e-6}
"""Least relative distance of eigenvalues that a quotient of differences is formed with, by bits: cube roots of the
rounding."""


class VarianceTensor(eqx.Module):
    """A symmetric tensor by its entries along x and y. Sums with arrays, products and quotients by them are tensors."""

    xx: Array
    xy: Array
    yy: Array

    __array_ufunc__ = None  # so that arrays of numpy leave sums and products to it

    def __add__(self, other: "Variance") -> "VarianceTensor":
        if isinstance(other, VarianceTensor):
            return VarianceTensor(self.xx + other.xx, self.xy + other.xy, self.yy + other.yy)
        return VarianceTensor(self.xx + other, self.xy, self.yy + other)

    def __mul__(self, factor: Array | float) -> "VarianceTensor":
        return VarianceTensor(self.xx * factor, self.xy * factor, self.yy * factor)

    def __truediv__(self, divisor: Array | float) -> "VarianceTensor":
        return VarianceTensor(self.xx / divisor, self.xy / divisor, self.yy / divisor)

    def __neg__(self) -> "VarianceTensor":
        return VarianceTensor(-self.xx, -self.xy, -self.yy)

    def __sub__(self, other: "Variance") -> "VarianceTensor":
        return self + (-other)

    def __rsub__(self, other: "Variance") -> "VarianceTensor":
        return -self + other

    __radd__, __rmul__ = __add__, __mul__


Variance = Array | VarianceTensor
"""The variance of a lobe: an array where it is the same along all azimuths."""

Variances = tuple[Variance, ...]
"""One for all channels, or one for each."""


def facet_variance(width: Array | Widths) -> Variance:
    """Variance of a width, or of two."""
    if not isinstance(width, Widths):
        return variance(width)
    return VarianceTensor(*rotate(variance(width.alpha), variance(width.alpha_y), width.tangent))


def scale_width(width: Array | Widths, scale: Array) -> Array | Widths:
    """A width, or two, times a scale."""
    if not isinstance(width, Widths):
        return scale * width
    return Widths(scale * width.alpha, scale * width.alpha_y, width.tangent)


def limit_variance(sigma: Variance, most: float) -> Variance:
    """A variance that is not larger than `most`; a tensor keeps its shape."""
    if not isinstance(sigma, VarianceTensor):
        return clamp_max(sigma, most)
    return sigma * (most / clamp_min(sigma.xx + sigma.yy, most))


def as_tensor(sigma: Variance) -> VarianceTensor:
    """A variance as a tensor."""
    if isinstance(sigma, VarianceTensor):
        return sigma
    return VarianceTensor(sigma, jnp.zeros_like(sigma), sigma)


def roughness_matrix(sigma: VarianceTensor) -> WidthMatrix:
    """The widths of a variance, within the range that lobes are evaluated in: `roughness` of a tensor.

    alpha^1.1 = sigma / (1 + sigma) (Eq. 6) is a quotient of tensors; only the power takes eigenvalues. About a tangent
    that is no axis, the smaller variance has the rounding of the larger one.
    """
    determinant = clamp_min(sigma.xx * sigma.yy - sigma.xy * sigma.xy, 0.0)
    whole = 1.0 + sigma.xx + sigma.yy + determinant
    xx, xy, yy = (sigma.xx + determinant) / whole, sigma.xy / whole, (sigma.yy + determinant) / whole
    middle, half = clamp_min(0.5 * (xx + yy), NARROWEST**EXPONENT), 0.5 * (xx - yy)
    apart, least = half * half + xy * xy, (SPLIT[jnp.finfo(middle.dtype).bits] * middle) ** 2
    distance = jnp.sqrt(apart + least * least / (apart + least))  # of eigenvalues that are equal, the least
    large = middle + distance
    small = determinant / whole / large
    wide, narrow = (
        jnp.exp(jnp.log(clamp_max(clamp_min(power, LEAST_WIDTH**EXPONENT), 1.0)) / EXPONENT) for power in (large, small)
    )
    mean, slope = 0.5 * (wide + narrow), 0.5 * (wide - narrow) / distance
    return WidthMatrix(mean + slope * half, slope * xy, mean - slope * half)
