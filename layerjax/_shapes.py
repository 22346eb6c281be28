"""What the shapes of a stack's numbers mean: one for all, one a channel, or one a texel of a map of stacks.

A map of shape S, ``(N,)`` or ``(H, W)``, is a stack some of whose numbers differ from texel to texel. In a map

- a number has shape S, or () if all texels share it;
- one that may differ by channel (`layerjax._parameters.PER_CHANNEL`) has its channels behind, ``S + (C,)`` or
  ``S + (1,)``; () and (C,) serve all texels;
- a vector has shape ``S + (3,)``, or (3,).

Axes of S may be 1 where all along them share a number. So a number a channel with a single axis always counts channels:
``Medium(thickness=(N,))`` alone is a stack of N channels, and where (N,) is the shape of the map as well it is refused.
So is (N, N) where no other number tells texels from channels.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from layerjax._parameters import PER_CHANNEL, RANGES, VECTORS, is_placeholder, leaves_with_names

Shape = tuple[int, ...]


class Number(NamedTuple):
    """A number of a stack: its name, its shape, and how many axes of that are not the map's.

    by_channel: it may differ from channel to channel; `channel_axes` is then 0 or 1.
    """

    name: str
    shape: Shape
    channel_axes: int
    by_channel: bool

    @property
    def map_axes(self) -> int:
        """Axes of the map."""
        return len(self.shape) - self.channel_axes


def numbers_of(stack: Any) -> Iterator[Number]:
    """Every number of a stack that has a value; what phase functions hold besides is the same for all texels.

    Of a mixture those of its parts, and their weights.
    """
    if hasattr(stack, "parts"):
        for name, part in stack.parts.items():
            for number in numbers_of(part):
                yield number._replace(name=f"{name}.{number.name}")
            if hasattr(stack.weights[name], "shape") and not is_placeholder(stack.weights[name]):
                yield Number(f"weights.{name}", stack.weights[name].shape, 0, False)
        return
    if not hasattr(stack, "layers"):  # a part of a mixture that is prepared
        return
    for index, layer in enumerate(stack.layers):
        yield from _numbers_in(f"layers[{index}]", layer)
    if stack.base is not None:
        yield from _numbers_in("base", stack.base)


def _numbers_in(prefix: str, owner: Any) -> Iterator[Number]:
    for field in dataclasses.fields(owner):
        value, name = getattr(owner, field.name), f"{prefix}.{field.name}"
        if isinstance(value, eqx.Module) and not is_placeholder(value):
            yield from _numbers_in(name, value)
        elif hasattr(value, "shape") and not is_placeholder(value):
            keys = {f"{kind.__name__}.{field.name}" for kind in type(owner).__mro__}
            axes = len(value.shape)
            if keys & PER_CHANNEL:
                yield Number(name, value.shape, min(axes, 1), True)
            elif keys & VECTORS:
                yield Number(name, value.shape, 1, False)
            elif keys & RANGES.keys():
                yield Number(name, value.shape, 0, False)
            elif axes == 1 and ".phase" not in prefix:  # a plain array of a surface of one's own counts channels
                yield Number(name, value.shape, 1, True)


def channel_count(stack: Any) -> int:
    """Number of channels, 1 if no number differs by channel.

    Raises:
        ValueError: numbers disagree; or shapes are none of a map, see `map_shape`.
    """
    map_shape(stack)
    sizes: dict[int, str] = {}
    for number in numbers_of(stack):
        if number.by_channel and number.channel_axes and number.shape[-1] > 1:
            sizes.setdefault(number.shape[-1], number.name)
    if len(sizes) > 1:
        raise ValueError(
            "Stack: parameters disagree on the number of channels: "
            + ", ".join(f"{name} has {size}" for size, name in sizes.items())
        )
    return next(iter(sizes), 1)


def map_shape(stack: Any) -> Shape:
    """Shape of a map of stacks; () if it is a single one.

    Raises:
        ValueError: shapes that do not go together, or that may count texels as well as channels.
    """
    found = list(numbers_of(stack))
    axes = max((number.map_axes for number in found), default=0)
    if axes == 0:
        return ()
    mapped = [number for number in found if number.map_axes]
    for number in mapped:
        if number.map_axes != axes:
            raise ValueError(
                f"Stack.{number.name}: shape {number.shape} given, where "
                f"{next(other.name for other in mapped if other.map_axes == axes)} makes it a map of {axes} "
                f"{'axis' if axes == 1 else 'axes'}: {_expected_shape(number, axes)}"
            )
    try:
        shape = np.broadcast_shapes(*(number.shape[:axes] for number in mapped))
    except ValueError:
        shapes = ", ".join(f"{number.name} has {number.shape[:axes]}" for number in mapped)
        raise ValueError(f"Stack: parameters disagree on the shape of the map: {shapes}") from None
    _refuse_square(found, mapped)
    for number in found:
        if (
            number.by_channel
            and axes == 1
            and not number.map_axes
            and number.channel_axes
            and number.shape == shape != (1,)
        ):
            raise ValueError(
                f"Stack.{number.name}: shape {number.shape} given in a map of shape {shape}: texels or channels? "
                f"{_expected_shape(number, axes)}, or (1, C) for channels that all texels share"
            )
    return shape


def _refuse_square(numbers: list[Number], mapped: list[Number]) -> None:
    """Refuse a map of as many texels as channels where no other number tells which of its axes are which."""
    number = mapped[0]
    if len(number.shape) != 2 or len({*number.shape}) != 1 or number.shape == (1, 1):
        return
    others = [other for other in numbers if other.by_channel or other.map_axes]
    if all(other.shape in (number.shape, (), (1,)) for other in others):
        raise ValueError(
            f"Stack.{number.name}: shape {number.shape} given, and nothing else says whether these are texels or "
            "channels: (H, W, 1) is a number a texel of a map of H x W; for N texels of C channels give one number as "
            "(1, C)"
        )


def _expected_shape(number: Number, axes: int) -> str:
    texels = ", ".join("HW" if axes == 2 else "N" * axes)
    if number.by_channel:
        return f"({texels}, 1) is a number a texel, ({texels}, C) one a channel of each"
    return f"({texels}{',' if axes == 1 else ''}{' 3' if number.channel_axes else ''}) is one a texel"


def require_single(stack: Any, who: str) -> None:
    """Refuse a map of stacks, on behalf of what takes one stack alone."""
    if map_shape(stack):
        number = next(number for number in numbers_of(stack) if number.map_axes)
        raise ValueError(
            f"stack: {who} takes one stack; {number.name} of shape {number.shape} makes it a map of stacks, "
            "which evaluate, sample, pdf, albedo, specular and unscattered take"
        )


def axes_of_map(stack: Any, shape: Shape) -> Any:
    """A tree like the stack's: for every leaf whether it differs from texel to texel of a map of this shape."""
    mapped = {number.name for number in numbers_of(stack) if number.map_axes == len(shape)}
    named = [name in mapped for name, _ in leaves_with_names(stack)]
    return jax.tree.unflatten(jax.tree.structure(stack), named)
