"""Rough dielectric coats over diffuse light, from tables (de Dinechin & Belcour 2022).

Three energies describe a coat over a Lambertian base: T01, transmitted inwards from a direction, R10, diffuse light
sent back from below, and T10, diffuse light let out. Each contains what the coat absorbs: tau is its transmittance
along the normal, and light at a cosine c in it is left with tau^(1/c). The facets scatter as often as it takes (Heitz
et al. 2016): without absorption nothing is lost, R10 + T10 = 1.

The tables hold T01 and R10 only. By reciprocity T10 is a mean of T01 over the cosine, and the lobe that leaves is T01
of the outgoing direction, so that its width is another such mean.

Tables are reduced by singular vectors (Eqs. 6-8). Those in tau are sums of powers tau^(1/c); those in alpha, and what
is left of the cosine and the index, are uniform cubic splines of variables in which the functions are smooth. The index
is split at 1, where total reflection changes sides.

All functions take arrays that broadcast: cosines in (0, 1], alpha (GGX width) in [1e-4, 1], ior (index of the coat over
that outside) in [0.25, 4], tau in [0, 1].
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, safe_sqrt
from layerjax.directions import Vector
from layerjax.microsurface.energy_tables import index_variable
from layerjax.microsurface.splines import taps, weights
from layerjax.quadrature import gauss_legendre, panels
from layerjax.tables import load
from layerjax.transport.lobes.variance import bounded_refracted_cosine, roughness, transmission_scale, variance

Table = Mapping[str, np.ndarray]

GRAIN = 0.04
"""Distance from the critical cosine, and alpha, below which the grid is uniform in them; above, in the logarithm."""

NODES = 24
"""Cosines of a mean over diffuse light, in each of its two panels."""

LEAST_ENERGY = 1e-5
"""Energy below which the ratio of two tabulated energies fades to a fixed value."""

ABSENT = 1e4
"""Optical depth that stands for a transmittance of 0."""

STEEPEST = 0.999
"""Sine of refraction that stands in beyond the critical angle."""


class Coat(NamedTuple):
    """A rough dielectric interface and the absorbing medium below it.

    alpha: GGX width. ior: index of the medium over that outside the whole stack. tau: its transmittance along the
    normal.
    """

    alpha: Array
    ior: Array
    tau: Array


def coated_transmission(cosine: Array, alpha: Array, ior: Array, tau: Array) -> Array:
    """T01: share of light from outside at this cosine that arrives at the bottom of a coat."""
    return transmission(load("diffuse_interface"), cosine, alpha, ior, tau)


class Means(NamedTuple):
    """What a coat does to diffuse light from its bottom.

    leaving: T10, let out. returned: R10, sent back. clear: T10 of the same coat without absorption. width: alpha_2+,
    GGX width of the lobe that is let out: lit along the normal, such a lobe has the second moment sigma_2+ of that
    light on the disc of directions (per axis).
    """

    leaving: Array
    returned: Array
    clear: Array
    width: Array


def coat_means(alpha: Array, ior: Array, tau: Array) -> Means:
    """T10, R10 and alpha_2+ of a coat at once."""
    table, (alpha, ior, tau) = load("diffuse_interface"), (jnp.asarray(x) for x in (alpha, ior, tau))
    axes = len(jnp.broadcast_shapes(alpha.shape, ior.shape, tau.shape))
    critical = critical_cosine(ior.reshape((1,) * (axes - ior.ndim) + ior.shape))
    edges = jnp.stack([jnp.zeros_like(critical), critical, jnp.ones_like(critical)], axis=-1)
    cosine, weight = (jnp.moveaxis(x, -1, 0).astype(critical.dtype) for x in panels(edges, NODES))
    parts, side = _transmission_parts(table, cosine, alpha, ior)
    weight = 2.0 * weight * cosine / (ior * ior)  # by reciprocity
    one = jnp.ones_like(tau)
    clear, entering = (clamp_min(_sum_absorption(table, "absorption", parts, side, t), 0.0) for t in (one, tau))
    out_clear, out = jnp.sum(weight * clear, axis=0), jnp.sum(weight * entering, axis=0)
    moment = jnp.sum(weight * entering * 0.5 * (1.0 - cosine) * (1.0 + cosine), axis=0)
    narrow = 0.25 * clamp_max(ior * ior, 1.0)  # even on the part of the disc where light can leave
    back, back_clear = (clamp_min(reflection(table, alpha, ior, t), 0.0) for t in (tau, one))
    # without absorption all that does not leave returns: the smaller of the two is the more exact, and decides
    all_clear = jnp.where(ior < 1.0, 1.0 - back_clear, clamp_max(out_clear, 1.0))
    absorbed = clamp_max((back + LEAST_ENERGY * tau) / (back_clear + LEAST_ENERGY), 1.0)
    return Means(
        leaving=out * all_clear / out_clear,
        returned=(1.0 - all_clear) * absorbed,
        clear=all_clear,
        width=width((moment + LEAST_ENERGY * narrow) / (out + LEAST_ENERGY)),
    )


def indirect_energy(entering: Array, leaving: Array, returned: Array, albedo: Array) -> Array:
    """rho_2+: energy of the light that has met the base, from T01, T10, R10 and the base's albedo (Eqs. 2-3)."""
    return entering * albedo * leaving / (1.0 - albedo * returned)


