"""Normals of the facets of a rough surface: GGX, Beckmann, Student-t or von Mises-Fisher, behind one set of functions.

Which one is known while tracing, so that none pays for another, and so is whether facets have one width or two. Masking
is separable Smith. All but vMF normals are drawn as they are seen. Seen vMF normals have no sampler in closed
form: the polar angle is drawn as it is, the azimuth about the plane of incidence from a density linear between 0 and
the rim beyond which facets look away. None is lost, and what is left to weigh (see `draw_weight`) is 1 where normals
are narrow, with a standard deviation of 0.5 at grazing light and of 0.6 at kappa = 0.
"""

from typing import Any, Literal, get_args

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._checks import require_choice
from layerjax._numerics import clamp_max, clamp_min, safe_div, safe_sqrt
from layerjax._parameters import check_range, is_placeholder
from layerjax.directions import Vector, dot, normalize, reflect, sanitise, scale
from layerjax.normals import vmf
from layerjax.normals.beckmann import beckmann_area, beckmann_density, beckmann_sample
from layerjax.normals.ggx import ggx_area, ggx_density, ggx_masking, ggx_sample
from layerjax.normals.sggx import radii
from layerjax.normals.student import student_area, student_density, student_sample
from layerjax.normals.widths import (
    StudentWidth,
    Width,
    Widths,
    from_unit_width,
    length,
    shrink,
    stretch,
    unit_grid,
    unit_width,
)
from layerjax.quadrature import Nodes, flake_rule, panels

Distribution = Literal["ggx", "beckmann", "vmf", "gtr"]
"""Normals of Walter et al. 2007, the first two, von Mises-Fisher ones with kappa = 2 / alpha^2 (Guo et al. 2015), or
those of Student-t slopes, whose width is a `StudentWidth` (Ribardiere et al. 2017)."""

MOST_SLOPE = 0.999
"""Slope of the density of azimuths, at most: at 1 the rim would have density 0."""

LEAST_WEIGHT = 1e-9
"""Of what is left to weigh, and of <wi, m> where it divides: well below its rounding."""

TAIL = 4.6
"""Quadratures end where kappa (1 - cos theta) is the square of this; 6e-10 of the normals lie beyond."""


def check_facets(
    owner: str, distribution: Any, alpha: Any, alpha_y: Any = None, tangent: Any = None, gamma: Any = None
) -> None:
    """Refuse a distribution that is none, a width outside the range that belongs to it (None: smooth), a second width
    that cannot be, a tangent that is none, and a gamma that is lacking or of no effect."""
    require_choice(f"{owner}.distribution", distribution, get_args(Distribution))
    if alpha is not None and not is_placeholder(alpha):
        check_range(f"{owner}.alpha" if distribution == "ggx" else f"{owner}.alpha, {distribution}", alpha)
    if distribution != "gtr" and gamma is not None:
        raise ValueError(f'{owner}.gamma: given with "{distribution}" normals; only "gtr" has it')
    if distribution == "gtr" and gamma is None and alpha is not None:
        raise ValueError(f'{owner}.gamma: not given, "gtr" normals need it (2: GGX, 40: nearly Beckmann)')
    if alpha_y is None:
        if tangent is not None:
            raise ValueError(f"{owner}.tangent: given without alpha_y, the width across it")
        return
    if alpha is None:
        raise ValueError(f"{owner}.alpha_y: given without alpha; a smooth surface has no width")
    if distribution == "vmf":
        raise ValueError(f'{owner}.alpha_y: "vmf" normals have one width; "ggx", "beckmann" and "gtr" may have two')


def width_of(alpha: Any, alpha_y: Any, tangent: Any, gamma: Any = None) -> Any:
    """The width or the widths of facets, by their parameters."""
    if alpha_y is not None:
        return Widths(alpha, alpha_y, tangent, gamma)
    return alpha if gamma is None else StudentWidth(alpha, gamma)


class Facets:
    """What the facets of interfaces and metals have in common, by the parameters that both classes have."""

    alpha: Any
    alpha_y: Any
    tangent: Any
    gamma: Any

    @property
    def width(self) -> Width:
        """Of its facets: one number, or two along and across a tangent; with gamma, where that is given."""
        return width_of(self.alpha, self.alpha_y, self.tangent, self.gamma)

    @property
    def is_anisotropic(self) -> bool:
        """Whether it has two widths, by structure."""
        return self.alpha_y is not None


