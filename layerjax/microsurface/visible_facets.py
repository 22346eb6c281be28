"""Quadrature over the GGX facets that are seen from a direction.

Stretched by 1 / alpha, the facets visible along wi are a cap of uniform density (Dupuy & Benyoub 2023, "Sampling
visible GGX normals with spherical caps"), in polar coordinates t, from the pole to the rim, and phi. Where something
ends (a facet reflects below the horizon, out of a cone, or totally) is known in closed form: on a circle of constant t
it is one azimuth, a + b cos(phi) = 0, and circles begin and cease to be cut in the plane of incidence. Integrals are
split there, so that they are accurate with few points and smooth in every argument.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, safe_sqrt
from layerjax.quadrature import gauss_legendre, panels

UPRIGHT = 1e-6
"""Least squared sine of a direction: all is even in the sine, and would have no derivative where it is 0."""


class Cap(NamedTuple):
    """The facets seen from one direction: GGX width, cosine and angle of incidence, and the stretched direction v."""

    alpha: Array
    cosine: Array
    angle: Array
    stretch: Array
    """Length of (alpha wi_x, alpha wi_y, wi_z)."""
    vx: Array
    vz: Array
    tilt: Array
    """Angle of v from the normal; the rim lies pi - tilt from the pole."""

    def inner(self) -> "Cap":
        """The same with one more axis, for points."""
        return Cap(*(x[..., None] for x in self))


Cut = tuple[Array, Array]
"""(a, b), shape of t: the half turn is kept where a + b cos(phi) > 0."""


class Region(NamedTuple):
    """A part of the cap: the circles t at which its boundary touches the plane of incidence, and the boundary."""

    touches: tuple[Array, Array]
    cut: Callable[[Cap, Array], Cut]


class Facets(NamedTuple):
    """Facets at points of the cap, shape ``batch + (circles, azimuths)``; all their weights together sum to 1."""

    alpha: Array
    cosine: Array
    weight: Array
    facing: Array
    """Cosine between wi and the facet normal."""
    upright: Array
    """Cosine of the facet normal."""

    def reflected_cosine(self) -> Array:
        """Cosine of the direction that a facet reflects to, negative below the horizon."""
        return 2.0 * self.facing * self.upright - self.cosine

    def refracted_cosine(self, ior: Array) -> Array:
        """Cosine of the direction that a facet refracts to, on the far side; no meaning under total reflection."""
        inside = safe_sqrt((ior - 1.0) * (ior + 1.0) + self.facing * self.facing) / ior
        return (self.cosine - self.facing * self.upright) / ior + inside * self.upright

    def mean(self, value: Array) -> Array:
        """Integral over the points."""
        return jnp.sum(self.weight * value, axis=(-1, -2))


def make_cap(cosine: Array, alpha: Array) -> Cap:
    """The cap of facets seen at `cosine` > 0; both arrays of one shape."""
    sine = jnp.sqrt(clamp_min((1.0 - cosine) * (1.0 + cosine), 0.0) + UPRIGHT * cosine * cosine)
    cosine = cosine * float(np.sqrt(1.0 - UPRIGHT))
    x = alpha * sine
    stretch = jnp.sqrt(x * x + cosine * cosine)
    return Cap(alpha, cosine, jnp.arctan2(sine, cosine), stretch, x / stretch, cosine / stretch, jnp.arctan2(x, cosine))


def cone(cap: Cap, sine: Array) -> Region:
    """Facets that reflect into directions with sin(theta_o) < sine; 1 is the horizon."""
    inside = sine < 1.0
    least = jnp.sqrt(jnp.where(inside, (1.0 - sine) * (1.0 + sine), 0.75))
    edge = jnp.where(inside, jnp.arctan2(sine, least), 0.5 * jnp.pi)
    least = jnp.where(inside, least, 0.0)

    def cut(cap: Cap, t: Array) -> Cut:
        # 2 <wi, m> m_z > least + wi_z times the squared length of the stretched m: linear in cos(phi)
        s, height, facing = _circle(cap, t)
        total = least[..., None] + cap.cosine
        squared = cap.alpha * cap.alpha
        a = 2.0 * cap.stretch * height * facing - total * (squared * (cap.vx * cap.vx + s * s) + height * height)
        return a, 2.0 * cap.vx * s * (cap.stretch * height - squared * total)

    return Region((_polar(cap, 0.5 * (cap.angle + edge)), _polar(cap, 0.5 * (cap.angle - edge))), cut)


def refraction_region(cap: Cap, ior: Array) -> Region:
    """Facets that do not reflect totally; all of them if ior, the index on the far side over this one's, is >= 1."""
    squared = jnp.where(ior < 1.0, (1.0 - ior) * (1.0 + ior), 0.0)  # cosine of the critical angle, squared
    critical = jnp.arctan2(jnp.where(squared > 0, ior, 1.0), safe_sqrt(squared))

    def cut(cap: Cap, t: Array) -> Cut:
        # <wi, m>^2 > squared is quadratic in <v, h>, with one root that is positive
        s, height, facing = _circle(cap, t)
        c = squared[..., None]
        half = c * (cap.alpha / cap.stretch) ** 2
        tall = c * (height / cap.stretch) ** 2 * (1.0 - cap.alpha) * (1.0 + cap.alpha)
        return facing - half - safe_sqrt(half * half + tall), cap.vx * s

    return Region((_polar(cap, clamp_max(cap.angle + critical, 0.5 * jnp.pi)), _polar(cap, cap.angle - critical)), cut)


