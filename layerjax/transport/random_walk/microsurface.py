"""Multiple scattering on a rough surface: the walk of Heitz et al. 2016 ("Multiple-scattering microfacet BSDFs with the
Smith model") over GGX facets, for dielectrics and conductors.

Under the Smith assumption a rough surface is a medium of facets without a bottom. In the coordinate
height = -log C1(h) >= 0 (C1: the distribution of heights) it is homogeneous: a ray along w meets a facet after a free
path with extinction A(w) / |w_z|, A(w) = (sigma(w) - w_z) / 2 the projected area of the facets that face it, and has
left where the coordinate would fall below 0. Passing through a facet turns the surface over, C1 -> 1 - C1.

Directions are local to the side that the ray is on: z is positive away from the surface.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._numerics import safe_sqrt
from layerjax.channels import Channels, each, per_channel
from layerjax.directions import Vector, add, dot, normalize, reflect, refract, scale, select
from layerjax.normals.sggx import ggx_density, ggx_sample
from layerjax.surfaces import Conductor
from layerjax.surfaces.microfacet import refraction_lobe
from layerjax.transport.random_walk.scene import Scene
from layerjax.transport.random_walk.surfaces import Bounce, base_of, is_base, roughness, turned


class Position(NamedTuple):
    """Where a path is on a microsurface."""

    on: Array
    surface: Array
    height: Array
    entry: Vector
    """Direction of travel that the path came with."""
    entered_above: Array


def away(travel: Vector) -> Position:
    """On no microsurface."""
    zero = jnp.zeros_like(travel[2])
    no = jnp.zeros(zero.shape, bool)
    return Position(no, jnp.zeros(zero.shape, jnp.int32), zero, travel, no)


def applies(scene: Scene) -> bool:
    """Whether any surface of the scene has facets."""
    return bool(scene.interfaces) or isinstance(scene.base, Conductor)


def has_facets(scene: Scene, surface: Array | None) -> Array | bool:
    """Whether a surface is walked on: all but diffuse bases."""
    if scene.base is None or isinstance(scene.base, Conductor):
        return True
    return ~jnp.asarray(is_base(scene, surface))


def width(scene: Scene, surface: Array | None) -> Array:
    """GGX width of a surface with facets."""
    if not isinstance(scene.base, Conductor):
        return roughness(scene, surface)
    if not scene.interfaces:
        return scene.base.alpha
    return jnp.where(is_base(scene, surface), scene.base.alpha, roughness(scene, surface))


def fly(w: Vector, height: Array, alpha: Array, free_path: Array) -> tuple[Array, Array]:
    """Next height of a ray after a free path (in mean free paths), and whether it has left the surface."""
    reached = height - w[2] * free_path / _area(w, alpha)
    return reached, (w[2] > 0) & (reached <= 0)


def bounce(
    scene: Scene,
    surface: Array | None,
    from_above: Array,
    travel: Vector,
    height: Array,
    target: Vector | None,
    uniforms: tuple[Array, Array, Array],
) -> tuple[Bounce, Array]:
    """Reflection or refraction at one facet, and the height afterwards, counted from the side that the ray is on then.

    See `layerjax.transport.random_walk.surfaces.bounce`; what is sent to the target is what escapes the surface.
    """
    u1, u2, u3 = uniforms
    wi = turned(travel, from_above, -1.0)
    alpha = width(scene, surface)
    m = ggx_sample(wi, alpha, u1, u2)
    cosine = jnp.clip(dot(wi, m), 0.0, 1.0)
    reflected = reflect(wi, m)
    at_base = is_base(scene, surface) if isinstance(scene.base, Conductor) else False
    towards = None if target is None else turned(target, from_above)
    area = _area(scale(-1.0, wi), alpha)
    one = jnp.ones_like(cosine)
    sent: list[Channels] = []
    wo, crosses = reflected, jnp.zeros(cosine.shape, bool)
    kept: Channels = (one,)
    if at_base is not True:
        ior = scene.surface_ior(surface, from_above)
        refracted, exists = refract(wi, m, ior)
        crosses = (u3 >= fresnel.dielectric(cosine, ior)) & exists
        wo = select(crosses, refracted, reflected)
        if towards is not None:
            sent.append((_dielectric(wi, towards, height, area, ior, alpha),))
    if at_base is not False:
        base = base_of(scene)
        assert isinstance(base, Conductor)
        if at_base is not True:
            crosses, wo = crosses & ~at_base, select(at_base, reflected, wo)
        shares = _reflectance(base, cosine)
        kept = shares if at_base is True else tuple(jnp.where(at_base, share, one) for share in shares)
        if towards is not None:
            lobe, between = _mirror(wi, towards, height, area, alpha)
            values = tuple(lobe * share for share in _reflectance(base, between))
            if at_base is True:
                sent.append(values)
            else:
                sent[0] = tuple(jnp.where(at_base, value, sent[0][0]) for value in values)
    # sides are counted from where the ray is now: under the facets the surface is upside down
    after = jnp.where(crosses, _overturned(height), height)
    result = Bounce(sent[0] if sent else (), turned(wo, from_above), crosses, kept, jnp.ones_like(crosses))
    return result, after


def _dielectric(wi: Vector, wo: Vector, height: Array, area: Array, ior: Array, alpha: Array) -> Array:
    """What a facet at this height, met along wi, sends to wo and out, per solid angle."""
    lobe, cosine = _mirror(wi, wo, height, area, alpha)
    reflected = lobe * fresnel.dielectric(jnp.minimum(cosine, 1.0), ior)
    facets, transmittance = refraction_lobe(wi, wo, ior, alpha)
    below = (wo[0], wo[1], -wo[2])
    refracted = facets * transmittance / area * _escape(below, _overturned(height), alpha)
    return jnp.where(wo[2] > 0, reflected, jnp.where(facets > 0, refracted, 0.0))


def _mirror(wi: Vector, wo: Vector, height: Array, area: Array, alpha: Array) -> tuple[Array, Array]:
    """The same by reflection, before Fresnel, and the cosine at the facet."""
    total = add(wi, wo)
    h = normalize(total)
    valid = (wo[2] > 0) & (h[2] > 0) & (dot(total, total) > 0)
    lobe = 0.25 * ggx_density(h, alpha) / area * _escape(wo, height, alpha)
    return jnp.where(valid, lobe, 0.0), jnp.maximum(dot(wi, h), 0.0)


def _escape(w: Vector, height: Array, alpha: Array) -> Array:
    """Share of light along w that leaves the surface from this height, exp(-Lambda(w) height)."""
    return jnp.exp(-height * _area(w, alpha) / jnp.maximum(w[2], jnp.finfo(height.dtype).tiny * 1e4))


def _area(w: Vector, alpha: Array) -> Array:
    """Projected area of the facets that face a ray along w: (sigma - w_z) / 2, without cancellation."""
    spread = alpha * alpha * (w[0] * w[0] + w[1] * w[1])
    sigma = safe_sqrt(spread + w[2] * w[2])
    floor = jnp.finfo(sigma.dtype).tiny * 1e4
    return 0.5 * jnp.where(w[2] > 0, (spread + floor) / (sigma + jnp.maximum(w[2], 0.0) + floor), sigma - w[2])


def _overturned(height: Array) -> Array:
    """-log(1 - exp(-height)), to rounding at small and large heights."""
    height = jnp.maximum(height, jnp.finfo(height.dtype).tiny)  # 0 would lie infinitely deep on the other side
    small = height < 0.6931
    return -jnp.where(small, jnp.log(-jnp.expm1(-height)), jnp.log1p(-jnp.exp(-height)))


def _reflectance(base: Conductor, cosine: Array) -> Channels:
    ior, k = per_channel(base.ior), per_channel(base.k)
    cosine = jnp.minimum(cosine, 1.0)
    return each(lambda ior, k: fresnel.conductor(cosine, ior, k), ior, k)
