"""Free flight of the walk: to the next collision, or to the surface or the way out that lies before it."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels, pick
from layerjax.transport.random_walk.scene import Scene, choose
from layerjax.transport.random_walk.state import PathState


def free_flight(scene: Scene, path: PathState, free: Array, u: Array) -> tuple[PathState, Array, Array | None]:
    """To the next collision if it lies in the region: the path there, whether it does, and the medium."""
    last = len(scene.media) - 1
    if last < 0:
        return path, ~free & free, None
    assert path.depth is not None
    down = path.direction[2] < 0
    rates, levels = scene.rates(path.direction), scene.fractions(path.layer, path.depth)
    thickness = [choose(path.sampling_channel, tau) if len(tau) > 1 else tau[0] for tau in scene.thickness]
    rest = -jnp.log(u)  # mean free paths still to go
    collides, medium, depth = ~free & free, jnp.zeros(u.shape, jnp.int32), path.depth
    crossed = [jnp.zeros_like(u)] * (last + 1)
    for s in range(last + 1):
        # in the order that the ray meets them
        def met(values: Any, s: int = s) -> Any:
            return values[0] if last == 0 else jnp.where(down, values[s], values[last - s])

        extinction = met([rate * tau for rate, tau in zip(rates, thickness, strict=True)])
        begin = met(levels)
        share = jnp.where(down, 1.0 - begin, begin)
        if path.region is not None:
            share = jnp.where(met([jnp.int32(r) for r in scene.region_of]) == path.region, share, 0.0)
        stops = free & ~collides & (rest < extinction * share)
        advance = jnp.where(stops, rest / jnp.where(stops, extinction, 1.0), share)
        depth = jnp.where(stops, jnp.where(down, begin + advance, begin - advance), depth)
        medium = jnp.where(stops, met(list(range(last + 1))), medium)
        if scene.colored_depths:
            passed = jnp.where(free & ~collides, advance, 0.0)
            for j in range(last + 1):
                crossed[j] = crossed[j] + jnp.where(met(list(range(last + 1))) == j, passed, 0.0)
        rest = rest - extinction * share
        collides = collides | stops
    path = path._replace(depth=depth, layer=None if path.layer is None else jnp.where(collides, medium, path.layer))
    chosen = None if last == 0 else medium
    if scene.colored_depths:
        path = path._replace(ratios=_reweight(scene, path, crossed, rates, collides, chosen))
    return path, collides, chosen


def _reweight(
    scene: Scene, path: PathState, crossed: list[Array], rates: list[Array], collides: Array, medium: Array | None
) -> Channels:
    """Densities of the path for every channel over that for the channel drawn for, after a flight."""
    tables = scene.thickness
    drawn = [choose(path.sampling_channel, tau) if len(tau) > 1 else tau[0] for tau in tables]
    ratios = []
    for c in range(scene.channels):
        excess = sum(
            share * rate * (pick(tau, c) - own)
            for share, rate, tau, own in zip(crossed, rates, tables, drawn, strict=True)
        )
        here, own = choose(medium, [pick(tau, c) for tau in tables]), choose(medium, drawn)
        collision = jnp.where(collides, here / jnp.where(own > 0, own, 1.0), 1.0)
        ratios.append(path.ratios[c] * jnp.exp(-excess) * collision)
    return tuple(ratios)


def boundary(scene: Scene, path: PathState, passes: Array) -> tuple[Array, Array, Array | None]:
    """Of paths that meet no collision: those that arrive at a surface, those that leave; and the surface."""
    down = path.direction[2] < 0
    if not scene.surfaces:
        return passes & ~passes, passes, None
    if path.region is None:
        return passes & down, passes & ~down, None
    surface = jnp.where(down, path.region, path.region - 1)
    inside = (surface >= 0) & (surface < scene.surfaces)
    arrives, escapes = passes & inside, passes & ~inside
    if path.facet is not None:
        surface = jnp.where(path.facet.on_surface, path.facet.surface, surface)
    return arrives, escapes, jnp.clip(surface, 0, scene.surfaces - 1)
