"""How measurements lie in angle: incidences, planes and scans, correlation along them, and selections by angle."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits._files import require_switch
from fits.data.geometry import AT_NORMAL as AT_NORMAL
from fits.data.geometry import LIGHT_AZIMUTH, Pairs

SAME_ANGLE = 0.5  # degrees: closer incidences are one incidence, closer azimuths one plane
SHORTEST_SCAN = 5  # points in one plane before neighbours in it mean anything
LISTED = 12  # the most angles of the data that an error lists; of more it names the first and the last

Rows = NDArray[np.bool_]
Angles = float | Sequence[float] | slice


@dataclass(frozen=True)
class Incidence:
    """One direction of the light: its angles in degrees and the rows of the measurements that have it."""

    theta: float
    phi: float
    rows: np.ndarray

    @property
    def label(self) -> str:
        return f"θᵢ = {self.theta:g}°"


def incidences(data: Pairs) -> list[Incidence]:
    """The distinct incident directions, by polar angle then azimuth.

    Directions within `SAME_ANGLE` count as the same, as no instrument repeats an angle to the last digit.
    """
    theta = data.theta_i
    phi = np.where(theta < AT_NORMAL, LIGHT_AZIMUTH, data.phi_i)
    found = []
    for rows in groups(theta):
        normal = theta[rows].max() < SAME_ANGLE
        parts = [np.arange(len(rows))] if normal else groups(phi[rows], turn=360.0)
        own = [Incidence(_mean(theta[rows[part]]), _mean(phi[rows[part]], 360.0), rows[part]) for part in parts]
        found.extend(sorted(own, key=lambda one: one.phi))
    return found


def groups(angles: np.ndarray, turn: float | None = None) -> list[np.ndarray]:
    """Rows of equal angles (N,), in order: groups that each span less than `SAME_ANGLE`.

    turn: period of the angles; the first group then follows the widest gap.
    """
    if not len(angles):
        return []
    angles = np.round(angles, 6)  # they come back from unit vectors
    if turn is not None:
        values = np.unique(angles % turn)
        after_gap = (np.argmax(np.diff(values, append=values[0] + turn)) + 1) % len(values)
        angles = np.round((angles - values[after_gap]) % turn, 6)
    order = np.argsort(angles, kind="stable")
    ordered, ends, start = angles[order], [], 0
    while start < len(ordered):
        start = int(np.searchsorted(ordered, ordered[start] + SAME_ANGLE - 1e-7))
        ends.append(start)
    return [np.sort(part) for part in np.split(order, ends[:-1])]


def relative_azimuth(data: Pairs) -> np.ndarray:
    """Azimuth of the viewer seen from the mirror side, (N,) degrees in (-180, 180]: 0 is forward, 180 backward.

    Light along the normal has no azimuth: it counts as `LIGHT_AZIMUTH`.
    """
    phi_i = np.where(data.theta_i < AT_NORMAL, LIGHT_AZIMUTH, data.phi_i)
    return 180.0 - (phi_i - data.phi_o) % 360.0


def signed_angle(data: Pairs) -> np.ndarray:
    """Polar angle of the viewer, (N,) degrees, positive on the forward side of its own plane and negative behind."""
    side = np.where(np.abs(relative_azimuth(data)) <= 90.0, 1.0, -1.0)
    return side * data.theta_o


def in_plane(data: Pairs) -> np.ndarray:
    """(N,) bool: the viewer lies in the plane of incidence, or the light in that of the viewer, to `SAME_ANGLE`."""
    light, viewer = np.sin(np.radians(data.theta_i)), np.sin(np.radians(data.theta_o))
    # near the normal the azimuth of the light hardly matters; on it, it counts as `relative_azimuth` says
    arm = np.where(light < np.sin(np.radians(AT_NORMAL)), viewer, np.minimum(light, viewer))
    off_plane = np.abs(np.sin(np.radians(relative_azimuth(data)))) * arm
    return off_plane < np.sin(np.radians(SAME_ANGLE))


def planes(data: Pairs) -> np.ndarray:
    """Azimuth of the viewer's plane from the plane of incidence, (N,), degrees in [0, 180)."""
    turns = np.round(relative_azimuth(data) % 180.0 / SAME_ANGLE) % round(180.0 / SAME_ANGLE)
    return np.where(in_plane(data), 0.0, SAME_ANGLE * turns)


