"""A solver at several resolutions: what each gets wrong, and which is the fastest of those that are good enough."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring.timing import once

Floats = NDArray[np.float64]

FLOOR = 1e-3
"""Errors are relative, with this share of the largest value as a floor."""


@dataclass(frozen=True)
class Way:
    """A solver at one resolution: its name, the work, and the error of what it gives."""

    name: str
    work: Callable[[], Any]
    error: float


def way_of(name: str, work: Callable[[], Floats], exact: Floats) -> Way:
    """A way and the largest error of what it gives."""
    return Way(name, work, largest_error(work(), exact))


def cheapest(ways: Sequence[Way], error: float) -> Way:
    """The fastest way that reaches the error; the most exact if none does."""
    reaching = [way for way in ways if way.error <= error]
    if not reaching:
        return min(ways, key=lambda way: way.error)
    return min(reaching, key=lambda way: min(once(way.work) for _ in range(3)))


def largest_error(values: Floats, exact: Floats) -> float:
    """Largest relative error."""
    return float(np.max(np.abs(values - exact) / np.maximum(exact, FLOOR * exact.max())))


def spread(values: Floats, exact: Floats) -> float:
    """Root mean square of the relative errors: noise in what counts as exact touches it less than the largest."""
    return float(np.sqrt(np.mean(((values - exact) / exact) ** 2)))
