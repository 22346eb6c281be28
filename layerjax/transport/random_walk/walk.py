"""The random walk: one event a step, on many lanes at a time.

A path starts as light along wi and follows energy. With a target direction wo, next-event estimation adds at each event
what it sends to wo: directly where no interface lies between, and through the one interface that wo sees where the
event happens behind it (Guo, Hasan & Zhao 2018). For that a direction through the interface is drawn from wo's side
once a path (the prelude); the same light is also found by walking on to the interface, and the two are weighed by the
balance heuristic. Behind more than one interface only the walk itself arrives, which is unbiased as well.

Channels share their paths. Where they differ in optical depth, the distances are drawn for one of them, chosen at
random once a path, and the balance heuristic over the channels weighs them all. Paths end by leaving or by Russian
roulette; nothing else ends them.
"""

from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels, largest, pick
from layerjax.directions import Vector, scale, select
from layerjax.microsurface import Microfacets
from layerjax.transport.random_walk import microsurface as microsurface
from layerjax.transport.random_walk import surfaces as surfaces
from layerjax.transport.random_walk.flight import boundary, fly
from layerjax.transport.random_walk.scene import Scene, choose
from layerjax.transport.random_walk.state import Aim, Event, Lane, Step, make_goal, merge, to_level, weights

Orders = Literal["all", "first", "multiple"]

ROULETTE = 0.25
"""Throughput below which a path is ended at random; survivors go on with this much."""


