"""Checks of measurements before any model: reciprocity, energy, repeatability, and the side that azimuths count from.

The sample is taken to be isotropic: polar angles of light and viewer and the azimuth between them matter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree

from fits.data.measurements import Measurements
from fits.data.scans import AT_NORMAL, SAME_ANGLE, in_plane, incidences, relative_azimuth, scans, signed_angle

SAME_PLACE = 0.05  # degrees within which two measurements are repeats of one
LEAST_COVERED = 0.5  # share of the projected hemisphere that must be covered for an integral over it
STEEP = 5.0  # polar angle of the light, in degrees, from which forward and backward are distinguished


class Agreement(NamedTuple):
    """Pairs of measurements that should be equal: their number, and quantiles of |difference| / mean."""

    number: int
    median: float
    p95: float

    @property
    def noise(self) -> float:
        """Relative standard deviation of a single measurement, for random Gaussian differences."""
        return self.median / (0.6745 * 2.0**0.5)


class Energy(NamedTuple):
    """Share (C,) of light at polar angle `theta` that is reflected into the covered part of the hemisphere.

    covered: that part, as a share of the projected hemisphere.
    """

    theta: float
    share: tuple[float, ...]
    covered: float


class Sides(NamedTuple):
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
    if not len(used):
        return None
    azimuth = np.radians(relative_azimuth(used))
    side = np.where(np.abs(np.sin(azimuth)) > np.sin(np.radians(SAME_ANGLE)), np.sin(azimuth), 0.0)
    both = side.min() < 0.0 < side.max()
    azimuth = azimuth if both else np.abs(azimuth)
    # polar angles, and the azimuth between them as a point of a circle: at the normal there is none
    size = np.where(np.minimum(used.theta_i, used.theta_o) < AT_NORMAL, 0.0, np.degrees(1.0))
    circle = size * np.cos(azimuth), size * np.sin(azimuth)
    places = np.column_stack([used.theta_i, used.theta_o, *circle])
    exchanged = np.column_stack([used.theta_o, used.theta_i, circle[0], -circle[1] if both else circle[1]])
    rows = np.flatnonzero(np.abs(used.theta_i - used.theta_o) > SAME_ANGLE)
    distance, nearest = cKDTree(places).query(exchanged[rows], distance_upper_bound=SAME_ANGLE)
    found = np.isfinite(distance)
    pairs = np.unique(np.sort(np.column_stack([rows[found], nearest[found]]), axis=1), axis=0)
    return _agreement(used, *pairs[pairs[:, 0] != pairs[:, 1]].T)


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


def _agreement(used: Measurements, first: NDArray[np.int64], second: NDArray[np.int64]) -> Agreement | None:
    one, other = used.values[first], used.values[second]
    mean = 0.5 * (one + other)
    if not (mean > 0.0).any():
        return None
    apart = np.abs(other - one)[mean > 0.0] / mean[mean > 0.0]
    return Agreement(first.size, float(np.median(apart)), float(np.quantile(apart, 0.95)))
