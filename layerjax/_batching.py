"""Large batches of directions in chunks that fit the cache, on the way there and back.

A processor's cache, that is: on a GPU, which a chunk has to fill, chunks are larger.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from layerjax._devices import shard_rows
from layerjax.directions import split

CHUNK_BYTES = 20_000
"""Size of one component of a chunk: 5,000 pairs in float32, 2,500 in float64."""

ACCELERATOR_FACTOR = 400
"""Times as large are chunks where there is no processor's cache to stay in: what memory holds, if all is kept."""

BLOCK_CHUNKS = 4
"""Chunks that are transposed together."""

VECTOR_WIDTH = 16
"""Rows of a chunk are a multiple of this: the widest vector of a processor, in float32."""


def chunk_factor() -> int:
    """Times as much as on a processor that a chunk may hold, on the device that a program is traced for."""
    chosen = jax.default_device.value
    platform = jax.default_backend() if chosen is None else getattr(chosen, "platform", chosen)
    return 1 if platform == "cpu" else ACCELERATOR_FACTOR


def even_chunks(count: int, chunks: int) -> tuple[int, int]:
    """At most so many chunks for ``count`` rows, and the rows of each; the last one is to be filled up.

    A loop over chunks whose rows no vector divides took three times as long a row.
    """
    rows = -(-count // chunks)
    if rows >= VECTOR_WIDTH**2:  # where filling up costs little
        rows = -(-rows // VECTOR_WIDTH) * VECTOR_WIDTH
    return -(-count // max(1, rows)), rows


def map_row_chunks(function: Callable[[Any], Any], rows: Any, chunks: int = 2) -> Any:
    """function over arrays that share their first axis, in chunks of it, at least two.

    The loop keeps what goes in and what comes out in memory: XLA would fuse cheap consumers with dear producers, and
    compute these again for each of the consumers.
    """
    count = jax.tree.leaves(rows)[0].shape[0]
    chunks, size = even_chunks(count, max(2, chunks))
    chunks = max(2, chunks)
    missing = chunks * size - count

    def in_loop(array: Array) -> Array:
        filled = (
            jnp.concatenate([array, jnp.broadcast_to(array[-1:], (missing, *array.shape[1:]))]) if missing else array
        )
        return filled.reshape(chunks, size, *array.shape[1:])

    found = jax.lax.map(function, jax.tree.map(in_loop, rows))
    return jax.tree.map(lambda array: array.reshape(chunks * size, *array.shape[2:])[:count], found)


def map_direction_chunks(function: Callable[..., tuple[Array, ...]], *inputs: Array) -> Array:
    """function over arrays of shape ``(..., 3)`` as components, its results along a new last axis.

    Many pairs run in blocks, which are transposed to components and back (a loop that reads every third number takes
    several times as long as the arithmetic), and these in chunks that stay in the cache. A gradient keeps the
    directions alone and computes each block, and each chunk of it, again on the way back.
    """
    batch = jnp.broadcast_shapes(*(array.shape for array in inputs))[:-1]
    pairs = math.prod(batch)
    chunk = chunk_factor() * CHUNK_BYTES // inputs[0].dtype.itemsize
    if pairs <= 2 * chunk:
        return jnp.stack([jnp.broadcast_to(result, batch) for result in function(*map(split, inputs))], axis=-1)
    flat = [jnp.broadcast_to(array, (*batch, 3)).reshape(pairs, 3) for array in inputs]
    return shard_rows(partial(_map_blocks, function, chunk), flat, least=chunk).reshape(*batch, -1)


def _map_blocks(function: Callable[..., tuple[Array, ...]], chunk: int, flat: list[Array]) -> Array:
    """function over arrays (n, 3), block by block."""
    pairs, size = flat[0].shape[0], BLOCK_CHUNKS * chunk
    whole = pairs // size * size
    run = partial(_map_block, function, chunk)
    parts = []
    if whole:
        blocks = [array[:whole].reshape(-1, size, 3) for array in flat]
        step = jax.checkpoint(lambda _, rows: (None, run(*rows)))
        _, results = jax.lax.scan(step, None, blocks)
        parts.append(results.reshape(whole, -1))
    if whole < pairs:
        left = pairs - whole
        number, even = even_chunks(left, -(-left // chunk))
        # a vector of zeros is no direction: it gives 0
        rest = [jnp.pad(array[whole:], ((0, number * even - left), (0, 0))) for array in flat]
        parts.append(_map_block(function, even, *rest)[:left])
    return jnp.concatenate(parts)


def _map_block(function: Callable[..., tuple[Array, ...]], chunk: int, *rows: Array) -> Array:
    """function over a whole number of chunks, (n, 3) each."""
    vectors = [tuple(array.T.reshape(3, -1, chunk)) for array in jax.lax.optimization_barrier(rows)]
    step = jax.checkpoint(lambda _, vectors: (None, function(*vectors)))
    _, results = jax.lax.scan(step, None, jax.lax.optimization_barrier(vectors))
    together = jax.lax.optimization_barrier(jnp.stack([result.reshape(-1) for result in results]))
    return together.T
