"""Quadrature of the GGX facets that a direction sees, in coordinates about that direction.

A facet is told by the angle theta_d between its normal and the direction, on which Fresnel's equations depend, and by
an azimuth psi about the direction. So the critical angle is a line of constant theta_d: panels end there, with the root
of the refracted cosine taken out. They also end where parallels begin to be cut, by facets that turn their backs or by
light that is mirrored below the horizon. Both coordinates are stretched for the density of normals, so that the same
points serve alpha from 1e-4 to 1: theta_d like a sinh about its peak, psi by the Moebius map under which the density is
nearly even.
"""

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import at_least, at_most, safe_div, safe_sqrt
from layerjax.directions import Vector
from layerjax.normals.ggx import ggx_masking
from layerjax.quadrature import gauss_legendre

REACH = 3.0
"""Where the sinh of the stretch is bent to end: the narrowest lobe keeps points in its middle."""

LEAST_COSINE = 1e-9

Way = Literal["reflected", "refracted"]


class Parallels(NamedTuple):
    """Normals at one angle theta_d from a direction w = (-sine, 0, cosine), (nodes, points) each.

    sine, cosine: of theta_d less theta. facing, across: cosine and sine of theta_d. squeeze: of tan(psi/2), for the
    density of normals; end: of what is squeezed, where the normal, or the light mirrored at it, reaches the horizon.
    level: the density of normals times the visible area, without what psi changes.
    """

    sine: Array
    cosine: Array
    facing: Array
    across: Array
    squeeze: Array
    end: Array
    level: Array


def parallels(cosine: Array, sine: Array, polar: tuple[Array, Array], alpha: Array, way: Way) -> Parallels:
    """What facets at the angles `polar` (see `polar_angles`) from directions, (nodes,), have in common.

    Args:
        cosine, sine: of w, (nodes,).
        alpha: GGX width.
        way: what becomes of the light: "reflected", to above the horizon, or "refracted".
    """
    apart, measure = polar
    mu, sin_w = cosine[:, None], sine[:, None]
    sin_apart, cos_apart = jnp.sin(apart), jnp.cos(apart)
    c = at_least(mu * cos_apart - sin_w * sin_apart, LEAST_COSINE)
    s = at_least(sin_w * cos_apart + mu * sin_apart, 0.0)
    # the density of normals is that of 1 / (near + (far - near) sin(psi/2)^2)^2, nearly
    scale = 1.0 / (1.0 + 0.5 * alpha * alpha)
    least = 0.5 * alpha * alpha * scale
    near = least + scale * sin_apart * sin_apart / (1.0 + at_least(cos_apart, 0.0))
    far = least + scale * at_least(1.0 - mu * c + sin_w * s, 0.0)
    squeeze = jnp.sqrt(near / far)
    # psi ends where the normal, or the light mirrored at it, reaches the horizon
    level, swing = mu * c - (0.5 * mu / c if way == "reflected" else 0.0), sin_w * s
    up, down = safe_sqrt(swing + level), squeeze * safe_sqrt(swing - level)
    end = safe_div(up, down + safe_sqrt(up * up + down * down))
    visible = ggx_masking((-sin_w, jnp.zeros_like(mu), mu), alpha) / mu
    return Parallels(
        sin_apart, cos_apart, c, s, squeeze, end, (8.0 / jnp.pi) * alpha * alpha * measure * s * c * visible
    )


