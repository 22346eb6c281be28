"""What an event sends to wo where there are smooth surfaces: along the one ray that they bend and mirror to it.

A walk never meets wo by a smooth surface, so that all such light is found by events before it. In every region the ray
to wo has one direction towards wo's side, and its mirror image away from it where a smooth surface lies on that side;
how much arrives by either, with all turns between smooth surfaces, is known in closed form. Rough surfaces end the ray:
light from behind them walks on to them, and is sent to wo there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax import channels
from layerjax._numerics import clamp_min
from layerjax.channels import Channels, map_channels, multiply, pick
from layerjax.directions import Vector, bend, flip
from layerjax.transport.random_walk.scene import Scene, choose
from layerjax.transport.random_walk.state import Arrival, Event, PathState, Target, weights
from layerjax.transport.specular import LEAST_LOSS, crossed_layers, ray_shares

LEAST_COSINE = 1e-12
"""Stands for smaller cosines, where the ray would lie along the tangent plane."""


class RegionRay(NamedTuple):
    """The ray to wo in a region: its direction towards wo's side; extinctions of the media along it, and along its
    mirror image; what light brings of f, for each unit of flux per solid angle, that reaches the boundary on wo's side
    along it, and that on the other side along the image."""

    direction: Vector
    rates: tuple[list[Array], list[Array]]
    near: Channels
    far: Channels


class SpecularGoal(NamedTuple):
    """The requested direction of the light, and its ray in every region."""

    wo: Vector
    above: Array
    rays: list[RegionRay]


def make_specular_goal(scene: Scene, wo: Vector) -> SpecularGoal:
    """What follows from wo."""
    above = wo[2] > 0
    outside = jnp.where(above, scene.indices[0], scene.indices[-1])
    return SpecularGoal(wo, above, [_region_ray(scene, region, wo, above, outside) for region in range(scene.regions)])


def _region_ray(scene: Scene, region: int, wo: Vector, above: Array, outside: Array) -> RegionRay:
    index, faces = scene.indices[region], scene.places
    ray, exists = bend(wo, index / outside)
    cosine = jnp.where(exists, clamp_min(jnp.abs(ray[2]), LEAST_COSINE), 0.5)
    ray = (ray[0], ray[1], jnp.where(above, cosine, -cosine))
    crossed = crossed_layers(scene.stack, scene.indices)
    over = crossed[: faces[region - 1] + 1] if region else []
    under = crossed[faces[region] :] if region < len(faces) else []
    upward = ray_shares(over[::-1], index, None, ray, turned=True)
    downward = ray_shares(under, index, scene.base, ray)
    (mirrored, passed), (opposite, _) = (
        (channels.select(above, one[0], other[0]), channels.select(above, one[1], other[1]))
        for one, other in ((upward, downward), (downward, upward))
    )
    rates = scene.rates(ray), scene.rates(flip(ray))
    crossing = [jnp.where(place == region, 1.0, 0.0) for place in scene.region_of]
    one: Channels = (jnp.ones_like(cosine),)
    there, back = (scene.transmittance(crossing, rate) if scene.media else one for rate in rates)
    turn = multiply(opposite, there)
    again = map_channels(lambda m, t, b: 1.0 / clamp_min(1.0 - m * t * b, LEAST_LOSS), mirrored, turn, back)
    # flux per solid angle to radiance, and n^2 cos dw is kept: f = passed n_o^2 / (n^2 cos)
    level = jnp.where(exists, (outside / index) ** 2 / cosine, 0.0)
    near = tuple(level * part for part in multiply(passed, again))
    return RegionRay(ray, rates, near, multiply(turn, near))


def specular_target(scene: Scene, goal: SpecularGoal, path: PathState, arrival: Arrival, u: Array) -> Target:
    """The direction in which light of an event is requested; u chooses one of the two at collisions."""
    away = _goes_away(arrival, u)
    x, y, z = (choose(_region(scene, goal, path, arrival), list(part)) for part in zip(*_directions(goal), strict=True))
    return Target((x, y, jnp.where(away, -z, z)), None, None)


def specular_contribution(
    scene: Scene, goal: SpecularGoal, path: PathState, arrival: Arrival, event: Event, u: Array
) -> Channels:
    """What the event adds to the BSDF at (wi, wo)."""
    region, away = _region(scene, goal, path, arrival), _goes_away(arrival, u)
    counted = arrival.collides if arrival.at_surface is None else arrival.collides | arrival.at_surface
    passed: Channels = (jnp.ones_like(u),)
    if scene.media and path.depth is not None:
        end = jnp.where(goal.above ^ away, 0.0, 1.0)
        levels = scene.fractions(path.layer, path.depth)
        crossed = [
            jnp.where(region == place, jnp.abs(level - end), 0.0)
            for level, place in zip(levels, scene.region_of, strict=True)
        ]
        rates = [_either(away, region, [ray.rates[::-1] for ray in goal.rays], j) for j in range(len(scene.media))]
        passed = scene.transmittance(crossed, rates)
    # one of two directions was chosen at collisions
    share = jnp.where(arrival.collides, 2.0, 1.0)
    weight = weights(path)

    def arrives(c: int) -> Array:
        sides = [((pick(ray.far, c),), (pick(ray.near, c),)) for ray in goal.rays]
        return weight[c] * pick(event.sent, c) * share * _either(away, region, sides, 0) * pick(passed, c)

    return tuple(jnp.where(counted, arrives(c), 0.0) for c in range(scene.channels))


def _directions(goal: SpecularGoal) -> list[Vector]:
    return [ray.direction for ray in goal.rays]


def _either(away: Array, region: Array, pairs: Sequence[Sequence[Sequence[Array]]], place: int) -> Array:
    """The first of the region's pair where light goes away from wo's side, else the second."""
    first, second = (choose(region, [pair[side][place] for pair in pairs]) for side in (0, 1))
    return jnp.where(away, first, second)


def _region(scene: Scene, goal: SpecularGoal, path: PathState, arrival: Arrival) -> Array:
    """The region whose light counts: where a collision is, or on wo's side of a surface."""
    here = jnp.zeros(goal.above.shape, jnp.int32) if path.region is None else path.region
    if arrival.at_surface is None or arrival.surface is None:
        return here
    beside = jnp.where(goal.above, arrival.surface, jnp.minimum(arrival.surface + 1, scene.regions - 1))
    return jnp.where(arrival.at_surface, beside, here)


def _goes_away(arrival: Arrival, u: Array) -> Array:
    """Whether light is requested away from wo's side, to be mirrored there."""
    return arrival.collides & (u < 0.5)
