"""Numbers on the command line, and their ranges."""

import argparse


def count(word: str) -> int:
    """A whole number, at least 1."""
    return int(_number(word, int, 1, None))


def whole(word: str) -> int:
    """A whole number, at least 0."""
    return int(_number(word, int, 0, None))


def seed(word: str) -> int:
    """A whole number that seeds a generator."""
    return int(_number(word, int, 0, 2**32 - 1))


def angle(word: str) -> float:
    """An angle from the normal, in degrees."""
    return _number(word, float, 0.0, 90.0)


def degrees(words: str) -> list[float]:
    """Polar angles, separated by commas."""
    return [_number(word, float, 0.0, 180.0) for word in words.split(",")]


def level(word: str) -> float:
    """A number, at least 0."""
    return _number(word, float, 0.0, None)


def scale(word: str) -> tuple[str, float]:
    """A number, at least 0, and the name before it, as in base.albedo=0.1; "" where there is none."""
    name, _, number = word.rpartition("=")
    return name, _number(number, float, 0.0, None)


def length(word: str) -> float:
    """A wavelength, in nanometres."""
    return _number(word, float, 1.0, None)


def _number(word: str, kind: type[int] | type[float], low: float, high: float | None) -> float:
    allowed = f"{'a whole number' if kind is int else 'a number'} " + (
        f">= {low:g}" if high is None else f"in [{low:g}, {high:g}]"
    )
    try:
        value = kind(word)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{word!r} given, must be {allowed}") from None
    if not low <= value <= (float("inf") if high is None else high) or value == float("inf"):
        raise argparse.ArgumentTypeError(f"{word} given, must be {allowed}")
    return value
