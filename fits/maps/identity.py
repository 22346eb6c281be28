"""What tells one fit of a map from another: a store is gone on with only by the fit that began it."""

import functools
import hashlib
from collections.abc import Mapping
from types import CodeType
from typing import Any

import jax
import numpy as np

from fits.maps.sources import UNREADABLE
from fits.problem.parameters import is_free
from fits.store import portable_repr


def digest(tree: Any) -> str:
    """A fingerprint of a tree: its structure and its numbers, and of functions their names, what they do and what they
    hold; not what they find in global variables."""
    return _digest(tree, ())


def _digest(tree: Any, within: tuple[Any, ...]) -> str:
    """within: functions that hold the tree, or may be in it themselves."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=is_free)
    found = hashlib.sha256(repr(structure).encode())
    for leaf in leaves:
        if isinstance(leaf, np.ndarray | np.generic | jax.Array):
            array = np.asarray(leaf)
            found.update(repr((array.shape, str(array.dtype))).encode())
            found.update(np.ascontiguousarray(array).tobytes())
        else:
            found.update((_of_function(leaf, within) if callable(leaf) else portable_repr(leaf)).encode())
    return found.hexdigest()


def require_same(path: Any, stored: Mapping[str, str], given: Mapping[str, str]) -> None:
    """Refuse to go on with a store of something else.

    Raises:
        ValueError: it names what differs.
    """
    changed = [name for name in {**stored, **given} if not alike(stored.get(name, ""), given.get(name, ""))]
    if changed:
        raise ValueError(
            f"{path}: holds a map of another fit, different in {', '.join(changed)} "
            "(--force, or force=True, throws it away and begins anew)"
        )


def alike(one: str, other: str) -> bool:
    """Whether two fingerprints are the same, of which parts may be "?": of what could not be read at the time."""
    parts = [each.split(",") for each in (one, other)]
    same = all(a == b or UNREADABLE in (a, b) for a, b in zip(*parts, strict=False))
    return same and len(parts[0]) == len(parts[1])


def _of_function(function: Any, within: tuple[Any, ...]) -> str:
    """What tells a function, or whatever can be called, from others."""
    if any(function is one for one in within):
        return "itself"
    within = (*within, function)
    if isinstance(function, functools.partial):
        return _digest(["partial", function.func, function.args, function.keywords], within)
    name = f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', portable_repr(function))}"
    if hasattr(function, "__code__"):
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        held = [cells, function.__defaults__, function.__kwdefaults__, getattr(function, "__self__", None)]
        return f"{name} {_of_code(function.__code__)} {_digest(held, within)}"
    if hasattr(function, "__wrapped__"):  # as jax.jit has it
        return f"{name} {_of_function(function.__wrapped__, within)}"
    return name


def _of_code(code: CodeType) -> str:
    """Its instructions, and the names and constants that they are about."""
    constants = [
        _of_code(one) if isinstance(one, CodeType) else sorted(map(repr, one)) if isinstance(one, frozenset) else one
        for one in code.co_consts
    ]
    return repr((code.co_code, code.co_names, constants))
