"""Next-event estimation: what an event of the walk sends to wo, directly or through the interface that wo sees.

Light behind that interface, the exit, reaches wo by refraction alone. For that a direction of travel to it, the aim,
is drawn once a path, from wo's side and as wo would be lit through it (Guo, Hasan & Zhao 2018); a path that has yet to
draw it is "aiming". The same light is also found by walking on to the exit, and the two are weighed by the balance
heuristic.

Where the surface opposite may be glossy, another direction is drawn, the relay, so that it is reflected there along the
aim: narrow lobes of a metal, say, are met by walks with a small chance and then bring much. Three ways lead to such
light: by the relay, to that surface and by the aim, and on foot; all three are weighed by the balance heuristic.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels, map_channels, pick
from layerjax.directions import Vector, scale, select
from layerjax.transport.random_walk import surfaces
from layerjax.transport.random_walk.scene import Scene, choose
from layerjax.transport.random_walk.state import Aim, Arrival, Event, PathState, Relay, Target, weights


class Goal(NamedTuple):
    """The requested direction of the light, one a walker, and what follows from it once."""

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
    return Aim(direction, [zero] * len(scene.media), (zero,) * scene.film_channels, zero)


def no_relay(scene: Scene, direction: Vector) -> Relay:
    """Stands in until a relay is drawn."""
    zero = jnp.zeros_like(direction[2])
    return Relay(direction, [zero] * len(scene.media), (zero,) * scene.channels, zero)


def start_aiming(path: PathState, goal: Goal) -> PathState:
    """A path at its beginning, turned into the ray that draws its aim."""
    yes = jnp.ones(goal.above.shape, bool)
    region = None if path.region is None else goal.outer
    return path._replace(direction=scale(-1.0, goal.wo), region=region, aiming=yes)


def make_target(goal: Goal, path: PathState, arrival: Arrival) -> Target:
    """Where the light of an event should go: wo, or, behind the exit interface, the aim."""
    if path.region is None:
        return Target(goal.wo, None, None)
    assert arrival.at_surface is not None
    direct = jnp.where(arrival.at_surface, arrival.surface == goal.exit, path.region == goal.outer)
    if path.aim is None:
        return Target(goal.wo, direct, None)
    through = jnp.where(arrival.at_surface, arrival.surface == goal.opposite, path.region == goal.inner)
    return Target(select(direct, goal.wo, path.aim.travel), direct, through)


def meet_exit(
    scene: Scene,
    goal: Goal,
    path: PathState,
    entry: Vector,
    hit: surfaces.Bounce,
    leaves: Array,
    at_exit: Array,
    *,
    multiple: bool,
) -> tuple[Aim, Array]:
    """Refraction at the exit interface, requested by aim and by walk.

    Args:
        entry: direction of travel with which the path came to the surface.
        hit: what happened there.
        leaves: whether the path is done with the surface.
        at_exit: whether that is the exit.
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
        passed = (1.0 / jnp.maximum(jnp.abs(inside[2]), jnp.finfo(scene.dtype).tiny * 1e4),) * scene.film_channels
    travel = scale(-1.0, hit.direction)
    weights = tuple(jnp.where(found, share / (ior * ior), 0.0) for share in passed)
    drawn = Aim(travel, scene.rates(travel), weights, density)
    ready = path.aiming & leaves & at_exit
    aim = jax.tree.map(lambda new, old: jnp.where(ready, new, old), drawn, path.aim)
    weight = jnp.ones_like(density)
    if path.inverse_density is not None:
        weight = 1.0 / (1.0 + density * path.inverse_density)
    return aim, weight


def meet_opposite(
    scene: Scene,
    goal: Goal,
    path: PathState,
    surface: Array | None,
    from_above: Array,
    hit: surfaces.Bounce,
    target: Vector,
    at_opposite: Array,
) -> tuple[Relay, Array, Array]:
    """Reflection at the surface opposite the exit, or at the base where none is over it.

    Args:
        surface, from_above, hit: what is met, from where, and what happened there.
        target: the requested direction of its light.
        at_opposite: whether it is that surface.

    Returns:
        The relay, a new one for rays that were to draw it; and 1 + the density of relays over that of the walk, for
        light along the path's old direction that is sent to the target, and to its new direction.
    """
    assert path.aiming is not None
    assert path.relay is not None
    assert path.inverse_density is not None
    tiny = jnp.finfo(scene.dtype).tiny * 1e4
    most = jnp.sqrt(jnp.finfo(scene.dtype).max)  # of a quotient of densities: times a density of 0 it stays 0

    def turns(travel: Vector, onward: Vector) -> Array:
        return surfaces.density(scene, surface, from_above, travel, onward, diffuse=False)

    travel, onward = scale(-1.0, hit.direction), scale(-1.0, path.direction)
    drawn = jnp.maximum(turns(path.direction, hit.direction), tiny)
    walked = jnp.ones_like(drawn)
    shares: tuple[Any, ...] = (1.0,)
    if path.aim is not None:
        walked = jnp.minimum(1.0 + turns(travel, onward) / jnp.maximum(path.aim.density, tiny), most)
        shares = path.aim.weight
    turned = jnp.abs(path.direction[2]) / jnp.maximum(jnp.abs(hit.direction[2]), tiny)
    found = hit.survives & ~hit.crosses & at_opposite  # a ray still at the exit has none yet
    rates = goal.rates if path.aim is None else path.aim.rates
    crossed = [jnp.where(goal.inner == region, 1.0, 0.0) for region in scene.region_of]
    passed = scene.transmittance(crossed, rates) if scene.media else (jnp.ones_like(drawn),)
    weight = tuple(pick(hit.weight, c) * pick(passed, c) * turned * pick(shares, c) for c in range(scene.channels))
    weight = tuple(jnp.where(found, w, 0.0) for w in weight)
    of_relay = jnp.minimum(walked / drawn, most)
    aiming, relay = path.aiming, Relay(travel, scene.rates(travel), weight, jnp.where(found, of_relay, 0.0))
    relay = jax.tree.map(lambda new, old: jnp.where(aiming, new, old), relay, path.relay)
    rivals = (
        1.0 + jnp.where(at_opposite, jnp.minimum(path.inverse_density * turns(scale(-1.0, w), onward), most), 0.0)
        for w in (target, hit.direction)
    )
    return relay, next(rivals), next(rivals)