def seen_facets(cosine: Array, sine: Array, at: Parallels, alpha: Array, azimuths: int) -> tuple[Vector, Array, Array]:
    """Normals m seen along w = (-sine, 0, cosine), m . w, and their shares of the visible area: (nodes, points) each.

    They have y >= 0, and stand for their mirror images too. Left out are normals of which nothing goes the way asked
    for: the shares sum to 1 less those.

    Args:
        cosine, sine: of w, (nodes,).
        at: where they lie.
        alpha: GGX width.
        azimuths: points in psi.
    """
    mu, sin_w = cosine[:, None], sine[:, None]
    # tan(psi/2) is squeezed; in terms of v, the tangent of half of the angle that has it then
    x, w = (jnp.asarray(array, mu.dtype) for array in gauss_legendre(azimuths))
    v = at.end[..., None] * x
    cos_half, sin_half = (1.0 - v) * (1.0 + v), 2.0 * at.squeeze[..., None] * v
    norm = 1.0 / (cos_half * cos_half + sin_half * sin_half)
    turn = (at.level * at.end * at.squeeze)[..., None] * w * norm * (1.0 + v * v)
    back = 2.0 * sin_half * sin_half * norm  # 1 - cos(psi)
    # no differences of large numbers where lobes are narrow
    mx = at.sine[..., None] - (mu * at.across)[..., None] * back
    my = at.across[..., None] * 2.0 * sin_half * cos_half * norm
    mz = at.cosine[..., None] - (sin_w * at.across)[..., None] * back
    # in units of alpha: fourth powers of the narrowest have derivatives beyond single precision
    slopes = (mx / alpha) ** 2 + (my / alpha) ** 2
    shares = turn / (alpha * alpha) / (alpha * alpha) / (mz * mz + slopes) ** 2
    flat = (mu.shape[0], -1)
    facing = at.facing[..., None] * jnp.ones_like(back)
    return (mx.reshape(flat), my.reshape(flat), mz.reshape(flat)), facing.reshape(flat), shares.reshape(flat)


def polar_angles(cosine: Array, sine: Array, alpha: Array, ratio: Array, way: Way, points: int) -> tuple[Array, Array]:
    """theta_d - theta and its measure, (nodes, panels * points).

    ratio: index on the far side over that on the side of w. points: a panel; there are two, for "reflected" three.
    """
    theta = jnp.arctan2(sine, cosine)[:, None]
    total = ratio < 1.0  # reflection beyond the critical angle
    critical = jnp.where(total, jnp.arcsin(jnp.where(total, ratio, 0.5)), 0.5 * jnp.pi)
    quarter = 0.5 * jnp.pi
    if way == "reflected":
        cut, end = 0.5 * (quarter - theta), 0.5 * (quarter + theta)
        inner = at_most(critical, end)
    else:
        cut, end = quarter - theta, at_most(critical, quarter) * jnp.ones_like(theta)
        inner = end
    cut = at_most(cut, end)
    low, high = jnp.where(cut < inner, cut, inner), jnp.where(cut < inner, inner, cut)
    edges = jnp.concatenate([jnp.zeros_like(theta), low, high, end][: 4 if way == "reflected" else 3], axis=1)
    root = edges[:, 1:] == inner  # also where nothing is totally reflected: points move smoothly as that begins
    places = _place((edges - theta) / alpha)
    first, width = places[:, :-1, None], (places[:, 1:] - places[:, :-1])[..., None]
    x, w = (jnp.asarray(array, theta.dtype) for array in gauss_legendre(points))
    share = jnp.where(root[..., None], 1.0 - (1.0 - x) ** 2, x)
    measure = jnp.where(root[..., None], 2.0 * (1.0 - x) * w, w)
    stretched, slope = _stretched(first + width * share)
    flat = (theta.shape[0], -1)
    return (alpha * stretched).reshape(flat), (alpha * width * measure * slope).reshape(flat)


def _place(t: Array) -> Array:
    y = jnp.arcsinh(t)
    return y / jnp.sqrt(1.0 + (y / REACH) ** 2)


def _stretched(place: Array) -> tuple[Array, Array]:
    """t of a place, and its slope: the inverse of `_place`."""
    inverse = 1.0 / jnp.sqrt(1.0 - (place / REACH) ** 2)
    y = place * inverse
    rise = jnp.expm1(y)
    fall = rise / (1.0 + rise)
    return 0.5 * (rise + fall), (1.0 + 0.5 * (rise - fall)) * inverse * inverse * inverse
