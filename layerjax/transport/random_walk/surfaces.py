"""What happens to the walk at a surface: a rough interface or the base, by one reflection or refraction.

Directions here are of travel, in the frame of the stack; inside each function they are turned away from the surface,
with z positive on the side that light arrives from.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._numerics import safe_div
from layerjax.channels import Channels, mean, pick
from layerjax.directions import Vector, bend, mirror, sanitise, scale, select
from layerjax.normals.facets import Distribution, draw_weight, masking, twice_projected_area
from layerjax.normals.widths import StudentWidth, Width, Widths
from layerjax.stack import Interface
from layerjax.surfaces import Conductor, Surface
from layerjax.surfaces.interface import (
    event_weights,
    facet_normal,
    interface_event,
    interface_pdf,
    reflected_channels,
    refraction_lobe,
    transmitted_channels,
)
from layerjax.surfaces.thin_film import Films
from layerjax.transport.random_walk.scene import Scene, choose

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
    weight: Channels
    """Share of the light that the new direction carries."""
    survives: Array
    """Whether it carries any."""


def base_of(scene: Scene) -> Surface | None:
    """The base, its index taken relative to the medium on it."""
    if not isinstance(scene.base, Conductor) or not scene.interfaces:
        return scene.base
    return scene.base.relative_to(scene.indices[-1])


def orient(w: Vector, from_above: Array, sign: float = 1.0) -> Vector:
    """w (times the sign) with z positive on the side that light arrives from."""
    return sign * w[0], sign * w[1], jnp.where(from_above, sign * w[2], -sign * w[2])


def is_base(scene: Scene, surface: Array | None) -> Array | bool:
    """Whether the surface is the base; a Python bool if there is no choice."""
    if not scene.interfaces or scene.base is None:
        return scene.base is not None
    return surface == len(scene.interfaces)


def roughness(scene: Scene, surface: Array | None) -> Array:
    """Width of the normals of an interface, the one along the tangent; of a smooth one, which has none, a stand-in."""
    return choose(surface, [0.5 if interface.is_smooth else interface.alpha for interface in scene.interfaces])


def _widths(scene: Scene, surface: Array | None, distribution: Distribution) -> Widths:
    """Both widths of the normals of an interface."""
    across = [
        0.5 if face.is_smooth else (face.alpha_y if face.is_anisotropic else face.alpha) for face in scene.interfaces
    ]
    turned = [0.0 if face.tangent is None else face.tangent for face in scene.interfaces]
    gamma = _gamma(scene, surface) if distribution == "gtr" else None
    return Widths(roughness(scene, surface), choose(surface, across), choose(surface, turned), gamma)


def _gamma(scene: Scene, surface: Array | None) -> Array:
    """Exponent of the slopes of an interface; a stand-in where others have none."""
    return choose(surface, [2.0 if face.gamma is None else face.gamma for face in scene.interfaces])


def is_smooth(scene: Scene, surface: Array | None) -> Array | bool:
    """Whether the surface is smooth; a Python bool if all are, or none is."""
    kinds = list(scene.is_smooth)
    if scene.base is not None:
        kinds.append(isinstance(scene.base, Conductor) and scene.base.is_smooth)
    if all(kinds) or not any(kinds):
        return all(kinds)
    return choose(surface, [jnp.asarray(kind) for kind in kinds])


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
        target: a direction of travel away from the surface requested of the scattered light, or None.
        refracts: walkers that are to refract wherever that is possible (their `weight` then lacks the transmittance).
    """
    wi = _clamp_to_upper(orient(travel, from_above, -1.0))
    towards = None if target is None else orient(target, from_above)
    u1, u2, u3 = uniforms
    at_base = is_base(scene, surface)
    results = []
    if at_base is not True:
        ior = scene.surface_ior(surface, from_above)
        films = scene.films(surface, from_above)
        u3 = u3 if refracts is None else jnp.where(refracts, 2.0, u3)

        def event(alpha: Width, distribution: Distribution) -> Bounce:
            wo, leaves, m, shares = interface_event(wi, ior, alpha, u1, u2, u3, distribution, films)
            if refracts is not None:
                shares = tuple(jnp.where(refracts, 1.0, share) for share in shares)
            weight = masking((wo[0], wo[1], jnp.abs(wo[2])), alpha, distribution)
            if distribution == "vmf" and not isinstance(alpha, Widths | StudentWidth):
                weight = weight * draw_weight(wi, m, alpha)
            sent: Channels = ()
            if towards is not None:
                values = _interface(wi, towards, ior, alpha, distribution, films)
                sent = tuple(value * jnp.abs(towards[2]) for value in values)
            return Bounce(sent, wo, wo[2] < 0, tuple(weight * share for share in shares) or (weight,), leaves)

        smooth = any(scene.is_smooth)
        met = None if all(scene.is_smooth) else _by_normals(scene, surface, event)
        if smooth:
            ray = _meet_smooth(wi, ior, films, u3, towards)
            mask = choose(surface, [jnp.asarray(kind) for kind in (*scene.is_smooth, False)])
            met = ray if met is None else merge(mask, ray, met)
        assert met is not None
        results.append(met)
    if at_base is not False:
        base = base_of(scene)
        assert base is not None
        wo = base.sample(wi, u1, u2)
        leaves = wo[2] > 0
        inside = _clamp_to_upper(wo)
        if isinstance(base, Conductor) and base.is_smooth:
            share = base.reflectance(wi[2])
        else:
            share = tuple(_weight(f * inside[2], base.pdf(wi, inside), base) for f in base.evaluate(wi, inside))
        value: Channels = () if towards is None else base_towards(base, wi, towards)
        results.append(Bounce(value, wo, jnp.zeros_like(leaves), share, leaves))
    result = results[0] if len(results) == 1 else merge(at_base, results[1], results[0])
    return result._replace(direction=orient(result.direction, from_above))