def scans(data: Pairs) -> list[np.ndarray]:
    """Rows in the order of the angle, one array per incidence and plane: neighbours in it are neighbours in angle."""
    angle, plane = signed_angle(data), planes(data)
    ordered = []
    for incidence in incidences(data):
        for own in np.unique(plane[incidence.rows]):
            rows = incidence.rows[plane[incidence.rows] == own]
            if len(rows) >= SHORTEST_SCAN:
                ordered.append(rows[np.argsort(angle[rows], kind="stable")])
    return ordered


def neighbours(data: Pairs, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, C) of neighbours in a scan, two arrays; rows with NaN are skipped."""
    first, second = [np.empty(0)], [np.empty(0)]
    for rows in scans(data):
        scan = residuals[rows][np.isfinite(residuals[rows]).all(axis=-1)]
        first.append(scan[:-1].ravel())
        second.append(scan[1:].ravel())
    return np.concatenate(first), np.concatenate(second)


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Correlation of pairs about zero, as a bias over a stretch of angle is structure too; NaN for no pairs."""
    norm = np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(np.sum(first * second) / norm) if norm > 0.0 else float("nan")


def _mean(angles: np.ndarray, turn: float | None = None) -> float:
    """Mean of angles that lie close to each other, to 0.01 degrees, modulo `turn`."""
    if turn is None:
        return round(float(np.mean(angles)), 2)
    apart = (angles - angles[0] + 0.5 * turn) % turn - 0.5 * turn
    return round(float(angles[0] + np.mean(apart)) % turn, 2) % turn


# ---- selections ----

_coplanar = in_plane  # the name of an argument below


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
        for one in incidences(data):
            theta[one.rows] = one.theta
        chosen &= _at(theta, "incidence", incidence)
    if azimuth is not None:
        chosen &= _at(planes(data), "azimuth", azimuth, 180.0)
    if theta_o is not None:
        chosen &= _at(data.theta_o, "theta_o", theta_o)
    if in_plane is not None:
        chosen &= _coplanar(data) == in_plane
    return chosen


def select(data: Pairs, words: str) -> Rows:
    """Samples (N,) by words for one argument of `rows_of`: ``incidence=30,70``, ``azimuth=90``, ``theta_o=20:60``.

    Raises:
        ValueError: no such selection, or angles that the data do not hold.
    """
    name, equals, text = words.partition("=")
    if not equals or name not in ("incidence", "azimuth", "theta_o"):
        known = "incidence=..., azimuth=..., theta_o=..., or channels=... in --select"
        raise ValueError(f"{words!r} is no selection; it must be one of {known}")
    low, colon, high = text.partition(":")
    try:
        angles: Any = slice(float(low), float(high)) if colon else [float(word) for word in text.split(",")]
    except ValueError:
        raise ValueError(f"{name} is {text!r}; it must be angles in degrees, as in 10,50 or 20:60") from None
    return rows_of(data, **{name: angles})


def _at(measured: NDArray[np.float64], name: str, angles: Angles, turn: float = math.inf) -> Rows:
    """Which of the `measured` angles (N,) are among `angles`, modulo `turn`."""
    if isinstance(angles, slice):
        low = -math.inf if angles.start is None else angles.start - SAME_ANGLE
        high = math.inf if angles.stop is None else angles.stop + SAME_ANGLE
        if angles.step is not None or not low <= high:
            given = f"{angles.start}:{angles.stop}" + ("" if angles.step is None else f":{angles.step}")
            raise ValueError(f"{name} is {given}; it must be two angles, the first not above the second")
        return (measured >= low) & (measured <= high)
    chosen = np.zeros(len(measured), bool)
    for angle in np.atleast_1d(np.asarray(angles, float)):
        apart = np.abs(measured - angle) % turn
        near = np.minimum(apart, turn - apart) <= SAME_ANGLE
        if not near.any():
            there = np.unique(measured)
            words = f"they go from {there[0]:g} to {there[-1]:g}"
            if len(there) <= LISTED:
                words = f"there are {', '.join(f'{one:g}' for one in there)}"
            raise ValueError(f"{name} {angle:g} is not in the data; {words} degrees")
        chosen |= near
    return chosen
