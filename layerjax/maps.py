"""Maps of stacks: every texel a stack of its own, in chunks that stay in the cache.

`layerjax._shapes` documents what a map is, and how texels are distinguished from channels. Directions broadcast
against a map: one of shape ``(3,)`` serves all texels, ``(H, W, 3)`` are one for each, ``(K, 1, 1, 3)`` K for all of
them, and ``(K, H, W, 3)`` K for each. Memory grows with inputs and results alone; a gradient computes each chunk again
on the way back.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from layerjax._batching import chunk_factor, even_chunks
from layerjax._devices import compile_for_devices, shard_rows
from layerjax._shapes import Shape, axes_of_map
from layerjax.directions import join, split
from layerjax.stack import Stack
from layerjax.transport.contract import TEXELS, Draws, Side, Transport
from layerjax.transport.known_directions import KnownDirections, separate_cosines


class Layout(NamedTuple):
    """How directions lie over a map.

    shape: of the map. outer_axes: axes of the directions in front of it. shared: whether all texels have the same.
    """

    shape: Shape
    outer_axes: Shape
    shared: bool

    @property
    def result(self) -> Shape:
        """Shape of what is found, without channels."""
        return (*self.outer_axes, *self.shape)

    @property
    def empty(self) -> bool:
        """Whether there is nothing to be found."""
        return 0 in self.result

    def broadcast(self, w: Array) -> Array:
        """Directions as every texel has them, (texels, pairs, 3); (pairs, 3) if they are shared."""
        if self.shared:
            own = w.shape[:-1][: max(0, w.ndim - 1 - len(self.shape))]
            return jnp.broadcast_to(w.reshape(*own, 3), (*self.outer_axes, 3)).reshape(-1, 3)
        w = jnp.broadcast_to(w, (*self.result, 3)).reshape(math.prod(self.outer_axes), math.prod(self.shape), 3)
        return jnp.swapaxes(w, 0, 1)

    def gather(self, values: Array) -> Array:
        """Values (texels, pairs, ...) in the shape of the result."""
        return jnp.swapaxes(values, 0, 1).reshape(*self.result, *values.shape[2:])


class TexelDirections(NamedTuple):
    """Whether the directions of each texel are few enough to be known, and whether all are known to lie above."""

    known: bool
    above: bool


def layout(shape: Shape, *directions: Array) -> Layout:
    """How directions (..., 3) lie over a map of this shape.

    Raises:
        ValueError: they do not broadcast.
    """
    batches = [w.shape[:-1] for w in directions]
    try:
        result = jnp.broadcast_shapes(shape, *batches)
    except ValueError:
        given = " and ".join(str(w.shape) for w in directions)
        raise ValueError(
            f"stack: a map of shape {shape} does not broadcast against directions of shape {given}"
        ) from None
    over = len(shape)
    if result[len(result) - over :] != shape:
        raise ValueError(
            f"stack: directions of shape {' and '.join(str(w.shape) for w in directions)} are longer than the map of "
            f"shape {shape} that they lie over"
        )
    shared = all(math.prod(batch[max(0, len(batch) - over) :]) == 1 for batch in batches)
    return Layout(shape, result[: len(result) - over], shared)


def map_texels(
    function: Callable[..., Any], stack: Stack, layout: Layout, rows: Sequence[Array], batch_size: int
) -> Any:
    """function(stack, *rows) of every texel; what it returns along a new first axis.

    Args:
        stack: a map; function gets single ones.
        rows: arrays (texels, ...), an entry for each.
        batch_size: texels that are computed together.
    """
    texels = math.prod(layout.shape)
    leaves, structure = jax.tree.flatten(stack)
    mapped = jax.tree.leaves(axes_of_map(stack, layout.shape))
    over = len(layout.shape)
    numbers = [
        jnp.broadcast_to(leaf, (*layout.shape, *leaf.shape[over:])).reshape(texels, *leaf.shape[over:])
        for leaf, is_mapped in zip(leaves, mapped, strict=True)
        if is_mapped
    ]

    def one(numbers: list[Array], row: Sequence[Array], _: Array) -> Any:
        rest = iter(numbers)
        filled = [next(rest) if is_mapped else leaf for leaf, is_mapped in zip(leaves, mapped, strict=True)]
        return function(jax.tree.unflatten(structure, filled), *row)

    # numbered: a map may be left without a number that differs, where all its layers are known not to be there
    numbered = (numbers, tuple(rows), jnp.arange(texels))
    return shard_rows(partial(_map_batches, one, batch_size), numbered, least=batch_size, filled=True)


def _map_batches(one: Callable[..., Any], batch_size: int, rows: Any) -> Any:
    """one(*row) of every row, so many of them at a time."""
    if batch_size == 1:
        return jax.lax.map(jax.checkpoint(lambda row: one(*row)), rows)
    texels = jax.tree.leaves(rows)[0].shape[0]
    chunks, size = even_chunks(texels, -(-texels // batch_size))
    missing = chunks * size - texels

    def add_chunk_axis(array: Array) -> Array:
        if missing:
            array = jnp.concatenate([array, jnp.broadcast_to(array[-1:], (missing, *array.shape[1:]))])
        return array.reshape(chunks, size, *array.shape[1:])

    found = jax.lax.map(jax.checkpoint(lambda row: jax.vmap(one)(*row)), jax.tree.map(add_chunk_axis, rows))
    return jax.tree.map(lambda array: array.reshape(chunks * size, *array.shape[2:])[:texels], found)


@compile_for_devices
def values(
    stack: Stack,
    transport: Transport,
    layout: Layout,
    directions: tuple[Array, Array],
    side: Side,
    channels: int,
    key: Array | None,
    known: KnownDirections | None,
    texels: TexelDirections,
) -> Array:
    """BSDF of every texel of a simplified map, ``layout.result + (channels,)``.

    directions: wi and wo as `Layout.broadcast` gives them. known: of directions that are shared.
    """

    def one(stack: Stack, wi: Array, wo: Array, key: Array | None) -> tuple[Array, ...]:
        state = transport.prepare_for_directions(
            stack, lambda: separate_cosines(wi, wo, texels.above) if texels.known else known
        )
        found, _ = transport.evaluate_batch(state, wi, wo, side, channels, key)
        return tuple(found[..., c] for c in range(channels))

    return jnp.stack(
        [layout.gather(value) for value in _map_directions(one, stack, transport, layout, directions, key)], axis=-1
    )


@compile_for_devices
def draws(stack: Stack, transport: Transport, layout: Layout, wi: Array, channels: int, key: Array) -> Draws:
    """Directions drawn for every texel, as `layerjax.sample` gives them."""

    def one(stack: Stack, wi: Array, key: Array) -> tuple[Array, ...]:
        drawn = transport.sample_batch(transport.prepare(stack), wi, channels, key)
        return (*split(drawn.wo), drawn.density, drawn.specular, *(drawn.weight[..., c] for c in range(channels)))

    found = [layout.gather(value) for value in _map_directions(one, stack, transport, layout, (wi,), key)]
    return Draws(jnp.stack(found[:3], axis=-1), found[3], jnp.stack(found[5:], axis=-1), found[4])


@compile_for_devices
def densities(stack: Stack, transport: Transport, layout: Layout, directions: tuple[Array, Array]) -> Array:
    """Density of draws of every texel, ``layout.result``."""

    def one(stack: Stack, wi: Array, wo: Array, key: None) -> Array:
        return transport.pdf(transport.prepare(stack), split(wi), split(wo))

    return layout.gather(_map_directions(one, stack, transport, layout, directions, None))


@compile_for_devices
def albedos(
    stack: Stack, transport: Transport, layout: Layout, wi: Array, channels: int, nodes: int, key: Array | None
) -> tuple[Array, Array]:
    """Scattered energy of every texel on wi's side and on the other, ``layout.result + (channels,)`` each."""

    def one(stack: Stack, wi: Array, key: Array | None) -> tuple[Array, Array]:
        return transport.albedo_batch(transport.prepare_for_albedo(stack), wi, channels, nodes, key)

    near, far = _map_directions(one, stack, transport, layout, (wi,), key, batch_size=1)
    return layout.gather(near), layout.gather(far)


