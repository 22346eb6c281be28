"""Paths with exactly one event, in closed form: one collision, reflection or refraction, and straight lines else.

In front of the first interface (or of the base) that is single scattering in the media there, and the face that lies
behind them; seen from below likewise. Through the stack it is single scattering where no interface is, and refraction
at the interface where there is one only: through two, every path has two events.

Where interfaces are smooth the straight lines are those of refracted rays, for what smooth interfaces do is no event;
paths that one of them mirrors are not among these.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax._numerics import horizon, one_minus_exp
from layerjax._parameters import Parameter
from layerjax.channels import Channels, map_channels, multiply, total
from layerjax.directions import Vector, flip, half_vector, reflect, sanitise, select
from layerjax.normals.facets import Distribution, reflection_pdf, rule, sample
from layerjax.normals.widths import Width
from layerjax.quadrature import Nodes
from layerjax.stack import Interface, Medium, Stack, optical_depths
from layerjax.surfaces import Conductor, Surface, ThinFilm
from layerjax.surfaces.interface import reflected_channels, transmitted_channels
from layerjax.surfaces.thin_film import films_of
from layerjax.transport.contract import Side
from layerjax.transport.single_scattering import Media, SingleScattering
from layerjax.transport.specular import Window, is_smooth, region_indices, smooth_window, windows


class ReflectingInterface(Surface):
    """Reflection at an interface, seen from its upper side. ior: index below over index above; so are those of a film
    counted."""

    ior: Parameter
    alpha: Width
    distribution: Distribution = eqx.field(static=True, default="ggx")
    film: ThinFilm | None = None

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        return reflected_channels(wi, wo, self.ior, self.alpha, self.distribution, films_of(self.film))

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        return reflect(wi, sample(wi, self.alpha, u1, u2, self.distribution))

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        h, _ = half_vector(wi, wo, same_side=True)
        return reflection_pdf(h, wi, self.alpha, self.distribution)

    def rule(self, wi: Vector, nodes: int) -> Nodes:
        return rule(wi, self.alpha, nodes, self.distribution)


class FirstOrder(eqx.Module):
    """What a path of one event can meet: from above, from below (mirrored: below is up), and on the way through.

    Without interfaces `upper` is the whole stack, lit from either side.
    """

    upper: Media
    lower: Media | None
    crossing: ReflectingInterface | None
    opaque: bool = eqx.field(static=True)
    layered: bool = eqx.field(static=True)
    """Whether there are interfaces."""


class Segment(eqx.Module):
    """Layers between smooth interfaces: their own `FirstOrder`, the indices above the first and below the last, and
    through what they are seen from either side (None: they are not)."""

    first: FirstOrder
    indices: tuple[Array, Array]
    above: Window | None
    below: Window | None


class SmoothOrder(eqx.Module):
    """`FirstOrder` of a stack with smooth interfaces.

    upper, lower: what light meets first from above and from below (mirrored), where that is media and a rough surface
    behind them; or the smooth interface, or nothing, that lets it in. None: no light comes from there.
    """

    segments: tuple[Segment, ...]
    outside: tuple[Array, Array]
    upper: Media | Window
    lower: Media | Window | None
    opaque: bool = eqx.field(static=True)
    crossing: None = None
    layered: bool = eqx.field(static=True, default=True)


def first_order(stack: Stack) -> FirstOrder | SmoothOrder:
    """Sort out the layers; `stack` is simplified."""
    return _smooth_order(stack) if any(map(is_smooth, stack.layers)) else _rough_order(stack)


def _smooth_order(stack: Stack) -> SmoothOrder:
    indices = region_indices(stack)
    segments = []
    for start, stop, above, below in windows(stack):
        before = sum(isinstance(layer, Interface) for layer in stack.layers[:start])
        behind = before + sum(isinstance(layer, Interface) for layer in stack.layers[start:stop])
        base = stack.base if stop == len(stack.layers) else None
        if base is None and start == stop:
            continue
        part = _rough_order(_relative_stack(stack.layers[start:stop], base, indices[before]))
        segments.append(Segment(part, (indices[before], indices[behind]), above, below))
    surfaces = [layer for layer in stack.layers if isinstance(layer, Interface)]
    upper: Media | Window = smooth_window(stack, upward=False) or Window(())
    if not surfaces[0].is_smooth:
        found = segments[0].first.upper
        upper = found
    lower: Media | Window | None = None
    if stack.base is None:
        lower = smooth_window(stack, upward=True) or Window(())
        if not surfaces[-1].is_smooth:
            lower = segments[-1].first.lower
    return SmoothOrder(tuple(segments), (indices[0], indices[-1]), upper, lower, stack.base is not None)


def _relative_stack(layers: Sequence[Any], base: Surface | None, above: Array) -> Stack:
    """A part of a stack, its indices counted from what lies above it."""
    counted = tuple(layer.relative_to(above) if isinstance(layer, Interface) else layer for layer in layers)
    return Stack(counted, base.relative_to(above) if isinstance(base, Conductor) else base)


def _rough_order(stack: Stack) -> FirstOrder:
    interfaces = [k for k, layer in enumerate(stack.layers) if isinstance(layer, Interface)]
    if not interfaces:
        return FirstOrder(Media(_media(stack.layers), stack.base), None, None, stack.base is not None, False)
    first, last = interfaces[0], interfaces[-1]
    face = stack.layers[first]
    assert isinstance(face, Interface)
    crossing = ReflectingInterface(face.ior, face.width, face.distribution, face.film)
    upper = Media(_media(stack.layers[:first]), crossing)
    if stack.base is not None:
        return FirstOrder(upper, None, None, True, True)
    above: Any = 1.0
    if len(interfaces) > 1:
        before = stack.layers[interfaces[-2]]
        assert isinstance(before, Interface)
        above = before.ior
    bottom = stack.layers[last]
    assert isinstance(bottom, Interface)
    film = None if bottom.film is None else bottom.film.relative_to(bottom.ior)
    lower = Media(
        tuple(map(_flip_medium, reversed(_media(stack.layers[last + 1 :])))),
        ReflectingInterface(above / bottom.ior, bottom.width, bottom.distribution, film),
    )
    return FirstOrder(upper, lower, crossing if first == last else None, False, True)


def evaluate_first(state: FirstOrder | SmoothOrder, wi: Vector, wo: Vector, side: Side) -> Channels:
    """BSDF of the paths with one event."""
    if isinstance(state, SmoothOrder):
        return _evaluate_segments(state, wi, wo, side)
    single = SingleScattering()
    if state.opaque or not state.layered:
        return single.evaluate(state.upper, wi, wo, side)
    parts: list[Channels] = []
    if side != "transmission":
        parts.append(single.evaluate(state.upper, wi, wo, "reflection"))
    if side == "all" and state.lower is not None:
        parts.append(single.evaluate(state.lower, flip(wi), flip(wo), "reflection"))
    if side != "reflection" and state.crossing is not None:
        parts.append(_refraction(state, state.crossing, wi, wo))
    zero = jnp.zeros_like(wi[2] * wo[2])
    return total(parts, zero)


def _evaluate_segments(state: SmoothOrder, wi: Vector, wo: Vector, side: Side) -> Channels:
    """Every segment along refracted rays: f = passed_i passed_o f' (n_o / n_o')^2, with ' in the segment."""
    zero = jnp.zeros_like(wi[2] * wo[2])
    if state.opaque and side == "transmission":
        return (zero,)
    edge = horizon(zero.dtype)
    reflects = state.opaque or side == "reflection"
    valid = (wi[2] > edge) & (wo[2] > edge) if reflects else (jnp.abs(wi[2]) > edge) & (jnp.abs(wo[2]) > edge)
    if side == "transmission":
        valid = valid & (wi[2] * wo[2] < 0)
    parts: list[Channels] = []
    for segment in state.segments:
        (inner_i, passed_i), (inner_o, passed_o) = (_cross_windows(segment, w, reflects) for w in (wi, wo))
        value = evaluate_first(segment.first, inner_i, inner_o, "reflection" if reflects else side)
        upward = wo[2] > 0
        above, below = (out / here for out, here in zip(state.outside, segment.indices, strict=True))
        index = jnp.where(upward, above, below)
        scale = jnp.where(valid, index * index, 0.0)
        parts.append(multiply(multiply(passed_i, passed_o), tuple(scale * one for one in value)))
    return total(parts, zero)