def closed_form(entering_i: Array, entering_o: Array, returned: Array, albedo: Array, ior: Array) -> Array:
    """BRDF, 1/sr, of the light that has met the base: T01(i) T01(o) rho / (pi n^2 (1 - rho R10)).

    Exact for what the energies describe, and reciprocal: the base forgets where light came from, and what leaves along
    wo is, by reciprocity, what would arrive from there.

    Args:
        entering_i, entering_o: T01 along both directions.
        returned: R10.
        albedo: of the base, in [0, 1].
        ior: index of the coat over that outside.
    """
    return entering_i * entering_o * albedo / (np.pi * ior * ior * (1.0 - albedo * returned))


def indirect_lobe(wo: Vector, alpha: Array, energy: Array) -> Array:
    """BRDF, 1/sr, of a GGX lobe around the normal with width alpha_2+ and energy rho_2+ (Eq. 5).

    The printed denominator is corrected to 4 cos(theta_o), as the lobe is lit along the normal; it is scaled to its
    energy. Not reciprocal.

    Args:
        wo: above the horizon.
    """
    across = (wo[0] * wo[0] + wo[1] * wo[1]) / (2.0 * (1.0 + wo[2]))  # squared sine of the half vector
    squared = alpha * alpha
    root = alpha / (across + squared * (1.0 - across))
    sigma = safe_sqrt(squared * (1.0 - wo[2] * wo[2]) + wo[2] * wo[2])
    whole, _ = normal_lobe(alpha)
    return energy * root * root / (2.0 * np.pi * (wo[2] + sigma) * whole)  # Eq. (5), G1 over its cosine


def stack_lobe(coats: Sequence[Coat], albedo: Array, cosine: Array) -> tuple[Array, Array]:
    """Energy and GGX width of the lobe of light that has met the base of a stack of coats (Algorithm 1, corrected).

    Light comes down as a beam, by directional energies; from the base up it is diffuse, and every interface and what
    lies below it is met with means over diffuse light. Widths are bounded by that of light diffuse below the interface.
    Exact for one coat. Several rough interfaces are treated as if a beam stayed a beam between them.

    Args:
        coats: from top to bottom, at least one; their fields broadcast with the other arguments.
        albedo: of the base.
        cosine: of incidence on the top.
    """
    indices = [jnp.asarray(1.0), *(coat.ior for coat in coats)]
    relative = [below / above for above, below in pairwise(indices)]
    means = [coat_means(coat.alpha, n, coat.tau) for coat, n in zip(coats, relative, strict=True)]
    energy, below, sigma = _arrival_share(coats, relative, cosine), albedo, jnp.asarray(0.0)
    for i in reversed(range(len(coats))):
        alpha, n, mean = coats[i].alpha, relative[i], means[i]
        again = 1.0 / (1.0 - mean.returned * below)
        widest = variance(mean.width)
        if i == len(coats) - 1:
            energy, sigma = indirect_energy(energy, mean.leaving, mean.returned, albedo), widest
        else:
            energy = energy * mean.leaving * again  # Eq. (12)
            through = variance(transmission_scale(jnp.ones_like(n), 1.0 / n, jnp.ones_like(n)) * alpha)
            bounces = (again - 1.0) * (variance(alpha) + variance(coats[i + 1].alpha))
            sigma = clamp_max(n * (sigma + bounces) + through, widest)  # Eq. (13), and the bound below it
        # of diffuse light from above: reflected by the interface, and by all below it
        below = 1.0 - n * n * (mean.clear - mean.leaving * mean.leaving * below * again)
    return energy, roughness(sigma)


