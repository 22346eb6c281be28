"""What readings say of themselves, before any model: reciprocity, energy, symmetry, sampling and repeats.

Directions are those of an isotropic sample: polar angles of light and viewer, and the azimuth between them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree

from fits.data.measurements import Measurements
from fits.data.scans import AT_NORMAL, SAME_ANGLE, in_plane, incidences, relative_azimuth, scans, signed_angle

SAME_PLACE = 0.05
"""Degrees within which readings are repeats of one."""

LEAST_COVERED = 0.5
"""Share of the projected hemisphere that has to be covered before its integral is taken."""

FAR = 30.0
"""Degrees from the mirror direction within which a peak is looked for."""

STEEP = 5.0
"""Degrees of incidence from which the light has a side."""

BRIGHTER = 1.3
"""Ratio of the brightest measurements of two sides from which one of them is the brighter: more than noise makes."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """Readings that should be equal, two by two: how many pairs, and how far they are apart: median and 95th percentile
    of |difference| / mean, and the median of the signed one; z: root mean square in standard errors, NaN without sigma.
    """

    count: int
    median: float
    most: float
    signed: float
    z: float

    @property
    def noise(self) -> float:
        """Relative standard deviation of one reading, were the differences random and Gaussian."""
        return self.median / (0.6745 * 2.0**0.5)


@dataclass(frozen=True)
class Energy:
    """Of light at this polar angle, the share (C,) that is scattered back over what is covered of the hemisphere.

    covered: of the projected hemisphere.
    """

    theta: float
    share: tuple[float, ...]
    covered: float


@dataclass(frozen=True)
class Peak:
    """Of a scan through the mirror direction: degrees between readings there, and how many are above half its top.

    stands_out: whether measurements about it fall to half of its top, so that it is a peak, and no flank of another.
    """

    theta: float
    step: float
    readings: int
    stands_out: bool


@dataclass(frozen=True)
class Sides:
    """Of light at this polar angle, the brightest measurement in its plane on its own side, and on the mirror side; NaN
    where all of them are on its own."""

    theta: float
    light: float
    mirror: float


def reciprocity(data: Measurements) -> Agreement | None:
    """Pairs in which light and viewer change places, both above the surface; None if there is none.

    Where all readings lie on one side of the plane of incidence, those on the other are taken to be the same.
    """
    used = _above(data)
    turn = relative_azimuth(used)
    turn = turn if _both_sides(turn) else np.abs(turn)
    swapped = -turn if _both_sides(turn) else turn
    apart = np.abs(used.theta_i - used.theta_o) > SAME_ANGLE
    return _matched(used, _places(used, turn), _places(used, swapped)[:, [1, 0, 2, 3]], apart)


def symmetry(data: Measurements) -> Agreement | None:
    """Pairs on either side of the plane of incidence; None if there is none."""
    used = _above(data)
    turn = relative_azimuth(used)
    return _matched(used, _places(used, turn), _places(used, -turn), _off_plane(turn) & ~_upright(used))


def repeats(data: Measurements) -> Agreement | None:
    """Readings that were taken again, each beside the one before it; None if there is none."""
    used = data.used()
    key = np.round(np.column_stack([used.wi, used.wo]) / np.radians(SAME_PLACE)).astype(np.int64)
    order = np.lexsort(key.T)
    same = np.all(key[order[1:]] == key[order[:-1]], axis=1)
    return _apart(used, order[:-1][same], order[1:][same])


def energies(data: Measurements) -> list[Energy]:
    """Of every incidence whose readings cover half of the projected hemisphere or more, those of one side mirrored."""
    used, found = _above(data), []
    for one in incidences(used):
        turn = np.radians(relative_azimuth(used)[one.rows])
        sine = np.sin(np.radians(used.theta_o[one.rows]))
        place = np.column_stack([sine * np.cos(turn), sine * np.sin(turn)])
        values = used.values[one.rows]
        if np.all(place[:, 1] > -1e-9) or np.all(place[:, 1] < 1e-9):
            place, values = np.concatenate([place, place * [1.0, -1.0]]), np.concatenate([values, values])
        place, first = np.unique(np.round(place, 9), axis=0, return_index=True)
        try:
            corners = Delaunay(place).simplices
        except (QhullError, ValueError):  # all in one plane
            continue
        a, b, c = (place[corners[:, k]] for k in range(3))
        area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        covered = float(area.sum() / np.pi)
        if covered >= LEAST_COVERED:
            share = area @ values[first][corners].mean(axis=1)
            found.append(Energy(one.theta, tuple(map(float, share)), covered))
    return found


def peaks(data: Measurements) -> list[Peak]:
    """Of each scan that crosses the mirror direction of its light."""
    used = _above(data)
    angle, found = signed_angle(used), []
    flat = in_plane(used)
    for rows in scans(used):
        rows = rows[flat[rows]]
        mirror = float(used.theta_i[rows[0]]) if rows.size else 0.0
        near = rows[np.abs(angle[rows] - mirror) <= FAR]
        if near.size < 3 or not angle[near].min() < mirror < angle[near].max():
            continue
        level = used.values[near].mean(axis=1)
        top = int(np.argmax(level))
        low = high = top
        while low > 0 and level[low - 1] >= 0.5 * level[top]:
            low -= 1
        while high < near.size - 1 and level[high + 1] >= 0.5 * level[top]:
            high += 1
        step = float(np.median(np.diff(angle[near])[max(0, low - 1) : high + 1]))
        falls = top > 0 and (low > 0 or high < near.size - 1)
        of_light = angle[near[top]] < -0.5 * mirror - SAME_ANGLE
        found.append(Peak(mirror, step, high - low + 1, bool(falls and not of_light)))
    return found


def sides(data: Measurements) -> list[Sides]:
    """Of each scan in the plane of incidence, as far as it reaches on both sides of the normal."""
    used = _above(data)
    angle, found = signed_angle(used), []
    flat = in_plane(used)
    for rows in scans(used):
        rows = rows[flat[rows]]
        if not rows.size or used.theta_i[rows[0]] < STEEP:
            continue
        own, level = angle[rows], used.values[rows].mean(axis=1)
        if own.min() >= -SAME_ANGLE:
            continue
        one_sided = own.max() <= SAME_ANGLE
        reach = np.inf if one_sided else min(own.max(), -own.min()) + SAME_ANGLE
        light, mirror = (level[(sign * own > SAME_ANGLE) & (sign * own <= reach)] for sign in (-1, 1))
        if light.size and (mirror.size or one_sided):
            brightest = np.nan if one_sided else float(mirror.max())
            found.append(Sides(float(used.theta_i[rows[0]]), float(light.max()), brightest))
    return found


def _above(data: Measurements) -> Measurements:
    used = data.used()
    return used.where((used.wi[:, 2] > 0.0) & (used.wo[:, 2] > 0.0)).used()


def _off_plane(turn: Floats) -> NDArray[np.bool_]:
    """Which azimuths (N,) are on one side of the plane of incidence."""
    return np.abs(np.sin(np.radians(turn))) > np.sin(np.radians(SAME_ANGLE))


def _both_sides(turn: Floats) -> bool:
    side = np.sign(turn[_off_plane(turn)])
    return bool(np.any(side > 0.0) and np.any(side < 0.0))


def _upright(used: Measurements) -> NDArray[np.bool_]:
    return np.minimum(used.theta_i, used.theta_o) < AT_NORMAL


def _places(used: Measurements, turn: Floats) -> Floats:
    """Polar angles of light and viewer, and the azimuth between them as a point of a circle, (N, 4), in degrees."""
    size = np.where(_upright(used), 0.0, np.degrees(1.0))
    around = [size * part(np.radians(turn)) for part in (np.cos, np.sin)]
    return np.column_stack([used.theta_i, used.theta_o, *around])


def _matched(used: Measurements, places: Floats, wanted: Floats, which: NDArray[np.bool_]) -> Agreement | None:
    """Each of `which` (N,) with the reading whose place is nearest to where it is `wanted`; every pair once."""
    rows = np.flatnonzero(which)
    if rows.size == 0:
        return None
    near, other = cKDTree(places).query(wanted[rows], distance_upper_bound=SAME_ANGLE)
    once = np.isfinite(near)
    first, second = rows[once], other[once]
    pairs = np.unique(np.sort(np.column_stack([first, second]), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    # in the order of the light, so that a sign means something
    turned = places[pairs[:, 0], 0] > places[pairs[:, 1], 0]
    pairs[turned] = pairs[turned][:, ::-1]
    return _apart(used, pairs[:, 0], pairs[:, 1])


def _apart(used: Measurements, first: NDArray[np.int64], second: NDArray[np.int64]) -> Agreement | None:
    if first.size == 0:
        return None
    one, other = used.values[first], used.values[second]
    mean = 0.5 * (one + other)
    lit = mean > 0.0
    if not lit.any():
        return None
    relative = ((other - one)[lit] / mean[lit]).ravel()
    z = np.nan
    if used.sigma is not None:
        spread = np.hypot(used.sigma[first], used.sigma[second])
        z = float(np.sqrt(np.mean(((other - one)[spread > 0.0] / spread[spread > 0.0]) ** 2)))
    size = np.abs(relative)
    return Agreement(first.size, float(np.median(size)), float(np.quantile(size, 0.95)), float(np.median(relative)), z)