def whole_region(cap: Cap) -> Region:
    """All facets, with circles as for the horizon."""
    horizon = cone(cap, jnp.ones_like(cap.cosine))
    rim = jnp.pi - cap.tilt

    def cut(cap: Cap, t: Array) -> Cut:
        return jnp.ones_like(t), jnp.zeros_like(t)

    return Region((horizon.touches[1], rim), cut)


def region_facets(cap: Cap, region: Region, points: int) -> Facets:
    """Points in a region."""
    t, w = _circles(cap, _sort_pair(region.touches), points)
    start, end = _arc(*region.cut(cap.inner(), t))
    return _facets(cap, t, w, start, end, _graded_nodes, _azimuths(points))


def split_facets(cap: Cap, region: Region, inner: Region, points: int) -> Facets:
    """Points in a region, split where another one ends."""
    low, high = _sort_pair(region.touches)
    edges = jnp.sort(jnp.stack([low, high, *(clamp_max(touch, high) for touch in inner.touches)], axis=-1), axis=-1)
    t, w = _circles(cap, tuple(jnp.moveaxis(edges, -1, 0)), points)
    start, end = _arc(*region.cut(cap.inner(), t))
    _, between = _arc(*inner.cut(cap.inner(), t))
    between = clamp_min(clamp_max(between, end), start)
    near = _facets(cap, t, w, start, between, _graded_nodes, _azimuths(points))
    rest = _facets(cap, t, w, between, end, _even, _azimuths(points))
    joined = (jnp.concatenate(parts, axis=-1) for parts in zip(near[2:], rest[2:], strict=True))
    return Facets(near.alpha, near.cosine, *joined)


def _azimuths(points: int) -> int:
    return (2 * points + 2) // 3


def _graded_nodes(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on [0, 1] for integrands that end like a square root at 1."""
    s, w = gauss_legendre(nodes)
    return s * (2.0 - s), 2.0 * w * (1.0 - s)


_even = gauss_legendre


def _polar(cap: Cap, angle: Array) -> Array:
    """t of the facet in the plane of incidence at this angle from the normal, towards wi."""
    stretched = jnp.arctan2(jnp.sin(angle), cap.alpha * jnp.cos(angle))
    return clamp_max(jnp.abs(2.0 * stretched - cap.tilt), jnp.pi - cap.tilt)


def _sort_pair(pair: tuple[Array, Array]) -> tuple[Array, Array]:
    a, b = pair
    return jnp.where(a < b, a, b), jnp.where(a < b, b, a)


def _circles(cap: Cap, edges: tuple[Array, ...], points: int) -> tuple[Array, Array]:
    """Polar angles from the pole to the last edge, and weights."""
    edge = jnp.stack([jnp.zeros_like(cap.tilt), *edges], axis=-1)
    t, w = (x.astype(edge.dtype) for x in panels(edge, points))
    return t, w * jnp.sin(t) / (1.0 + cap.vz[..., None])


def _circle(cap: Cap, t: Array) -> tuple[Array, Array, Array]:
    """sin(t); height of the stretched normal h = v + u; and <v, h> at phi = pi / 2. No differences."""
    up, down = 0.5 * (t + cap.tilt), 0.5 * (t - cap.tilt)
    height = 2.0 * jnp.cos(up) * jnp.cos(down)
    return jnp.sin(t), height, jnp.cos(up) ** 2 + jnp.cos(down) ** 2


def _arc(a: Array, b: Array) -> tuple[Array, Array]:
    """Azimuths in [0, pi] between which a + b cos(phi) > 0."""
    a = jnp.where((a == 0) & (b == 0), 1.0, a)  # the boundary itself: on panels without extent
    length = jnp.arctan2(safe_sqrt((b - a) * (b + a)), -a)
    start = jnp.where(b > 0, 0.0, jnp.pi - length)
    return start, start + length


def _facets(
    cap: Cap,
    t: Array,
    w: Array,
    start: Array,
    end: Array,
    rule: Callable[[int], tuple[np.ndarray, np.ndarray]],
    nodes: int,
) -> Facets:
    """Facets on circles t, of weight w, at azimuths from start to end."""
    s, share = (jnp.asarray(array, t.dtype) for array in rule(nodes))
    cap = cap.inner()
    sine, height, _ = _circle(cap, t)
    turn = jnp.cos(0.5 * (start[..., None] + (end - start)[..., None] * s))
    gap = cap.vx - sine
    across = (gap * gap)[..., None] + (4.0 * cap.vx * sine)[..., None] * turn * turn  # h_x^2 + h_y^2
    height, cap = height[..., None], cap.inner()
    inverse = 1.0 / jnp.sqrt(cap.alpha * cap.alpha * across + height * height + jnp.finfo(t.dtype).tiny)
    facing = 0.5 * cap.stretch * (across + height * height) * inverse  # <v, h> = |h|^2 / 2
    weight = (w * (end - start) / jnp.pi)[..., None] * share
    return Facets(cap.alpha, cap.cosine, weight, facing, height * inverse)