def _meet_smooth(wi: Vector, ior: Array, films: Films, u: Array, target: Vector | None) -> Bounce:
    """Reflection or refraction at a smooth interface, chosen by Fresnel's shares, the mean of the channels."""
    behind, exists = bend(wi, ior)
    levels = tuple(fresnel.dielectric_towards(wi[2], ior, behind[2], exists, film) for film in films)
    level = mean(levels)
    reflects = (u < level) | ~exists
    wo = select(reflects, mirror(wi), scale(-1.0, behind))
    zero, yes = jnp.zeros_like(level), jnp.ones(level.shape, bool)
    weight = event_weights(levels, reflects) or (zero + 1.0,)
    return Bounce(() if target is None else (zero,), wo, ~reflects, weight, yes)


def base_towards(base: Surface, wi: Vector, towards: Vector) -> Channels:
    """Light that the base sends to a direction, per solid angle; 0 below it."""
    inside = _clamp_to_upper(towards)
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
        channels(a.weight, b.weight),
        jnp.where(mask, a.survives, b.survives),
    )


def density(
    scene: Scene, surface: Array | None, from_above: Array, travel: Vector, onward: Vector, *, diffuse: bool
) -> Array:
    """Density, 1/sr, with which `bounce` turns `travel` into `onward`; with `diffuse`, a stand-in that is never 0."""
    wi, wo = _clamp_to_upper(orient(travel, from_above, -1.0)), orient(onward, from_above)
    at_base = is_base(scene, surface)
    value: Array | None = None
    if at_base is not True:
        ior, films = scene.surface_ior(surface, from_above), scene.films(surface, from_above)

        def drawn(alpha: Width, distribution: Distribution) -> Array:
            value = mean(_interface(wi, wo, ior, alpha, distribution, films))
            return interface_pdf(value, wi, wo, ior, alpha, distribution)

        value = _by_normals(scene, surface, drawn)
    if at_base is not False:
        base = base_of(scene)
        assert base is not None
        below = jnp.where(wo[2] > 0, base.pdf(wi, _clamp_to_upper(wo)), 0.0)
        value = below if value is None else jnp.where(at_base, below, value)
    assert value is not None
    return value + DIFFUSE_SHARE * jnp.abs(wo[2]) / jnp.pi if diffuse else value