class Walk:
    """Walks through one scene, traced once for its structure.

    Args:
        scene: the stack.
        wi: where the light comes from, lane by lane.
        wo: where it is asked for, or None for a walk that only follows it.
        microfacets: whether light that stays on a rough surface is followed.
        orders: which orders count (see `layerjax.RandomWalk`).
        count_orders: whether to count events although all orders count.
    """

    def __init__(
        self,
        scene: Scene,
        wi: Vector,
        wo: Vector | None,
        microfacets: Microfacets,
        orders: Orders = "all",
        count_orders: bool = False,
    ):
        self.scene = scene
        self.wi = wi
        self.orders = orders
        self.counts = count_orders or orders != "all"
        self.multiple = microfacets == "multiple" and microsurface.applies(scene)
        self.goal = None if wo is None else make_goal(scene, wo)
        self.aims = wo is not None and bool(scene.interfaces) and orders != "first"
        self.adjacent = self.aims and scene.surfaces > 1
        self.mixes = self.adjacent or (self.aims and bool(scene.media))
        self.fades = bool(scene.surfaces) or not scene.lossless or scene.colored_depths
        self.blocks = 2 if scene.surfaces or scene.colored_depths else 1

    def start(self, u: Array) -> Lane:
        """Paths at their beginning; u draws the channel, where one is drawn."""
        lane = self._start(u)
        if not self.aims or self.goal is None:
            return lane
        return lane._replace(
            direction=scale(-1.0, self.goal.wo), region=self.goal.outer, prelude=jnp.ones(u.shape, bool)
        )

    def step(self, lane: Lane, u: list[Array]) -> tuple[Lane, Step]:
        """One event: a collision, a bounce at a surface, or the way out. The caller restarts paths that end."""
        scene = self.scene
        free = jnp.ones(u[0].shape, bool)
        free = free if lane.prelude is None else free & ~lane.prelude
        free = free if lane.facet is None else free & ~lane.facet.on
        lane, collides, medium = fly(scene, lane, free, u[0])
        arrives, escapes, surface = boundary(scene, lane, free & ~collides)
        at_surface = (arrives | ~free) if scene.surfaces else None
        escaped = (escapes, lane.direction, weights(lane), lane.order)
        if lane.order is not None:
            lane = lane._replace(order=lane.order + (collides | arrives))
        if at_surface is not None:
            lane = to_level(scene, lane, at_surface, surface)
        target, direct, via = self._target(lane, at_surface, surface)
        event: Event | None = None
        if scene.media:
            event = self._collision(medium, lane.direction, target, collides, u)
        share: Array | None = None
        if at_surface is not None:
            lane, hit, settled, share = self._bounce(lane, at_surface, surface, target, u)
            event = hit if event is None else merge(at_surface, hit, event, scene.channels)
        else:
            settled = None
        assert event is not None
        contribution: Channels = ()
        if target is not None:
            events = collides if at_surface is None else collides | at_surface
            contribution = self._contribution(lane, event, events, at_surface, direct, via, share)
        lane, ends = self._continue(lane, event, escapes, settled, surface, at_surface, u)
        return lane, Step(contribution, ends, *escaped)

    # parts of a step

    def _start(self, u: Array) -> Lane:
        scene, wi = self.scene, self.wi
        above = wi[2] > 0
        one, zero = jnp.ones_like(wi[2]), jnp.zeros_like(wi[2])
        index = jnp.zeros(wi[2].shape, jnp.int32)
        last = len(scene.media) - 1
        direction = scale(-1.0, wi)
        drawn = jnp.minimum((u * scene.channels).astype(jnp.int32), scene.channels - 1)
        return Lane(
            direction=direction,
            layer=jnp.where(above, index, last) if last > 0 else None,
            depth=jnp.where(above, zero, one) if scene.media else None,
            region=jnp.where(above, index, scene.regions - 1) if scene.regions > 1 else None,
            throughput=(one,) * scene.channels,
            ratios=(one,) * scene.channels if scene.colored_depths else (),
            drawn_for=drawn if scene.colored_depths else None,
            order=index if self.counts else None,
            prelude=above & ~above if self.aims else None,
            aim=Aim(direction, [zero] * len(scene.media), zero, zero) if self.aims else None,
            inverse_density=zero if self.mixes else None,
            facet=microsurface.away(direction) if self.multiple else None,
        )

    def _target(
        self, lane: Lane, at_surface: Array | None, surface: Array | None
    ) -> tuple[Vector | None, Array | None, Array | None]:
        """Where the event's light is asked for: wo (direct), or a direction through the exit interface (via)."""
        goal = self.goal
        if goal is None or lane.region is None:
            return None if goal is None else goal.wo, None, None
        assert at_surface is not None
        direct = jnp.where(at_surface, surface == goal.exit, lane.region == goal.outer)
        if lane.aim is None:
            return goal.wo, direct, None
        via = jnp.where(at_surface, surface == goal.beyond, lane.region == goal.inner)
        return select(direct, goal.wo, lane.aim.travel), direct, via

    def _collision(
        self, medium: Array | None, travel: Vector, target: Vector | None, collides: Array, u: list[Array]
    ) -> Event:
        scene, wi = self.scene, scale(-1.0, travel)
        area = scene.cross_section(medium, wi)
        direction, kept = scene.deflect(medium, wi, u[1], u[2])
        if target is None:
            return Event(direction, kept, collides)
        density, share = scene.collide(medium, wi, target, area)
        sent = tuple(density * pick(share, c) for c in range(scene.channels))
        next_density = scene.collide(medium, wi, direction, area)[0] if self.mixes else None
        return Event(direction, kept, collides, sent, density, next_density)

    def _bounce(
        self, lane: Lane, at_surface: Array, surface: Array | None, target: Vector | None, u: list[Array]
    ) -> tuple[Lane, Event, Array, Array | None]:
        """An event at a surface.

        Returns the lane on the side where it is then, the event, whether the lane has left the surface, and the weight
        of what the exit interface sends to wo.
        """
        scene, travel = self.scene, lane.direction
        from_above = jnp.ones_like(at_surface) if lane.region is None else jnp.asarray(lane.region == surface)
        entry, entered_above, settled = travel, from_above, at_surface
        refracts = None if self.multiple else lane.prelude
        hit = surfaces.bounce(scene, surface, from_above, travel, target, refracts, (u[1], u[2], u[4]))
        if lane.facet is not None:
            index = jnp.zeros(at_surface.shape, jnp.int32) if surface is None else surface
            begins = at_surface & ~lane.facet.on
            entry = select(begins, travel, lane.facet.entry)
            entered_above = jnp.where(begins, from_above, lane.facet.entered_above)
            alpha = microsurface.width(scene, surface)
            first, _ = microsurface.fly(
                surfaces.turned(travel, from_above), jnp.zeros_like(u[0]), alpha, -jnp.log(u[5])
            )
            height = jnp.where(begins, first, lane.facet.height)
            walked, height = microsurface.bounce(scene, surface, from_above, travel, height, target, (u[1], u[2], u[4]))
            side = from_above ^ walked.crosses
            height, left = microsurface.fly(surfaces.turned(walked.direction, side), height, alpha, -jnp.log(u[6]))
            if scene.interfaces:  # nothing bends light between equal indices: it passes at the first facet
                left = left | (walked.crosses & (scene.surface_ior(surface, from_above) == 1.0))
            faceted = microsurface.has_facets(scene, surface)
            hit = walked if faceted is True else surfaces.merge(faceted, walked, hit)
            settled = at_surface & (left | ~jnp.asarray(faceted))
            on = at_surface & ~settled
            lane = lane._replace(facet=microsurface.Position(on, index, height, entry, entered_above))
        if lane.region is not None:
            assert surface is not None
            beyond = jnp.where(from_above, surface + 1, surface)
            lane = lane._replace(region=jnp.where(at_surface & hit.crosses, beyond, lane.region))
        event = Event(hit.direction, hit.kept, hit.survives, hit.towards_target)
        if self.adjacent and target is not None:
            densities = [
                surfaces.density(scene, surface, entered_above, entry, w, diffuse=self.multiple)
                for w in (target, hit.direction)
            ]
            event = event._replace(density=densities[0], next_density=densities[1])
        share: Array | None = None
        if self.aims:
            lane, share = self._through_exit(lane, entry, hit, settled)
        return lane, event, settled, share

    def _through_exit(self, lane: Lane, entry: Vector, hit: surfaces.Bounce, settled: Array) -> tuple[Lane, Array]:
        """The lane with its aim, if its prelude ends; and the weight of having walked, not aimed, along `entry`."""
        scene, goal = self.scene, self.goal
        assert goal is not None
        assert lane.prelude is not None
        assert lane.aim is not None
        inside = select(lane.prelude, hit.direction, scale(-1.0, entry))
        density, passed = surfaces.exit_density(scene, goal.exit, goal.above, goal.wo, inside, diffuse=self.multiple)
        ready = lane.prelude & settled
        # else the draw came back, or was reflected totally and masked: nothing is aimed on this path
        found = (lane.region == goal.inner) & hit.survives
        ior = scene.surface_ior(goal.exit, goal.above)
        if self.multiple:  # drawn by the walk itself
            passed = 1.0 / jnp.maximum(jnp.abs(inside[2]), jnp.finfo(scene.dtype).tiny * 1e4)
        travel = scale(-1.0, hit.direction)
        fresh = Aim(
            travel,
            scene.rates(travel),
            jnp.where(found, passed / (ior * ior), 0.0),
            density,
        )
        aim = jax.tree.map(lambda new, old: jnp.where(ready, new, old), fresh, lane.aim)
        share = jnp.ones_like(density)
        if lane.inverse_density is not None:
            share = 1.0 / (1.0 + density * lane.inverse_density)
        return lane._replace(aim=aim), share

    def _contribution(
        self,
        lane: Lane,
        event: Event,
        events: Array,
        at_surface: Array | None,
        direct: Array | None,
        via: Array | None,
        share: Array | None,
    ) -> Channels:
        """What the event adds to the BSDF at (wi, wo)."""
        scene, goal = self.scene, self.goal
        assert goal is not None
        useful = events
        factors: Channels = (1.0 / jnp.abs(goal.wo[2]),)
        ends: list[Any] = [jnp.where(goal.above, 0.0, 1.0)] * len(scene.media)
        rates = goal.rates
        if direct is not None:
            useful = useful & (direct if via is None else direct | via)
            if lane.prelude is not None:
                useful = useful & ~lane.prelude
        if lane.aim is not None and direct is not None:
            assert at_surface is not None
            straight = factors[0] if share is None else factors[0] * jnp.where(at_surface, share, 1.0)
            aimed = lane.aim.weight
            if event.density is not None:
                total = event.density + lane.aim.density
                aimed = aimed * lane.aim.density / jnp.where(total > 0, total, 1.0)
            factors = tuple(jnp.where(direct, straight, aimed * outer) for outer in goal.outer_transmittance)
            exit_level = choose(goal.exit, [jnp.int32(level) for level in scene.levels[: len(scene.interfaces)]])
            ends = [jnp.where(direct, end, jnp.where(exit_level > j, 1.0, 0.0)) for j, end in enumerate(ends)]
            rates = [jnp.where(direct, a, b) for a, b in zip(rates, lane.aim.rates, strict=True)]
        passed: Channels = (jnp.ones_like(goal.above, scene.dtype),)
        if scene.media and lane.depth is not None:
            levels = scene.fractions(lane.layer, lane.depth)
            passed = scene.transmittance([jnp.abs(a - b) for a, b in zip(levels, ends, strict=True)], rates)
        if lane.order is not None and self.orders != "all":
            order = lane.order if via is None or direct is None else lane.order + (via & ~direct)
            useful = useful & (order == 1 if self.orders == "first" else order >= 2)
        weight = weights(lane)
        return tuple(
            jnp.where(useful, weight[c] * pick(event.sent, c) * pick(factors, c) * pick(passed, c), 0.0)
            for c in range(scene.channels)
        )

    def _continue(
        self,
        lane: Lane,
        event: Event,
        escapes: Array,
        settled: Array | None,
        surface: Array | None,
        at_surface: Array | None,
        u: list[Array],
    ) -> tuple[Lane, Array]:
        """The lane after its event, and whether its path ends; lanes whose prelude is over begin their path."""
        channels = range(self.scene.channels)
        throughput = tuple(lane.throughput[c] * pick(event.kept, c) for c in channels)
        after = lane._replace(direction=event.direction, throughput=throughput)
        ends = escapes | ~event.survives
        if self.fades:
            largest_weight = largest(weights(after))
            chance = jnp.minimum(largest_weight / ROULETTE, 1.0)
            ends = ends | ~(u[3] < chance)
            scale_up = 1.0 / jnp.where(chance > 0, chance, 1.0)
            after = after._replace(throughput=tuple(t * scale_up for t in after.throughput))
        if self.orders == "first" and lane.order is not None:
            done = lane.order >= 1
            ends = ends | (done if settled is None else done & (settled | ~jnp.asarray(at_surface)))
        if lane.inverse_density is not None and event.next_density is not None:
            ends_visit = jnp.asarray(True) if settled is None else settled | ~jnp.asarray(at_surface)
            goal = self.goal
            assert goal is not None
            aimed = jnp.where(jnp.asarray(at_surface), surface == goal.beyond, True) & (after.region == goal.inner)
            inverse = jnp.where(aimed, 1.0 / jnp.maximum(event.next_density, jnp.finfo(u[0].dtype).tiny * 1e4), 0.0)
            after = after._replace(inverse_density=jnp.where(ends_visit, inverse, lane.inverse_density))
        if lane.prelude is not None:
            assert settled is not None
            ready = lane.prelude & settled
            begun = self._start(u[7])._replace(aim=lane.aim)
            after = jax.tree.map(lambda new, old: jnp.where(ready, new, old), begun, after)
            ends = ends & ~lane.prelude
        return after, ends