def _cross_windows(segment: Segment, w: Vector, only_above: bool) -> tuple[Vector, Channels]:
    """A direction in the segment, from the side that it is on, and the share that passes; 0 where none does."""
    dark: tuple[Vector, Channels] = (sanitise(w, jnp.abs(w[2]) > horizon(w[2].dtype)), (jnp.zeros_like(w[2]),))
    above = dark if segment.above is None else segment.above.cross(w)
    if only_above:
        return above
    below = dark if segment.below is None else segment.below.cross(w)
    upward = w[2] > 0
    passed = map_channels(lambda one, other: jnp.where(upward, one, other), above[1], below[1])
    return select(upward, above[0], below[0]), passed


def interaction_probability(state: FirstOrder | SmoothOrder, w: Vector) -> Channels | None:
    """Probability that light along w meets an event at all, per channel; None: it is 1. See `collision_probability`."""
    if isinstance(state, SmoothOrder) or state.layered or state.opaque:
        return None
    return collision_probability(state.upper.media, sanitise(w, jnp.abs(w[2]) > horizon(w[2].dtype)))


def peak_probability(state: FirstOrder | SmoothOrder, scaled: FirstOrder | SmoothOrder, w: Vector) -> Channels | None:
    """Probability that light passes the scaled media without a collision, but not the others; None: it is 0."""
    if isinstance(state, SmoothOrder) or isinstance(scaled, SmoothOrder) or state.layered or state.opaque:
        return None
    w = sanitise(w, jnp.abs(w[2]) > horizon(w[2].dtype))
    whole, less = (total(optical_depths(one.upper.media, w), jnp.zeros_like(w[2])) for one in (state, scaled))
    return map_channels(lambda whole, less: jnp.exp(-less) * one_minus_exp(whole - less), whole, less)


