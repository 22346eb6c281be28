"""Selections of measurements: by incidence, plane or viewing angle, or a share in blocks."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from fits.data.geometry import Pairs
from fits.data.scans import SAME_ANGLE, in_plane, incidences, planes, scans, signed_angle

BLOCK = 10.0
"""Length of the blocks of a share, in degrees along a scan: neighbouring measurements are correlated, so that single
ones would be no test of a prediction."""

LISTED = 12
"""The most angles of the data that an error lists; of more it names the first and the last."""

Rows = NDArray[np.bool_]
Angles = float | Sequence[float] | slice


def rows_of(
    data: Pairs, incidence: Angles | None, azimuth: Angles | None, theta_o: Angles | None, plane: bool | None
) -> Rows:
    """Samples (N,) that fulfil all of these, see `Measurements.select`; plane: whether in the plane of incidence."""
    chosen = np.ones(len(data), bool)
    if incidence is not None:
        chosen &= _at(_incidence_of(data), "incidence", incidence)
    if azimuth is not None:
        chosen &= _at(planes(data), "azimuth", azimuth, 180.0)
    if theta_o is not None:
        chosen &= _at(data.theta_o, "theta_o", theta_o)
    if plane is not None:
        chosen &= in_plane(data) == plane
    return chosen


def select(data: Pairs, words: str) -> Rows:
    """Samples (N,) of one of these selections, all angles in degrees.

    - ``incidence=30,70``: polar angles of the light;
    - ``plane=0,90``: planes of the viewer, 0 is that of incidence;
    - ``angle=-20:20,60``: polar angles of the viewer, or ranges of them, negative on the side of the light;
    - ``share=0.2``: that share of every scan, in blocks of 10 degrees.

    Raises:
        ValueError: no such selection, or angles that the data do not hold.
    """
    name, equals, text = words.partition("=")
    if not equals or name not in _KINDS:
        raise ValueError(f"{words!r} is no selection; it must be one of {', '.join(f'{kind}=...' for kind in _KINDS)}")
    return _KINDS[name](data, name, text)


def _incidence(data: Pairs, name: str, text: str) -> Rows:
    return _at(_incidence_of(data), name, [_number(name, word) for word in text.split(",")])


def _plane(data: Pairs, name: str, text: str) -> Rows:
    return _at(planes(data), name, [_number(name, word) for word in text.split(",")])


def _incidence_of(data: Pairs) -> NDArray[np.float64]:
    """Polar angle of the incidence that each sample belongs to, (N,)."""
    theta = np.full(len(data), np.nan)
    for incidence in incidences(data):
        theta[incidence.rows] = incidence.theta
    return theta


def _at(measured: NDArray[np.float64], name: str, angles: Angles, turn: float = math.inf) -> Rows:
    """Which of the `measured` angles (N,) are among `angles`, modulo `turn`."""
    if isinstance(angles, slice):
        low = -math.inf if angles.start is None else angles.start - SAME_ANGLE
        high = math.inf if angles.stop is None else angles.stop + SAME_ANGLE
        if angles.step is not None or not low <= high:
            raise ValueError(f"{name} is {angles}; it must be slice(low, high), the first not above the second")
        return (measured >= low) & (measured <= high)
    chosen = np.zeros(len(measured), bool)
    for angle in np.atleast_1d(np.asarray(angles, float)):
        distance = np.abs(measured - angle)
        if not math.isinf(turn):
            distance = np.minimum(distance % turn, turn - distance % turn)
        near = distance <= SAME_ANGLE
        if not near.any():
            raise ValueError(f"{name} {angle:g} is not in the data; {_listed(measured)} degrees")
        chosen |= near
    return chosen


def _listed(measured: NDArray[np.float64]) -> str:
    angles = np.unique(measured)
    if len(angles) > LISTED:
        return f"they go from {angles[0]:g} to {angles[-1]:g}"
    return f"there are {', '.join(f'{angle:g}' for angle in angles)}"


def _angle(data: Pairs, name: str, text: str) -> Rows:
    angle, chosen = signed_angle(data), np.zeros(len(data), bool)
    for word in text.split(","):
        low, colon, high = word.partition(":")
        first, last = _number(name, low), _number(name, high if colon else low)
        if first > last:
            raise ValueError(f"{name} {word.strip()} is empty: its first angle must not be above its second")
        tolerance = 0.0 if colon else SAME_ANGLE
        chosen |= (angle >= first - tolerance) & (angle <= last + tolerance)
    if not chosen.any():
        raise ValueError(f"{name} {text} is not in the data; they go from {angle.min():g} to {angle.max():g} degrees")
    return chosen


def _share(data: Pairs, name: str, text: str) -> Rows:
    share = _number(name, text)
    if not 0.0 < share < 1.0:
        raise ValueError(f"{name} is {share:g}; it must be above 0 and below 1")
    angle, chosen = signed_angle(data), np.zeros(len(data), bool)
    generator = np.random.default_rng(0)
    for rows in scans(data):
        block = np.floor((angle[rows] - angle[rows].min()) / BLOCK).astype(int)
        blocks = np.unique(block)
        count = min(max(1, round(share * len(blocks))), len(blocks) - 1)
        chosen[rows] = np.isin(block, generator.choice(blocks, count, replace=False)) if count > 0 else False
    if not chosen.any():
        raise ValueError(f"{name} {text}: no scan of the data is longer than a block of {BLOCK:g} degrees")
    return chosen


def _number(name: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise ValueError(f"{name} is {word.strip()!r}; it must be a number")
    return value


_KINDS: dict[str, Callable[[Pairs, str, str], Rows]] = {
    "incidence": _incidence,
    "plane": _plane,
    "angle": _angle,
    "share": _share,
}
