"""A surface that is partly one material and partly another, as the eye or an instrument sees it: a mean by area."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from html import escape
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._checks import abbreviate, require_key
from layerjax._diagram import diagram_column
from layerjax._parameters import RANGES, Parameter, as_floating, check_range, is_placeholder
from layerjax._repr import ReprModule, format_value
from layerjax._shapes import Shape, axes_of_map, channel_count, map_shape
from layerjax.stack import Interface, Medium, Stack, TurbidMedium
from layerjax.surfaces import Surface

WEIGHTS = "Mixture.weights"
RANGES[WEIGHTS] = (0.0, 1.0)
_PARTS = "Mixture.parts"

SUM_SLACK = 1e-6
"""How far the sum of weights may be from 1: files round them."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_RESERVED = ("weights", "parts", "layers", "base", "scale", "noise")


class Mixture(ReprModule):
    """Stacks side by side, each covering a share of the area; no light passes from one to another.

    A mixture can be used wherever a `Stack` can. Its BSDF, albedo and ballistic transmission are the weighted means of
    those of its parts. To sample a direction, a part is drawn by its weight; the density is that of the mixture.

    Args:
        parts: stacks or mixtures by name; names begin with a letter and hold letters, digits, ``-`` and ``_``.
        weights: shares of the area in [0, 1] that sum to 1, by name or in the order of the parts. One may be None: the
            rest of the area. Each has shape (), or that of a map.

    Raises:
        ValueError: names or weights are missing or invalid, weights do not sum to 1, a weight is free and none is None,
            or parts disagree on channels or the shape of a map.
    """

    parts: dict[str, Any]
    weights: dict[str, Parameter]

    def __init__(self, parts: Mapping[str, "Stack | Mixture"], weights: Sequence[Parameter] | Mapping[str, Parameter]):
        if not isinstance(parts, Mapping):
            raise ValueError(f"{_PARTS}: {abbreviate(parts)} is not a dictionary of stacks by name")
        if not isinstance(weights, Mapping | Sequence | np.ndarray | jax.Array) or isinstance(weights, str):
            raise ValueError(
                f"{WEIGHTS}: {abbreviate(weights)} is not a list of shares, nor a dictionary of them by name"
            )
        for name in parts:
            if not (isinstance(name, str) and _NAME.fullmatch(name)) or name in _RESERVED:
                raise ValueError(
                    f"{_PARTS}: {name!r} is no name; it must be letters, digits, - and _, a letter first, and not "
                    f"one of {', '.join(_RESERVED)}"
                )
        self.parts = dict(parts)
        self.weights = {name: _weight(name, value) for name, value in _by_name(parts, weights).items()}

    def __check_init__(self) -> None:
        for name, part in self.parts.items():
            if not isinstance(part, Stack | Mixture):
                raise ValueError(f"{_PARTS}[{name!r}]: {abbreviate(part)} is not a Stack or a Mixture")
        _check_sum(self.weights)
        channel_count(self)

    @property
    def channels(self) -> int:
        """Number of channels C of the values."""
        return channel_count(self)

    def _repr_html_(self) -> str:
        heads = [f"{name}: {_share_words(self.weights[name])}" for name in self.parts]
        shown = [
            part._repr_html_() if hasattr(part, "_repr_html_") else escape(repr(part)) for part in self.parts.values()
        ]
        return diagram_column(list(zip(heads, shown, strict=True)))

    def shares(self) -> dict[str, Array]:
        """Weights by name, that which is None worked out."""
        rest = 1.0 - sum(weight for weight in self.weights.values() if weight is not None)
        return {name: jnp.asarray(rest if weight is None else weight) for name, weight in self.weights.items()}

    def map_parts(self, function: Callable[[Any], Any]) -> "Mixture":
        """The same mixture of function(part) for every part."""
        found = {name: function(part) for name, part in self.parts.items()}
        return eqx.tree_at(lambda mixture: mixture.parts, self, found)

    def weighted_values(self, function: Callable[[Any, Any], Any], key: Array | None = None) -> list[tuple[Array, Any]]:
        """The weight of every part, and function(part, its own key) of it; without a key each has None.

        By name, as they are within transformations: there, too, a key is that of the same part.
        """
        if key is not None:
            require_key(key)
        keys = [None] * len(self.parts) if key is None else [*jax.random.split(key, len(self.parts))]
        shares = self.shares()
        return [(shares[name], function(self.parts[name], own)) for name, own in zip(sorted(shares), keys, strict=True)]

    def mean(self, function: Callable[[Any, Any], Any], key: Array | None = None, by_channel: bool = True) -> Any:
        """Arrays of function(part, key), weighted and summed; by_channel: their last axis counts channels."""

        def times(share: Array, value: Array) -> Array:
            share = share.astype(value.dtype)
            return (share[..., None] if by_channel else share) * value

        found = [jax.tree.map(partial(times, share), value) for share, value in self.weighted_values(function, key)]
        return jax.tree.map(lambda *values: sum(values[1:], values[0]), *found)

    def broadcast_parts(self, shape: Shape) -> "Mixture":
        """The same with parts that are maps of exactly this shape, or single stacks."""
        return self.map_parts(
            lambda part: part.broadcast_parts(shape) if isinstance(part, Mixture) else _broadcast_part(part, shape)
        )


