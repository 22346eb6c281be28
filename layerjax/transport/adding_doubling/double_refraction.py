"""Light that two rough interfaces refract, one after the other: the integral over the directions between them.

The directions between are integrated over along the facets that either side sees, and the two sums weighed against each
other (Veach & Guibas 1995): the narrower lobe gives the points, the wider the values. Lobes of two widths may cross,
each the narrower one along an axis of its own. Then a third sum is over points where both overlap.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._numerics import clamp_min, safe_sqrt, smooth_step
from layerjax.channels import Channels, count, pick, total
from layerjax.directions import Vector, dot, sanitise
from layerjax.normals.facets import visible_grid
from layerjax.normals.width_matrix import rotate
from layerjax.normals.widths import Widths, narrowest
from layerjax.quadrature import gauss_legendre
from layerjax.stack import Interface
from layerjax.surfaces.interface import continued_transmission, is_index_matched
from layerjax.surfaces.thin_film import BARE, films_of
from layerjax.transport.adding_doubling.facet_scattering import Normals, facet_spacing, refract, refracted_rays
from layerjax.transport.adding_doubling.requested_directions import requested_region

POINTS = (16, 12)
"""Points a panel, and in azimuth, of the facets of either side."""

POINTS_AROUND = (24, 48)
"""Points from pole to rim and around of facets of two widths, and of where lobes overlap."""

EDGE = 7.5
"""Times the distance between rays: half the width over which the end of a lobe is rounded off, at facets that stand
upright. Else values would change by steps of up to 3e-4 as an index moves rays across it."""

TINY = 1e-18
"""1/sr: of two lobes that are less the weights do not matter; their squares are none in single precision."""

REACH = 50.0
"""Radius up to which lobes of two widths overlap, in units of its own."""

FAVOUR, MOST_CROSSED = 4.0, 64.0
"""Times how much lobes cross, which counts up to the second: the weight of points where they overlap. A slab of index
1.5 with widths of 0.02 along one axis and 0.5 along the other, crossed: off by 2e-1 without them, by 1e-4 with them."""

LEAST_BEND = 3e-3
"""Of a lobe that refraction hardly bends: its width over that of its facets, at least, where lobes overlap."""

LEAST_INSIDE = 0.1
"""Cosine between the interfaces, at least, of the middle of a lobe: at total reflection it has none."""


class BTDFLobe(NamedTuple):
    """A BTDF, continued beyond the facets that stand upright, and ended there: only the first has smooth weights."""

    continued: Array
    ended: Array


Turn = tuple[Array, Array] | None
"""Cosine and sine of the azimuth in which light travels, (pairs, 1); None: along x."""


def double_refraction(
    upper: Interface,
    lower: Interface,
    passed: Callable[[Vector], Channels],
    cosine_i: Array,
    cosine_o: Array,
    azimuth: Array,
    azimuth_i: Array | None = None,
) -> Channels:
    """BSDF of light from above to below, (pairs,); once for each channel that films distinguish.

    Args:
        upper, lower: the interfaces.
        passed: share that comes across, by the direction between them.
        cosine_i, cosine_o: outside of either.
        azimuth, azimuth_i: in which light leaves, and in which it came (None: along x).
    """
    films = [films_of(face.film) for face in (upper, lower)]

    def seen_through(one: fresnel.Film | None, other: fresnel.Film | None) -> Channels:
        return _film_transmitted((upper, lower), (one, other), passed, (cosine_i, cosine_o), (azimuth_i, azimuth))

    if films == [BARE, BARE]:
        return seen_through(None, None)
    zero = jnp.zeros_like(cosine_i)
    channels = max(count(*films), len(passed((zero, zero, zero + 1.0))))
    return tuple(pick(seen_through(pick(films[0], c), pick(films[1], c)), c) for c in range(channels))


def _film_transmitted(
    interfaces: tuple[Interface, Interface],
    films: tuple[fresnel.Film | None, fresnel.Film | None],
    passed: Callable[[Vector], Channels],
    cosines: tuple[Array, Array],
    azimuths: tuple[Array | None, Array],
) -> Channels:
    """f from above to below for light that comes in along an azimuth and leaves along another.

    With m between, g_i and g_o the BTDFs from m out along either direction, f = n^2 * integral of g_i g_o cos(m). Rays
    from above have the density n^2 g_i cos(m) of m, those from below n^2 g_o cos(m) / n_below^2.
    """
    inner, below = (face.ior for face in interfaces)
    faces = [Normals(face.width, face.distribution) for face in interfaces]
    sines = [safe_sqrt((1.0 - c) * (1.0 + c)) for c in cosines]
    turn_o = jnp.cos(azimuths[1])[:, None], jnp.sin(azimuths[1])[:, None]
    turn_i = None if azimuths[0] is None else (jnp.cos(azimuths[0])[:, None], jnp.sin(azimuths[0])[:, None])
    over = _turned((-sines[0][:, None], jnp.zeros_like(turn_o[0]), -cosines[0][:, None]), turn_i)
    under: Vector = (sines[1][:, None] * turn_o[0], sines[1][:, None] * turn_o[1], -cosines[1][:, None])

    ratios = 1.0 / inner, below / inner
    of_inner = [None if film is None else film.seen_from(inner) for film in films]
    edges = [
        EDGE * facet_spacing(POINTS[0], facets) * jnp.abs(1.0 - n) for n, facets in zip(ratios, faces, strict=True)
    ]
    overlap = None
    if any(isinstance(normals.alpha, Widths) for normals in faces):
        overlap = _overlap(((-over[0], -over[1], over[2]), under), (inner, inner / below), faces)

    def parts(m: Vector) -> tuple[BTDFLobe, BTDFLobe, Channels]:
        """g_i, g_o / n_below^2 and what comes across, of travel along (x, y, -z) between the interfaces."""
        middle: Vector = (-m[0], -m[1], m[2])
        g_i = _lobe(m, over, ratios[0], faces[0], edges[1], of_inner[0])
        g_o = _lobe(middle, under, ratios[1], faces[1], edges[0], of_inner[1])
        return g_i, BTDFLobe(*(part / below**2 for part in g_o)), passed(middle)

    def weight(one: BTDFLobe, other: BTDFLobe, m: Vector) -> Array:
        both = one.continued + other.continued
        if overlap is not None:
            both = both + overlap.density(m[0], m[1]) / inner**2
        return one.continued / (both + TINY)

    # a BTDF at equal indices is a delta: then the rays of that side are the whole
    delta_i, delta_o = is_index_matched(inner), is_index_matched(inner / below)
    m, share = _rays(cosines[0], turn_i, inner, faces[0], films[0])
    g_i, g_o, shares = parts(m)
    counted = jnp.where(delta_i, 1.0, jnp.where(delta_o, 0.0, weight(g_i, g_o, m)))
    sums = [tuple(jnp.sum(share * below**2 * g_o.ended * counted * level, axis=-1) for level in shares)]
    from_outside = None if films[1] is None else films[1].seen_from(below)
    m, share = _rays(cosines[1], turn_o, inner / below, faces[1], from_outside)
    g_i, g_o, shares = parts(m)  # followed backwards, from where it leaves
    counted = jnp.where(delta_i, 0.0, jnp.where(delta_o, 1.0, weight(g_o, g_i, m)))
    sums.append(tuple(jnp.sum(share * below**2 * g_i.ended * counted * level, axis=-1) for level in shares))
    if overlap is not None:
        m, area = overlap.points()
        g_i, g_o, shares = parts(m)
        density = overlap.density(m[0], m[1]) / inner**2
        weighed = density / (density + g_i.continued + g_o.continued + TINY) * g_i.ended * g_o.ended
        counted = jnp.where(delta_i | delta_o, 0.0, area * inner**2 * below**2 * weighed)
        sums.append(tuple(jnp.sum(counted * level, axis=-1) for level in shares))
    return total(sums)


def _lobe(wi: Vector, wo: Vector, ratio: Array, facets: Normals, edge: Array, film: fresnel.Film | None) -> BTDFLobe:
    (value,), height = continued_transmission(wi, wo, ratio, *facets, (film,))
    return BTDFLobe(value, value * smooth_step(height / (edge + TINY)))


def _rays(cosine: Array, turn: Turn, ratio: Array, normals: Normals, film: fresnel.Film | None) -> tuple[Vector, Array]:
    """Where facets refract light to that travels along an azimuth, z counted on the far side, and its shares."""
    region = requested_region(cosine, jnp.ones_like(ratio))
    if isinstance(normals.alpha, Widths):
        zero = jnp.zeros_like(cosine)[:, None]
        wi = _turned((-region.sine[:, None], zero, cosine[:, None]), turn)
        flat = wi[0][:, 0], wi[1][:, 0], wi[2][:, 0]
        normal, seen = visible_grid(flat, normals.alpha, normals.distribution, POINTS_AROUND)
        rays, share = refract(wi, normal, dot(wi, normal), jnp.asarray(seen, cosine.dtype), ratio, normals, film=film)
        return sanitise(rays, rays[2] > 0), share
    rays, share = refracted_rays(region, ratio, normals, POINTS, film)
    x, y, z = sanitise(rays, rays[2] > 0)  # of rays back up, whose share is 0, masking has no meaning

    def both(part: Array, mirrored: Array) -> Array:  # shares stand for mirror images too
        return jnp.concatenate([part, mirrored], axis=-1)

    whole: Vector = (both(x, x), both(y, -y), both(z, z))
    share = 0.5 * both(share, share)
    return _turned(whole, turn), share


def _turned(w: Vector, turn: Turn) -> Vector:
    if turn is None:
        return w
    cosine, sine = turn
    return w[0] * cosine - w[1] * sine, w[0] * sine + w[1] * cosine, w[2]


# ---- where lobes of two widths overlap ----


class Overlap(NamedTuple):
    """An ellipse in the plane of x and y of directions between the interfaces, about the product of two lobes.

    Its points are (x, y) + L u, u being about as far as 1 from 0, with L = [[xx, 0], [xy, yy]]. weight: of its points,
    beside those of either lobe; 0 where the lobes are of one shape.
    """

    x: Array
    y: Array
    xx: Array
    xy: Array
    yy: Array
    weight: Array

    def density(self, x: Array, y: Array) -> Array:
        """Weight of its points, by area; none at grazing directions, where what is summed ends with a step."""
        u = (x - self.x) / self.xx
        v = (y - self.y - self.xy * u) / self.yy
        ended = clamp_min((1.0 - x) * (1.0 + x) - y * y, 0.0) ** 3
        return self.weight * ended / (jnp.pi * self.xx * self.yy * (1.0 + u * u + v * v) ** 2)

    def points(self) -> tuple[Vector, Array]:
        """Directions, of which those that there are not have the area 0, and the area of each."""
        polar, azimuths = POINTS_AROUND
        s, w = gauss_legendre(polar)
        most, phi = np.arcsinh(REACH), 2.0 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
        radius = np.sinh(most * s)
        ring = radius * np.cosh(most * s) * most * w * 2.0 * np.pi / azimuths
        grid = np.outer(radius, np.cos(phi)), np.outer(radius, np.sin(phi)), np.outer(ring, np.ones_like(phi))
        u, v, area = (jnp.asarray(part.ravel(), self.x.dtype) for part in grid)
        x, y = self.x + self.xx * u, self.y + self.xy * u + self.yy * v
        squared = x * x + y * y
        exists = squared < 1.0
        x, y, squared = (jnp.where(exists, part, 0.0) for part in (x, y, squared))
        return (x, y, safe_sqrt(1.0 - squared)), jnp.where(exists, self.xx * self.yy * area, 0.0)


def _overlap(outside: tuple[Vector, Vector], ratios: tuple[Array, Array], faces: list[Normals]) -> Overlap:
    """Where two lobes overlap that stand for ellipses A and B about the directions that flat interfaces refract to.

    The ellipse of the product of Gaussian lobes is (A^-1 + B^-1)^-1 = (det(A) B + det(B) A) / det(A + B), its middle
    A (A + B)^-1 of the way from one to the other. Determinants are sums of squares, so that nothing is lost however
    narrow the lobes are.

    Args:
        outside: travel before the first and behind the second interface, (pairs, 1).
        ratios: index between over that outside.
        faces: normals.
    """
    middles, widths = [], []
    for w, ratio, normals in zip(outside, ratios, faces, strict=True):
        width = normals.alpha
        if not isinstance(width, Widths):
            width = Widths(narrowest(width), narrowest(width))
        inside = jnp.sqrt(clamp_min(1.0 - (1.0 - w[2]) * (1.0 + w[2]) / ratio**2, LEAST_INSIDE**2))
        bend = clamp_min(jnp.abs(inside - jnp.abs(w[2]) / ratio), LEAST_BEND)
        middles.append((w[0] / ratio, w[1] / ratio))
        widths.append(Widths(bend * width.alpha, bend * width.alpha_y, width.tangent))
    (a, b), (c, d) = ((width.alpha, width.alpha_y) for width in widths)
    azimuths = [0.0 if width.tangent is None else width.tangent for width in widths]
    along, across = jnp.cos(azimuths[0] - azimuths[1]) ** 2, jnp.sin(azimuths[0] - azimuths[1]) ** 2
    size = a * b + c * d  # all determinants are over its square
    p, q = a * b / size, c * d / size
    crossed = along * ((a * d - b * c) / size) ** 2 + across * ((a * c - b * d) / size) ** 2
    whole = 1.0 + crossed  # det(A + B)
    first, second = (rotate(width.alpha**2, width.alpha_y**2, width.tangent) for width in widths)
    xx, xy = ((p * p * two + q * q * one) / whole for one, two in zip(first[:2], second[:2], strict=True))
    # A (A + B)^-1 = (det(A) + A adj(B)) / det(A + B)
    x, y = (end - start for start, end in zip(*middles, strict=True))
    u, v = (second[2] * x - second[1] * y) / size, (second[0] * y - second[1] * x) / size
    x = middles[0][0] + (p * p * x + (first[0] * u + first[1] * v) / size) / whole
    y = middles[0][1] + (p * p * y + (first[1] * u + first[2] * v) / size) / whole
    root = jnp.sqrt(xx)
    weight = FAVOUR * crossed / (p * q + crossed / MOST_CROSSED)
    return Overlap(x, y, root, xy / root, a * b * q / jnp.sqrt(whole) / root, weight)
