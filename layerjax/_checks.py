"""Arguments of a wrong kind are refused in one line, which names the argument and what it should be."""

import math
from collections.abc import Iterable
from numbers import Real
from typing import Any

import jax
import numpy as np

MOST_LETTERS = 60


def abbreviate(value: object) -> str:
    """A value of whatever kind, on one line and cut short; a class is called one."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"{' '.join(repr(value).split()):.{MOST_LETTERS}}"


def require_kind(name: str, value: object, *kinds: type | None, fix: str = "") -> None:
    """Refuse what is of none of these types, and say what to do; None among them: it may be None."""
    if not isinstance(value, tuple(kind for kind in kinds if kind is not None)) and not (value is None in kinds):
        words = " or ".join("None" if kind is None else f"a {kind.__name__}" for kind in kinds)
        raise ValueError(f"{name}: {abbreviate(value)} is not {words}{f'; {fix}' if fix else ''}")


def require_count(name: str, value: object, least: int, most: int | None = None) -> None:
    """Refuse what is not a whole number of at least `least`, and at most `most`."""
    above = most is not None and isinstance(value, int | np.integer) and value > most
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least or above:
        words = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name}: {abbreviate(value)} is not a whole number {words}")


def require_seed(seed: object) -> None:
    """Refuse what is not a seed that every random generator takes."""
    require_count("seed", seed, 0, 2**32 - 1)


def require_number(
    name: str, value: object, low: float = -math.inf, high: float = math.inf, *, open_ends: bool = False
) -> None:
    """Refuse what is not a real number in a range, which is closed, or open at both ends."""
    number: Any = value if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if not (low < number < high if open_ends else low <= number <= high):
        left, right = "()" if open_ends else "[]"
        raise ValueError(f"{name} is {abbreviate(value)}; it must be a number in {left}{low:g}, {high:g}{right}")


def require_choice(name: str, value: object, allowed: Iterable[Any]) -> None:
    """Refuse what is not one of these words, or neither True nor False."""
    if not any(value is one or (isinstance(value, str) and value == one) for one in allowed):
        raise ValueError(f"{name}: {abbreviate(value)} is not one of {', '.join(map(repr, allowed))}")


def require_key(key: Any) -> None:
    """Refuse what is not a single JAX random key, typed or of the older kind."""
    if isinstance(key, jax.Array | np.ndarray):
        typed = jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
        if key.shape == () if typed else key.dtype == np.uint32 and key.ndim == 1 and key.size in (2, 4):
            return
    seed = key if isinstance(key, int) else 0
    raise ValueError(f"key: {abbreviate(key)} is not a JAX random key, such as jax.random.key({seed})")
