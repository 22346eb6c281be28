"""The random walk: one event a step, on many paths at a time.

A path starts as light along wi and follows energy: it flies to a collision, to a surface or out of the stack, is
scattered there, and continues. With a target direction wo, each event adds what it sends there
(`layerjax.transport.random_walk.next_event`). Behind more than one interface only the walk itself arrives, which is
unbiased as well.

Channels share their paths. Where they differ in optical depth, the distances are drawn for one of them, chosen at
random once a path, and the balance heuristic over the channels weighs them all. Paths end by leaving or by Russian
roulette; nothing else ends them.

Every step has its own random numbers u: u[0] the free flight, u[1] and u[2] the new direction, u[3] the roulette, u[4]
reflection or refraction, u[5] the height of the first facet, u[6] the way to the next, u[7] the channel of a new path.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels, largest, pick
from layerjax.directions import Vector, scale, select
from layerjax.surfaces import Conductor
from layerjax.transport.random_walk import microsurface, surfaces
from layerjax.transport.random_walk.flight import boundary, free_flight
from layerjax.transport.random_walk.next_event import (
    contribution,
    make_goal,
    make_target,
    meet_exit,
    meet_opposite,
    no_aim,
    no_relay,
    relay_contribution,
    start_aiming,
)
from layerjax.transport.random_walk.scene import Scene
from layerjax.transport.random_walk.specular_exit import (
    make_specular_goal,
    specular_contribution,
    specular_target,
)
from layerjax.transport.random_walk.state import (
    Arrival,
    Event,
    PathState,
    Step,
    Target,
    merge,
    move_to_surface,
    weights,
)

Orders = Literal["all", "first", "multiple"]

ROULETTE = 0.25
"""Throughput below which a path is ended at random; survivors go on with this much."""


class Walk:
    """Walks through one scene, traced once for its structure.

    Args:
        scene: the stack.
        wi: where the light comes from, path by path.
        wo: where light should go, or None for a walk that only follows it.
        multiple: whether light that stays on a rough surface is followed.
        orders: which orders count (see `layerjax.RandomWalk`).
        count_orders: whether to count events although all orders count.
    """

    def __init__(
        self,
        scene: Scene,
        wi: Vector,
        wo: Vector | None,
        multiple: bool,
        orders: Orders = "all",
        count_orders: bool = False,
    ):
        self.scene = scene
        self.wi = wi
        self.orders: Orders = orders
        self.counts = count_orders or orders != "all"
        self.multiple = multiple and microsurface.has_microsurface(scene)
        self.ray = make_specular_goal(scene, wo) if wo is not None and scene.is_mirrored else None
        self.goal = None if wo is None or scene.is_mirrored else make_goal(scene, wo)
        self.aims = self.goal is not None and bool(scene.interfaces) and orders != "first"
        # where two surfaces enclose a region, light from one may be aimed through the other
        self.adjacent = self.aims and scene.surfaces > 1
        self.relays = self._may_relay() and self.goal is not None and orders != "first" and not self.multiple
        # whether aimed light and light that walks on are weighed against each other
        self.mixes = self.adjacent or self.relays or (self.aims and bool(scene.media))
        self.fades = bool(scene.surfaces) or not scene.lossless or scene.colored_depths
        self.blocks = 2 if scene.surfaces or scene.colored_depths else 1

    def start(self, u: Array) -> PathState:
        """Paths at their beginning; u draws the channel, where one is drawn."""
        path = self._start(u)
        return path if path.aiming is None or self.goal is None else start_aiming(path, self.goal)

    def step(self, path: PathState, u: list[Array]) -> tuple[PathState, Step]:
        """One event: a collision, a bounce at a surface, or the way out. The caller restarts paths that end."""
        path, arrival = self._free_flight(path, u)
        outside = (arrival.escapes, path.direction, weights(path), path.order)
        target = None if self.goal is None else make_target(self.goal, path, arrival)
        if self.ray is not None:
            target = specular_target(self.scene, self.ray, path, arrival, u[4])
        path, event = self._scatter(path, arrival, target, u)
        arrived: Channels = ()
        if self.ray is not None:
            arrived = specular_contribution(self.scene, self.ray, path, arrival, event, u[4])
        if self.goal is not None and target is not None:
            arrived = contribution(self.scene, self.goal, path, arrival, event, target, self.orders)
            if self.relays:
                more = relay_contribution(self.scene, self.goal, path, arrival, event)
                arrived = tuple(a + b for a, b in zip(arrived, more, strict=True))
        path, ends = self._continue(path, arrival, event, u)
        return path, Step(arrived, ends, *outside)

    # parts of a step

    def _may_relay(self) -> bool:
        """Whether there is an event before the reflection at a glossy surface that lies opposite the exit."""
        scene = self.scene
        glossy = isinstance(scene.base, Conductor) or len(scene.interfaces) > 1
        return glossy and (scene.surfaces > 1 if scene.interfaces else bool(scene.media))

    def _start(self, u: Array) -> PathState:
        """Light along wi, as it enters the stack."""
        scene, wi = self.scene, self.wi
        above = wi[2] > 0
        one, zero = jnp.ones_like(wi[2]), jnp.zeros_like(wi[2])
        index = jnp.zeros(wi[2].shape, jnp.int32)
        last = len(scene.media) - 1
        direction = scale(-1.0, wi)
        drawn = jnp.minimum((u * scene.channels).astype(jnp.int32), scene.channels - 1)
        return PathState(
            direction=direction,
            layer=jnp.where(above, index, last) if last > 0 else None,
            depth=jnp.where(above, zero, one) if scene.media else None,
            region=jnp.where(above, index, scene.regions - 1) if scene.regions > 1 else None,
            throughput=(one,) * scene.channels,
            ratios=(one,) * scene.channels if scene.colored_depths else (),
            sampling_channel=drawn if scene.colored_depths else None,
            order=index if self.counts else None,
            aiming=above & ~above if self.aims or self.relays else None,
            aim=no_aim(scene, direction) if self.aims else None,
            relay=no_relay(scene, direction) if self.relays else None,
            inverse_density=zero if self.mixes else None,
            facet=microsurface.off_surface(direction) if self.multiple else None,
        )

    def _free_flight(self, path: PathState, u: list[Array]) -> tuple[PathState, Arrival]:
        """The path where its flight ends. One that draws an aim, or is on a rough surface, is at a surface already."""
        scene = self.scene
        free = jnp.ones(u[0].shape, bool)
        free = free if path.aiming is None else free & ~path.aiming
        free = free if path.facet is None else free & ~path.facet.on_surface
        path, collides, medium = free_flight(scene, path, free, u[0])
        arrives, escapes, surface = boundary(scene, path, free & ~collides)
        if path.order is not None:
            counted = arrives & ~jnp.asarray(surfaces.is_smooth(scene, surface)) if scene.is_mirrored else arrives
            path = path._replace(order=path.order + (collides | counted))
        if not scene.surfaces:
            return path, Arrival(collides, medium, None, None, escapes)
        at_surface = arrives | ~free
        return move_to_surface(scene, path, at_surface, surface), Arrival(
            collides, medium, at_surface, surface, escapes
        )

    def _scatter(
        self, path: PathState, arrival: Arrival, target: Target | None, u: list[Array]
    ) -> tuple[PathState, Event]:
        """The event, at a collision or at a surface; and the path on the side of the surface where it is then."""
        event: Event | None = None
        if self.scene.media:
            event = self._collide(path, arrival, target, u)
        if arrival.at_surface is not None:
            path, hit = self._bounce(path, arrival, target, u)
            event = hit if event is None else merge(arrival.at_surface, hit, event, self.scene.channels)
        assert event is not None
        return path, event

    def _collide(self, path: PathState, arrival: Arrival, target: Target | None, u: list[Array]) -> Event:
        """Scattering in a medium."""
        scene, wi, medium = self.scene, scale(-1.0, path.direction), arrival.medium
        area = scene.cross_section(medium, wi)
        direction, weight = scene.deflect(medium, wi, u[1], u[2])
        if target is None:
            return Event(direction, weight, arrival.collides)
        density, share = scene.collide(medium, wi, target.direction, area)
        sent = tuple(density * pick(share, c) for c in range(scene.channels))
        next_density = scene.collide(medium, wi, direction, area)[0] if self.mixes else None
        event = Event(direction, weight, arrival.collides, sent, density, next_density)
        if path.relay is None:
            return event
        density, share = scene.collide(medium, wi, path.relay.travel, area)
        sent = tuple(density * pick(share, c) for c in range(scene.channels))
        return event._replace(relayed=sent, relayed_density=density)

    def _bounce(
        self, path: PathState, arrival: Arrival, target: Target | None, u: list[Array]
    ) -> tuple[PathState, Event]:
        """Reflection or refraction at a surface, at one facet of it where light is followed from facet to facet."""
        scene, travel, surface = self.scene, path.direction, arrival.surface
        at_surface = arrival.at_surface
        assert at_surface is not None
        leaves = at_surface
        from_above = jnp.ones_like(at_surface) if path.region is None else jnp.asarray(path.region == surface)
        towards = None if target is None else target.direction
        at_exit = at_surface if path.region is None or self.goal is None else jnp.asarray(surface == self.goal.exit)
        refracts = None if self.multiple or path.aiming is None else path.aiming & at_exit
        hit = surfaces.bounce(scene, surface, from_above, travel, towards, refracts, (u[1], u[2], u[4]))
        entry, entered_above = travel, from_above
        if path.facet is not None:
            facet, hit, leaves = self._meet_facet(path, path.facet, arrival, from_above, hit, towards, u)
            path, entry, entered_above = path._replace(facet=facet), facet.entry, facet.entered_above
        if path.region is not None:
            assert surface is not None
            beyond = jnp.where(from_above, surface + 1, surface)
            path = path._replace(region=jnp.where(at_surface & hit.crosses, beyond, path.region))
        event = Event(hit.direction, hit.weight, hit.survives, hit.towards_target, leaves=leaves)
        if self.adjacent and towards is not None:
            densities = [
                surfaces.density(scene, surface, entered_above, entry, w, diffuse=self.multiple)
                for w in (towards, hit.direction)
            ]
            event = event._replace(density=densities[0], next_density=densities[1])
        if self.aims:
            assert self.goal is not None
            aim, weight = meet_exit(scene, self.goal, path, entry, hit, leaves, at_exit, multiple=self.multiple)
            path, event = path._replace(aim=aim), event._replace(exit_weight=weight)
        if self.relays and towards is not None:
            path, event = self._relay(path, arrival, event, from_above, hit, towards)
        return path, event

    def _relay(
        self, path: PathState, arrival: Arrival, event: Event, from_above: Array, hit: surfaces.Bounce, towards: Vector
    ) -> tuple[PathState, Event]:
        """What a surface sends along the relay; at the one opposite the exit, what relays are weighed with."""
        assert self.goal is not None
        assert path.relay is not None
        assert arrival.at_surface is not None
        scene, surface, opposite = self.scene, arrival.surface, arrival.at_surface
        if path.region is not None:
            opposite = opposite & (surface == self.goal.opposite)
        if scene.interfaces:
            sent, density = surfaces.interface_towards(scene, surface, from_above, path.direction, path.relay.travel)
            event = event._replace(relayed=sent, relayed_density=density)
        relay, to_target, onward = meet_opposite(scene, self.goal, path, surface, from_above, hit, towards, opposite)
        next_density = None if event.next_density is None else event.next_density / onward
        return path._replace(relay=relay), event._replace(rivals=to_target, next_density=next_density)

    def _meet_facet(
        self,
        path: PathState,
        facet: microsurface.Position,
        arrival: Arrival,
        from_above: Array,
        hit: surfaces.Bounce,
        towards: Vector | None,
        u: list[Array],
    ) -> tuple[microsurface.Position, surfaces.Bounce, Array]:
        """One facet of a rough surface: the place on it, what happens, and whether the path has left the surface.

        Surfaces without facets keep their `hit`.
        """
        scene, travel, surface, at_surface = self.scene, path.direction, arrival.surface, arrival.at_surface
        assert at_surface is not None
        begins = at_surface & ~facet.on_surface
        entry = select(begins, travel, facet.entry)
        entered_above = jnp.where(begins, from_above, facet.entered_above)
        alpha = microsurface.width(scene, surface)
        first, _ = microsurface.free_flight(
            surfaces.orient(travel, from_above), jnp.zeros_like(u[0]), alpha, -jnp.log(u[5])
        )
        height = jnp.where(begins, first, facet.height)
        walked, height = microsurface.bounce(scene, surface, from_above, travel, height, towards, (u[1], u[2], u[4]))
        side = from_above ^ walked.crosses
        height, left = microsurface.free_flight(surfaces.orient(walked.direction, side), height, alpha, -jnp.log(u[6]))
        if scene.interfaces:  # nothing is refracted between equal indices: light passes at the first facet
            left = left | (walked.crosses & (scene.surface_ior(surface, from_above) == 1.0))
        faceted = microsurface.has_facets(scene, surface)
        hit = walked if faceted is True else surfaces.merge(faceted, walked, hit)
        leaves = at_surface & (left | ~jnp.asarray(faceted))
        index = jnp.zeros(at_surface.shape, jnp.int32) if surface is None else surface
        return microsurface.Position(at_surface & ~leaves, index, height, entry, entered_above), hit, leaves

    def _continue(self, path: PathState, arrival: Arrival, event: Event, u: list[Array]) -> tuple[PathState, Array]:
        """The path after its event, and whether it ends; one that has drawn its aim becomes light along wi."""
        throughput = tuple(path.throughput[c] * pick(event.weight, c) for c in range(self.scene.channels))
        after = path._replace(direction=event.direction, throughput=throughput)
        ends = arrival.escapes | ~event.survives
        if self.fades:
            after, survives = _play_roulette(after, u[3])
            ends = ends | ~survives
        # whether the event is over: on a rough surface it continues from facet to facet
        over = None if event.leaves is None else event.leaves | ~jnp.asarray(arrival.at_surface)
        if self.orders == "first" and path.order is not None:
            done = path.order >= (1 if self.goal is not None else 2)  # without a goal it has yet to leave
            ends = ends | (done if over is None else done & over)
        if path.inverse_density is not None and event.next_density is not None:
            inverse = self._inverse_density(after, arrival, event.next_density)
            inverse = inverse if over is None else jnp.where(over, inverse, path.inverse_density)
            after = after._replace(inverse_density=inverse)
        if path.aiming is not None:
            assert event.leaves is not None
            ready = path.aiming & event.leaves
            begun = self._start(u[7])._replace(aim=path.aim, relay=path.relay)
            if self.relays and path.aim is not None:  # the ray that has passed the exit continues and draws the relay
                assert self.goal is not None
                ready = ready & ~((arrival.surface == self.goal.exit) & (after.region == self.goal.inner))
            after = jax.tree.map(lambda new, old: jnp.where(ready, new, old), begun, after)
            ends = ends & ~path.aiming
        return after, ends

    def _inverse_density(self, after: PathState, arrival: Arrival, density: Array) -> Array:
        """1 / density of the new direction where the light of this event was aimed through the exit as well, else 0."""
        goal = self.goal
        assert goal is not None
        at_surface = jnp.asarray(arrival.at_surface)
        if after.region is None:
            aimed = ~at_surface
        else:
            met = (arrival.surface == goal.opposite) | ((arrival.surface == goal.exit) if self.relays else False)
            aimed = jnp.where(at_surface, met, True) & (after.region == goal.inner)
        return jnp.where(aimed, 1.0 / jnp.maximum(density, jnp.finfo(density.dtype).tiny * 1e4), 0.0)


def _play_roulette(path: PathState, u: Array) -> tuple[PathState, Array]:
    """Russian roulette: paths whose largest weight is low survive with a chance, and are made up for by as much."""
    chance = jnp.minimum(largest(weights(path)) / ROULETTE, 1.0)
    scale_up = 1.0 / jnp.where(chance > 0, chance, 1.0)
    return path._replace(throughput=tuple(t * scale_up for t in path.throughput)), u < chance
