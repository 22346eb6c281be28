"""Materials as words: the call that makes one, with the numbers that were typed, and a short form for pictures."""

import dataclasses
import inspect
from collections.abc import Iterator, Mapping
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from layerjax._parameters import takes_several

MOST_LISTED = 8
"""Numbers that are named one by one; of more, shape and range are shown."""


SYNONYMS = {"roughness": "alpha", "eta": "ior", "n": "ior", "kappa": "k", "depth": "thickness", "tau": "thickness"}
"""Arguments by what they are called elsewhere."""


class ReprModule(eqx.Module):
    """A module that is shown as the call that makes it, and whose arguments are named where one is unknown."""

    def __new__(cls, *_: Any, **fields: Any) -> Self:
        known = [] if not fields else [*inspect.signature(cls.__init__).parameters][1:]
        for name in fields:
            if name not in known:
                meant = SYNONYMS.get(name)
                hint = f" ({meant}?)" if meant in known else ""
                raise TypeError(f"{cls.__name__}: unknown argument {name!r}{hint}; it takes {', '.join(known)}")
        return super().__new__(cls)

    def __repr__(self) -> str:
        return format_call(self)


def format_call(owner: Any) -> str:
    """``Interface(ior=1.5, alpha=0.3)``, on one line, without the fields that have their default.

    Single numbers and few channels have all their digits, so that the words make the same again. Of a map shape and
    range are shown, of what is traced type and shape.
    """
    words = []
    for field in dataclasses.fields(owner):
        if field.repr and hasattr(owner, field.name):  # one that a constructor has refused may lack fields
            word = format_value(getattr(owner, field.name))
            if word.startswith("[") and not takes_several(f"{type(owner).__name__}.{field.name}"):
                word = f"array({word})"  # of a map: lists are for channels
            if word != _default(field):
                words.append(f"{field.name}={word}")
    return f"{type(owner).__name__}({', '.join(words)})"


def describe(owner: Any, digits: int = 4) -> str:
    """The same for reading: ``ior 1.5, alpha 0.3``, without the name of the class, rounded to so many digits."""
    return ", ".join(_describe_fields(owner, digits)) if dataclasses.is_dataclass(owner) else ""


def _describe_fields(owner: Any, digits: int) -> Iterator[str]:
    for field in dataclasses.fields(owner):
        value = getattr(owner, field.name)
        if format_value(value) == _default(field):
            continue
        if isinstance(value, ReprModule):
            inner = describe(value, digits)
            yield f"{field.name} {type(value).__name__}{f' ({inner})' if inner else ''}"
        else:
            yield value if isinstance(value, str) else f"{field.name} {format_value(value, digits)}"


def format_value(value: Any, digits: int | None = None) -> str:
    """A value of a field on one line; numbers with all their digits, or so many."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(format_value(entry, digits) for entry in value)}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key!r}: {format_value(entry, digits)}' for key, entry in value.items())}}}"
    if _is_concrete(value):
        return _format_numbers(np.asarray(value), digits)
    if hasattr(value, "shape") and hasattr(value, "dtype"):  # traced, or a shape alone
        return eqx.tree_pformat(value)
    return " ".join(repr(value).split())


def _is_concrete(value: Any) -> bool:
    """Whether these are numbers, or one, with values that can be read."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number | np.ndarray | jax.Array):
        return False
    if isinstance(value, jax.core.Tracer) or (isinstance(value, jax.Array) and value.is_deleted()):
        return False
    dtype = jnp.result_type(value)
    return np.size(value) > 0 and (jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer))


def _format_numbers(numbers: np.ndarray, digits: int | None) -> str:
    def word(number: Any) -> str:
        # the shortest that makes this number again in its own precision, as Python writes it
        return repr(float(str(number))) if digits is None else f"{float(number):.{digits}g}"

    if numbers.ndim == 0:
        return word(numbers[()])
    if numbers.ndim == 1 and numbers.size <= MOST_LISTED:
        return f"[{', '.join(map(word, numbers))}]"
    shape = " x ".join(map(str, numbers.shape))
    low, high = (f"{float(end):.4g}" for end in (numbers.min(), numbers.max()))
    return f"<{shape} from {low} to {high}>" if low != high else f"<{shape} of {low}>"


def _default(field: Any) -> str | None:
    """What is shown of the field's default; None if it has none."""
    if field.default is not dataclasses.MISSING:
        return format_value(field.default)
    if field.default_factory is dataclasses.MISSING:
        return None
    with jax.ensure_compile_time_eval():  # nothing of it becomes part of a program that is being traced
        return format_value(field.default_factory())
