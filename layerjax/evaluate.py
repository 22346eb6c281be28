"""The public way in: evaluate, evaluate_with_error, sample, pdf, albedo, specular, unscattered; `prepare` is beside it.

Everything here is a pure function of arrays, compiled once per structure and shape, and usable inside ``jit``,
``vmap`` and ``grad``. Large batches run in chunks that fit the cache; a chunk is computed again on the way back, so
that a gradient holds no more than one chunk in memory and accumulates as it goes (`layerjax._batching`).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from layerjax import maps
from layerjax._batching import map_direction_chunks
from layerjax._checks import require_choice, require_count, require_key
from layerjax._devices import compile_for_devices
from layerjax._jacobian import differentiate_by_parameters, has_few_parameters
from layerjax._numerics import allow_broadcasting, horizon, safe_div
from layerjax._parameters import cast_arrays
from layerjax._shapes import Shape, channel_count, map_shape, require_single
from layerjax.channels import pick
from layerjax.compiling import is_traced
from layerjax.directions import Vector, horizontal, read_directions, split
from layerjax.mixture import Mixture, require_material
from layerjax.numerical_error import neighbours, numerical_error
from layerjax.preparation import (
    Prepared,
    ensure_prepared,
    ensure_prepared_for_albedo,
    prepare,
    prepare_for_directions,
    resolve_transport,
)
from layerjax.stack import Stack, media_of, optical_depths, require_numbers, simplify
from layerjax.transport import Side, Transport
from layerjax.transport.contract import Draws
from layerjax.transport.known_directions import (
    MOST_COSINES,
    DirectionLookup,
    KnownDirections,
    KnownPairs,
    known_above,
    known_directions,
    separate_cosines,
)
from layerjax.transport.specular import specular_shares


def evaluate(
    stack: Stack | Mixture | Prepared,
    wi: ArrayLike,
    wo: ArrayLike,
    transport: Transport | Literal["auto"] = "auto",
    *,
    side: Side = "all",
    key: Array | None = None,
) -> Array:
    """BSDF in 1/sr, without the cosine.

    Args:
        stack: the layered material, or the result of `prepare` (`transport` is then the one it was prepared for); or a
            map of stacks of shape S (see `Stack`), whose axes broadcast against the last ones of the directions.
        wi: unit directions towards the light, shape ``(..., 3)``, pointing away from the surface. Directions that are
            not of unit length raise an error, except under `jit`, `grad` or `vmap`, where they give wrong values.
        wo: unit directions towards the viewer, shape ``(..., 3)``. Same side as wi: reflection; opposite: transmission.
        transport: see `prepare`.
        side: the pairs that are evaluated: ``"all"``; ``"reflection"``, both above; ``"transmission"``, one above and
            one below. Other pairs give 0 and cost nothing.
        key: a JAX random key, which `RandomWalk` needs and others ignore. The same key gives the same values.

    Returns:
        Values of shape ``broadcast(wi, wo)[:-1] + (C,)``, for a map ``broadcast(S, wi[..., 0], wo[..., 0]) + (C,)``, in
        the floating type of the directions. A direction in the tangent plane gives 0. The resolution of `"auto"` and
        `AddingDoubling` is the same for all texels of a map: that of the texel that needs the finest. `AddingDoubling`
        solves a stack in the precision of its numbers: one made in single precision stays so under directions in
        double precision.
    """
    return evaluate_known(stack, wi, wo, transport, side=side, key=key)


@allow_broadcasting
def evaluate_known(
    stack: Any,
    wi: ArrayLike,
    wo: ArrayLike,
    transport: Any = "auto",
    *,
    side: Side = "all",
    key: Array | None = None,
    known: KnownDirections | None = None,
    pairs: KnownPairs | None = None,
) -> Array:
    """`evaluate` where the directions may be traced, and what they are is known all the same.

    Not public: `known` must be what `known_directions` says of just these directions, or `pairs` what `known_pairs`
    does, which cannot be checked where they are traced; of others the values would be wrong. The cosines are taken from
    them, so that derivatives by them are not complete. Concrete directions are looked at here, and maps look for
    themselves.
    """
    require_choice("side", side, get_args(Side))
    wi, wo = read_directions(wi=wi, wo=wo)
    if known is not None and (known.wi_index.shape, known.wo_index.shape) != (wi.shape[:-1], wo.shape[:-1]):
        raise ValueError(
            f"known: it is of directions of shapes {known.wi_index.shape} and {known.wo_index.shape}, "
            f"wi and wo have {wi.shape[:-1]} and {wo.shape[:-1]}"
        )
    if isinstance(stack, Mixture):
        return _broadcast_parts(stack).mean(
            lambda part, subkey: evaluate_known(
                part, wi, wo, transport, side=side, key=subkey, known=known, pairs=pairs
            ),
            key,
        )
    shape = _shape_of(stack)
    if shape:
        return _evaluate_map(stack, wi, wo, transport, side, key, shape)
    looked = cache(lambda: known_directions(wi, wo) if known is None else known)
    if not isinstance(stack, Prepared) and is_traced(stack) and not is_traced(wi, wo):
        values = math.prod(jnp.broadcast_shapes(wi.shape, wo.shape)[:-1]) * channel_count(stack)
        if has_few_parameters(stack, values):
            require_numbers(stack)
            chosen, simplified = resolve_transport(stack, transport, looked)
            traced = chosen.traceable_equivalent(simplified, looked)
            if traced is not None:
                chosen.resolve_key(key, "evaluate")
                directions = looked() if chosen.uses_known_directions else None
                more = (directions, wi, wo, side, channel_count(stack))
                return differentiate_by_parameters(
                    _evaluate_whole, (simplified, traced, *more), (simplified, chosen, *more)
                )
    prepared = ensure_prepared(stack, transport, wi.dtype, looked)
    if pairs is not None:
        state = prepared.transport.with_known_pairs(prepared.state, cast_arrays(pairs, wi.dtype))
        prepared = replace(prepared, state=state)
    return _evaluate(prepared, wi, wo, side, prepared.transport.resolve_key(key, "evaluate"))[0]


@allow_broadcasting
def evaluate_with_error(
    stack: Stack | Mixture | Prepared,
    wi: ArrayLike,
    wo: ArrayLike,
    transport: Transport | Literal["auto"] = "auto",
    *,
    side: Side = "all",
    key: Array | None = None,
) -> tuple[Array, Array]:
    """BSDF as `evaluate` gives it, and an estimate of its error, of the same shape.

    For `RandomWalk`, which needs a `key`, the error is the standard error of each value. For a transport of finite
    resolution it is the difference to the next coarser and finer resolution, for which the stack itself must be given
    and not a prepared one. Relative to the value, it is at least as large as at neighbouring pairs of directions.

    Raises:
        ValueError: the transport has no error estimate, or a prepared stack is given where other resolutions are
            needed.
    """
    require_choice("side", side, get_args(Side))
    wi, wo = read_directions(wi=wi, wo=wo)
    if _shape_of(stack):
        require_single(stack, "evaluate_with_error")
    if isinstance(stack, Mixture):
        return _mixture_with_error(stack, wi, wo, transport, side, key)
    around = cache(partial(neighbours, wi, wo))  # walks need none
    known = cache(lambda: known_directions(*around()))
    prepared = ensure_prepared(stack, transport, wi.dtype, known)
    key = prepared.transport.resolve_key(key, "evaluate_with_error")
    others = _prepare_comparisons(stack, prepared.transport, known)  # refuses before anything is evaluated
    if others is not None:
        return numerical_error(prepared, cast_arrays(others, wi.dtype), *around(), side)
    values, errors = _evaluate(prepared, wi, wo, side, key)
    assert errors is not None
    return values, errors


@allow_broadcasting
def sample(
    stack: Stack | Mixture | Prepared, wi: ArrayLike, key: Array, transport: Transport | Literal["auto"] = "auto"
) -> tuple[Array, Array, Array]:
    """Draw one outgoing direction for each wi (and each texel of a map of stacks, as in `evaluate`).

    Returns:
        ``wo`` of shape ``(..., 3)``; its density ``pdf`` in 1/sr, shape ``(...)``; and ``weight = f |cos_o| / pdf``
        of shape ``(..., C)``, whose mean is the albedo. Draws without light, for example below an opaque base, have
        weight 0; a draw without a direction is in the tangent plane.

        Smooth surfaces are drawn as in Mitsuba and pbrt: ``wo`` is then exactly the mirror or the refracted direction,
        ``pdf`` the probability of that draw (no density), and ``weight`` the energy of `specular` over it. `evaluate`
        and `pdf` know nothing of the delta there.
    """
    drawn = draw(stack, wi, key, transport)
    return drawn.wo, drawn.density, drawn.weight


@allow_broadcasting
def draw(
    stack: Stack | Mixture | Prepared, wi: ArrayLike, key: Array, transport: Transport | Literal["auto"] = "auto"
) -> Draws:
    """`sample`, and which draws are along a delta. Not public."""
    require_key(key)
    (wi,) = read_directions(wi=wi)
    if isinstance(stack, Mixture):
        return _sample_mixture(stack, wi, key, transport)
    shape = _shape_of(stack)
    if shape:
        mapped, chosen, layout = _resolve_map(stack, transport, shape, wi)
        return maps.draws(mapped, chosen, layout, layout.broadcast(wi), channel_count(stack), key)
    return _sample(ensure_prepared(stack, transport, wi.dtype), wi, key)


@allow_broadcasting
def pdf(
    stack: Stack | Mixture | Prepared, wi: ArrayLike, wo: ArrayLike, transport: Transport | Literal["auto"] = "auto"
) -> Array:
    """Density in solid angle, 1/sr, with which `sample` draws wo for wi; shape ``broadcast(wi, wo)[:-1]``.

    Maps of stacks as in `evaluate`.
    """
    wi, wo = read_directions(wi=wi, wo=wo)
    if isinstance(stack, Mixture):
        return _broadcast_parts(stack).mean(lambda part, _: pdf(part, wi, wo, transport), by_channel=False)
    shape = _shape_of(stack)
    if shape:
        mapped, chosen, layout = _resolve_map(stack, transport, shape, wi, wo)
        return maps.densities(mapped, chosen, layout, (layout.broadcast(wi), layout.broadcast(wo)))
    return _pdf(ensure_prepared(stack, transport, wi.dtype), wi, wo)


@allow_broadcasting
def albedo(
    stack: Stack | Mixture | Prepared,
    wi: ArrayLike,
    transport: Transport | Literal["auto"] = "auto",
    *,
    nodes: int = 32,
    key: Array | None = None,
) -> tuple[Array, Array]:
    """Directional albedo: the shares of light along wi that are reflected and transmitted, ``(..., C)`` each.

    The delta part is not included: see `specular` and, of media alone, `unscattered`. The BSDF is integrated by
    quadrature that is adapted to each lobe, with `nodes` Gauss points per dimension and panel. The error with 32 is
    1e-6 as a rule, and 4e-3 at worst, for grazing light and lobes of alpha 1e-4. `RandomWalk` counts paths instead, and
    needs a `key`.

    Maps of stacks as in `evaluate`.
    """
    require_count("nodes", nodes, 1)
    (wi,) = read_directions(wi=wi)
    if isinstance(stack, Mixture):
        return _broadcast_parts(stack).mean(
            lambda part, subkey: albedo(part, wi, transport, nodes=nodes, key=subkey), key
        )
    shape = _shape_of(stack)
    if shape:
        mapped, chosen, layout = _resolve_map(stack, transport, shape, wi)
        given = chosen.resolve_key(key, "albedo")
        return maps.albedos(mapped, chosen, layout, layout.broadcast(wi), channel_count(stack), nodes, given)
    prepared = ensure_prepared_for_albedo(stack, transport, wi.dtype)
    return _albedo(prepared, wi, nodes, prepared.transport.resolve_key(key, "albedo"))


@allow_broadcasting
def unscattered(stack: Stack | Mixture, wi: ArrayLike) -> Array:
    """Share of radiance along wi that passes the stack without a collision, shape ``(..., C)``.

    This is the delta component of the BSDF of media alone. It is 0 over an opaque base and through interfaces, of which
    smooth ones have `specular`. Maps of stacks as in `evaluate`.
    """
    require_material(stack)
    require_numbers(stack)
    (wi,) = read_directions(wi=wi)
    if isinstance(stack, Mixture):
        return _broadcast_parts(stack).mean(lambda part, _: unscattered(part, wi))
    return _evaluate_deltas(_unscattered, stack, wi)


@allow_broadcasting
def specular(stack: Stack | Mixture, wi: ArrayLike) -> tuple[Array, Array]:
    """Energies of the delta part of the BSDF: what is reflected along the mirror direction, and what is transmitted
    along the refracted one, of light along wi, shape ``(..., C)`` each.

    They hold all reflections to and fro between smooth interfaces, and the attenuation by media, in closed form. They
    are 0 where the first surface that light meets is rough, and beyond any rough surface. Without surfaces the second
    is `unscattered`. Of a lossless stack they and both parts of `albedo` sum to 1. Maps of stacks as in `evaluate`.

    Args:
        stack: the layered material.
        wi: unit directions towards the light, shape ``(..., 3)``; below the horizon it falls on the stack from below.

    Raises:
        ValueError: the stack holds a placeholder, or directions are not of unit length.

    Example:
        >>> import layerjax as lj
        >>> pane = lj.Stack([lj.Interface(ior=1.5), lj.Interface(ior=1.0)])
        >>> reflected, transmitted = lj.specular(pane, lj.direction(0.0, 0.0))
        >>> print(reflected.round(4), transmitted.round(4))
        [0.0769] [0.9231]
    """
    require_material(stack)
    require_numbers(stack)
    (wi,) = read_directions(wi=wi)
    if isinstance(stack, Mixture):
        return _broadcast_parts(stack).mean(lambda part, _: specular(part, wi))
    reflected, transmitted = jnp.split(_evaluate_deltas(_specular, stack, wi), 2, axis=-1)
    return reflected, transmitted


def _evaluate_deltas(function: Callable[[Stack, Array, int], Array], stack: Stack, wi: Array) -> Array:
    """A closed form of a stack, its light and its number of channels; of a map texel by texel."""
    slim, channels, shape = cast_arrays(simplify(stack), wi.dtype), channel_count(stack), map_shape(stack)
    if shape:
        return maps.evaluate_texels(function, slim, maps.layout(shape, wi), wi, channels)
    return function(slim, wi, channels)


def _evaluate_whole(inputs: tuple[Stack, Transport, KnownDirections | None, Array, Array, Side, int]) -> Array:
    stack, transport, known, wi, wo, side, channels = inputs
    prepared = Prepared(transport.prepare_for_directions(stack, lambda: known), transport, channels)
    return _evaluate(cast_arrays(prepared, wi.dtype), wi, wo, side, None)[0]


@compile_for_devices
def _evaluate(prepared: Prepared, wi: Array, wo: Array, side: Side, key: Array | None) -> tuple[Array, Array | None]:
    return prepared.transport.evaluate_batch(prepared.state, wi, wo, side, prepared.channels, key)


@compile_for_devices
def _sample(prepared: Prepared, wi: Array, key: Array) -> Draws:
    return prepared.transport.sample_batch(prepared.state, wi, prepared.channels, key)


@compile_for_devices
def _pdf(prepared: Prepared, wi: Array, wo: Array) -> Array:
    def density(wi: Vector, wo: Vector) -> tuple[Array, ...]:
        return (prepared.transport.pdf(prepared.state, wi, wo),)

    return map_direction_chunks(density, wi, wo)[..., 0]


@compile_for_devices
def _albedo(prepared: Prepared, wi: Array, nodes: int, key: Array | None) -> tuple[Array, Array]:
    return prepared.transport.albedo_batch(prepared.state, wi, prepared.channels, nodes, key)


@compile_for_devices
def _unscattered(stack: Stack, wi: Array, channels: int) -> Array:
    x, y, z = split(wi)
    media = media_of(stack)
    if stack.base is not None or len(media) < len(stack.layers):
        return jnp.zeros((*z.shape, channels), z.dtype)
    visible = jnp.abs(z) > horizon(z.dtype)
    depths = optical_depths(media, (x, y, jnp.where(visible, z, 0.5)))
    totals = [sum((pick(depth, c) for depth in depths), jnp.zeros_like(z)) for c in range(channels)]
    return jnp.stack([jnp.where(visible, jnp.exp(-total), 0.0) for total in totals], axis=-1)


@compile_for_devices
def _specular(stack: Stack, wi: Array, channels: int) -> Array:
    """Reflected and transmitted, (..., 2 channels)."""
    sides = specular_shares(stack, split(wi))
    return jnp.stack([pick(side, c) for side in sides for c in range(channels)], axis=-1)


def _broadcast_parts(mixture: Mixture) -> Mixture:
    require_numbers(mixture)
    return mixture.broadcast_parts(map_shape(mixture))


def _mixture_with_error(
    mixture: Mixture, wi: Array, wo: Array, transport: Any, side: Side, key: Array | None
) -> tuple[Array, Array]:
    """Standard errors of independent walks add in squares, numerical errors as they are."""
    found = mixture.weighted_values(
        lambda part, subkey: evaluate_with_error(part, wi, wo, transport, side=side, key=subkey), key
    )
    values = sum(share * value for share, (value, _) in found)
    errors = jnp.stack(jnp.broadcast_arrays(*(share * error for share, (_, error) in found)))
    return values, jnp.linalg.norm(errors, axis=0) if _is_random(mixture, transport) else jnp.sum(errors, axis=0)


def _is_random(material: Any, transport: Any) -> bool:
    """Whether values are drawn; what is prepared has a transport of its own."""
    if isinstance(material, Mixture):
        return any(_is_random(part, transport) for part in material.parts.values())
    chosen = material.transport if isinstance(material, Prepared) else transport
    return isinstance(chosen, Transport) and chosen.random


def _sample_mixture(mixture: Mixture, wi: Array, key: Array, transport: Any) -> Draws:
    """A draw from every part, of which one is chosen by weight: its density is the mean of all. A delta is its part's
    own: the others that have one there draw it as often as they are chosen."""
    shape = map_shape(mixture)
    mixture = _broadcast_parts(mixture) if shape else prepare(mixture, transport)
    wi = jnp.broadcast_to(wi, (*jnp.broadcast_shapes(shape, wi.shape[:-1]), 3))
    draws, choice, values = jax.random.split(key, 3)
    found = mixture.weighted_values(lambda part, subkey: draw(part, wi, subkey, transport), draws)
    pick = jax.random.uniform(choice, wi.shape[:-1], wi.dtype)
    passed, chosen = found[0]
    share = jnp.broadcast_to(passed, pick.shape)
    for weight, drawn in found[1:]:
        before = pick < passed
        chosen = jax.tree.map(lambda one, other, before=before: _where(before, one, other), chosen, drawn)
        share = jnp.where(before, share, weight)
        passed = passed + weight
    # what a part draws that leaves nowhere must not count as a draw of the others
    wo = jnp.where((chosen.density > 0.0)[..., None], chosen.wo, jnp.stack(horizontal(split(chosen.wo)), axis=-1))
    density = pdf(mixture, wi, wo, transport)
    value = evaluate(mixture, wi, wo, transport, key=values)
    weight = safe_div(value * jnp.abs(wo[..., 2:]), density[..., None])
    along = chosen.specular
    return Draws(
        wo,
        jnp.where(along, (share * chosen.density).astype(density.dtype), density),
        _where(along, chosen.weight, weight),
        along,
    )


def _where(mask: Array, one: Array, other: Array) -> Array:
    """One of two arrays by a mask of their leading axes."""
    return jnp.where(mask[..., None] if one.ndim > mask.ndim else mask, one, other)


def _shape_of(stack: Stack | Mixture | Prepared) -> Shape:
    require_material(stack, Prepared)
    return () if isinstance(stack, Prepared) else map_shape(stack)


def _resolve_map(
    stack: Any, transport: Any, shape: Shape, *directions: Array, known: DirectionLookup = lambda: None
) -> tuple[Stack, Transport, maps.Layout]:
    """A simplified map of stacks in the precision of the directions, its transport, and how these lie over it."""
    layout = maps.layout(shape, *directions)
    chosen, simplified = resolve_transport(stack, transport, known)
    return cast_arrays(simplified, directions[0].dtype), chosen, layout


def _evaluate_map(
    stack: Any, wi: Array, wo: Array, transport: Any, side: Side, key: Array | None, shape: Shape
) -> Array:
    layout = maps.layout(shape, wi, wo)
    directions = layout.broadcast(wi), layout.broadcast(wo)
    pairs = math.prod(layout.outer_axes)
    own_known = not layout.shared and 0 < 2 * pairs <= MOST_COSINES
    first = [w if layout.shared else w[0] for w in directions] if pairs and not layout.empty else None
    known, above = None, own_known and known_above(wi, wo)
    if first is not None:
        known = separate_cosines(first[0], first[1], above) if own_known else known_directions(*first)
    mapped, chosen, _ = _resolve_map(stack, transport, shape, wi, wo, known=lambda: known)
    given, channels = chosen.resolve_key(key, "evaluate"), channel_count(stack)
    if not chosen.uses_known_directions:
        known, own_known = None, False
    own = maps.TexelDirections(own_known, above)
    return maps.values(mapped, chosen, layout, directions, side, channels, given, None if own_known else known, own)


def _prepare_comparisons(
    stack: Stack | Prepared, transport: Transport, known: DirectionLookup
) -> list[Prepared] | None:
    """The stack prepared for the transports of an error estimate; None, if it knows errors itself."""
    others = transport.comparison_transports()
    if others is None:
        return None
    if isinstance(stack, Prepared):
        name = type(transport).__name__
        raise ValueError(f"stack: {name} estimates its error at other resolutions and needs the Stack, not a Prepared")
    return [prepare_for_directions(stack, other, known) for other in others]
