"""One compiled program for every model of the same structure and shape: numbers are traced, the rest is its key."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax


class Static:
    """A tree without arrays as a hashable key: the hash is taken once, not at every call."""

    def __init__(self, tree: Any):
        leaves, structure = jax.tree.flatten(tree)
        self.tree, self.key = tree, (tuple(leaves), structure)
        self.hash = hash(self.key)

    def __hash__(self) -> int:
        return self.hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Static) and self.key == other.key


def run(function: Callable[..., Any], split_model: tuple[Any, Static], *arguments: Any) -> Any:
    """`function(model, *arguments)` compiled; see `Problem.call`."""
    return _run(function, split_model[1], split_model[0], *arguments)


@partial(jax.jit, static_argnums=(0, 1))
def _run(function: Callable[..., Any], static: Static, arrays: Any, *arguments: Any) -> Any:
    return function(eqx.combine(arrays, static.tree), *arguments)
