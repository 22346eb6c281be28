"""What the walk carries: the state of its paths, where a step takes them, and what it brings."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels, mean, pick
from layerjax.directions import Vector, select
from layerjax.transport.random_walk.microsurface import Position
from layerjax.transport.random_walk.scene import Scene, choose


class Aim(NamedTuple):
    """A direction of travel to the exit interface, drawn once a path as wo would be lit through it."""

    travel: Vector
    rates: list[Array]
    weight: Channels
    """What the interface passes from it to wo, over the density of the draw."""
    density: Array


class Relay(NamedTuple):
    """A direction of travel to the surface opposite the exit, drawn once a path so that it is reflected along the aim
    (along wo, where nothing lies between)."""

    travel: Vector
    rates: list[Array]
    weight: Channels
    """What arrives at wo of light that is reflected from it, over the density of the draws."""
    rivals: Array
    """Density with which walks find the same light, over that of the draws, for each unit of the density with which
    they turn to `travel`."""


class PathState(NamedTuple):
    """State of a path. What the scene or the question does not need is None or empty."""

    direction: Vector
    layer: Array | None
    depth: Array | None
    region: Array | None
    throughput: Channels
    ratios: Channels
    """Density of the path for each channel over that for the channel that draws."""
    sampling_channel: Array | None
    """Channel that draws the distances."""
    order: Array | None
    """Number of events so far."""
    aiming: Array | None
    """Whether it is not yet a path of light, but a ray from wo's side that draws the aim of the path to come."""
    aim: Aim | None
    relay: Relay | None
    inverse_density: Array | None
    """1 / density of the last direction if that light was aimed as well, through the exit interface or over the surface
    opposite, else 0."""
    facet: Position | None


class Arrival(NamedTuple):
    """Where a flight ends: at a collision, at a surface, or outside of the stack."""

    collides: Array
    medium: Array | None
    at_surface: Array | None
    """None: there are no surfaces."""
    surface: Array | None
    escapes: Array


class Target(NamedTuple):
    """Where the light of an event should go."""

    direction: Vector
    direct: Array | None
    """Whether that is wo itself, with no interface between; None: it always is."""
    through_exit: Array | None
    """Whether it is the aim of the path, whose light continues to wo through the exit interface; None: it never is."""


class Event(NamedTuple):
    """What happens to the light in one step, at a collision or at a surface."""

    direction: Vector
    weight: Channels
    survives: Array
    sent: Channels = ()
    """Light sent to the target, per solid angle."""
    density: Array | None = None
    """Density of the target among the new directions."""
    next_density: Array | None = None
    """Density of the new direction."""
    leaves: Array | None = None
    """Whether a path at a surface is done with it, and not on to another facet of it."""
    exit_weight: Array | None = None
    """Weight of what the exit interface sends to wo, beside that of light which was aimed through it."""
    relayed: Channels = ()
    """Light sent along the relay, per solid angle."""
    relayed_density: Array | None = None
    """Density of the relay among the new directions."""
    rivals: Array | None = None
    """1 + density of relays that bring light from the old direction to the target, over that of the walk so far."""


class Step(NamedTuple):
    """What a step brings: the light sent to wo, and the paths that end."""

    contribution: Channels
    ends: Array
    escapes: Array
    direction: Vector
    weight: Channels
    order: Array | None


def move_to_surface(scene: Scene, path: PathState, at_surface: Array, surface: Array | None) -> PathState:
    """Paths at a surface, placed there."""
    if path.depth is None:
        return path
    level = choose(surface, [jnp.int32(level) for level in scene.levels])
    if path.layer is None:
        return path._replace(depth=jnp.where(at_surface, level.astype(scene.dtype), path.depth))
    return path._replace(depth=jnp.where(at_surface, 0.0, path.depth), layer=jnp.where(at_surface, level, path.layer))


def merge(chosen: Array, a: Event, b: Event, channels: int) -> Event:
    """a where chosen, else b; what only one of them has is taken from it."""

    def either(x: Any, y: Any) -> Any:
        return y if x is None else x if y is None else jnp.where(chosen, x, y)

    def per_channel(x: Channels, y: Channels) -> Channels:
        return tuple(jnp.where(chosen, pick(x, c), pick(y, c)) for c in range(channels)) if x and y else x or y

    return Event(
        select(chosen, a.direction, b.direction),
        per_channel(a.weight, b.weight),
        either(a.survives, b.survives),
        per_channel(a.sent, b.sent),
        either(a.density, b.density),
        either(a.next_density, b.next_density),
        either(a.leaves, b.leaves),
        either(a.exit_weight, b.exit_weight),
        per_channel(a.relayed, b.relayed),
        either(a.relayed_density, b.relayed_density),
        either(a.rivals, b.rivals),
    )


def weights(path: PathState) -> Channels:
    """Throughput of each channel, weighed over the channels that could have drawn the path."""
    if not path.ratios:
        return path.throughput
    inverse = 1.0 / mean(path.ratios)
    return tuple(t * ratio * inverse for t, ratio in zip(path.throughput, path.ratios, strict=True))