def _map_directions(
    function: Callable[..., Any],
    stack: Stack,
    transport: Transport,
    layout: Layout,
    directions: Sequence[Array],
    key: Array | None,
    batch_size: int | None = None,
) -> Any:
    """function(stack, *directions, key) of every texel, each with a key of its own; see `map_texels`."""
    pairs = max(1, math.prod(layout.outer_axes))
    batch_size = (
        max(1, chunk_factor() * transport.texel_batch_size(stack) // pairs) if batch_size is None else batch_size
    )
    keys = [] if key is None else [jax.random.split(key, math.prod(layout.shape))]
    if layout.shared:
        parts: Sequence[Array] = []
    else:  # as components: to read every third number takes as long as the arithmetic
        parts = [part for w in directions for part in split(w)]

    def of_components(stack: Stack, *rest: Array) -> Any:
        w = (
            directions
            if layout.shared
            else [join((rest[k], rest[k + 1], rest[k + 2])) for k in range(0, len(parts), 3)]
        )
        return function(stack, *w, rest[-1] if keys else None)

    return map_texels(of_components, stack, layout, [*parts, *keys], batch_size)


@compile_for_devices
def evaluate_texels(function: Callable[..., Array], stack: Stack, layout: Layout, w: Array, *options: Any) -> Array:
    """function(stack, w, *options) of every texel, ``layout.result + ...``."""
    rows = [] if layout.shared else [layout.broadcast(w)]

    def one(stack: Stack, *row: Array) -> Array:
        return function(stack, row[0] if row else layout.broadcast(w), *options)

    batch_size = max(1, chunk_factor() * TEXELS // max(1, math.prod(layout.outer_axes)))
    return layout.gather(map_texels(one, stack, layout, rows, batch_size))
