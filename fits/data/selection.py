"""Parts of measurements by what a user thinks in: incidences, planes, viewing angles, or a share in blocks."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fits.data.measurements import Measurements
from fits.data.scans import SAME_ANGLE, incidences, planes, scans, signed_angle

BLOCK = 10.0
"""Of a share, in degrees along a scan: neighbouring readings are alike, and tell nothing of each other."""

Rows = NDArray[np.bool_]


def select(data: Measurements, words: str) -> Rows:
    """Samples (N,) that are meant by one of these, all angles in degrees.

    - ``incidence=30,70``: polar angles of the light;
    - ``plane=0,90``: planes of the viewer, 0 is that of incidence;
    - ``angle=-20:20,60``: polar angles of the viewer, or ranges of them, negative on the side of the light;
    - ``share=0.2``: so much of every scan, in blocks of 10 degrees.

    Raises:
        ValueError: something else, or what the data do not hold.
    """
    name, equals, text = words.partition("=")
    if not equals or name not in _KINDS:
        raise ValueError(f"{words!r} is no selection; it must be one of {', '.join(f'{kind}=...' for kind in _KINDS)}")
    return _KINDS[name](data, name, text)


def _incidence(data: Measurements, name: str, text: str) -> Rows:
    there = np.full(len(data), np.nan)
    for incidence in incidences(data):
        there[incidence.rows] = incidence.theta
    return _among(there, name, text)


def _plane(data: Measurements, name: str, text: str) -> Rows:
    return _among(planes(data), name, text)


def _among(there: NDArray[np.float64], name: str, text: str) -> Rows:
    chosen = np.zeros(len(there), bool)
    for word in text.split(","):
        near = np.abs(there - _number(name, word)) <= SAME_ANGLE
        if not near.any():
            known = ", ".join(f"{angle:g}" for angle in np.unique(there))
            raise ValueError(f"{name} {word.strip()} is not in the data; there are {known} degrees")
        chosen |= near
    return chosen


def _angle(data: Measurements, name: str, text: str) -> Rows:
    angle, chosen = signed_angle(data), np.zeros(len(data), bool)
    for word in text.split(","):
        low, colon, high = word.partition(":")
        ends = _number(name, low), _number(name, high if colon else low)
        if ends[0] > ends[1]:
            raise ValueError(f"{name} {word.strip()} is empty: its first end must not be above its second")
        slack = 0.0 if colon else SAME_ANGLE
        chosen |= (angle >= ends[0] - slack) & (angle <= ends[1] + slack)
    if not chosen.any():
        raise ValueError(f"{name} {text} is not in the data; they go from {angle.min():g} to {angle.max():g} degrees")
    return chosen


def _share(data: Measurements, name: str, text: str) -> Rows:
    share = _number(name, text)
    if not 0.0 < share < 1.0:
        raise ValueError(f"{name} is {share:g}; it must be above 0 and below 1")
    angle, chosen = signed_angle(data), np.zeros(len(data), bool)
    generator = np.random.default_rng(0)
    for rows in scans(data):
        block = np.floor((angle[rows] - angle[rows].min()) / BLOCK).astype(int)
        every = np.unique(block)
        count = min(max(1, round(share * len(every))), len(every) - 1)
        chosen[rows] = np.isin(block, generator.choice(every, count, replace=False)) if count > 0 else False
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


_KINDS: dict[str, Callable[[Measurements, str, str], Rows]] = {
    "incidence": _incidence,
    "plane": _plane,
    "angle": _angle,
    "share": _share,
}