def require_material(stack: object, *others: type) -> None:
    """Refuse what is neither a `Stack` nor a `Mixture`, nor of these other types, and say what it should stand in."""
    if isinstance(stack, (Stack, Mixture, *others)):
        return
    kinds = " or a ".join(kind.__name__ for kind in (Stack, Mixture, *others))
    hint = ""
    if isinstance(stack, Surface):
        hint = "; a surface alone is Stack([], base=surface)"
    elif isinstance(stack, Interface | Medium | TurbidMedium):
        hint = "; a layer alone is Stack([layer])"
    raise ValueError(f"stack: {abbreviate(stack)} is not a {kinds}{hint}")


def stacks_of(material: Stack | Mixture) -> list[Stack]:
    """The stacks that a material is made of; itself, if it is one."""
    return list(stacks_by_name(material).values())


def stacks_by_name(material: Stack | Mixture, prefix: str = "") -> dict[str, Stack]:
    """The stacks that a material is made of, by what names of their numbers begin with, such as ``coat.``."""
    if not isinstance(material, Mixture):
        return {prefix: material}
    stacks: dict[str, Stack] = {}
    for name, part in material.parts.items():
        stacks |= stacks_by_name(part, f"{prefix}{name}.")
    return stacks


def _by_name(parts: Mapping[str, Any], weights: Any) -> dict[str, Any]:
    if isinstance(weights, Mapping):
        if set(weights) != set(parts):
            raise ValueError(f"{WEIGHTS} are of {', '.join(weights)}; they must be of {', '.join(parts)}")
        return {name: weights[name] for name in parts}
    given = list(weights)
    if len(given) != len(parts) or not given:
        raise ValueError(f"{WEIGHTS}: {len(given)} given for {len(parts)} parts; each part must have one")
    return dict(zip(parts, given, strict=True))


def _share_words(weight: Any) -> str:
    return "the rest of the area" if weight is None else f"{format_value(weight, 4)} of the area"


def _weight(name: str, value: Any) -> Any:
    if value is None or is_placeholder(value):
        return value
    array = as_floating(f"{WEIGHTS}[{name!r}]", value)
    try:
        check_range(WEIGHTS, array)
    except ValueError as error:
        raise ValueError(str(error).replace(WEIGHTS, f"{WEIGHTS}[{name!r}]", 1)) from None
    return array


def _check_sum(weights: Mapping[str, Any]) -> None:
    given = [weight for weight in weights.values() if weight is not None]
    rest = len(weights) - len(given)
    if rest > 1:
        raise ValueError(f"{WEIGHTS}: {rest} are None; at most one may be, which covers the rest")
    if any(map(is_placeholder, given)):
        if not rest:
            raise ValueError(f"{WEIGHTS}: one has to be free of choice: None, which covers the rest")
        return
    if any(isinstance(weight, jax.core.Tracer) for weight in given):
        return
    totals = np.asarray(sum(np.asarray(weight, np.float64) for weight in given))
    wrong = totals > 1.0 + SUM_SLACK if rest else np.abs(totals - 1.0) > SUM_SLACK
    if wrong.any():
        must = "at most 1, with one that is None" if rest else "1"
        raise ValueError(f"{WEIGHTS} sum to {float(totals[wrong].ravel()[0]):g}; they must sum to {must}")


def _broadcast_part(part: Any, shape: Shape) -> Any:
    """A map with its numbers broadcast to this shape; a single stack, or one that is prepared, as it is."""
    if not isinstance(part, Stack) or map_shape(part) in ((), shape):
        return part
    own = map_shape(part)

    def broadcast(leaf: Any, is_mapped: bool) -> Any:
        return jnp.broadcast_to(leaf, (*shape, *leaf.shape[len(own) :])) if is_mapped else leaf

    return jax.tree.map(broadcast, part, axes_of_map(part, own))
