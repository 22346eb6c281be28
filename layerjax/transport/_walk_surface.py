"""What happens to the walk at a surface: a rough interface or the base, by one reflection or refraction.

Directions here are of travel, in the frame of the stack; inside each function they are turned away from the surface,
with z positive on the side that light arrives from.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels, pick
from layerjax.directions import Vector, select
from layerjax.distributions import ggx_masking, sggx_area
from layerjax.surfaces import Conductor, Surface
from layerjax.surfaces.microfacet import (
    interface_pdf,
    interface_reflection,
    interface_sample,
    interface_transmission,
    refraction_lobe,
)
from layerjax.transport._walk_scene import Scene, choose

DIFFUSE_SHARE = 0.1
"""Weight of a cosine lobe in densities that stand for those of multiple scattering, which are not known."""


class Bounce(NamedTuple):
    """Result of an event at a surface."""

    towards_target: Channels
    """Share of the light sent to the target direction, per solid angle."""
    direction: Vector
    """New direction of travel."""
    crosses: Array
    """Whether that lies on the other side."""
    kept: Channels
    """Share of the light that the new direction carries."""
    survives: Array
    """Whether it carries any."""


def base_of(scene: Scene) -> Surface | None:
    """The base, its index taken relative to the medium on it."""
    if not isinstance(scene.base, Conductor) or not scene.interfaces:
        return scene.base
    above = scene.indices[-1]
    return eqx.tree_at(lambda base: (base.ior, base.k), scene.base, (scene.base.ior / above, scene.base.k / above))


def turned(w: Vector, from_above: Array, sign: float = 1.0) -> Vector:
    """w (times the sign) with z positive on the side that light arrives from."""
    return sign * w[0], sign * w[1], jnp.where(from_above, sign * w[2], -sign * w[2])


def is_base(scene: Scene, surface: Array | None) -> Array | bool:
    """Whether the surface is the base; a Python bool if there is no choice."""
    if not scene.interfaces or scene.base is None:
        return scene.base is not None
    return surface == len(scene.interfaces)


def roughness(scene: Scene, surface: Array | None) -> Array:
    """GGX width of an interface."""
    return choose(surface, [interface.alpha for interface in scene.interfaces])


def bounce(
    scene: Scene,
    surface: Array | None,
    from_above: Array,
    travel: Vector,
    target: Vector | None,
    refracts: Array | None,
    uniforms: tuple[Array, Array, Array],
) -> Bounce:
    """One reflection or refraction of light that travels along `travel` onto a surface.

    Args:
        target: a direction of travel away from the surface that the scattered light is asked for, or None.
        refracts: lanes that are to refract wherever that is possible (their `kept` then lacks the transmittance).
    """
    wi = _facing(turned(travel, from_above, -1.0))
    towards = None if target is None else turned(target, from_above)
    u1, u2, u3 = uniforms
    at_base = is_base(scene, surface)
    results = []
    if at_base is not True:
        ior, alpha = scene.surface_ior(surface, from_above), roughness(scene, surface)
        wo, leaves = interface_sample(wi, ior, alpha, u1, u2, u3 if refracts is None else jnp.where(refracts, 2.0, u3))
        masking = ggx_masking((wo[0], wo[1], jnp.abs(wo[2])), alpha)
        value: Channels = () if towards is None else (_interface(wi, towards, ior, alpha) * jnp.abs(towards[2]),)
        results.append(Bounce(value, wo, wo[2] < 0, (masking,), leaves))
    if at_base is not False:
        base = base_of(scene)
        assert base is not None
        wo = base.sample(wi, u1, u2)
        leaves = wo[2] > 0
        inside = _facing(wo)
        share = tuple(f * inside[2] / base.pdf(wi, inside) for f in base.evaluate(wi, inside))
        value = () if towards is None else base_towards(base, wi, towards)
        results.append(Bounce(value, wo, jnp.zeros_like(leaves), share, leaves))
    result = results[0] if len(results) == 1 else merge(at_base, results[1], results[0])
    return result._replace(direction=turned(result.direction, from_above))


def base_towards(base: Surface, wi: Vector, towards: Vector) -> Channels:
    """Light that the base sends to a direction, per solid angle; 0 below it."""
    inside = _facing(towards)
    return tuple(jnp.where(towards[2] > 0, f * inside[2], 0.0) for f in base.evaluate(wi, inside))


def merge(chosen: Array | bool, a: Bounce, b: Bounce) -> Bounce:
    """a where chosen, else b."""

    def channels(x: Channels, y: Channels) -> Channels:
        return tuple(jnp.where(chosen, pick(x, c), pick(y, c)) for c in range(max(len(x), len(y))))

    mask = jnp.asarray(chosen)
    return Bounce(
        channels(a.towards_target, b.towards_target),
        select(mask, a.direction, b.direction),
        jnp.where(mask, a.crosses, b.crosses),
        channels(a.kept, b.kept),
        jnp.where(mask, a.survives, b.survives),
    )


def density(
    scene: Scene, surface: Array | None, from_above: Array, travel: Vector, onward: Vector, *, diffuse: bool
) -> Array:
    """Density, 1/sr, with which `bounce` turns `travel` into `onward`; with `diffuse`, a stand-in that is never 0."""
    wi, wo = _facing(turned(travel, from_above, -1.0)), turned(onward, from_above)
    at_base = is_base(scene, surface)
    value: Array | None = None
    if at_base is not True:
        ior, alpha = scene.surface_ior(surface, from_above), roughness(scene, surface)
        value = interface_pdf(_interface(wi, wo, ior, alpha), wo, alpha)
    if at_base is not False:
        base = base_of(scene)
        assert base is not None
        below = jnp.where(wo[2] > 0, base.pdf(wi, _facing(wo)), 0.0)
        value = below if value is None else jnp.where(at_base, below, value)
    assert value is not None
    return value + DIFFUSE_SHARE * jnp.abs(wo[2]) / jnp.pi if diffuse else value


def exit_density(
    scene: Scene, surface: Array, above: Array, leaving: Vector, inside: Vector, *, diffuse: bool
) -> tuple[Array, Array]:
    """Density with which an interface, seen from outside along `leaving`, refracts to the direction `inside`.

    Both directions point away from the interface; `above` says on which side `leaving` lies. Also the transmittance of
    the facet and the Smith term 2 / (cos + sigma) of `inside`, multiplied.
    """
    wi, wo = turned(leaving, above), turned(inside, above)
    ior, alpha = scene.surface_ior(surface, above), roughness(scene, surface)
    lobe, transmittance = refraction_lobe(wi, wo, ior, alpha)
    value = jnp.where(wo[2] < 0, 2.0 * lobe / (wi[2] + sggx_area(wi, "surface", alpha, None)), 0.0)
    if diffuse:
        value = value + DIFFUSE_SHARE * jnp.abs(wo[2]) / jnp.pi
    return value, transmittance * 2.0 / (jnp.abs(wo[2]) + sggx_area(wo, "surface", alpha, None))


def _interface(wi: Vector, wo: Vector, ior: Array, alpha: Array) -> Array:
    """BSDF of an interface, of whichever kind the side of wo asks for."""
    above = wo[2] > 0
    reflected = interface_reflection(wi, (wo[0], wo[1], jnp.where(above, wo[2], 0.5)), ior, alpha)
    refracted = interface_transmission(wi, (wo[0], wo[1], jnp.where(above, -0.5, wo[2])), ior, alpha)
    return jnp.where(above, reflected, refracted)


def _facing(w: Vector) -> Vector:
    """w with its z kept above 0: rounding may leave it in the plane of the surface."""
    return w[0], w[1], jnp.maximum(w[2], 1e-12)
