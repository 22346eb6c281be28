"""OpenPBR Surface 1.1, as far as it is opaque, isotropic and without fuzz: a coat over a base of metal or of diffuse.

The specification (Academy Software Foundation, https://academysoftwarefoundation.github.io/OpenPBR) leaves to renderers
how a coat darkens its base and how it absorbs, and they differ. Here coats are clear and `coat_darkening` is 0, so that
what is left means the same everywhere: lobes of microfacets, each of which takes its albedo from what lies below it, as
the section "Reduction to a mixture of lobes" writes them. The albedo is that along the viewer, so values change where
light and viewer change places.
"""

from collections.abc import Iterable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax.directions import Vector, dot, half_vector, split
from layerjax.fresnel import dielectric, schlick
from layerjax.normals.facets import rule
from layerjax.normals.ggx import ggx_area, ggx_density
from layerjax.quadrature import Nodes, hemisphere_rule

Lobe = Literal["coat", "gloss", "metal", "diffuse"]

ANGLES, NODES = 20, 16
"""Polar angles at which albedos are computed (by a rule of so many nodes along each coordinate), and a polynomial goes
through them."""

_POINTS = np.polynomial.chebyshev.chebpts1(ANGLES)
_COEFFICIENTS = np.linalg.inv(np.polynomial.chebyshev.chebvander(_POINTS, ANGLES - 1))

EDGE = 1.0 / 7.0
"""Cosine at which `specular_color` scales the reflectance of a metal: 82 degrees."""


class Surface(eqx.Module):
    """Parameters by OpenPBR's names, numbers or one for each channel; roughness is the square root of alpha.

    ======================== ========= ===================================================================
    parameter                range     meaning
    ======================== ========= ===================================================================
    lobes                              which there are: "coat" over "gloss", "metal" and "diffuse"
    base_color               [0, 1]    of the diffuse lobe, and reflectance of the metal along the normal
    base_diffuse_roughness   [0, 1]    sigma of Oren and Nayar
    base_metalness           [0, 1]    share of the metal, the rest is gloss over diffuse
    specular_color           [0, 1]    reflectance of the metal at 82 degrees over Schlick's
    specular_roughness       [0, 1]    of gloss and metal, before the coat widens them
    specular_ior             >= 1      of the gloss
    coat_roughness           [0, 1]
    coat_ior                 >= 1
    ======================== ========= ===================================================================
    """

    lobes: tuple[Lobe, ...] = eqx.field(static=True)
    base_color: Any = 0.8
    base_diffuse_roughness: Any = 0.0
    base_metalness: Any = 0.0
    specular_color: Any = 1.0
    specular_roughness: Any = 0.3
    specular_ior: Any = 1.5
    coat_roughness: Any = 0.0
    coat_ior: Any = 1.6


def evaluate(surface: Surface, wi: Array, wo: Array) -> Array:
    """BRDF in 1/sr without the cosine, (N, C), of light from wi seen along wo, (N, 3) each, above the surface."""
    return sum(lobes(surface, split(wi), split(wo)).values(), jnp.zeros((1, 1)))


def albedo(surface: Surface, wo: Array, nodes: int = 16) -> Array:
    """Share of light from everywhere that is seen along wo (N, 3), (N, C): each lobe by a rule that is made for it.

    Of a surface that obeys reciprocity it is the share of the light from wo that leaves.
    """
    view = split(wo)
    total = jnp.zeros((1, 1))
    for lobe in surface.lobes:
        alpha = _alpha(surface, lobe)
        wi, weight = hemisphere_rule(view, nodes) if alpha is None else _rule(view, alpha, nodes)
        spread = _vector(jnp.broadcast_to(part[:, None], weight.shape).ravel() for part in view)
        values = lobes(surface, _vector(part.ravel() for part in wi), spread)[lobe]
        total = total + (values.reshape(*weight.shape, -1) * (wi[2] * weight)[..., None]).sum(axis=1)
    return total


def lobes(surface: Surface, wi: Vector, wo: Vector) -> dict[Lobe, Array]:
    """Contribution of each lobe to the BRDF, (N, C); directions by components (N,)."""
    values: dict[Lobe, Array] = {}
    passed = jnp.ones_like(wo[2])[:, None]
    if "coat" in surface.lobes:
        values["coat"], albedo = _facets(surface, "coat", wi, wo)
        passed = passed * (1.0 - albedo)
    metal = jnp.asarray(surface.base_metalness)
    if "metal" in surface.lobes:
        values["metal"] = passed * metal * _facets(surface, "metal", wi, wo)[0]
        passed = passed * (1.0 - metal)
    if "gloss" in surface.lobes:
        gloss, albedo = _facets(surface, "gloss", wi, wo)
        values["gloss"] = passed * gloss
        passed = passed * (1.0 - albedo)
    if "diffuse" in surface.lobes:
        values["diffuse"] = passed * _diffuse(surface, wi, wo)
    return values


def _alpha(surface: Surface, lobe: Lobe) -> Array | None:
    """Width of the normals of a lobe; None: it has none."""
    coat = jnp.asarray(surface.coat_roughness) ** 2
    if lobe == "coat":
        return coat
    if lobe == "diffuse":
        return None
    own = jnp.asarray(surface.specular_roughness) ** 2
    # section "Roughening"
    return jnp.sqrt(jnp.minimum(1.0, own**2 + 2.0 * coat**2)) if "coat" in surface.lobes else own


