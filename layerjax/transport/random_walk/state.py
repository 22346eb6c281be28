"""What the walk carries: the state of its lanes, what it aims at, and what a step brings."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels, mean, pick
from layerjax.directions import Vector, select
from layerjax.transport.random_walk.microsurface import Position
from layerjax.transport.random_walk.scene import Scene, choose


class Goal(NamedTuple):
    """The direction that light is asked for, lane by lane, and what follows from it once."""

    wo: Vector
    above: Array
    rates: list[Array]
    exit: Array
    """Interface that wo sees."""
    outer: Array
    """Region that wo lies in."""
    inner: Array
    """Region behind that interface."""
    beyond: Array
    """Surface next to the exit interface, on the inner region."""
    outer_transmittance: Channels


class Aim(NamedTuple):
    """A direction of travel to the exit interface, drawn once a path as wo would be lit through it."""

    travel: Vector
    rates: list[Array]
    weight: Array
    """What the interface passes from it to wo, over the density of the draw."""
    density: Array


class Lane(NamedTuple):
    """State of a path. What the scene or the question does not need is None or empty."""

    direction: Vector
    layer: Array | None
    depth: Array | None
    region: Array | None
    throughput: Channels
    ratios: Channels
    """Density of the path for each channel over that for the channel that draws."""
    drawn_for: Array | None
    order: Array | None
    prelude: Array | None
    aim: Aim | None
    inverse_density: Array | None
    """1 / density of the last direction if that light was aimed through the exit interface as well, else 0."""
    facet: Position | None


class Step(NamedTuple):
    """What a step brings: the light sent to wo, and the paths that end."""

    contribution: Channels
    ends: Array
    escapes: Array
    direction: Vector
    weight: Channels
    order: Array | None


class Event(NamedTuple):
    """What happens to the light in one step, at a collision or at a surface."""

    direction: Vector
    kept: Channels
    survives: Array
    sent: Channels = ()
    """Light sent to the target, per solid angle."""
    density: Array | None = None
    """Density of the target among the new directions."""
    next_density: Array | None = None
    """Density of the new direction."""


def make_goal(scene: Scene, wo: Vector) -> Goal:
    above = wo[2] > 0
    last = len(scene.interfaces)
    outer = jnp.where(above, 0, last)
    crossed = [jnp.where(outer == region, 1.0, 0.0) for region in scene.region_of]
    rates = scene.rates(wo)
    return Goal(
        wo=wo,
        above=above,
        rates=rates,
        exit=jnp.where(above, 0, last - 1),
        outer=outer,
        inner=jnp.where(above, 1, last - 1),
        beyond=jnp.where(above, 1, last - 2),
        outer_transmittance=scene.transmittance(crossed, rates) if scene.media else (jnp.ones_like(wo[2]),),
    )


def to_level(scene: Scene, lane: Lane, at_surface: Array, surface: Array | None) -> Lane:
    """Lanes at a surface, placed there."""
    if lane.depth is None:
        return lane
    level = choose(surface, [jnp.int32(level) for level in scene.levels])
    if lane.layer is None:
        return lane._replace(depth=jnp.where(at_surface, level.astype(scene.dtype), lane.depth))
    return lane._replace(depth=jnp.where(at_surface, 0.0, lane.depth), layer=jnp.where(at_surface, level, lane.layer))


def merge(chosen: Array, a: Event, b: Event, channels: int) -> Event:
    """a where chosen, else b; what only one of them has is taken from it."""

    def either(x: Any, y: Any) -> Any:
        return y if x is None else x if y is None else jnp.where(chosen, x, y)

    def per_channel(x: Channels, y: Channels) -> Channels:
        return tuple(jnp.where(chosen, pick(x, c), pick(y, c)) for c in range(channels)) if x and y else x or y

    return Event(
        select(chosen, a.direction, b.direction),
        per_channel(a.kept, b.kept),
        either(a.survives, b.survives),
        per_channel(a.sent, b.sent),
        either(a.density, b.density),
        either(a.next_density, b.next_density),
    )


def weights(lane: Lane) -> Channels:
    """Throughput of each channel, weighed over the channels that could have drawn the path."""
    if not lane.ratios:
        return lane.throughput
    inverse = 1.0 / mean(lane.ratios)
    return tuple(t * ratio * inverse for t, ratio in zip(lane.throughput, lane.ratios, strict=True))
