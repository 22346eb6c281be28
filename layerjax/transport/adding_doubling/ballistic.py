"""Light that passes a slab by two refractions, at its two interfaces, and meets nothing between: in closed form.

So is light that a mirror sends back through the rough interface that let it in: seen in the mirror, that is a slab, and
the two refractions are at the same interface. A smooth interface in the place of the mirror has a critical angle, which
the points of the facets do not resolve: what it sends back is left to the grid.

Both lobes may be narrower than the nodes are apart, which then miss where they overlap: see `double_refraction`.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from layerjax._batching import map_row_chunks
from layerjax._numerics import horizon
from layerjax.channels import Channels, map_channels, total
from layerjax.directions import Vector, flip, select
from layerjax.stack import Interface, Medium, Stack, is_tilted, optical_depths
from layerjax.surfaces import Surface
from layerjax.transport.adding_doubling.double_refraction import POINTS, double_refraction
from layerjax.transport.adding_doubling.operators import (
    Layer,
    Operator,
    Parts,
    add,
    add_operators,
    matmul,
    multiply,
    scale_columns,
    scale_rows,
)
from layerjax.transport.adding_doubling.requested_directions import azimuth, turn
from layerjax.transport.adding_doubling.resolution import mirrors_in_closed_form
from layerjax.transport.specular import Crossed, crossed_layers, is_smooth, ray_shares, region_indices

BATCH_RAYS = 1 << 17
"""Rays that are followed together."""


class Slab(eqx.Module):
    """Media between two interfaces."""

    media: tuple[Medium, ...]

    def passed(self, w: Vector) -> Channels:
        """Share of light along w, in the first region, that reaches the second interface."""
        depths = total([*optical_depths(self.media, w), (jnp.zeros_like(w[2]),)])
        return tuple(jnp.exp(-depth) for depth in depths)


class Mirror(eqx.Module):
    """Media behind an interface, and the mirror that sends light back to it: see `ray_shares`."""

    layers: tuple[Crossed, ...]
    outside: Array
    base: Surface | None

    def passed(self, w: Vector) -> Channels:
        """Share of light along -w that comes back to the interface."""
        return ray_shares(self.layers, self.outside, self.base, w)[0]


class Ballistic(eqx.Module):
    """The two interfaces, what is between them, and the media above and below.

    crosses: whether light leaves on the other side. Else the second interface is the first, as it is seen in the
    mirror, and what lies below is what lies above. symmetric: whether all between the two, and both, are symmetric
    about the normal.
    """

    upper: Interface
    lower: Interface
    interior: Slab | Mirror
    outside: tuple[tuple[Medium, ...], tuple[Medium, ...]]
    crosses: bool = eqx.field(static=True)
    symmetric: bool = eqx.field(static=True)


def ballistic_paths(stack: Stack) -> tuple[Ballistic, ...]:
    """What light passes by two refractions alone."""
    found = []
    faces = _slab_faces(stack)
    if faces is not None:
        parts = (stack.layers[: faces[0]], stack.layers[faces[0] + 1 : faces[1]], stack.layers[faces[1] + 1 :])
        upper, lower = (stack.layers[k] for k in faces)
        assert isinstance(upper, Interface)
        assert isinstance(lower, Interface)
        above, between, below = map(_media, parts)
        symmetric = not any(map(is_tilted, (upper, *between, lower)))
        found.append(Ballistic(upper, lower, Slab(between), (above, below), True, symmetric))
    if mirrors_in_closed_form(stack.layers, is_smooth(stack.base)):
        found.append(_mirrored_path(stack))
    return tuple(found)


def _media(layers: Sequence[Any]) -> tuple[Medium, ...]:
    return tuple(layer for layer in layers if isinstance(layer, Medium))


def _mirrored_path(stack: Stack) -> Ballistic:
    layers = crossed_layers(stack, region_indices(stack))
    place = next(k for k, (layer, _, _) in enumerate(layers) if isinstance(layer, Interface))
    upper, _, inside = layers[place]
    lower = eqx.tree_at(lambda face: face.ior, upper, jnp.ones_like(inside))
    media = _media(stack.layers[:place])
    symmetric = not any(map(is_tilted, stack.layers[place:]))
    interior = Mirror(tuple(layers[place + 1 :]), inside, stack.base)
    return Ballistic(upper, lower, interior, (media, media), False, symmetric)


def _slab_faces(stack: Stack) -> tuple[int, int] | None:
    """The two interfaces of a slab, if both are rough and no other part is an interface or a base."""
    if any(map(is_smooth, stack.layers)):  # it is bent on its way
        return None
    faces = [place for place, layer in enumerate(stack.layers) if isinstance(layer, Interface)]
    return (faces[0], faces[1]) if stack.base is None and len(faces) == 2 else None


def subtract_ballistic(stack: Stack, layers: Sequence[Layer], whole: Layer) -> Layer:
    """The whole stack without the light that passes by two refractions alone, as its layers have it."""
    down = [(layer.transmit_down.first, layer.direct_down) for layer in layers]
    up = [(layer.transmit_up.first, layer.direct_up) for layer in layers]
    faces = _slab_faces(stack)
    if faces is not None:
        mirrored = [len(layers) - 1 - place for place in faces]
        once = _double_refraction(down, faces), _double_refraction(up[::-1], mirrored)
        whole = _subtract(whole, lambda layer: (layer.transmit_down.rest, layer.transmit_up.rest), once)
    is_mirror = stack.base is not None and layers[-1].mirror_top is not None  # the base itself may be a stand-in
    if mirrors_in_closed_form(stack.layers, is_mirror):
        stop = 1 + next(place for place, layer in enumerate(stack.layers) if isinstance(layer, Interface))
        back = _double_passage(down[:stop], up[:stop], _mirrors(layers[stop:]).mirror_top)
        whole = _subtract(whole, lambda layer: (layer.reflect_top.rest,), (back,))
    return whole


def _subtract(whole: Layer, parts: Callable[[Layer], tuple[Operator, ...]], less: Sequence[Array]) -> Layer:
    return eqx.tree_at(
        parts, whole, tuple(add_operators(part, -once) for part, once in zip(parts(whole), less, strict=True))
    )


def _mirrors(layers: Sequence[Layer]) -> Layer:
    """What mirrors and media alone do, layer on layer."""
    alone = [
        Layer(
            Parts(None),
            direct_down=layer.direct_down,
            direct_up=layer.direct_up,
            mirror_top=layer.mirror_top,
            mirror_bottom=layer.mirror_bottom,
        )
        for layer in layers
    ]
    return reduce(lambda below, above: add(above, below), reversed(alone))


def _double_passage(
    inward: Sequence[tuple[Operator, Operator]], outward: Sequence[tuple[Operator, Operator]], mirror: Operator
) -> Array:
    """Flux that passes the last of these layers, comes back from the mirror behind it, and passes it again.

    inward, outward: what each layer passes with one event, and what untouched, in the order in which light comes in.
    """
    (into, _), (out, _) = inward[-1], outward[-1]
    before: Operator = jnp.ones(1)
    after: Operator = jnp.ones(1)
    for (_, direct), (_, back) in zip(inward[:-1], outward[:-1], strict=True):
        before, after = multiply(before, direct), multiply(after, back)
    passed = scale_rows(after, matmul(out, scale_rows(mirror, scale_columns(into, before))))
    assert passed is not None
    return passed


def _double_refraction(layers: Sequence[tuple[Operator, Operator]], faces: Sequence[int]) -> Array:
    """Flux that meets the two faces alone, of layers in the order in which light comes through them.

    layers: what each passes with one event, and what untouched.
    """
    before: Operator = jnp.ones(1)
    passed: Operator = None
    for place, (through, direct) in enumerate(layers):
        if place in faces:
            passed = scale_columns(through, before) if passed is None else matmul(through, passed)
        elif passed is None:
            before = multiply(before, direct)
        else:
            passed = scale_rows(direct, passed)
    assert passed is not None
    return passed


def evaluate_ballistic(state: Ballistic, wi: Vector, wo: Vector) -> Channels:
    """BSDF of that light, 0 for pairs on other sides than those where it comes in and leaves."""
    shape = jnp.broadcast_shapes(wi[2].shape, wo[2].shape)
    downward = wi[2] > 0
    over, under = (select(downward, wi, wo), flip(select(downward, wo, wi))) if state.crosses else (wi, wo)
    if 0 in shape:
        return (jnp.zeros(shape, over[2].dtype),)
    edge = horizon(over[2].dtype)
    valid = (over[2] > edge) & (under[2] > edge)
    cosines = (jnp.where(valid, over[2], 0.5), jnp.where(valid, under[2], 0.5))
    azimuths = [turn(over, flip(under))] if state.symmetric else [azimuth(*under[:2]), azimuth(-over[0], -over[1])]
    rows = [jnp.broadcast_to(row, shape).ravel() for row in (valid, *cosines, *azimuths)]
    passed = partial(double_refraction, state.upper, state.lower, state.interior.passed)

    def nothing(*pairs: Array) -> Channels:
        return tuple(jnp.zeros(found.shape, found.dtype) for found in jax.eval_shape(passed, *pairs))

    def some(rows: list[Array]) -> Channels:  # pairs on other sides, which often lie together, are omitted
        crossing, *pairs = rows
        return jax.lax.cond(jnp.any(crossing), passed, nothing, *pairs)

    rays = rows[0].size * 8 * POINTS[0] * POINTS[1]
    found = map_row_chunks(some, rows, rays // BATCH_RAYS)
    outside = total(
        [*optical_depths(state.outside[0], over), *optical_depths(state.outside[1], flip(under)), (0.0 * over[2],)]
    )
    level = jnp.where(downward, 1.0, 1.0 / state.lower.ior**2)  # f / ior_o^2 is reciprocal

    def value(passed: Array, depth: Array) -> Array:
        return jnp.where(valid, passed.reshape(shape) * level * jnp.exp(-depth), 0.0)

    return map_channels(value, found, outside)
