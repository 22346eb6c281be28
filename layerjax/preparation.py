"""Preparation of a stack: everything that does not depend on direction, and the choice of the transport."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Literal, overload

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from layerjax import transport as transports
from layerjax._checks import abbreviate
from layerjax._numerics import allow_broadcasting
from layerjax._parameters import cast_arrays
from layerjax._shapes import channel_count, require_single
from layerjax.directions import read_directions
from layerjax.mixture import Mixture, require_material, stacks_of
from layerjax.stack import Stack, require_numbers, simplify_and_name
from layerjax.transport import Transport
from layerjax.transport.adding_doubling import AddingDoubling
from layerjax.transport.automatic import automatic
from layerjax.transport.known_directions import DirectionLookup, KnownDirections, known_directions


class Prepared(eqx.Module):
    """A stack made ready for a transport by `prepare`: `evaluate`, `sample`, `pdf` and `albedo` take it for a stack."""

    state: Any
    transport: Transport
    channels: int = eqx.field(static=True)


@overload
def prepare(stack: Stack, transport: Transport | Literal["auto"] = "auto") -> Prepared: ...
@overload
def prepare(stack: Mixture, transport: Transport | Literal["auto"] = "auto") -> Mixture: ...
@allow_broadcasting
def prepare(stack: Stack | Mixture, transport: Transport | Literal["auto"] = "auto") -> Prepared | Mixture:
    """Precompute everything that does not depend on direction.

    Args:
        stack: the layered material. Of a mixture, each part is prepared, and a mixture of prepared parts is returned.
        transport: the light transport model. ``"auto"`` includes all orders of scattering: it is `SingleScattering` for
            a base (no mirror) under media that are known to absorb only, where it is exact, and `AddingDoubling` for
            all others.

    Raises:
        ValueError: the stack holds a placeholder, or a layer or base that the transport does not support.
    """
    require_material(stack)
    if isinstance(stack, Mixture):
        return stack.map_parts(lambda part: part if isinstance(part, Prepared) else prepare(part, transport))
    return prepare_for_directions(stack, transport, lambda: None)


def choose_transport(
    stack: Stack | Mixture,
    wi: ArrayLike | None = None,
    wo: ArrayLike | None = None,
    transport: Transport | Literal["auto"] = "auto",
) -> Transport:
    """The transport that `evaluate` uses, with its resolution: what `"auto"` and `AddingDoubling` leave to the stack.

    Call it outside of ``jit``, and pass the result to `evaluate` inside, where the values of parameters are not known
    and narrow lobes have to be assumed::

        transport = lj.choose_transport(stack, wi, wo)
        fast = jax.jit(lambda stack: lj.evaluate(stack, wi, wo, transport))

    Args:
        stack: the layered material; traced parameters count as not known. For a mixture, the transport supports all
            parts, at the finest resolution that one of them needs.
        wi, wo: the directions, as in `evaluate`. None: many, or not known.
        transport: see `prepare`.

    Raises:
        ValueError: as `prepare`.
    """
    if (wi is None) != (wo is None):
        raise ValueError("wi, wo: both directions are needed, or none of them")
    if wi is None or wo is None:
        return transport_for(stack, transport, None)
    return transport_for(stack, transport, known_directions(*read_directions(wi=wi, wo=wo)))


@allow_broadcasting
def transport_for(stack: Stack | Mixture, transport: Any, known: KnownDirections | None) -> Transport:
    """`choose_transport` for directions of which this is known; None: they are many, or not known."""
    require_material(stack)
    found = [resolve_transport(part, transport, lambda: known)[0] for part in stacks_of(stack)]
    solvers = [one for one in found if isinstance(one, AddingDoubling)]
    return _finest(solvers) if solvers else found[0]


def ensure_prepared(
    stack: Stack | Prepared, transport: Any, dtype: jnp.dtype, known: DirectionLookup = lambda: None
) -> Prepared:
    """A stack, prepared or not, for directions of this floating type, of which this is known."""
    prepared = stack if isinstance(stack, Prepared) else prepare_for_directions(stack, transport, known)
    return cast_arrays(prepared, dtype)


def ensure_prepared_for_albedo(stack: Stack | Prepared, transport: Any, dtype: jnp.dtype) -> Prepared:
    """A stack, prepared or not, for its albedo along directions of this floating type."""
    if not isinstance(stack, Prepared):
        require_single(stack, "prepare")
        chosen, simplified = resolve_transport(stack, transport, None)
        stack = Prepared(chosen.prepare_for_albedo(simplified), chosen, channel_count(stack))
    return cast_arrays(stack, dtype)


def prepare_for_directions(stack: Stack, transport: Any, known: DirectionLookup) -> Prepared:
    """`prepare` for values at directions of which this is known."""
    known = cache(known)
    require_single(stack, "prepare")
    chosen, simplified = resolve_transport(stack, transport, known)
    return Prepared(chosen.prepare_for_directions(simplified, known), chosen, channel_count(stack))


def resolve_transport(stack: Stack, transport: Any, known: DirectionLookup | None) -> tuple[Transport, Stack]:
    """The transport with nothing left open, and the simplified stack; known is None: for energies."""
    require_numbers(stack)
    simplified, names = simplify_and_name(stack)
    chosen = automatic(stack, simplified) if isinstance(transport, str) and transport == "auto" else transport
    if not isinstance(chosen, Transport):
        raise ValueError(f'transport: {abbreviate(transport)} is not a Transport or "auto"{_suggestion(transport)}')
    chosen.check(simplified, names)
    chosen = (
        chosen.resolve_options_for_albedo(simplified) if known is None else chosen.resolve_options(simplified, known)
    )
    return chosen, simplified


def _suggestion(transport: object) -> str:
    """The call that makes the transport which a class or a word names."""
    named = getattr(transports, transport, None) if isinstance(transport, str) else transport
    return f"; {named.__name__}() is one" if isinstance(named, type) and issubclass(named, Transport) else ""


def _finest(transports: Sequence[AddingDoubling]) -> AddingDoubling:
    """As fine in each dimension as the finest of them."""
    cosines = [one.ordinates or (0, 0) for one in transports]
    return replace(
        transports[0],
        nodes=max(one.nodes or 0 for one in transports),
        modes=max(one.modes or 0 for one in transports),
        ordinates=(max(first for first, _ in cosines), max(second for _, second in cosines)),
    )