def contribution(
    scene: Scene, goal: Goal, path: PathState, arrival: Arrival, event: Event, target: Target, orders: str
) -> Channels:
    """What the event adds to the BSDF at (wi, wo): what it sends to the target, and what of that arrives at wo."""
    counted = _is_counted(path, arrival, target, orders)
    factors: Channels = (1.0 / jnp.abs(goal.wo[2]),)
    ends: list[Any] = [jnp.where(goal.above, 0.0, 1.0)] * len(scene.media)  # of the way to wo or to the exit
    rates = goal.rates
    if path.aim is not None and target.direct is not None:
        direct = target.direct
        unaimed, aimed = factors[0], path.aim.weight
        if event.exit_weight is not None:
            assert arrival.at_surface is not None
            unaimed = unaimed * jnp.where(arrival.at_surface, event.exit_weight, 1.0)
        if event.density is not None:
            rivals = path.aim.density if event.rivals is None else path.aim.density * event.rivals
            total = event.density + rivals
            share = jnp.where(total > 0, total, 1.0)
            aimed = tuple(one * path.aim.density / share for one in aimed)  # balance heuristic
        factors = map_channels(
            lambda aimed, outer: jnp.where(direct, unaimed, aimed * outer), aimed, goal.outer_transmittance
        )
        exit_level = choose(goal.exit, [jnp.int32(level) for level in scene.levels[: len(scene.interfaces)]])
        ends = [jnp.where(direct, end, jnp.where(exit_level > j, 1.0, 0.0)) for j, end in enumerate(ends)]
        rates = [jnp.where(direct, a, b) for a, b in zip(rates, path.aim.rates, strict=True)]
    elif event.rivals is not None:  # no interface: light that the base sends to wo
        factors = (factors[0] / event.rivals,)
    passed = _transmitted(scene, path, ends, rates)
    weight = weights(path)
    return tuple(
        jnp.where(counted, weight[c] * pick(event.sent, c) * pick(factors, c) * pick(passed, c), 0.0)
        for c in range(scene.channels)
    )


def relay_contribution(scene: Scene, goal: Goal, path: PathState, arrival: Arrival, event: Event) -> Channels:
    """What the event adds to the BSDF by the relay, where light from it travels to the surface opposite."""
    assert path.relay is not None
    assert path.aiming is not None
    assert event.relayed_density is not None
    happens = arrival.collides if arrival.at_surface is None else arrival.collides | arrival.at_surface
    if path.region is None:
        near = ~jnp.asarray(arrival.at_surface)
        level = jnp.full(near.shape, scene.levels[0])
    else:
        near = jnp.where(jnp.asarray(arrival.at_surface), arrival.surface == goal.exit, path.region == goal.inner)
        level = choose(goal.opposite, [jnp.int32(level) for level in scene.levels])
    ends = [jnp.where(level > j, 1.0, 0.0) for j in range(len(scene.media))]
    passed = _transmitted(scene, path, ends, path.relay.rates)
    share = 1.0 / (1.0 + event.relayed_density * path.relay.rivals)  # balance heuristic
    share = share if path.aim is not None else share / jnp.abs(goal.wo[2])
    weight, counted = weights(path), happens & near & ~path.aiming
    return tuple(
        jnp.where(
            counted,
            weight[c]
            * pick(event.relayed, c)
            * pick(path.relay.weight, c)
            * (pick(passed, c) * pick(goal.outer_transmittance, c) * share),
            0.0,
        )
        for c in range(scene.channels)
    )


def _transmitted(scene: Scene, path: PathState, ends: list[Any], rates: list[Array]) -> Channels:
    """Transmittance from where the path is to other positions."""
    if not scene.media or path.depth is None:
        return (jnp.ones_like(path.direction[2]),)
    levels = scene.fractions(path.layer, path.depth)
    return scene.transmittance([jnp.abs(a - b) for a, b in zip(levels, ends, strict=True)], rates)


def _is_counted(path: PathState, arrival: Arrival, target: Target, orders: str) -> Array:
    """Whether there is an event whose light can arrive at wo, and is of a requested order."""
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
