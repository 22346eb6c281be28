"""The public way in: evaluate, evaluate_with_error, sample, pdf, albedo, unscattered, prepare.

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
from layerjax._parameters import in_precision
from layerjax.channels import Channels, pick
from layerjax.directions import UNIT_SLACK, Vector, dot, horizontal, read_directions, select, split
from layerjax.stack import Stack, channel_count, media_of, optical_depths, require_numbers, simplify
from layerjax.transport import Side, Transport
from layerjax.transport.automatic import automatic

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
        transport: how light is carried. ``"auto"``: `SingleScattering` where no `Interface` is, which is exact to the
            first order and costs least; ``Statistical(microfacets="single")`` for one `Interface` over a `Lambertian`
            with media beside it that only absorb, exact but for 5e-3 (where the index steps down and light meets it
            beyond the critical angle, for 5 % of the little that passes) and several times faster than
            `AddingDoubling`, which takes all else.

    Raises:
        ValueError: the stack holds a placeholder, or something that the transport cannot carry (it is named).
    """
    require_numbers(stack)
    chosen = automatic(stack) if transport == "auto" else transport
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
    key: Array | None = None,
) -> Array:
    """BSDF in 1/sr, without the cosine.

    Args:
        stack: the layered material, or what `prepare` made of it (`transport` is then the one it was prepared for).
        wi: unit directions towards the light, shape ``(..., 3)``, pointing away from the surface. Concrete ones that
            are not of unit length are refused; traced ones (under `jit`, `grad`, `vmap`) cannot be, and give wrong
            numbers.
        wo: unit directions towards the viewer, shape ``(..., 3)``. Same side as wi: reflection; opposite: transmission.
        transport: see `prepare`.
        side: which pairs are asked for: ``"all"``; ``"reflection"``, both above; ``"transmission"``, one above and
        one below.
            Other pairs give 0, and what only they need is left out of the program.
        key: a JAX random key, which `RandomWalk` needs and others ignore. The same key gives the same values.

    Returns:
        Values of shape ``broadcast(wi, wo)[:-1] + (C,)`` in the floating type of the directions, the channel axis
        last. A direction in the tangent plane gives 0.
    """
    _check_side(side)
    wi, wo = read_directions(wi=wi, wo=wo)
    prepared = _prepared(stack, transport, wi.dtype)
    if prepared.transport.random:
        return _estimate(prepared, wi, wo, side, _needed(key, "evaluate"))[0]
    return _evaluate(prepared, wi, wo, side)


def evaluate_with_error(
    stack: Stack | Prepared,
    wi: ArrayLike,
    wo: ArrayLike,
    transport: Transport | Literal["auto"] = "auto",
    *,
    side: Side = "all",
    key: Array | None = None,
) -> tuple[Array, Array]:
    """BSDF as `evaluate` gives it, and an estimate of its error, of the same shape.

    For `RandomWalk` (which needs a `key`) that is the standard error of each value; for a transport of finite
    resolution the distance to its value at the next coarser one, for which the stack itself must be given.

    Raises:
        ValueError: the transport has neither, or a prepared stack is given to one that needs a second resolution.
    """
    _check_side(side)
    wi, wo = read_directions(wi=wi, wo=wo)
    prepared = _prepared(stack, transport, wi.dtype)
    if prepared.transport.random:
        return _estimate(prepared, wi, wo, side, _needed(key, "evaluate_with_error"))
    coarser = prepared.transport.coarser()
    name = type(prepared.transport).__name__
    if coarser is None:
        raise ValueError(f"transport: {name} has no resolution to vary and no standard error: evaluate_with_error")
    if isinstance(stack, Prepared):
        raise ValueError(
            f"stack: {name} estimates its error at a second resolution and needs the Stack, not a Prepared"
        )
    values = _evaluate(prepared, wi, wo, side)
    return values, jnp.abs(values - _evaluate(_prepared(stack, coarser, wi.dtype), wi, wo, side))


def sample(
    stack: Stack | Prepared, wi: ArrayLike, key: Array, transport: Transport | Literal["auto"] = "auto"
) -> tuple[Array, Array, Array]:
    """Draw one outgoing direction for each wi.

    Returns:
        ``wo`` of shape ``(..., 3)``; its density ``pdf`` in 1/sr, shape ``(...)``; and ``weight = f |cos_o| / pdf``
        of shape ``(..., C)``, whose mean is the albedo. Draws that leave no light (below an opaque base, say) have
        weight 0, and a direction in the tangent plane if they have none.
    """
    (wi,) = read_directions(wi=wi)
    return _sample(_prepared(stack, transport, wi.dtype), wi, key)


def pdf(
    stack: Stack | Prepared, wi: ArrayLike, wo: ArrayLike, transport: Transport | Literal["auto"] = "auto"
) -> Array:
    """Density in solid angle, 1/sr, with which `sample` draws wo for wi; shape ``broadcast(wi, wo)[:-1]``."""
    wi, wo = read_directions(wi=wi, wo=wo)
    return _pdf(_prepared(stack, transport, wi.dtype), wi, wo)


def albedo(
    stack: Stack | Prepared,
    wi: ArrayLike,
    transport: Transport | Literal["auto"] = "auto",
    *,
    nodes: int = 32,
    key: Array | None = None,
) -> tuple[Array, Array]:
    """Directional albedo: the shares of light along wi scattered to wi's own side and to the other, ``(..., C)`` each.

    The part that passes without scattering is not in it (see `unscattered`). By quadrature adapted to every lobe, with
    `nodes` Gauss points a dimension and panel: 32 give 1e-6 as a rule, and 4e-3 at worst over the documented box, where
    light grazes lobes of alpha 1e-4. `RandomWalk` follows light instead of that, and needs a `key`.
    """
    (wi,) = read_directions(wi=wi)
    prepared = _prepared(stack, transport, wi.dtype)
    if prepared.transport.random:
        return _estimate_albedo(prepared, wi, _needed(key, "albedo"))
    return _albedo(prepared, wi, nodes)