def interface_towards(
    scene: Scene, surface: Array | None, from_above: Array, travel: Vector, target: Vector
) -> tuple[Channels, Array]:
    """What an interface sends to a direction of travel, per solid angle, and the density with which it is drawn."""
    wi, towards = _clamp_to_upper(orient(travel, from_above, -1.0)), orient(target, from_above)
    ior, films = scene.surface_ior(surface, from_above), scene.films(surface, from_above)

    def sent(alpha: Width, distribution: Distribution) -> tuple[Channels, Array]:
        values = _interface(wi, towards, ior, alpha, distribution, films)
        density = interface_pdf(mean(values), wi, towards, ior, alpha, distribution)
        return tuple(value * jnp.abs(towards[2]) for value in values), density

    return _by_normals(scene, surface, sent)


def exit_density(
    scene: Scene, surface: Array, above: Array, leaving: Vector, inside: Vector, *, diffuse: bool
) -> tuple[Array, Channels]:
    """Density with which an interface, seen from outside along `leaving`, refracts to the direction `inside`.

    Both directions point away from the interface; `above` says on which side `leaving` lies. Also the transmittance of
    the facet, G1 / cos of `inside` and what the draw weighs, multiplied.
    """
    wi, wo = orient(leaving, above), orient(inside, above)
    ior, films = scene.surface_ior(surface, above), scene.films(surface, above)

    def drawn(alpha: Width, distribution: Distribution) -> tuple[Array, Channels]:
        lobe, transmittances = refraction_lobe(wi, wo, ior, alpha, distribution, films)
        value = jnp.where(wo[2] < 0, 2.0 * lobe / twice_projected_area(wi[2], wi, alpha, distribution), 0.0)
        area = twice_projected_area(jnp.abs(wo[2]), wo, alpha, distribution)
        passed = tuple(transmittance * 2.0 / area for transmittance in transmittances)
        if distribution != "vmf" or isinstance(alpha, Widths | StudentWidth):
            return value, passed
        weight = draw_weight(wi, facet_normal(wi, wo, ior), alpha)
        return value / weight, tuple(share * weight for share in passed)

    value, passed = _by_normals(scene, surface, drawn)
    if diffuse:
        value = value + DIFFUSE_SHARE * jnp.abs(wo[2]) / jnp.pi
    return value, passed


def _by_normals(scene: Scene, surface: Array | None, function: Callable[[Width, Distribution], Any]) -> Any:
    """What the function gives for the normals of the interface; computed for every kind of them that there is."""

    def kind(interface: Interface) -> tuple[Distribution, bool]:
        return interface.distribution, interface.is_anisotropic

    def value_for(distribution: Distribution, anisotropic: bool) -> Any:
        if anisotropic:
            return function(_widths(scene, surface, distribution), distribution)
        alpha = roughness(scene, surface)
        return function(StudentWidth(alpha, _gamma(scene, surface)) if distribution == "gtr" else alpha, distribution)

    kinds = [kind(interface) for interface in scene.interfaces if not interface.is_smooth]
    result = value_for(*kinds[0])
    for other in sorted(set(kinds[1:]) - {kinds[0]}):
        chosen = choose(surface, [jnp.asarray(kind(interface) == other) for interface in scene.interfaces])
        result = jax.tree.map(partial(jnp.where, chosen), value_for(*other), result)
    return result


def _weight(value: Array, density: Array, base: Surface) -> Array:
    """Their quotient; 0 where normals are so improbable that both are 0."""
    vanishes = isinstance(base, Conductor) and base.distribution != "ggx"
    return safe_div(value, density) if vanishes else value / density


def _interface(wi: Vector, wo: Vector, ior: Array, alpha: Width, distribution: Distribution, films: Films) -> Channels:
    """BSDF of an interface, of whichever kind the side of wo asks for."""
    above = wo[2] > 0
    under: Vector = (wo[0], wo[1], jnp.where(above, -0.5, wo[2]))
    reflected = reflected_channels(wi, sanitise(wo, above), ior, alpha, distribution, films)
    refracted = transmitted_channels(wi, under, ior, alpha, distribution, films)
    return tuple(jnp.where(above, one, other) for one, other in zip(reflected, refracted, strict=True))


def _clamp_to_upper(w: Vector) -> Vector:
    """w with its z kept above 0: rounding may leave it in the plane of the surface."""
    return w[0], w[1], jnp.maximum(w[2], 1e-12)
