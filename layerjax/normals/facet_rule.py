"""Quadrature of the facets that a direction sees, in coordinates about that direction.

A facet has coordinates: the angle theta_d between its normal and the direction, on which Fresnel's equations depend,
and an azimuth psi about the direction. So the critical angle is a line of constant theta_d: panels end there, with the
root of the refracted cosine taken out. They also end where parallels begin to be cut, by facets that turn their backs
or by light that is mirrored below the horizon. Points move smoothly with the width and the index, and so do the sums:
no point crosses an edge of what is summed.

Both coordinates are fitted to the density of normals, so that the same points serve all widths. GGX: theta_d is
stretched like a sinh about its peak, psi by the Moebius map under which the density is nearly even; also of Student-t
slopes, which may have tails. vMF and Beckmann normals have none: both coordinates end where the density of vMF normals
does, which is no narrower.
"""

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, safe_div, safe_sqrt
from layerjax.directions import Vector
from layerjax.normals import vmf
from layerjax.normals.facets import Distribution, density, twice_projected_area
from layerjax.normals.ggx import ggx_masking
from layerjax.normals.widths import OneWidth, StudentWidth, narrowest
from layerjax.quadrature import gauss_legendre

STRETCH_LIMIT = 3.0
"""Where the sinh of the stretch is bent to end: the narrowest lobe keeps points in its middle."""

VMF_EXTENT = 3.4
"""Widths alpha from their peak to where vMF normals end: 1e-5 of them lie beyond."""

SOFT = 0.6
"""Share of that reach within which an edge of a panel lies whose root is wholly removed."""

CROWDING = 1.5
"""Of `_crowd_at_end`, at gamma = 2: where tails are short nothing is crowded."""

LEAST_COSINE = 1e-9

FacetEvent = Literal["reflected", "refracted"]


def has_tails(distribution: Distribution) -> bool:
    """Whether points are placed as for GGX normals."""
    return distribution in ("ggx", "gtr")


class Parallels(NamedTuple):
    """Normals at one angle theta_d from a direction w = (-sine, 0, cosine), (nodes, points) each.

    sine, cosine: of theta_d less theta. facing, across: cosine and sine of theta_d. squeeze: of tan(psi/2), for the
    density of normals; end: of what is squeezed, where the normal, or the light mirrored at it, reaches the horizon;
    start: where refracted light comes above it (None: 0, of reflected light).
    level: the density of normals (others: 1) times the visible area, without what psi changes.
    """

    sine: Array
    cosine: Array
    facing: Array
    across: Array
    squeeze: Array
    end: Array
    level: Array
    start: Array | None = None


def parallels(
    cosine: Array,
    sine: Array,
    polar: tuple[Array, Array],
    width: OneWidth,
    distribution: Distribution,
    ratio: Array,
    event: FacetEvent,
) -> Parallels:
    """What facets at the angles `polar` (see `polar_angles`) from directions, (nodes,), have in common.

    Args:
        cosine, sine: of w, (nodes,).
        width, distribution: of the normals.
        ratio: index on the far side over that on the side of w.
        event: what becomes of the light: "reflected", to above the horizon, or "refracted".
    """
    apart, measure = polar
    alpha = narrowest(width)
    mu, sin_w = cosine[:, None], sine[:, None]
    sin_apart, cos_apart = jnp.sin(apart), jnp.cos(apart)
    c = clamp_min(mu * cos_apart - sin_w * sin_apart, LEAST_COSINE)
    s = clamp_min(sin_w * cos_apart + mu * sin_apart, 0.0)
    if has_tails(distribution):
        # the density of normals is that of 1 / (near + (far - near) sin(psi/2)^2)^2, nearly
        scale = 1.0 / (1.0 + 0.5 * alpha * alpha)
        least = 0.5 * alpha * alpha * scale
        near = least + scale * sin_apart * sin_apart / (1.0 + clamp_min(cos_apart, 0.0))
        far = least + scale * clamp_min(1.0 - mu * c + sin_w * s, 0.0)
        squeeze = jnp.sqrt(near / far)
    else:
        squeeze = jnp.ones_like(s)
    if distribution == "ggx":
        visible = ggx_masking((-sin_w, jnp.zeros_like(mu), mu), alpha) / mu
        scale_of_density = (8.0 / jnp.pi) * alpha * alpha
    else:
        visible = 2.0 / twice_projected_area(mu, (-sin_w, jnp.zeros_like(mu), mu), width, distribution)
        scale_of_density = jnp.asarray(8.0, mu.dtype)
    # psi ends where the normal, or the light mirrored at it, reaches the horizon
    level, swing = mu * c - (0.5 * mu / c if event == "reflected" else 0.0), sin_w * s
    end = _azimuth_of(swing, level, squeeze)
    if not has_tails(distribution):
        # the density goes like exp(-2 kappa sin_w s sin(psi/2)^2): by this sine, and up to a tangent of psi/4 beyond it
        last = VMF_EXTENT / jnp.sqrt(1.0 + 2.0 * vmf.concentration(alpha) * swing)
        end = clamp_max(end, 0.5 * last * (1.0 + last * last))
    start = None
    if event == "refracted":
        total = ratio < 1.0  # else all of the light comes through
        n = jnp.where(total, ratio, 0.5)
        # of normals, mz at most: mu / (c - n cos(theta_t)), without the difference
        highest = mu * (c + n * safe_sqrt(1.0 - (s / n) ** 2)) / ((1.0 - n) * (1.0 + n))
        start = jnp.where(total, clamp_max(_azimuth_of(swing, mu * c - highest, squeeze), end), 0.0)
    return Parallels(sin_apart, cos_apart, c, s, squeeze, end, scale_of_density * measure * s * c * visible, start)