def unscattered(stack: Stack, wi: ArrayLike) -> Array:
    """Share of radiance along wi that passes straight through the stack without a collision, shape ``(..., C)``.

    The delta part of the BSDF: 0 over an opaque base and through rough interfaces.
    """
    require_numbers(stack)
    (wi,) = read_directions(wi=wi)
    return _unscattered(in_precision(simplify(stack), wi.dtype), wi, channel_count(stack))


@eqx.filter_jit
def _evaluate(prepared: Prepared, wi: Array, wo: Array, side: Side) -> Array:
    def values(wi: Vector, wo: Vector) -> Channels:
        channels = prepared.transport.evaluate(prepared.state, wi, wo, side)
        return tuple(pick(channels, c) for c in range(prepared.channels))

    return _in_chunks(values, wi, wo)


@eqx.filter_jit
def _estimate(prepared: Prepared, wi: Array, wo: Array, side: Side, key: Array) -> tuple[Array, Array]:
    batch = jnp.broadcast_shapes(wi.shape, wo.shape)[:-1]
    if 0 in batch:
        return (jnp.zeros((*batch, prepared.channels), wi.dtype),) * 2
    pairs = (jnp.broadcast_to(w, (*batch, 3)).reshape(-1, 3) for w in (wi, wo))
    i, o = map(split, pairs)
    values, errors = prepared.transport.estimate(prepared.state, i, o, side, prepared.channels, key)
    return values.reshape(*batch, -1), errors.reshape(*batch, -1)


@eqx.filter_jit
def _estimate_albedo(prepared: Prepared, wi: Array, key: Array) -> tuple[Array, Array]:
    if 0 in wi.shape:
        return (jnp.zeros((*wi.shape[:-1], prepared.channels), wi.dtype),) * 2
    values, _ = prepared.transport.estimate_albedo(prepared.state, split(wi.reshape(-1, 3)), prepared.channels, key)
    near, far = jnp.split(values, 2, axis=-1)
    return near.reshape(*wi.shape[:-1], -1), far.reshape(*wi.shape[:-1], -1)


@eqx.filter_jit
def _sample(prepared: Prepared, wi: Array, key: Array) -> tuple[Array, Array, Array]:
    transport, state = prepared.transport, prepared.state

    def draw(wi: Vector, uniforms: Vector) -> tuple[Array, ...]:
        drawn = transport.sample(state, wi, uniforms)
        # what leaves nowhere may be no unit vector: it becomes a direction in the tangent plane, where the BSDF is 0
        left = jnp.abs(dot(drawn, drawn) - 1.0) < UNIT_SLACK
        wo = select(left, drawn, horizontal(drawn))
        density = jnp.where(left, transport.pdf(state, wi, wo), 0.0)
        if transport.random:
            return (*wo, density)
        values = transport.evaluate(state, wi, wo, "all")
        weights = [safe_div(pick(values, c) * jnp.abs(wo[2]), density) for c in range(prepared.channels)]
        return (*wo, density, *weights)

    uniforms = jax.random.uniform(key, wi.shape, dtype=wi.dtype)
    drawn = _in_chunks(draw, wi, uniforms)
    wo, density, weights = drawn[..., :3], drawn[..., 3], drawn[..., 4:]
    if transport.random:
        values, _ = _estimate(prepared, wi, wo, "all", jax.random.fold_in(key, 1))
        weights = safe_div(values * jnp.abs(wo[..., 2:]), density[..., None])
    return wo, density, weights


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
    if 0 in batch:
        return (jnp.zeros((*batch, prepared.channels), wi.dtype),) * 2
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
        left = pairs - whole
        number = -(-left // chunk)
        even = -(-left // number)
        # a vector of zeros is no direction: it gives 0
        rest = [jnp.pad(array[whole:], ((0, number * even - left), (0, 0))) for array in flat]
        parts.append(_block(function, even, *rest)[:left])
    return jnp.concatenate(parts).reshape(*batch, -1)


def _block(function: Callable[..., tuple[Array, ...]], chunk: int, *rows: Array) -> Array:
    """function over a whole number of chunks, (n, 3) each."""
    vectors = [tuple(array.T.reshape(3, -1, chunk)) for array in jax.lax.optimization_barrier(rows)]
    step = jax.checkpoint(lambda _, vectors: (None, function(*vectors)))
    _, results = jax.lax.scan(step, None, jax.lax.optimization_barrier(vectors))
    together = jax.lax.optimization_barrier(jnp.stack([result.reshape(-1) for result in results]))
    return together.T


def _check_side(side: Side) -> None:
    if side not in get_args(Side):
        raise ValueError(f"side: {side!r} is not one of {', '.join(map(repr, get_args(Side)))}")


def _needed(key: Array | None, function: str) -> Array:
    if key is None:
        raise ValueError(f"key: RandomWalk draws random numbers: {function}(..., key=jax.random.key(seed))")
    return key


def _prepared(stack: Stack | Prepared, transport: Any, dtype: jnp.dtype) -> Prepared:
    prepared = stack if isinstance(stack, Prepared) else prepare(stack, transport)
    return in_precision(prepared, dtype)
