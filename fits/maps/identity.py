"""What tells one fit of a map from another: a store is gone on with only by the fit that began it."""

import hashlib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from fits.maps.sources import UNREADABLE
from fits.problem.parameters import is_free


def digest(tree: Any) -> str:
    """A fingerprint of a tree: its structure and its numbers, functions by their names."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=is_free)
    found = hashlib.sha256(repr(structure).encode())
    for leaf in leaves:
        if isinstance(leaf, np.ndarray | np.generic | jax.Array):
            array = np.asarray(leaf)
            found.update(repr((array.shape, str(array.dtype))).encode())
            found.update(np.ascontiguousarray(array).tobytes())
        else:
            found.update((_named(leaf) if callable(leaf) else repr(leaf)).encode())
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


def _named(function: Any) -> str:
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', repr(function))}"
