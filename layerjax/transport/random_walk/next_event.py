"""Next-event estimation: what an event of the walk sends to wo, directly or through the interface that wo sees.

Light behind that interface, the exit, reaches wo by refraction alone. For that a direction of travel to it, the aim,
is drawn once a path, from wo's side and as wo would be lit through it (Guo, Hasan & Zhao 2018); a path that has yet to
draw it is "aiming". The same light is also found by walking on to the exit, and the two are weighed by the balance
heuristic.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels, pick
from layerjax.directions import Vector, scale, select
from layerjax.transport.random_walk import surfaces
from layerjax.transport.random_walk.scene import Scene, choose
from layerjax.transport.random_walk.state import Aim, Arrival, Event, PathState, Target, weights


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
    opposite: Array
    """The other surface of that region."""
    outer_transmittance: Channels


def make_goal(scene: Scene, wo: Vector) -> Goal:
    """What follows from wo."""
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
        opposite=jnp.where(above, 1, last - 2),
        outer_transmittance=scene.transmittance(crossed, rates) if scene.media else (jnp.ones_like(wo[2]),),
    )


def no_aim(scene: Scene, direction: Vector) -> Aim:
    """Stands in until an aim is drawn."""
    zero = jnp.zeros_like(direction[2])
    return Aim(direction, [zero] * len(scene.media), zero, zero)


def start_aiming(path: PathState, goal: Goal) -> PathState:
    """A path at its beginning, turned into the ray that draws its aim."""
    yes = jnp.ones(goal.above.shape, bool)
    return path._replace(direction=scale(-1.0, goal.wo), region=goal.outer, aiming=yes)


def make_target(goal: Goal, path: PathState, arrival: Arrival) -> Target:
    """Where the light of an event is asked for: wo, or, behind the exit interface, the aim."""
    if path.region is None:
        return Target(goal.wo, None, None)
    assert arrival.at_surface is not None
    direct = jnp.where(arrival.at_surface, arrival.surface == goal.exit, path.region == goal.outer)
    if path.aim is None:
        return Target(goal.wo, direct, None)
    through = jnp.where(arrival.at_surface, arrival.surface == goal.opposite, path.region == goal.inner)
    return Target(select(direct, goal.wo, path.aim.travel), direct, through)


def meet_exit(
    scene: Scene, goal: Goal, path: PathState, entry: Vector, hit: surfaces.Bounce, leaves: Array, *, multiple: bool
) -> tuple[Aim, Array]:
    """Refraction at the exit interface, asked for by aim and by walk.

    Args:
        entry: direction of travel with which the path came to the surface.
        hit: what happened there.
        leaves: whether the path is done with the surface.
        multiple: whether light is followed from facet to facet.

    Returns:
        The aim, a new one for rays that were to draw it; and the weight, beside aimed light, of what has walked to the
        exit along `entry`.
    """
    assert path.aiming is not None
    assert path.aim is not None
    inside = select(path.aiming, hit.direction, scale(-1.0, entry))
    density, passed = surfaces.exit_density(scene, goal.exit, goal.above, goal.wo, inside, diffuse=multiple)
    # else the draw came back, or was reflected totally and masked: nothing is aimed on this path
    found = (path.region == goal.inner) & hit.survives
    ior = scene.surface_ior(goal.exit, goal.above)
    if multiple:  # drawn by the walk itself
        passed = 1.0 / jnp.maximum(jnp.abs(inside[2]), jnp.finfo(scene.dtype).tiny * 1e4)
    travel = scale(-1.0, hit.direction)
    drawn = Aim(travel, scene.rates(travel), jnp.where(found, passed / (ior * ior), 0.0), density)
    ready = path.aiming & leaves
    aim = jax.tree.map(lambda new, old: jnp.where(ready, new, old), drawn, path.aim)
    weight = jnp.ones_like(density)
    if path.inverse_density is not None:
        weight = 1.0 / (1.0 + density * path.inverse_density)
    return aim, weight


def contribution(
    scene: Scene, goal: Goal, path: PathState, arrival: Arrival, event: Event, target: Target, orders: str
) -> Channels:
    """What the event adds to the BSDF at (wi, wo): what it sends to the target, and what of that arrives at wo."""
    counted = _counted(path, arrival, target, orders)
    factors: Channels = (1.0 / jnp.abs(goal.wo[2]),)
    ends: list[Any] = [jnp.where(goal.above, 0.0, 1.0)] * len(scene.media)  # of the way to wo or to the exit
    rates = goal.rates
    if path.aim is not None and target.direct is not None:
        direct = target.direct
        straight, aimed = factors[0], path.aim.weight
        if event.exit_weight is not None:
            assert arrival.at_surface is not None
            straight = straight * jnp.where(arrival.at_surface, event.exit_weight, 1.0)
        if event.density is not None:
            total = event.density + path.aim.density
            aimed = aimed * path.aim.density / jnp.where(total > 0, total, 1.0)  # balance heuristic
        factors = tuple(jnp.where(direct, straight, aimed * outer) for outer in goal.outer_transmittance)
        exit_level = choose(goal.exit, [jnp.int32(level) for level in scene.levels[: len(scene.interfaces)]])
        ends = [jnp.where(direct, end, jnp.where(exit_level > j, 1.0, 0.0)) for j, end in enumerate(ends)]
        rates = [jnp.where(direct, a, b) for a, b in zip(rates, path.aim.rates, strict=True)]
    passed: Channels = (jnp.ones_like(goal.above, scene.dtype),)
    if scene.media and path.depth is not None:
        levels = scene.fractions(path.layer, path.depth)
        passed = scene.transmittance([jnp.abs(a - b) for a, b in zip(levels, ends, strict=True)], rates)
    weight = weights(path)
    return tuple(
        jnp.where(counted, weight[c] * pick(event.sent, c) * pick(factors, c) * pick(passed, c), 0.0)
        for c in range(scene.channels)
    )


def _counted(path: PathState, arrival: Arrival, target: Target, orders: str) -> Array:
    """Whether there is an event whose light can arrive at wo, and is of an order that is asked for."""
    counted = arrival.collides if arrival.at_surface is None else arrival.collides | arrival.at_surface
    direct, through = target.direct, target.through_exit
    if direct is not None:
        counted = counted & (direct if through is None else direct | through)
        if path.aiming is not None:
            counted = counted & ~path.aiming
    if path.order is not None and orders != "all":
        order = path.order if through is None or direct is None else path.order + (through & ~direct)
        counted = counted & (order == 1 if orders == "first" else order >= 2)
    return counted