def _fresnel(surface: Surface, lobe: Lobe, cosine: Array) -> Array:
    """Reflectance of facets at this cosine (...), (..., C)."""
    cosine = cosine[..., None]
    if lobe == "metal":
        return metal_reflectance(cosine, jnp.asarray(surface.base_color), jnp.asarray(surface.specular_color))
    if lobe == "coat":
        return dielectric(cosine, jnp.asarray(surface.coat_ior))
    ratio = jnp.asarray(surface.specular_ior) / (surface.coat_ior if "coat" in surface.lobes else 1.0)
    # section "Total internal reflection": light that came in through the coat cannot be reflected totally
    return dielectric(cosine, jnp.maximum(ratio, 1.0 / ratio))


def metal_reflectance(cosine: Array, color: Array, tint: Array) -> Array:
    """F82-tint, section "Metal" (Kutz et al. 2021)."""
    edge = schlick(jnp.asarray(EDGE), color)
    lowered = cosine * (1.0 - cosine) ** 6 / (EDGE * (1.0 - EDGE) ** 6)
    return schlick(cosine, color) - lowered * edge * (1.0 - tint)


def _facets(surface: Surface, lobe: Lobe, wi: Vector, wo: Vector) -> tuple[Array, Array]:
    """The lobe of facets, and its albedo along wo, (N, C) each.

    What facets reflect more than once is there as a factor (Turquin 2019, Eq. 14 and 16), as in MaterialX.
    """
    alpha = _alpha(surface, lobe)
    assert alpha is not None
    half, cosine = half_vector(wi, wo, same_side=True)
    once, whole = _albedos(surface, lobe, alpha)
    weights = _interpolation(wo[2])
    reflectance = _fresnel(surface, lobe, cosine)
    value = _mirrors(half, wi, wo, alpha)[:, None] * reflectance
    return value * (1.0 + reflectance * (1.0 / (weights @ once) - 1.0)[:, None]), weights @ whole


def _albedos(surface: Surface, lobe: Lobe, alpha: Array) -> tuple[Array, Array]:
    """At the angles of the table: albedo of facets that are perfect mirrors, by one reflection, (ANGLES,), and of the
    lobe, (ANGLES, C)."""
    theta = 0.25 * jnp.pi * (1.0 + jnp.asarray(_POINTS))
    wo = (jnp.sin(theta), jnp.zeros_like(theta), jnp.cos(theta))
    light, weight = _rule(wo, alpha, NODES)
    seen = _vector(part[:, None] for part in wo)
    normal, cosine = half_vector(light, seen, same_side=True)
    share = _mirrors(normal, light, seen, alpha) * light[2] * weight
    once = share.sum(axis=1)
    reflectance = _fresnel(surface, lobe, cosine)
    again = 1.0 + reflectance * (1.0 / once - 1.0)[:, None, None]
    return once, (share[..., None] * reflectance * again).sum(axis=1)


def _interpolation(cosine: Array) -> Array:
    """Weights (N, ANGLES) of the table's angles in an interpolation at these cosines (N,)."""
    x = 4.0 / jnp.pi * jnp.arccos(jnp.minimum(cosine, 1.0)) - 1.0
    return jnp.cos(jnp.arange(ANGLES) * jnp.arccos(jnp.clip(x, -1.0, 1.0))[:, None]) @ jnp.asarray(_COEFFICIENTS)


def _rule(w: Vector, alpha: Array, nodes: int) -> Nodes:
    """Directions that facets mirror light from w (N,) to, (N, nodes) a component, and weights."""
    return jax.vmap(lambda one: rule(one, alpha, nodes, "ggx"))(w)


def _vector(parts: Iterable[Array]) -> Vector:
    x, y, z = parts
    return x, y, z


def _mirrors(half: Vector, wi: Vector, wo: Vector, alpha: Array) -> Array:
    """BRDF of facets that are perfect mirrors: GGX, masking and shadowing correlated (Heitz 2014, Eq. 99)."""
    return ggx_density(half, alpha) / (2.0 * (ggx_area(wi, alpha) * wo[2] + ggx_area(wo, alpha) * wi[2]))


def _diffuse(surface: Surface, wi: Vector, wo: Vector) -> Array:
    """Energy-preserving Oren-Nayar (Portsmouth et al. 2024), section "Glossy-diffuse", (N, C).

    The specification's rho_ms has 1 / pi once too often; without it a white surface is white.
    """
    color, sigma = jnp.asarray(surface.base_color), jnp.asarray(surface.base_diffuse_roughness)
    level = 1.0 / (1.0 + (0.5 - 2.0 / (3.0 * jnp.pi)) * sigma)
    s = dot(wi, wo) - wi[2] * wo[2]
    once = level * (1.0 + sigma * s / jnp.where(s > 0.0, jnp.maximum(wi[2], wo[2]), 1.0))
    mean = level * (1.0 + (2.0 / 3.0 - 28.0 / (15.0 * jnp.pi)) * sigma)
    lost_i, lost_o = (1.0 - level * (1.0 + sigma * _excess(w[2]) / jnp.pi) for w in (wi, wo))
    # of a smooth surface both are 0
    lost = (lost_i * lost_o / jnp.where(sigma > 0.0, 1.0 - mean, 1.0))[:, None]
    return (color * once[:, None] + color**2 * mean / (1.0 - color * (1.0 - mean)) * lost) / jnp.pi


def _excess(cosine: Array) -> Array:
    """G of Portsmouth et al. 2024, in a form that does not divide by the cosine."""
    sine = jnp.sqrt(1.0 - jnp.minimum(cosine, 1.0) ** 2)
    outer = sine * cosine * (1.0 + sine + sine**2) / (1.0 + sine)
    return sine * (jnp.arccos(jnp.minimum(cosine, 1.0)) - sine * cosine) + 2.0 / 3.0 * (outer - sine)
