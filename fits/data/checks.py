"""Checks of measurements before any model: reciprocity, energy, symmetry, sampling and repeatability.

The sample is taken to be isotropic: polar angles of light and viewer and the azimuth between them matter.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree

from fits.data.measurements import Measurements
from fits.data.scans import AT_NORMAL, SAME_ANGLE, in_plane, incidences, relative_azimuth, scans, signed_angle

SAME_PLACE = 0.05
"""Degrees within which two measurements are repeats of one."""

LEAST_COVERED = 0.5
"""Share of the projected hemisphere that must be covered for an integral over it."""

FAR = 30.0
"""Degrees from the mirror direction within which a peak is sought."""

STEEP = 5.0
"""Polar angle of the light, in degrees, from which forward and backward are distinguished."""

BRIGHTER = 1.3
"""Ratio of the brightest measurements of two sides above which one side is the brighter beyond noise."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """Pairs of measurements that should be equal. count: number of pairs; median, p95: median and 95th percentile of
    |difference| / mean; bias: median of difference / mean; z: root mean square in standard errors, NaN without sigma.
    """

    count: int
    median: float
    p95: float
    bias: float
    z: float

    @property
    def noise(self) -> float:
        """Relative standard deviation of a single measurement, for random Gaussian differences."""
        return self.median / (0.6745 * 2.0**0.5)


@dataclass(frozen=True)
class Energy:
    """Share (C,) of light at polar angle `theta` that is reflected into the covered part of the hemisphere.

    covered: that part, as a share of the projected hemisphere.
    """

    theta: float
    share: tuple[float, ...]
    covered: float


@dataclass(frozen=True)
class Peak:
    """Sampling of a scan through the mirror direction, for light at polar angle `theta`.

    step: degrees between measurements there; count: measurements above half of the maximum; stands_out: whether
    measurements about it fall to half of the maximum, so that it is a peak and no flank of another.
    """

    theta: float
    step: float
    count: int
    stands_out: bool


@dataclass(frozen=True)
class Sides:
    """Brightest measurements in the plane of incidence, for light at polar angle `theta`, on the side of the light and
    on the mirror side; NaN if all of them are on the side of the light."""

    theta: float
    light: float
    mirror: float


def reciprocity(data: Measurements) -> Agreement | None:
    """Pairs in which light and viewer change places, both above the surface; None if there is none.

    If all measurements lie on one side of the plane of incidence, the sample is taken to be symmetric about it.
    """
    used = _above(data)
    azimuth = relative_azimuth(used)
    azimuth = azimuth if _both_sides(azimuth) else np.abs(azimuth)
    swapped = -azimuth if _both_sides(azimuth) else azimuth
    distinct = np.abs(used.theta_i - used.theta_o) > SAME_ANGLE
    return _matched(used, _positions(used, azimuth), _positions(used, swapped)[:, [1, 0, 2, 3]], distinct)


def symmetry(data: Measurements) -> Agreement | None:
    """Pairs on either side of the plane of incidence; None if there is none."""
    used = _above(data)
    azimuth = relative_azimuth(used)
    off_plane = _off_plane(azimuth) & ~_along_normal(used)
    return _matched(used, _positions(used, azimuth), _positions(used, -azimuth), off_plane)


def repeats(data: Measurements) -> Agreement | None:
    """Pairs of repeated measurements along the same directions; None if there is none."""
    used = data.used()
    key = np.round(np.column_stack([used.wi, used.wo]) / np.radians(SAME_PLACE)).astype(np.int64)
    order = np.lexsort(key.T)
    same = np.all(key[order[1:]] == key[order[:-1]], axis=1)
    return _agreement(used, order[:-1][same], order[1:][same])


def energies(data: Measurements) -> list[Energy]:
    """Energy of each incidence whose measurements cover at least half of the projected hemisphere; measurements on one
    side of the plane of incidence are mirrored."""
    used, result = _above(data), []
    for one in incidences(used):
        azimuth = np.radians(relative_azimuth(used)[one.rows])
        sine = np.sin(np.radians(used.theta_o[one.rows]))
        points = np.column_stack([sine * np.cos(azimuth), sine * np.sin(azimuth)])
        values = used.values[one.rows]
        if np.all(points[:, 1] > -1e-9) or np.all(points[:, 1] < 1e-9):
            points, values = np.concatenate([points, points * [1.0, -1.0]]), np.concatenate([values, values])
        points, first = np.unique(np.round(points, 9), axis=0, return_index=True)
        try:
            corners = Delaunay(points).simplices
        except (QhullError, ValueError):  # all in one plane
            continue
        a, b, c = (points[corners[:, k]] for k in range(3))
        area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        covered = float(area.sum() / np.pi)
        if covered >= LEAST_COVERED:
            share = area @ values[first][corners].mean(axis=1)
            result.append(Energy(one.theta, tuple(map(float, share)), covered))
    return result


def peaks(data: Measurements) -> list[Peak]:
    """Peak of each scan that crosses the mirror direction of its light."""
    used = _above(data)
    angle, coplanar, result = signed_angle(used), in_plane(used), []
    for rows in scans(used):
        rows = rows[coplanar[rows]]
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
        backward = angle[near[top]] < -0.5 * mirror - SAME_ANGLE
        result.append(Peak(mirror, step, high - low + 1, bool(falls and not backward)))
    return result


def sides(data: Measurements) -> list[Sides]:
    """Brightest measurements of each scan in the plane of incidence, over the angles that both sides cover."""
    used = _above(data)
    angle, coplanar, result = signed_angle(used), in_plane(used), []
    for rows in scans(used):
        rows = rows[coplanar[rows]]
        if not rows.size or used.theta_i[rows[0]] < STEEP:
            continue
        theta, level = angle[rows], used.values[rows].mean(axis=1)
        if theta.min() >= -SAME_ANGLE:
            continue
        one_sided = theta.max() <= SAME_ANGLE
        limit = np.inf if one_sided else min(theta.max(), -theta.min()) + SAME_ANGLE
        light, mirror = (level[(sign * theta > SAME_ANGLE) & (sign * theta <= limit)] for sign in (-1, 1))
        if light.size and (mirror.size or one_sided):
            brightest = np.nan if one_sided else float(mirror.max())
            result.append(Sides(float(used.theta_i[rows[0]]), float(light.max()), brightest))
    return result


def _above(data: Measurements) -> Measurements:
    used = data.used()
    return used.where((used.wi[:, 2] > 0.0) & (used.wo[:, 2] > 0.0)).used()


def _off_plane(azimuth: Floats) -> NDArray[np.bool_]:
    """Which relative azimuths (N,) are outside of the plane of incidence."""
    return np.abs(np.sin(np.radians(azimuth))) > np.sin(np.radians(SAME_ANGLE))


def _both_sides(azimuth: Floats) -> bool:
    side = np.sign(azimuth[_off_plane(azimuth)])
    return bool(np.any(side > 0.0) and np.any(side < 0.0))


def _along_normal(used: Measurements) -> NDArray[np.bool_]:
    return np.minimum(used.theta_i, used.theta_o) < AT_NORMAL


def _positions(used: Measurements, azimuth: Floats) -> Floats:
    """Polar angles of light and viewer, and the azimuth between them as a point of a circle, (N, 4), in degrees."""
    size = np.where(_along_normal(used), 0.0, np.degrees(1.0))
    circle = [size * part(np.radians(azimuth)) for part in (np.cos, np.sin)]
    return np.column_stack([used.theta_i, used.theta_o, *circle])


def _matched(used: Measurements, positions: Floats, images: Floats, chosen: NDArray[np.bool_]) -> Agreement | None:
    """Agreement of each `chosen` (N,) measurement with the one nearest to its image; every pair counts once."""
    rows = np.flatnonzero(chosen)
    if rows.size == 0:
        return None
    distance, nearest = cKDTree(positions).query(images[rows], distance_upper_bound=SAME_ANGLE)
    matched = np.isfinite(distance)
    first, second = rows[matched], nearest[matched]
    pairs = np.unique(np.sort(np.column_stack([first, second]), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    # in the order of the incidence, so that the bias has a meaning
    swapped = positions[pairs[:, 0], 0] > positions[pairs[:, 1], 0]
    pairs[swapped] = pairs[swapped][:, ::-1]
    return _agreement(used, pairs[:, 0], pairs[:, 1])


def _agreement(used: Measurements, first: NDArray[np.int64], second: NDArray[np.int64]) -> Agreement | None:
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