def density(m: Vector, alpha: Width, distribution: Distribution) -> Array:
    """Density D(m) of normals above the horizon, 1/sr; the integral of D cos over the hemisphere is 1."""
    if isinstance(alpha, Widths):
        v = shrink(m, alpha)
        size = length(v)
        unit = density(scale(1.0 / size, v), unit_width(alpha, size), distribution)
        return unit / (size * size) / (alpha.alpha * size) / (alpha.alpha_y * size)
    if isinstance(alpha, StudentWidth):
        return student_density(m, alpha.alpha, alpha.gamma)
    if distribution == "ggx":
        return ggx_density(m, alpha)
    if distribution == "beckmann":
        return beckmann_density(m, alpha)
    assert distribution == "vmf"  # "gtr" comes with a `StudentWidth`
    return vmf.hemisphere_density(m, vmf.concentration(alpha))


def twice_projected_area(cosine: Array, w: Vector, alpha: Width, distribution: Distribution) -> Array:
    """2 cos / G1(w): twice the projected area of the facets seen along w, which has this cosine >= 0 with the normal.

    Densities of light that a facet scatters are quotients by it, so that no cosine is left to divide by.
    """
    if isinstance(alpha, Widths):
        # an area goes with the length of the vector along which it is seen
        v = stretch(w, alpha)
        if distribution == "ggx":
            return cosine + length(v)
        return twice_projected_area(cosine, v, unit_width(alpha, cosine), distribution)
    if isinstance(alpha, StudentWidth):
        return student_area(cosine, w, alpha.alpha, alpha.gamma)
    if distribution == "ggx":
        return cosine + ggx_area(w, alpha)
    if distribution == "beckmann":
        return beckmann_area(cosine, w, alpha)
    assert distribution == "vmf"  # "gtr" comes with a `StudentWidth`
    return 2.0 / vmf.masking_over_cosine(cosine, vmf.concentration(alpha))


def masking(w: Vector, alpha: Width, distribution: Distribution) -> Array:
    """Smith masking G1(w) for w above the horizon."""
    return 2.0 * w[2] / twice_projected_area(w[2], w, alpha, distribution)


def sample(wi: Vector, alpha: Width, u1: Array, u2: Array, distribution: Distribution) -> Vector:
    """A normal that is seen from wi (above the horizon), from two uniform numbers; see `reflection_pdf`."""
    if isinstance(alpha, Widths):
        unit = sample(normalize(stretch(wi, alpha)), unit_width(alpha, wi[2]), u1, u2, distribution)
        return from_unit_width(unit, alpha)
    if isinstance(alpha, StudentWidth):
        return student_sample(wi, alpha.alpha, alpha.gamma, u1, u2)
    if distribution == "ggx":
        return ggx_sample(wi, alpha, u1, u2)
    if distribution == "beckmann":
        return beckmann_sample(wi, alpha, u1, u2)
    assert distribution == "vmf"  # "gtr" comes with a `StudentWidth`
    normal = vmf.hemisphere_sample(vmf.concentration(alpha), u1, jnp.zeros_like(u2))
    planar, x, y = _plane(wi)
    sine, cosine = safe_sqrt(normal[0] * normal[0] + normal[1] * normal[1]), normal[2]
    slope, rim = _azimuths(wi[2] * cosine, planar * sine)
    signed = 2.0 * u2 - 1.0
    part, total = jnp.abs(signed), 1.0 + slope
    phi = rim * 2.0 * signed / (total + safe_sqrt(total * total - 4.0 * slope * part))
    along, across = sine * jnp.cos(phi), sine * jnp.sin(phi)
    return x * along - y * across, y * along + x * across, cosine


