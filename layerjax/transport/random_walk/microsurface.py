"""Multiple scattering on the rough surfaces of a stack, dielectric or metal, one facet a step of the walk.

The physics of a facet is that of `layerjax.microsurface.heitz_walk`, whose heights and directions are counted from the
side of the surface that the ray is on. Here a path keeps its place on a surface of the stack, and sends what it can to
the requested direction of the light.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax.channels import Channels
from layerjax.directions import Vector, add, dot, flip, normalize, reflect, scale, select
from layerjax.microsurface.heitz_walk import (
    escape_probability,
    facing_area,
    meet_facet,
    next_height,
    opposite_height,
    pass_through,
)
from layerjax.normals.ggx import ggx_density
from layerjax.surfaces import Conductor
from layerjax.surfaces.interface import refraction_lobe
from layerjax.transport.random_walk.scene import Scene
from layerjax.transport.random_walk.surfaces import Bounce, base_of, is_base, is_smooth, merge, orient, roughness


class Position(NamedTuple):
    """Where a path is on a microsurface."""

    on_surface: Array
    surface: Array
    height: Array
    entry: Vector
    """Direction of travel that the path came with."""
    entered_above: Array


def off_surface(travel: Vector) -> Position:
    """On no microsurface."""
    zero = jnp.zeros_like(travel[2])
    no = jnp.zeros(zero.shape, bool)
    return Position(no, jnp.zeros(zero.shape, jnp.int32), zero, travel, no)


def has_microsurface(scene: Scene) -> bool:
    """Whether any surface of the scene has facets."""
    rough_metal = isinstance(scene.base, Conductor) and not scene.base.is_smooth
    return not all(scene.is_smooth) or rough_metal


def has_facets(scene: Scene, surface: Array | None) -> Array | bool:
    """Whether a surface is walked on: all but diffuse bases."""
    smooth = is_smooth(scene, surface)
    if scene.base is None or isinstance(scene.base, Conductor):
        return not smooth if isinstance(smooth, bool) else ~smooth
    return ~jnp.asarray(is_base(scene, surface)) & ~jnp.asarray(smooth)


def width(scene: Scene, surface: Array | None) -> Array:
    """GGX width of a surface with facets."""
    if not isinstance(scene.base, Conductor) or scene.base.is_smooth:
        return roughness(scene, surface)
    if not scene.interfaces:
        return scene.base.alpha
    return jnp.where(is_base(scene, surface), scene.base.alpha, roughness(scene, surface))


def free_flight(w: Vector, height: Array, alpha: Array, free_path: Array) -> tuple[Array, Array]:
    """Next height of a ray after a free path (in mean free paths), and whether it has left the surface."""
    reached = next_height(w, height, alpha, free_path)
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
    wi = orient(travel, from_above, -1.0)
    towards = None if target is None else orient(target, from_above)
    alpha = width(scene, surface)
    m, cosine = meet_facet(wi, alpha, u1, u2)
    at_base = is_base(scene, surface) if isinstance(scene.base, Conductor) else False
    results = []
    after = height
    if at_base is not True:
        ior = scene.surface_ior(surface, from_above)
        at_interface, after = _meet_interface(wi, m, cosine, towards, height, ior, alpha, u3)
        results.append(at_interface)
    if at_base is not False:
        base = base_of(scene)
        assert isinstance(base, Conductor)
        results.append(_meet_metal(base, wi, m, cosine, towards, height, alpha))
    result = results[0]
    if len(results) == 2:
        result, after = merge(at_base, results[1], results[0]), jnp.where(at_base, height, after)
    # directions are counted from where the ray is now: under the facets the surface is upside down
    return result._replace(direction=orient(result.direction, from_above ^ result.crosses)), after


def _meet_interface(
    wi: Vector, m: Vector, cosine: Array, towards: Vector | None, height: Array, ior: Array, alpha: Array, u: Array
) -> tuple[Bounce, Array]:
    """Reflection or refraction at a dielectric facet, chosen by Fresnel's shares; and the height afterwards."""
    refracted, below, exists = pass_through(wi, m, ior, height)
    crosses = (u >= fresnel.dielectric(cosine, ior)) & exists
    wo = select(crosses, refracted, reflect(wi, m))
    sent: Channels = () if towards is None else (_interface_contribution(wi, towards, height, ior, alpha),)
    bounced = Bounce(sent, wo, crosses, (jnp.ones_like(cosine),), jnp.ones_like(crosses))
    return bounced, jnp.where(crosses, below, height)


def _meet_metal(
    base: Conductor, wi: Vector, m: Vector, cosine: Array, towards: Vector | None, height: Array, alpha: Array
) -> Bounce:
    """Reflection at a metal facet."""
    sent: Channels = ()
    if towards is not None:
        lobe, between = _mirror_contribution(wi, towards, height, alpha)
        sent = tuple(lobe * share for share in _reflectance(base, between))
    no = jnp.zeros(cosine.shape, bool)
    return Bounce(sent, reflect(wi, m), no, _reflectance(base, cosine), ~no)


def _interface_contribution(wi: Vector, wo: Vector, height: Array, ior: Array, alpha: Array) -> Array:
    """Light that a dielectric facet at this height, met along wi, sends to wo and out of the surface, 1/sr."""
    lobe, cosine = _mirror_contribution(wi, wo, height, alpha)
    reflected = lobe * fresnel.dielectric(jnp.minimum(cosine, 1.0), ior)
    facets, (transmittance,) = refraction_lobe(wi, wo, ior, alpha)
    escape = escape_probability(flip(wo), opposite_height(height), alpha)
    refracted = facets * transmittance / facing_area(scale(-1.0, wi), alpha) * escape
    return jnp.where(wo[2] > 0, reflected, jnp.where(facets > 0, refracted, 0.0))


def _mirror_contribution(wi: Vector, wo: Vector, height: Array, alpha: Array) -> tuple[Array, Array]:
    """Light that a perfect mirror facet at this height, met along wi, sends to wo and out of the surface, 1/sr.

    Also the cosine of wi with the facet, by which Fresnel's reflectance is still to be taken.
    """
    total = add(wi, wo)
    h = normalize(total)
    valid = (wo[2] > 0) & (h[2] > 0) & (dot(total, total) > 0)
    escape = escape_probability(wo, height, alpha)
    lobe = 0.25 * ggx_density(h, alpha) / facing_area(scale(-1.0, wi), alpha) * escape
    return jnp.where(valid, lobe, 0.0), jnp.maximum(dot(wi, h), 0.0)


def _reflectance(base: Conductor, cosine: Array) -> Channels:
    return base.reflectance(jnp.minimum(cosine, 1.0))