def collision_probability(media: Sequence[Medium], w: Vector) -> Channels:
    """Share of light along w that collides in media, 1 - exp(-depth), per channel.

    In media of thickness 0 it is what that is in proportion to: quantities that vanish with it are interpolated as
    quotients by it, and keep their derivatives.
    """
    depths = total(optical_depths(media, w), jnp.zeros_like(w[2]))
    return tuple(jnp.where(depth > 0, one_minus_exp(depth), 1.0 / jnp.abs(w[2])) for depth in depths)


def _refraction(state: FirstOrder, face: ReflectingInterface, wi: Vector, wo: Vector) -> Channels:
    assert state.lower is not None
    downward = wi[2] > 0
    over, under = select(downward, wi, wo), select(downward, wo, wi)
    edge = horizon(wi[2].dtype)
    valid = (over[2] > edge) & (under[2] < -edge)
    over = sanitise(over, valid)
    under = (under[0], under[1], jnp.where(valid, under[2], -0.5))
    values = transmitted_channels(over, under, face.ior, face.alpha, face.distribution, films_of(face.film))
    # f / ior_o^2 is reciprocal
    values = tuple(jnp.where(downward, value, value / (face.ior * face.ior)) for value in values)
    depths = optical_depths(state.upper.media, over) + optical_depths(state.lower.media, flip(under))
    return map_channels(
        lambda value, depth: jnp.where(valid, value * jnp.exp(-depth), 0.0),
        values,
        total(depths, jnp.zeros_like(values[0])),
    )


def _media(layers: tuple[Interface | Medium, ...]) -> tuple[Medium, ...]:
    return tuple(layer for layer in layers if isinstance(layer, Medium))


def _flip_medium(medium: Medium) -> Medium:
    phase = medium.phase.mirror()
    return medium if phase is medium.phase else eqx.tree_at(lambda m: m.phase, medium, phase)