def _azimuth_of(swing: Array, level: Array, squeeze: Array) -> Array:
    """psi where level + swing cos(psi) is 0, as the tangent of a quarter of what is squeezed; else 0 or 1."""
    up, down = safe_sqrt(swing + level), squeeze * safe_sqrt(swing - level)
    return safe_div(up, down + safe_sqrt(up * up + down * down))


def visible_normals(
    cosine: Array, sine: Array, circles: Parallels, width: OneWidth, distribution: Distribution, azimuths: int
) -> tuple[Vector, Array, Array]:
    """Normals m seen along w = (-sine, 0, cosine), m . w, and their shares of the visible area: (nodes, points) each.

    They have y >= 0, and stand for their mirror images too. Normals are omitted that send nothing the requested way
    for: the shares sum to 1 less those.

    Args:
        cosine, sine: of w, (nodes,).
        circles: where they lie.
        width, distribution: of the normals.
        azimuths: points in psi.
    """
    alpha = narrowest(width)
    mu, sin_w = cosine[:, None], sine[:, None]
    # tan(psi/2) is squeezed; in terms of v, the tangent of half of the angle that has it then
    x, w = (jnp.asarray(array, mu.dtype) for array in gauss_legendre(azimuths))
    if isinstance(width, StudentWidth):
        x, w = _crowd_at_end(x, w, width.gamma)
    length, v = circles.end, circles.end[..., None] * x
    if circles.start is not None:
        length = circles.end - circles.start
        v = circles.start[..., None] + length[..., None] * x
    cos_half, sin_half = (1.0 - v) * (1.0 + v), 2.0 * circles.squeeze[..., None] * v
    norm = 1.0 / (cos_half * cos_half + sin_half * sin_half)
    turn = (circles.level * length * circles.squeeze)[..., None] * w * norm * (1.0 + v * v)
    back = 2.0 * sin_half * sin_half * norm  # 1 - cos(psi)
    # no differences of large numbers where lobes are narrow
    mx = circles.sine[..., None] - (mu * circles.across)[..., None] * back
    my = circles.across[..., None] * 2.0 * sin_half * cos_half * norm
    mz = circles.cosine[..., None] - (sin_w * circles.across)[..., None] * back
    if distribution == "ggx":
        # in units of alpha: fourth powers of the narrowest have derivatives beyond single precision
        slopes = (mx / alpha) ** 2 + (my / alpha) ** 2
        shares = turn / (alpha * alpha) / (alpha * alpha) / (mz * mz + slopes) ** 2
    else:
        shares = turn * density((mx, my, mz), width, distribution)
    flat = (mu.shape[0], -1)
    facing = circles.facing[..., None] * jnp.ones_like(back)
    return (mx.reshape(flat), my.reshape(flat), mz.reshape(flat)), facing.reshape(flat), shares.reshape(flat)


def _crowd_at_end(x: Array, w: Array, gamma: Array) -> tuple[Array, Array]:
    """Points in (0, 1) closer to 1 and their weights: below gamma = 2 the density has no limit at upright facets."""
    power = 1.0 + CROWDING * (2.0 / gamma) ** 5
    rest = jnp.exp(power * jnp.log1p(-x))
    return 1.0 - rest, power * rest / (1.0 - x) * w