def reflection_pdf(h: Vector, wi: Vector, alpha: Width, distribution: Distribution = "ggx") -> Array:
    """Density, 1/sr, of directions mirrored at facets that `sample` draws, by their half vector with wi."""
    if isinstance(alpha, Widths | StudentWidth):
        return density(h, alpha, distribution) / (2.0 * twice_projected_area(wi[2], wi, alpha, distribution))
    if distribution == "ggx":
        return ggx_density(h, alpha) * ggx_masking(wi, alpha) / (4.0 * wi[2])
    if distribution == "beckmann":
        return beckmann_density(h, alpha) / (2.0 * beckmann_area(wi[2], wi, alpha))
    assert distribution == "vmf"  # "gtr" comes with a `StudentWidth`
    kappa = vmf.concentration(alpha)
    drawn = _share_drawn(wi, h, kappa) * vmf.hemisphere_norm(kappa) * vmf.hemisphere_density(h, kappa)
    return drawn / (4.0 * clamp_min(dot(wi, h), LEAST_WEIGHT))


def draw_weight(wi: Vector, m: Vector, alpha: Array) -> Array:
    """Density of seen vMF normals, D <wi, m> G1(wi) / cos, over that of `sample`; of others it is 1.

    It may be divided by: at the rim it stays above 0.
    """
    kappa = vmf.concentration(alpha)
    seen = clamp_min(dot(wi, m), 0.0) * vmf.masking_over_cosine(wi[2], kappa)
    return clamp_min(seen / (vmf.hemisphere_norm(kappa) * _share_drawn(wi, m, kappa)), LEAST_WEIGHT)


def rule(wi: Vector, alpha: Width, nodes: int, distribution: Distribution) -> Nodes:
    """Quadrature over the directions above the horizon that the facets mirror wi to (see `layerjax.quadrature`)."""
    if isinstance(alpha, Widths):
        return _drawn_rule(wi, alpha, nodes, distribution)
    if isinstance(alpha, StudentWidth):
        return _mirror_rule(wi, alpha.alpha, nodes, tails=True)
    if distribution == "ggx":
        return flake_rule(wi, *radii("surface", alpha), None, nodes)[0]
    # Beckmann normals end where vMF normals as wide do, or before
    return _mirror_rule(wi, alpha, nodes)


def visible_grid(
    wi: Vector, alpha: Widths, distribution: Distribution, points: tuple[int, int]
) -> tuple[Vector, np.ndarray]:
    """Normals seen along wi, a new last axis, and their shares of the visible area: a grid of what draws them."""
    *uniforms, weight = unit_grid(*points, round_axis=distribution == "ggx")
    u1, u2 = (jnp.asarray(u, wi[2].dtype) for u in uniforms)
    if alpha.gamma is not None:
        # either number draws an angle by itself
        apart = sample(
            (wi[0][..., None, None], wi[1][..., None, None], wi[2][..., None, None]),
            alpha,
            u1.reshape(points[1], points[0])[:, :1],
            u2[: points[0]],
            distribution,
        )
        m = (part.reshape(*wi[2].shape, -1) for part in apart)
        return (next(m), next(m), next(m)), weight
    x, y, z = (jnp.broadcast_to(part[..., None], (*wi[2].shape, u1.size)) for part in wi)
    return sample((x, y, z), alpha, u1, u2, distribution), weight


def _drawn_rule(wi: Vector, alpha: Widths, nodes: int, distribution: Distribution) -> Nodes:
    """Directions that the facets mirror wi to, each with one over its density as it is drawn."""
    m, share = visible_grid(wi, alpha, distribution, (nodes, 2 * nodes))
    towards = (wi[0][..., None], wi[1][..., None], wi[2][..., None])
    wo = reflect(towards, m)
    above = wo[2] > 0
    drawn = reflection_pdf(m, towards, alpha, distribution)
    weight = jnp.where(above & (drawn > 0), jnp.asarray(share, drawn.dtype) / jnp.where(drawn > 0, drawn, 1.0), 0.0)
    return sanitise(wo, above), weight


def _plane(wi: Vector) -> tuple[Array, Array, Array]:
    """Sine of wi, and the unit vector along its tilt, the x axis where it has none."""
    planar = safe_sqrt(wi[0] * wi[0] + wi[1] * wi[1])
    tilted = planar > 0
    inverse = 1.0 / jnp.where(tilted, planar, 1.0)
    return planar, jnp.where(tilted, wi[0] * inverse, 1.0), jnp.where(tilted, wi[1] * inverse, 0.0)


def _azimuths(level: Array, swing: Array) -> tuple[Array, Array]:
    """Of normals with <wi, m> = level + swing cos(phi): slope of the density of phi / rim, and the last phi seen."""
    cut = swing > level
    slope = clamp_max(safe_div(jnp.where(cut, 0.0, swing), jnp.where(cut, 1.0, level)), MOST_SLOPE)
    return jnp.where(cut, MOST_SLOPE, slope), jnp.where(cut, _rim(level, swing, cut), jnp.pi)


