"""Numbers on the command line, and their ranges."""

import argparse
import math
from collections.abc import Callable
from typing import Any


def _number(kind: type[int] | type[float], low: float, high: float = math.inf) -> Callable[[str], Any]:
    """What reads a number of this kind and range."""
    allowed = f"{'a whole number' if kind is int else 'a number'} " + (
        f">= {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
    )

    def read(word: str) -> Any:
        try:
            value = kind(word)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{word!r} given, must be {allowed}") from None
        if not low <= value <= high or value == math.inf:
            raise argparse.ArgumentTypeError(f"{word} given, must be {allowed}")
        return value

    return read


count, seed = _number(int, 1), _number(int, 0, 2**32 - 1)
level, length = _number(float, 0.0), _number(float, 1.0)
"""A share or a standard deviation; a wavelength in nanometres."""
angle, _polar = _number(float, 0.0, 90.0), _number(float, 0.0, 180.0)
"""Angles from the normal line, and from the normal, in degrees."""


def degrees(words: str) -> list[float]:
    """Polar angles, separated by commas."""
    return [_polar(word) for word in words.split(",")]


def scale(word: str) -> tuple[str, float]:
    """A number, at least 0, and the name before it, as in base.albedo=0.1; "" where there is none."""
    name, _, number = word.rpartition("=")
    return name, level(number)