def polar_angles(
    cosine: Array,
    sine: Array,
    one_width: OneWidth,
    distribution: Distribution,
    ratio: Array,
    event: FacetEvent,
    points: int,
) -> tuple[Array, Array]:
    """theta_d - theta and its measure, (nodes, panels * points).

    ratio: index on the far side over that on the side of w. points: a panel; there are three.
    """
    alpha = narrowest(one_width)
    theta = jnp.arctan2(sine, cosine)[:, None]
    total = ratio < 1.0  # reflection beyond the critical angle
    critical = jnp.where(total, jnp.arcsin(jnp.where(total, ratio, 0.5)), 0.5 * jnp.pi)
    quarter = 0.5 * jnp.pi
    if event == "reflected":
        cut, end = 0.5 * (quarter - theta), 0.5 * (quarter + theta)
        inner = clamp_max(critical, end)
    else:
        cut, end = quarter - theta, clamp_max(critical, quarter) * jnp.ones_like(theta)
        inner = _grazing(cosine, sine, ratio, end)
    cut = clamp_max(cut, end)
    low, high = jnp.where(cut < inner, cut, inner), jnp.where(cut < inner, inner, cut)
    edges = jnp.concatenate([jnp.zeros_like(theta), low, high, end], axis=1)
    places = _place((edges - theta) / alpha, distribution)
    first, width = places[:, :-1, None], (places[:, 1:] - places[:, :-1])[..., None]
    x, w = (jnp.asarray(array, theta.dtype) for array in gauss_legendre(points))
    if has_tails(distribution):
        root = edges[:, 1:] == inner  # also where nothing is totally reflected: points move smoothly as that begins
        share = jnp.where(root[..., None], 1.0 - (1.0 - x) ** 2, x)
        measure = jnp.where(root[..., None], 2.0 * (1.0 - x) * w, w)
    else:
        share, rise = _smooth_edges(places, x)
        measure = rise * w
    stretched, slope = _inverse_place(first + width * share, distribution)
    flat = (theta.shape[0], -1)
    return (alpha * stretched).reshape(flat), (alpha * width * measure * slope).reshape(flat)


def _grazing(cosine: Array, sine: Array, ratio: Array, end: Array) -> Array:
    """theta_d from which on the nearest facets refract light to below the horizon, which only light beyond the critical
    angle meets."""
    beyond = sine > ratio
    within = jnp.where(beyond, 1.0 / jnp.where(beyond, ratio, 1.0) - sine, 1.0)
    return jnp.where(beyond[:, None], clamp_max(jnp.arctan2(cosine, within)[:, None], end), end)


def _smooth_edges(places: Array, x: Array) -> tuple[Array, Array]:
    """Shares of panels at x in (0, 1), and their slopes: with the roots at the edges taken out.

    Sums over parallels that begin to be cut, or end, have a root there, and so has refraction at the critical angle.
    Where normals end before the edge there is none, and points are not crowded to it.
    """
    depth = jnp.clip((VMF_EXTENT - jnp.abs(places)) / (SOFT * VMF_EXTENT), 0.0, 1.0)
    level = depth * depth * (3.0 - 2.0 * depth)
    after, before = level[:, 1:, None], level.at[:, 0].set(0.0)[:, :-1, None]
    rest = 1.0 - x
    share = x + x * rest * (after * x - before * rest)
    return share, 1.0 + after * x * (2.0 - 3.0 * x) - before * rest * (1.0 - 3.0 * x)


def _place(t: Array, distribution: Distribution) -> Array:
    if not has_tails(distribution):
        return jnp.clip(t, -VMF_EXTENT, VMF_EXTENT)
    y = jnp.arcsinh(t)
    return y / jnp.sqrt(1.0 + (y / STRETCH_LIMIT) ** 2)


def _inverse_place(place: Array, distribution: Distribution) -> tuple[Array, Array]:
    """t of a place, and its slope: the inverse of `_place`."""
    if not has_tails(distribution):
        return place, jnp.ones_like(place)
    inverse = 1.0 / jnp.sqrt(1.0 - (place / STRETCH_LIMIT) ** 2)
    y = place * inverse
    rise = jnp.expm1(y)
    fall = rise / (1.0 + rise)
    return 0.5 * (rise + fall), (1.0 + 0.5 * (rise - fall)) * inverse * inverse * inverse