def _arrival_share(coats: Sequence[Coat], relative: Sequence[Array], cosine: Array) -> Array:
    """Share of light at this cosine that arrives at the base for the first time."""
    energy, back = jnp.ones_like(cosine), jnp.zeros_like(cosine)
    for coat, n in zip(coats, relative, strict=True):
        clear = coated_transmission(cosine, coat.alpha, n, jnp.ones_like(coat.tau))
        series = 1.0 / (1.0 - back * (1.0 - clear))
        energy = energy * coated_transmission(cosine, coat.alpha, n, coat.tau) * series
        cosine, _ = bounded_refracted_cosine(cosine, n, STEEPEST)
        # a smooth interface reflects a ray from either side equally
        back = (1.0 - clear + clear * clear * back * series) * _powers(coat.tau, 2.0 / cosine)
    return energy


def normal_lobe(alpha: Array) -> tuple[Array, Array]:
    """Energy N of a GGX lobe (reflectance 1) lit along the normal, and its second moment on the disc, per axis."""
    squared = (jnp.asarray(alpha) ** 2)[..., None]
    x, w = (jnp.asarray(array, squared.dtype) for array in gauss_legendre(NODES))
    # the share of facets steeper than tan(theta_m) is alpha^2 / (alpha^2 + tan^2): nodes even in its logarithm
    length = jnp.log1p(1.0 / squared)
    steeper = jnp.exp(-length * x)
    weight = w * length * steeper
    tan2 = squared * (1.0 - steeper) / steeper
    cosine = (1.0 - tan2) / (1.0 + tan2)  # of the reflected direction
    sine2 = 4.0 * tan2 / (1.0 + tan2) ** 2
    masking = 2.0 * cosine / (cosine + safe_sqrt(squared * sine2 + cosine * cosine))
    energy = jnp.sum(weight * masking, axis=-1)
    return energy, jnp.sum(weight * masking * 0.5 * sine2, axis=-1) / energy


def width(moment: Array) -> Array:
    """GGX width of the lobe, lit along the normal, with this second moment on the disc: inverse of `normal_lobe`."""
    table = load("diffuse_interface")
    first, last = (float(x) for x in table["moments"])
    place = (jnp.log(clamp_max(clamp_min(moment, first), last)) - math.log(first)) / math.log(last / first)
    index, weights = spline(place, table["widths"].shape[0])
    return jnp.exp(jnp.sum(_pick(table["widths"], weights.dtype, index) * weights, axis=-1))


def transmission(table: Table, cosine: Array, alpha: Array, ior: Array, tau: Array) -> Array:
    """T01 from a table (Eq. 8)."""
    parts, side = _transmission_parts(table, cosine, alpha, ior)
    return clamp_min(_sum_absorption(table, "absorption", parts, side, tau), 0.0)


