"""Paths with exactly one event, in closed form: one collision, reflection or refraction, and straight lines else.

In front of the first interface (or of the base) that is single scattering in the media there, and the face that lies
behind them; seen from below likewise. Through the stack it is single scattering where no interface is, and refraction
at the interface where there is one only: through two, every path has two events.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax._numerics import horizon, one_minus_exp
from layerjax._parameters import Parameter
from layerjax.channels import Channels, map_channels, total
from layerjax.directions import Vector, flip, half_vector, reflect, sanitise, select
from layerjax.normals.facets import Distribution, reflection_pdf, rule, sample
from layerjax.quadrature import Nodes
from layerjax.stack import Interface, Medium, Stack, optical_depths
from layerjax.surfaces import Surface
from layerjax.surfaces.interface import interface_reflection, interface_transmission
from layerjax.transport.contract import Side
from layerjax.transport.single_scattering import Media, SingleScattering


class ReflectingInterface(Surface):
    """Reflection at an interface, seen from its upper side. ior: index below over index above."""

    ior: Parameter
    alpha: Parameter
    distribution: Distribution = eqx.field(static=True, default="ggx")

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        return (interface_reflection(wi, wo, self.ior, self.alpha, self.distribution),)

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


def first_order(stack: Stack) -> FirstOrder:
    """Sort out the layers; `stack` is simplified."""
    interfaces = [k for k, layer in enumerate(stack.layers) if isinstance(layer, Interface)]
    if not interfaces:
        return FirstOrder(Media(_media(stack.layers), stack.base), None, None, stack.base is not None, False)
    first, last = interfaces[0], interfaces[-1]
    face = stack.layers[first]
    assert isinstance(face, Interface)
    upper = Media(_media(stack.layers[:first]), ReflectingInterface(face.ior, face.alpha, face.distribution))
    if stack.base is not None:
        return FirstOrder(upper, None, None, True, True)
    above: Any = 1.0
    if len(interfaces) > 1:
        before = stack.layers[interfaces[-2]]
        assert isinstance(before, Interface)
        above = before.ior
    bottom = stack.layers[last]
    assert isinstance(bottom, Interface)
    lower = Media(
        tuple(map(_flip_medium, reversed(_media(stack.layers[last + 1 :])))),
        ReflectingInterface(above / bottom.ior, bottom.alpha, bottom.distribution),
    )
    crossing = ReflectingInterface(face.ior, face.alpha, face.distribution) if first == last else None
    return FirstOrder(upper, lower, crossing, False, True)


def evaluate_first(state: FirstOrder, wi: Vector, wo: Vector, side: Side) -> Channels:
    """BSDF of the paths with one event."""
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


def interaction_probability(state: FirstOrder, w: Vector) -> Channels | None:
    """Probability that light along w meets an event at all, per channel; None: it is 1. See `collision_probability`."""
    if state.layered or state.opaque:
        return None
    return collision_probability(state.upper.media, sanitise(w, jnp.abs(w[2]) > horizon(w[2].dtype)))


def peak_probability(state: FirstOrder, scaled: FirstOrder, w: Vector) -> Channels | None:
    """Probability that light passes the scaled media without a collision, but not the others; None: it is 0."""
    if state.layered or state.opaque:
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
    value = interface_transmission(over, under, face.ior, face.alpha, face.distribution)
    value = jnp.where(downward, value, value / (face.ior * face.ior))  # f / ior_o^2 is reciprocal
    depths = optical_depths(state.upper.media, over) + optical_depths(state.lower.media, flip(under))
    return tuple(jnp.where(valid, value * jnp.exp(-depth), 0.0) for depth in total(depths, jnp.zeros_like(value)))


def _media(layers: tuple[Interface | Medium, ...]) -> tuple[Medium, ...]:
    return tuple(layer for layer in layers if isinstance(layer, Medium))


def _flip_medium(medium: Medium) -> Medium:
    phase = medium.phase.mirror()
    return medium if phase is medium.phase else eqx.tree_at(lambda m: m.phase, medium, phase)
