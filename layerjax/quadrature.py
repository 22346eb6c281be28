"""Quadrature over outgoing directions, adapted to a lobe.

Every rule splits the sphere at the horizon, where BSDFs have a kink, and warps it so that the lobe is smooth in the new
coordinates however narrow it is. A rule is a pair (nodes on wi's side of the horizon, nodes on the other side), each a
direction (components of shape ``batch + (nodes,)``) and a weight so that ``sum(weight g(wo))`` approximates the
integral of g over that hemisphere. A narrow g must be the lobe that the rule was made for, times something smooth.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import safe_div, safe_sqrt
from layerjax.directions import Vector, add, combine, cross, dot, frame, normalize, scale, select

Nodes = tuple[Vector, Array]
Rule = tuple[Nodes, Nodes]


@functools.cache
def gauss_legendre(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on [0, 1], shape ``(nodes,)`` each."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return 0.5 * (x + 1.0), 0.5 * w


def panels(edges: Array, nodes: int) -> tuple[Array, Array]:
    """Nodes and weights of Gauss panels between edges, crowded towards every edge, ``(..., (E - 1) * nodes)`` each.

    Args:
        edges: in ascending order along the last axis, shape ``(..., E)``.
        nodes: in each panel.

    The edges are where an integrand kinks or, towards grazing, changes quickly.
    """
    s, w = (jnp.asarray(array, edges.dtype) for array in gauss_legendre(nodes))
    smooth, slope = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s)
    begin, length = edges[..., :-1, None], jnp.diff(edges)[..., None]
    shape = (*edges.shape[:-1], -1)
    return (begin + length * smooth).reshape(shape), (length * slope * w).reshape(shape)


def hemisphere_rule(wi: Vector, nodes: int) -> Nodes:
    """Nodes over the upper hemisphere, split where theta_o = theta_i and where the azimuth differs by +-pi/2.

    wi: components of shape ``batch``. The rule has 4 nodes^2 directions, shape ``batch + (4 * nodes**2,)``.
    """
    s, w = (jnp.asarray(array, wi[2].dtype) for array in gauss_legendre(nodes))
    psi, w_psi = panels(_half_turns(wi[2].dtype), nodes)
    planar = safe_sqrt(wi[0] * wi[0] + wi[1] * wi[1])[..., None, None]
    theta_i = jnp.arctan2(planar, jnp.abs(wi[2])[..., None, None])
    theta = jnp.concatenate([theta_i * s, theta_i + (0.5 * jnp.pi - theta_i) * s], axis=-1)
    w_theta = jnp.concatenate([theta_i * w, (0.5 * jnp.pi - theta_i) * w], axis=-1)
    along = normalize((wi[0], wi[1], jnp.zeros_like(wi[2])))
    at_pole = (along[2] != 0.0)[..., None, None]  # normalize() gives +z for no azimuth at all
    x = jnp.where(at_pole, 1.0, along[0][..., None, None])
    y = jnp.where(at_pole, 0.0, along[1][..., None, None])
    sine, cosine = jnp.sin(theta), jnp.cos(theta)
    cos_psi, sin_psi = jnp.cos(psi)[:, None], jnp.sin(psi)[:, None]
    wo = (sine * (x * cos_psi - y * sin_psi), sine * (y * cos_psi + x * sin_psi), cosine * jnp.ones_like(cos_psi))
    return _flatten(wo, sine * w_theta * w_psi[:, None])


def sphere_rule(wi: Vector, nodes: int) -> Rule:
    """Nodes over both hemispheres for lobes that are not narrow: `hemisphere_rule` on either side."""
    (x, y, z), weight = hemisphere_rule(wi, nodes)
    side = jnp.where(wi[2] < 0, -1.0, 1.0)[..., None]
    return ((x, y, side * z), weight), ((x, y, -side * z), weight)


def flake_rule(wi: Vector, radial: Array, axial: Array, axis: Vector | None, nodes: int) -> Rule:
    """Nodes for mirrors whose normals m follow an ellipsoid, S = radial^2 (I - a a') + axial^2 a a'.

    With m = normalize(S^(1/2) y) the density of visible normals is uniform in the cosine of y, however narrow it is.
    Great circles of y through the image of wi are great circles of m through wi, and each of them crosses the horizon
    of wo once: polar coordinates about that point split the two hemispheres exactly.

    Args:
        wi: unit vectors, components of shape ``batch``.
        radial, axial: half widths of the ellipsoid across and along the axis, > 0, shape ``()``.
        axis: unit vector; None: z.
        nodes: points on each great circle and side of the horizon; half as many circles in each panel between edges.
    """
    a: Vector = axis if axis is not None else (jnp.zeros_like(wi[2]), jnp.zeros_like(wi[2]), jnp.ones_like(wi[2]))

    def stretch(w: Vector, across: Array, along: Array) -> Vector:
        return combine(across, w, (along - across) * dot(w, a), a)

    v = normalize(stretch(wi, radial, axial))
    pole = normalize(stretch(wi, 1.0 / radial, 1.0 / axial))
    first, second = _panel_frame(pole, v)
    edges = _crossings(wi, stretch(first, radial, axial), stretch(second, radial, axial))
    wi, v, pole, first, second, a = (_expand(w, 1) for w in (wi, v, pole, first, second, a))
    psi, w_psi = panels(edges, (nodes + 1) // 2)
    e = combine(jnp.cos(psi), first, jnp.sin(psi), second)
    # the great circle in the space of normals: m = cos(theta) wi + sin(theta) q, and wo at twice the angle
    image = stretch(e, radial, axial)
    q = normalize(combine(jnp.ones_like(psi), image, -dot(image, wi), wi))
    side = jnp.where(wi[2] < 0, -1.0, 1.0)
    theta = 0.5 * jnp.arctan2(side * wi[2], -side * q[2])  # where wo crosses the horizon
    back = stretch(combine(jnp.cos(theta), wi, jnp.sin(theta), q), 1.0 / radial, 1.0 / axial)
    crossing = jnp.arctan2(dot(back, e), dot(back, pole))
    last = jnp.arctan2(dot(v, pole), -dot(v, e))  # wi . m = 0

    def segment(begin: Array, end: Array) -> Nodes:
        s, w = (jnp.asarray(array, begin.dtype) for array in gauss_legendre(nodes))
        begin, length = begin[..., None], (end - begin)[..., None]
        t = begin + length * s
        y = combine(jnp.cos(t), _expand(pole, 1), jnp.sin(t), _expand(e, 1))
        raw = stretch(y, radial, axial)
        size = jnp.sqrt(dot(raw, raw))
        m = scale(1.0 / size, raw)
        cosine = dot(_expand(wi, 1), m)
        wo = combine(2.0 * cosine, m, -1.0, _expand(wi, 1))
        solid_angle = 4.0 * cosine * radial * radial * axial / (size * size * size)  # d wo / d y
        return _flatten(wo, jnp.sin(t) * solid_angle * length * w * w_psi[..., None])

    return segment(jnp.zeros_like(crossing), crossing), segment(crossing, last)


def henyey_greenstein_inverse(g: Array, s: Array) -> tuple[Array, Array]:
    """Cosine and sine of deflection at s in [-1, 1], uniform in s: the inverse of the cumulative distribution.

    g is the mean cosine, in (-1, 1), and broadcasts with s; both results have their common shape.

    Both factors of the sine are products of positive terms, so nothing cancels at g = 0 or at the poles.
    """
    norm = 2.0 * (1.0 + g * s) ** 2
    one_minus = (1.0 - g) ** 2 * (1.0 - s) * (2.0 + g * (1.0 + s)) / norm
    one_plus = (1.0 + g) ** 2 * (1.0 + s) * (2.0 - g * (1.0 - s)) / norm
    return 0.5 * (one_plus - one_minus), safe_sqrt(one_minus * one_plus)


def henyey_greenstein_rule(wi: Vector, g: Array, nodes: int) -> Rule:
    """Nodes uniform in the cumulative distribution of the deflection, and in azimuth about the direction of travel.

    wi: components of shape ``batch``; g: mean cosine in (-1, 1), shape ``()``.
    """
    axis = scale(-1.0, wi)
    first, second = _panel_frame(axis, (jnp.zeros_like(wi[2]), jnp.zeros_like(wi[2]), jnp.ones_like(wi[2])))
    wi, axis, first, second = (_expand(w, 1) for w in (wi, axis, first, second))
    psi, w_psi = panels(_half_turns(g.dtype), nodes)
    e = combine(jnp.cos(psi), first, jnp.sin(psi), second)
    side = jnp.where(wi[2] < 0, -1.0, 1.0)
    chi = jnp.arctan2(side * wi[2], side * e[2])  # deflection at which wo crosses the horizon
    cosine = jnp.cos(chi)
    root = jnp.sqrt((1.0 - g) ** 2 + 2.0 * g * (1.0 - cosine))
    crossing = jnp.clip((2.0 * cosine - 3.0 * g + g**3) / (root * (1.0 - g * g + root)), -1.0, 1.0)

    def segment(pole: float, end: Array) -> Nodes:
        # s runs as a square from the pole, where the direction depends on the root of s
        t, w = (jnp.asarray(array, end.dtype) for array in gauss_legendre(nodes))
        length = (end - pole)[..., None]
        c, sine = henyey_greenstein_inverse(g, pole + length * t * t)
        wo = add(scale(c, _expand(axis, 1)), scale(sine, _expand(e, 1)))
        density = (1.0 - g * g) / (2.0 * ((1.0 - g) ** 2 + 2.0 * g * (1.0 - c)) ** 1.5)  # dc = ds / (2 density)
        return _flatten(wo, jnp.abs(length) * t * w * w_psi[:, None] / density)

    return segment(-1.0, crossing), segment(1.0, crossing)


def _half_turns(dtype: jnp.dtype) -> Array:
    return jnp.asarray([-0.5 * np.pi, 0.5 * np.pi, 1.5 * np.pi], dtype=dtype)


def _crossings(wi: Vector, first: Vector, second: Vector) -> Array:
    """Azimuths where the mirror m = cos(psi) first + sin(psi) second sends wi into the horizon, and +-pi/2, in order.

    Thin fibers have all their normals there: the crossing leaps from one end of the great circle to the other.
    """
    a = 2.0 * dot(wi, first) * first[2] - wi[2] * dot(first, first)
    d = 2.0 * dot(wi, second) * second[2] - wi[2] * dot(second, second)
    b = dot(wi, first) * second[2] + dot(wi, second) * first[2] - wi[2] * dot(first, second)
    size = jnp.hypot(0.5 * (a - d), b)
    level = safe_div(-0.5 * (a + d), size)  # no root: any edge does
    turn, half = jnp.arctan2(b, 0.5 * (a - d)), jnp.arccos(jnp.clip(level, -1.0, 1.0))
    roots = [0.5 * (turn + half), 0.5 * (turn - half)]
    roots += [root + jnp.pi for root in roots]
    wrapped = [jnp.mod(root + 0.5 * jnp.pi, 2.0 * jnp.pi) - 0.5 * jnp.pi for root in roots]
    fixed = [jnp.full_like(wi[2], value) for value in (-0.5 * np.pi, 0.5 * np.pi, 1.5 * np.pi)]
    return jax.lax.stop_gradient(jnp.sort(jnp.stack(wrapped + fixed, axis=-1), axis=-1))


def _panel_frame(pole: Vector, towards: Vector) -> tuple[Vector, Vector]:
    """A frame about the pole whose first vector is tilted towards the given one (any, if they are parallel)."""
    projected = combine(jnp.ones_like(pole[2]), towards, -dot(towards, pole), pole)
    tangent, _ = frame(pole)
    parallel = dot(projected, projected) < jnp.finfo(pole[2].dtype).eps ** 1.5  # what is left is rounding
    first = normalize(select(parallel, tangent, projected))
    return first, cross(pole, first)


def _expand(w: Vector, axes: int) -> Vector:
    index = (...,) + (None,) * axes
    return (w[0][index], w[1][index], w[2][index])


def _flatten(wo: Vector, weight: Array) -> Nodes:
    shape = jnp.broadcast_shapes(weight.shape, *(component.shape for component in wo))
    flat = (*shape[:-2], shape[-2] * shape[-1])
    x, y, z = (jnp.broadcast_to(component, shape).reshape(flat) for component in wo)
    return (x, y, z), jnp.broadcast_to(weight, shape).reshape(flat)