def reflection(table: Table, alpha: Array, ior: Array, tau: Array) -> Array:
    """R10 from a table, in two dimensions and tau."""
    shape = jnp.broadcast_shapes(jnp.shape(alpha), jnp.shape(ior))
    side = jnp.broadcast_to(jnp.asarray(jnp.asarray(ior) < 1.0, jnp.int32), shape)
    _, roughnesses, indices, _ = table["returned"].shape
    i, along = spline(jnp.broadcast_to(roughness_variable(alpha), shape), roughnesses)
    j, across = spline(jnp.broadcast_to(index_variable(ior), shape), indices)
    plane = _pick(table["returned"], along.dtype, side[..., None, None], i[..., :, None], j[..., None, :])
    parts = jnp.sum((along[..., :, None] * across[..., None, :])[..., None] * plane, axis=(-3, -2))
    return _sum_absorption(table, "returned_absorption", parts, side, tau)


def cosine_variable(cosine: Array, ior: Array) -> Array:
    """Where a cosine lies on its axis, in [0, 1]: dense around the critical cosine (0 if there is none)."""
    critical = critical_cosine(ior)
    low, high = jnp.arcsinh(critical / GRAIN), jnp.arcsinh((1.0 - critical) / GRAIN)
    return (jnp.arcsinh((cosine - critical) / GRAIN) + low) / (low + high)


def roughness_variable(alpha: Array) -> Array:
    """Where an alpha lies on its axis, in [0, 1]."""
    return jnp.arcsinh(alpha / GRAIN) / math.asinh(1.0 / GRAIN)


def critical_cosine(ior: Array) -> Array:
    """Outer cosine below which nothing enters a smooth coat; 0 if it is not thinner than what is outside."""
    return safe_sqrt((1.0 - ior) * (1.0 + ior))


def _transmission_parts(table: Table, cosine: Array, alpha: Array, ior: Array) -> tuple[Array, Array]:
    """T01's parts of each function of tau, (..., functions), and the side of 1 that the index is on."""
    _, cosines, indices, *_ = table["planes"].shape
    shape = jnp.broadcast_shapes(jnp.shape(cosine), jnp.shape(alpha), jnp.shape(ior))
    side = jnp.broadcast_to(jnp.asarray(jnp.asarray(ior) < 1.0, jnp.int32), shape)
    i, along = spline(jnp.broadcast_to(cosine_variable(cosine, ior), shape), cosines)
    j, across = spline(jnp.broadcast_to(index_variable(ior), shape), indices)
    k, rough = spline(jnp.broadcast_to(roughness_variable(alpha), shape), table["roughnesses"].shape[1])
    plane = _pick(table["planes"], along.dtype, side[..., None, None], i[..., :, None], j[..., None, :])
    basis = _pick(table["roughnesses"], rough.dtype, side[..., None], k)
    weights = along[..., :, None] * across[..., None, :]
    smooth = jnp.sum(weights[..., None, None] * plane, axis=(-4, -3))
    return jnp.sum(smooth * jnp.sum(rough[..., None, None] * basis, axis=-3), axis=-1), side


def spline(place: Array, coefficients: int) -> tuple[Array, Array]:
    """First of four coefficients of a uniform cubic spline on [0, 1], all their indices, and their weights."""
    first, beyond, _ = taps(place, coefficients)
    return first[..., None] + np.arange(4), jnp.stack(weights(beyond), axis=-1)


def _pick(values: np.ndarray, dtype: jnp.dtype, *index: Array) -> Array:
    return jnp.asarray(values, dtype)[index]


def _sum_absorption(table: Table, name: str, parts: Array, side: Array, tau: Array) -> Array:
    """Sum over the basis in tau of its functions times their parts (..., functions)."""
    powers = _powers(jnp.asarray(tau)[..., None], 1.0 / jnp.asarray(table["cosines"], parts.dtype))
    basis = jnp.asarray(table[name], parts.dtype)  # (side, function, power)
    above, below = (jnp.sum(parts * (powers @ basis[s].T), axis=-1) for s in (0, 1))
    return jnp.where(side == 0, above, below)


def _powers(tau: Array, exponent: Array) -> Array:
    """tau^exponent for exponents >= 1; 0, with gradient 0, at tau = 0."""
    tau = jnp.asarray(tau)
    some = tau > jnp.finfo(tau.dtype).tiny
    depth = jnp.where(some, -jnp.log(jnp.where(some, tau, 0.5)), ABSENT)
    return jnp.exp(-depth * exponent)