def _rim(level: Array, swing: Array, cut: Array) -> Array:
    """The azimuth where level + swing cos(phi) is 0, if |level| < swing (`cut`)."""
    wide, low = jnp.where(cut, swing, 1.0), jnp.where(cut, level, 0.5)
    return jnp.arctan2(safe_sqrt((wide - low) * (wide + low)), -low)


def _share_drawn(wi: Vector, m: Vector, kappa: Array) -> Array:
    """Density of `sample` over that of all normals, M."""
    planar, x, y = _plane(wi)
    sine = safe_sqrt(m[0] * m[0] + m[1] * m[1])
    slope, rim = _azimuths(wi[2] * m[2], planar * sine)
    along, across = x * m[0] + y * m[1], x * m[1] - y * m[0]
    upright = sine == 0
    phi = jnp.abs(jnp.arctan2(jnp.where(upright, 0.0, across), jnp.where(upright, 1.0, along)))
    return jnp.pi * (1.0 + slope * (1.0 - 2.0 * clamp_max(phi / rim, 1.0))) / (rim * vmf.upper_share(kappa))


def _mirror_rule(wi: Vector, alpha: Array, nodes: int, *, tails: bool = False) -> Nodes:
    """Normals in polar coordinates, each parallel cut where wi is mirrored to the horizon.

    Up to pi/4 - theta_i / 2 no parallel is cut, beyond pi/4 + theta_i / 2 nothing is left of them. tails: normals do
    not end before; their angles go like a sinh.
    """
    kappa = None if tails else vmf.concentration(alpha)
    planar, x, y = _plane(wi)
    theta = jnp.arctan2(planar, wi[2])
    last = None if kappa is None else _last_angle(kappa)
    rims = (0.25 * jnp.pi + 0.5 * side * theta for side in (-1.0, 1.0))
    edges = [jnp.zeros_like(theta), *(rim if last is None else clamp_max(rim, last) for rim in rims)]
    if tails:
        place, w_place = panels(jnp.arcsinh(jnp.stack(edges, axis=-1) / alpha), nodes)
        polar, w_polar = alpha * jnp.sinh(place), alpha * jnp.cosh(place) * w_place
    else:
        polar, w_polar = panels(jnp.stack(edges, axis=-1), nodes)
    sine, cosine = jnp.sin(polar), jnp.cos(polar)
    # wo.z = cos(theta_i) cos(2 polar) + sin(theta_i) sin(2 polar) cos(phi)
    level, swing = wi[2][..., None] * jnp.cos(2.0 * polar), planar[..., None] * jnp.sin(2.0 * polar)
    cut = swing > jnp.abs(level)
    rim = jnp.where(cut, _rim(level, swing, cut), jnp.where(level > 0, jnp.pi, 0.0))
    s, w = panels(jnp.asarray([0.0, 1.0], theta.dtype), nodes)
    phi = rim[..., None] * jnp.concatenate([s, -s])
    along, across = sine[..., None] * jnp.cos(phi), sine[..., None] * jnp.sin(phi)
    x, y, z = (part[..., None, None] for part in (x, y, wi[2]))
    m = (x * along - y * across, y * along + x * across, cosine[..., None] * jnp.ones_like(phi))
    towards = (wi[0][..., None, None], wi[1][..., None, None], z)
    facing = dot(towards, m)
    wo = tuple(2.0 * facing * part - w_part for part, w_part in zip(m, towards, strict=True))
    weight = 4.0 * facing * (sine * w_polar * rim)[..., None] * jnp.concatenate([w, w])
    shape = (*weight.shape[:-2], -1)
    return (wo[0].reshape(shape), wo[1].reshape(shape), wo[2].reshape(shape)), weight.reshape(shape)


def _last_angle(kappa: Array) -> Array:
    """The angle from the normal beyond which there are no vMF normals but for what `TAIL` says."""
    drop = clamp_max(TAIL * TAIL / kappa, 1.0)
    return 2.0 * jnp.arctan2(safe_sqrt(0.5 * drop), safe_sqrt(1.0 - 0.5 * drop))
