"""Selections of measurements by incidence, plane and viewing angle, from arguments or words of the command line."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits._files import require_switch
from fits.data import scans
from fits.data.geometry import Pairs

LISTED = 12
"""The most angles of the data that an error lists; of more it names the first and the last."""

Rows = NDArray[np.bool_]
Angles = float | Sequence[float] | slice


def rows_of(
    data: Pairs,
    incidence: Angles | None = None,
    azimuth: Angles | None = None,
    theta_o: Angles | None = None,
    in_plane: bool | None = None,
) -> Rows:
    """Samples (N,) that fulfil all of these, see `Measurements.select`."""
    require_switch("in_plane", in_plane, None)
    chosen = np.ones(len(data), bool)
    if incidence is not None:
        theta = np.full(len(data), np.nan)
        for one in scans.incidences(data):
            theta[one.rows] = one.theta
        chosen &= _at(theta, "incidence", incidence)
    if azimuth is not None:
        chosen &= _at(scans.planes(data), "azimuth", azimuth, 180.0)
    if theta_o is not None:
        chosen &= _at(data.theta_o, "theta_o", theta_o)
    if in_plane is not None:
        chosen &= scans.in_plane(data) == in_plane
    return chosen


def select(data: Pairs, words: str) -> Rows:
    """Samples (N,) by words for one argument of `rows_of`: ``incidence=30,70``, ``azimuth=90``, ``theta_o=20:60``.

    Raises:
        ValueError: no such selection, or angles that the data do not hold.
    """
    name, equals, text = words.partition("=")
    if not equals or name not in ("incidence", "azimuth", "theta_o"):
        raise ValueError(f"{words!r} is no selection; it must be one of incidence=..., azimuth=..., theta_o=...")
    low, colon, high = text.partition(":")
    try:
        angles: Any = slice(float(low), float(high)) if colon else [float(word) for word in text.split(",")]
    except ValueError:
        raise ValueError(f"{name} is {text!r}; it must be angles in degrees, as in 10,50 or 20:60") from None
    return rows_of(data, **{name: angles})


def _at(measured: NDArray[np.float64], name: str, angles: Angles, turn: float = math.inf) -> Rows:
    """Which of the `measured` angles (N,) are among `angles`, modulo `turn`."""
    if isinstance(angles, slice):
        low = -math.inf if angles.start is None else angles.start - scans.SAME_ANGLE
        high = math.inf if angles.stop is None else angles.stop + scans.SAME_ANGLE
        if angles.step is not None or not low <= high:
            raise ValueError(f"{name} is {angles}; it must be slice(low, high), the first not above the second")
        return (measured >= low) & (measured <= high)
    chosen = np.zeros(len(measured), bool)
    for angle in np.atleast_1d(np.asarray(angles, float)):
        distance = np.abs(measured - angle)
        if not math.isinf(turn):
            distance = np.minimum(distance % turn, turn - distance % turn)
        near = distance <= scans.SAME_ANGLE
        if not near.any():
            there = np.unique(measured)
            words = f"there are {', '.join(f'{one:g}' for one in there)}"
            if len(there) > LISTED:
                words = f"they go from {there[0]:g} to {there[-1]:g}"
            raise ValueError(f"{name} {angle:g} is not in the data; {words} degrees")
        chosen |= near
    return chosen
