"""The public way in: evaluate, sample, pdf, albedo, unscattered, prepare.

Everything here is a pure function of arrays, compiled once per structure and shape, and usable inside ``jit``,
``vmap`` and ``grad``. Large batches run in chunks that fit the cache; a chunk is computed again on the way back, so
that a gradient holds no more than one chunk in memory and accumulates as it goes.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from layerjax._numerics import horizon, safe_div
from layerjax.channels import Channels, pick
from layerjax.directions import Vector, split
from layerjax.stack import Stack, channel_count, media_of, optical_depths, require_numbers, simplify
from layerjax.transport import Side, SingleScattering, Transport

CHUNK_BYTES = 20_000
"""Size of one component of a chunk: 5,000 pairs in float32, 2,500 in float64."""

BLOCK_CHUNKS = 4
"""Chunks that are transposed together."""


class Prepared(eqx.Module):
    """A stack made ready for a transport by `prepare`: `evaluate`, `sample`, `pdf` and `albedo` take it for a stack."""

    state: Any
    transport: Transport
    channels: int = eqx.field(static=True)


def prepare(stack: Stack, transport: Transport | Literal["auto"] = "auto") -> Prepared:
    """Do all the work that no direction is needed for, once.

    Args:
        stack: the layered material.
        transport: how light is carried. ``"auto"``: `SingleScattering`, the only transport of this version.

    Raises:
        ValueError: the stack holds a placeholder, or something that the transport cannot carry (it is named).
    """
    require_numbers(stack)
    chosen = SingleScattering() if transport == "auto" else transport
    if not isinstance(chosen, Transport):
        raise ValueError(f'transport: {transport!r} is not a Transport or "auto"')
    chosen.check(stack)
    return Prepared(chosen.prepare(stack), chosen, channel_count(stack))


def evaluate(
    stack: Stack | Prepared,
    wi: ArrayLike,
    wo: ArrayLike,
    transport: Transport | Literal["auto"] = "auto",
    *,
    side: Side = "all",
) -> Array:
    """BSDF in 1/sr, without the cosine.

    Args:
        stack: the layered material, or what `prepare` made of it (`transport` is then the one it was prepared for).
        wi: unit directions towards the light, shape ``(..., 3)``, pointing away from the surface.
        wo: unit directions towards the viewer, shape ``(..., 3)``. Same side as wi: reflection; opposite: transmission.
        transport: see `prepare`.
        side: which pairs are asked for: ``"all"``; ``"reflection"``, both above; ``"transmission"``, one above and
        one below.
            Other pairs give 0, and what only they need is left out of the program.

    Returns:
        Values of shape ``broadcast(wi, wo)[:-1] + (C,)`` in the floating type of the directions, the channel axis
        last. A direction in the tangent plane gives 0.
    """
    if side not in get_args(Side):
        raise ValueError(f"side: {side!r} is not one of {', '.join(map(repr, get_args(Side)))}")
    wi, wo = _directions(wi=wi, wo=wo)
    return _evaluate(_prepared(stack, transport, wi.dtype), wi, wo, side)


def sample(
    stack: Stack | Prepared, wi: ArrayLike, key: Array, transport: Transport | Literal["auto"] = "auto"
) -> tuple[Array, Array, Array]:
    """Draw one outgoing direction for each wi.

    Returns:
        ``wo`` of shape ``(..., 3)``; its density ``pdf`` in 1/sr, shape ``(...)``; and ``weight = f |cos_o| / pdf``
        of shape ``(..., C)``, whose mean is the albedo. Draws that leave no light (below an opaque base, say) have
        weight 0.
    """
    (wi,) = _directions(wi=wi)
    return _sample(_prepared(stack, transport, wi.dtype), wi, key)


def pdf(
    stack: Stack | Prepared, wi: ArrayLike, wo: ArrayLike, transport: Transport | Literal["auto"] = "auto"
) -> Array:
    """Density in solid angle, 1/sr, with which `sample` draws wo for wi; shape ``broadcast(wi, wo)[:-1]``."""
    wi, wo = _directions(wi=wi, wo=wo)
    return _pdf(_prepared(stack, transport, wi.dtype), wi, wo)


def albedo(
    stack: Stack | Prepared,
    wi: ArrayLike,
    transport: Transport | Literal["auto"] = "auto",
    *,
    nodes: int = 32,
) -> tuple[Array, Array]:
    """Directional albedo: the shares of light along wi scattered to wi's own side and to the other, ``(..., C)`` each.

    The part that passes without scattering is not in it (see `unscattered`). By quadrature adapted to every lobe, with
    `nodes` Gauss points a dimension and panel: 32 give 1e-6 as a rule, and 4e-3 at worst over the documented box, where
    light grazes lobes of alpha 1e-4.
    """
    (wi,) = _directions(wi=wi)
    return _albedo(_prepared(stack, transport, wi.dtype), wi, nodes)


def unscattered(stack: Stack, wi: ArrayLike) -> Array:
    """Share of radiance along wi that passes straight through the stack without a collision, shape ``(..., C)``.

    The delta part of the BSDF: 0 over an opaque base and through rough interfaces.
    """
    require_numbers(stack)
    (wi,) = _directions(wi=wi)
    return _unscattered(_cast(simplify(stack), wi.dtype), wi, channel_count(stack))


@eqx.filter_jit
def _evaluate(prepared: Prepared, wi: Array, wo: Array, side: Side) -> Array:
    def values(wi: Vector, wo: Vector) -> Channels:
        channels = prepared.transport.evaluate(prepared.state, wi, wo, side)
        return tuple(pick(channels, c) for c in range(prepared.channels))

    return _in_chunks(values, wi, wo)


@eqx.filter_jit
def _sample(prepared: Prepared, wi: Array, key: Array) -> tuple[Array, Array, Array]:
    transport, state = prepared.transport, prepared.state

    def draw(wi: Vector, uniforms: Vector) -> tuple[Array, ...]:
        wo = transport.sample(state, wi, uniforms)
        density = transport.pdf(state, wi, wo)
        values = transport.evaluate(state, wi, wo, "all")
        weights = [safe_div(pick(values, c) * jnp.abs(wo[2]), density) for c in range(prepared.channels)]
        return (*wo, density, *weights)

    uniforms = jax.random.uniform(key, wi.shape, dtype=wi.dtype)
    drawn = _in_chunks(draw, wi, uniforms)
    return drawn[..., :3], drawn[..., 3], drawn[..., 4:]


@eqx.filter_jit
def _pdf(prepared: Prepared, wi: Array, wo: Array) -> Array:
    def density(wi: Vector, wo: Vector) -> tuple[Array, ...]:
        return (prepared.transport.pdf(prepared.state, wi, wo),)

    return _in_chunks(density, wi, wo)[..., 0]


@eqx.filter_jit
def _albedo(prepared: Prepared, wi: Array, nodes: int) -> tuple[Array, Array]:
    def one(wi: Array) -> tuple[Array, Array]:
        energies = prepared.transport.albedo(prepared.state, split(wi), nodes)
        near, far = (jnp.stack([pick(e, c) for c in range(prepared.channels)], axis=-1) for e in energies)
        return near, far

    batch = wi.shape[:-1]
    near, far = jax.lax.map(one, wi.reshape(-1, 3))
    return near.reshape(*batch, -1), far.reshape(*batch, -1)


@eqx.filter_jit
def _unscattered(stack: Stack, wi: Array, channels: int) -> Array:
    x, y, z = split(wi)
    media = media_of(stack)
    if stack.base is not None or len(media) < len(stack.layers):
        return jnp.zeros((*z.shape, channels), z.dtype)
    visible = jnp.abs(z) > horizon(z.dtype)
    depths = optical_depths(media, (x, y, jnp.where(visible, z, 0.5)))
    totals = [sum((pick(depth, c) for depth in depths), jnp.zeros_like(z)) for c in range(channels)]
    return jnp.stack([jnp.where(visible, jnp.exp(-total), 0.0) for total in totals], axis=-1)


def _in_chunks(function: Callable[..., tuple[Array, ...]], *inputs: Array) -> Array:
    """function over arrays of shape ``(..., 3)`` as components, its results along a new last axis.

    Many pairs run in blocks, which are transposed to components and back (a loop that reads every third number takes
    several times as long as the arithmetic), and these in chunks that stay in the cache. A gradient keeps the
    directions alone and computes each block, and each chunk of it, again on the way back.
    """
    batch = jnp.broadcast_shapes(*(array.shape for array in inputs))[:-1]
    pairs = math.prod(batch)
    chunk = CHUNK_BYTES // inputs[0].dtype.itemsize
    if pairs <= 2 * chunk:
        return jnp.stack([jnp.broadcast_to(result, batch) for result in function(*map(split, inputs))], axis=-1)
    flat = [jnp.broadcast_to(array, (*batch, 3)).reshape(pairs, 3) for array in inputs]
    size = BLOCK_CHUNKS * chunk
    whole = pairs // size * size
    run = partial(_block, function, chunk)
    parts = []
    if whole:
        blocks = [array[:whole].reshape(-1, size, 3) for array in flat]
        step = jax.checkpoint(lambda _, rows: (None, run(*rows)))
        _, results = jax.lax.scan(step, None, blocks)
        parts.append(results.reshape(whole, -1))
    if whole < pairs:
        missing = -(pairs - whole) % chunk  # a vector of zeros is no direction: it gives 0
        rest = [jnp.pad(array[whole:], ((0, missing), (0, 0))) for array in flat]
        parts.append(run(*rest)[: pairs - whole])
    return jnp.concatenate(parts).reshape(*batch, -1)


def _block(function: Callable[..., tuple[Array, ...]], chunk: int, *rows: Array) -> Array:
    """function over a whole number of chunks, (n, 3) each."""
    vectors = [tuple(array.T.reshape(3, -1, chunk)) for array in jax.lax.optimization_barrier(rows)]
    step = jax.checkpoint(lambda _, vectors: (None, function(*vectors)))
    _, results = jax.lax.scan(step, None, jax.lax.optimization_barrier(vectors))
    together = jax.lax.optimization_barrier(jnp.stack([result.reshape(-1) for result in results]))
    return together.T


def _prepared(stack: Stack | Prepared, transport: Any, dtype: jnp.dtype) -> Prepared:
    prepared = stack if isinstance(stack, Prepared) else prepare(stack, transport)
    return _cast(prepared, dtype)


def _cast(tree: Any, dtype: jnp.dtype) -> Any:
    """Arrays of the tree in the floating type of the directions, which decide the precision of the computation."""
    cast = partial(jax.lax.convert_element_type, new_dtype=dtype)
    return jax.tree.map(lambda leaf: cast(leaf) if eqx.is_inexact_array(leaf) and leaf.dtype != dtype else leaf, tree)


def _directions(**named: ArrayLike) -> list[Array]:
    arrays = []
    for name, value in named.items():
        array = jnp.asarray(value)
        if array.ndim < 1 or array.shape[-1] != 3:
            raise ValueError(f"{name}: shape {array.shape} given, (..., 3) needed")
        arrays.append(array)
    dtype = jnp.result_type(*arrays)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    return [array.astype(dtype) for array in arrays]
