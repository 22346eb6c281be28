"""Counts of operations in the program that JAX hands to the compiler: what a scene costs, without a clock."""

import collections
import re
from collections.abc import Callable
from typing import Any

import jax

BOOKKEEPING = frozenset(
    {"return", "func", "call", "constant", "module", "broadcast_in_dim", "reshape", "convert", "slice"}
)
"""Operations that move or name numbers; they are fused away and not counted."""


def count(function: Callable[..., Any], *arguments: Any) -> collections.Counter[str]:
    """Arithmetic operations of the lowered (StableHLO) program, by name."""
    text = jax.jit(function).lower(*arguments).as_text()
    names = re.findall(r"(?:stablehlo|chlo|func)\.([a-z_0-9]+)", text)
    return collections.Counter(name for name in names if name not in BOOKKEEPING)


def total(function: Callable[..., Any], *arguments: Any) -> int:
    """Number of arithmetic operations of the lowered program."""
    return sum(count(function, *arguments).values())
