"""What is in a measurement file: tables, and sentences on doubtful angles, reciprocity, energy and repeats."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree

from fits.data.geometry import direction
from fits.data.measurements import Measurements
from fits.data.scans import AT_NORMAL, SAME_ANGLE, in_plane, incidences, relative_azimuth, scans, signed_angle
from fits.data.totals import Totals
from fits.reports.tables import Table, degrees, shortened

MOST_CHANNELS, MOST_ENERGIES, MOST_ANGLES = 6, 6, 24  # shown one by one: channels, energies, incidences in a line
BRIGHTER = 1.3  # ratio of the brightest measurements of two sides above which one side is the brighter beyond noise
SAME_PLACE = 0.05  # degrees within which two measurements are repeats of one
LEAST_COVERED = 0.5  # share of the projected hemisphere that must be covered for an integral over it
STEEP = 5.0  # polar angle of the light, in degrees, from which forward and backward are distinguished


def source_rows(data: Measurements) -> tuple[tuple[str, str], ...]:
    """What a file is: format, convention, counts, channels, incidences, sigma, and notes of its reader."""
    source, used, channels = data.source, int(np.count_nonzero(data.mask)), ", ".join(data.channels)
    if len(data.channels) > MOST_CHANNELS:
        channels = f"{', '.join(data.channels[:3])}, ..., {data.channels[-1]} ({len(data.channels):,} in all)"
    rows = [("format", source.format)]
    if isinstance(data, Totals):
        spheres = "" if data.spheres is None else ", as measured with an integrating sphere"
        if data.spheres is not None and data.spheres.together:
            spheres = ", as measured with two integrating spheres"
        rows.append(("quantity", f"shares of the incident flux{spheres}"))
    else:
        rows.append(("quantity", f"{source.quantity}, converted to BRDF in 1/sr"))
        rows.append(("in plane", f"{np.count_nonzero(in_plane(data))} of {len(data)}"))
    angles = [one.theta for one in incidences(data.used())]
    span = ", ".join(f"{angle:g}°" for angle in angles)
    if len(angles) > MOST_ANGLES:
        span = f"{len(angles)}, from {min(angles):g}° to {max(angles):g}°"
    sigma = "none"
    if data.sigma is not None and used:
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = (data.sigma / np.abs(data.values))[data.mask]
        sigma = f"median {np.median(relative):.2%} of the value, {np.min(relative):.2%} to {np.max(relative):.2%}"
    rows += [("measurements", f"{len(data)}, {used} used, {len(data) - used} masked"), ("channels", channels)]
    rows += [("incidence", span), ("sigma", sigma)]
    rows += [("attribution", source.attribution)] if source.attribution else []
    return (*rows, *(("note", note) for note in source.notes))


def data_table(data: Measurements) -> Table:
    """A row for each incidence: angles, counts, and the range of each channel's values; of totals for each of them."""
    few, rows = len(data.channels) <= MOST_CHANNELS, []
    if isinstance(data, Totals):
        for kind, theta, values in zip(data.kinds, data.theta_i, data.values, strict=True):
            numbers = values if few else (values.min(), values.max())
            rows.append((kind, degrees(theta), *(f"{value:.4g}" for value in numbers)))
        names = ("kind", "theta_i", *(data.channels if few else ("from", "to")))
        return Table("Shares of the incident flux", names, shortened(rows))
    flat = in_plane(data)
    for incidence in incidences(data):
        own = incidence.rows
        theta, values = data.theta_o[own], data.values[own]
        ranges = [f"{column.min():.3g} to {column.max():.3g}" for column in (values.T if few else values[None])]
        counts = (len(own), np.count_nonzero(data.mask[own]), np.count_nonzero(flat[own]))
        angles = (degrees(incidence.theta), degrees(incidence.phi), f"{degrees(theta.min())} to {degrees(theta.max())}")
        rows.append((*angles, *map(str, counts), *ranges))
    heads = tuple(f"BRDF {channel}" for channel in data.channels) if few else ("BRDF",)
    names = ("theta_i", "phi_i", "theta_o", "count", "used", "in plane", *heads)
    return Table("Angles, and BRDF in 1/sr", names, shortened(rows))


def doubtful_angles(data: Measurements) -> list[str]:
    """Sentences on angles that were probably meant otherwise: radians, azimuths from the mirror direction."""
    words, total = [], isinstance(data, Totals)
    largest = np.max(data.theta_i if total else np.concatenate([data.theta_i, data.theta_o]), initial=0.0)
    if 0.0 < largest < 1.6:  # a little more than a right angle in radians
        words.append(f"Angles: none is above {largest:.4g}°: are they radians? They were read as degrees.")
    if total or not len(found := sides(data)):
        return words
    theta, light, mirror = found.T
    brighter, darker = light > BRIGHTER * np.maximum(mirror, 0.0), mirror > BRIGHTER * np.maximum(light, 0.0)
    if np.isnan(mirror).all():
        where = "all measurements in the plane of incidence lie on the light's side"
    elif np.count_nonzero(brighter) > np.count_nonzero(darker):
        worst = np.argmax(np.where(brighter, light, -np.inf))
        where = f"the brightest side is the light's: at {theta[worst]:g}° up to {light[worst]:.3g} there"
        where = f"{where}, and {mirror[worst]:.3g} on the mirror side"
    else:
        return words
    return [
        *words,
        f"Sides: {where}. Unless the sample is retro-reflective, azimuths of this file count from the mirror "
        "direction, which must lie at phi_o = phi_i + 180.",
    ]


def data_statements(data: Measurements) -> list[str]:
    """Sentences on angles that look wrong, reciprocity, energy and repeats of the used data; of totals on angles."""
    if isinstance(data, Totals):
        return doubtful_angles(data)

    def agreement(what: str, pairs: Agreement | None) -> str:
        if pairs is None:
            return f"there are no measurements {what}"
        words = f"{pairs.number:,} pairs of measurements {what} differ by {100.0 * pairs.median:.2g} %"
        return f"{words} (median; 95 % of them by up to {100.0 * pairs.p95:.2g} %)"

    energy = "no incidence is measured over half of the hemisphere, the directional albedo is unknown"
    if known := energies(data):
        shares = [("/".join(f"{part:.3g}" for part in one.share), one) for one in known[:MOST_ENERGIES]]
        parts = [f"{share} at {one.theta:g}° over {100.0 * one.covered:.0f} % of it" for share, one in shares]
        energy = f"directional albedo over the measured part of the projected hemisphere: {'; '.join(parts)}"
    if above := [f"{one.theta:g}°" for one in known if max(one.share) > 1.0]:
        energy = f"{energy}. It exceeds 1 at {', '.join(above)}: the scale is wrong"
    repeated, noise = repeats(data), ""
    if repeated is not None:  # the median of the difference of two Gaussian numbers is 0.6745 sqrt(2) sd
        noise = f", a noise of about {100.0 * repeated.median / (0.6745 * math.sqrt(2.0)):.2g} %"
    return [
        *doubtful_angles(data),
        f"Reciprocity: {agreement('with light and viewer exchanged', reciprocity(data))}.",
        f"Energy: {energy}.",
        f"Repeats: {agreement('along the same directions', repeated)}{noise}.",
    ]


# ---- the checks: the sample is taken to be isotropic ----


class Agreement(NamedTuple):
    """Pairs of measurements that should be equal: their number, and quantiles of |difference| / mean."""

    number: int
    median: float
    p95: float


class Energy(NamedTuple):
    """Share (C,) of light at polar angle `theta` that is reflected into the `covered` share of the hemisphere."""

    theta: float
    share: tuple[float, ...]
    covered: float


def reciprocity(data: Measurements) -> Agreement | None:
    """Pairs in which light and viewer change places; None without any. Data of one side of the plane are mirrored."""
    used = _above(data)
    if not len(used):
        return None
    azimuth = np.where(np.minimum(used.theta_i, used.theta_o) < AT_NORMAL, 0.0, relative_azimuth(used))
    side = np.where(np.abs(np.sin(np.radians(azimuth))) > np.sin(np.radians(SAME_ANGLE)), azimuth, 0.0)
    both = side.min() < 0.0 < side.max()
    azimuth = azimuth if both else np.abs(azimuth)
    # the light's polar angle, and the viewer where the light stands at one azimuth
    places = np.column_stack([used.theta_i, np.degrees(direction(used.theta_o, azimuth))])
    exchanged = np.degrees(direction(used.theta_i, -azimuth if both else azimuth))
    rows = np.flatnonzero(np.abs(used.theta_i - used.theta_o) > SAME_ANGLE)
    tree, exchanged = cKDTree(places), np.column_stack([used.theta_o, exchanged])[rows]
    distance, nearest = tree.query(exchanged, distance_upper_bound=SAME_ANGLE)
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
    """Energy of each incidence that is measured over half of the projected hemisphere; of one side, mirrored."""
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


def sides(data: Measurements) -> NDArray[np.float64]:
    """Incidence, and the brightest on the sides of light and mirror (NaN: not measured) of each scan, (K, 3)."""
    used, result = _above(data), []
    angle, coplanar = signed_angle(used), in_plane(used)
    for rows in (rows[coplanar[rows]] for rows in scans(used)):
        if not rows.size or used.theta_i[rows[0]] < STEEP or angle[rows].min() >= -SAME_ANGLE:
            continue
        theta, level = angle[rows], used.values[rows].mean(axis=1)
        one_sided = theta.max() <= SAME_ANGLE
        limit = np.inf if one_sided else min(theta.max(), -theta.min()) + SAME_ANGLE
        light, mirror = (level[(sign * theta > SAME_ANGLE) & (sign * theta <= limit)] for sign in (-1, 1))
        if light.size and (mirror.size or one_sided):
            result.append((used.theta_i[rows[0]], light.max(), np.nan if one_sided else mirror.max()))
    return np.array(result).reshape(-1, 3)


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
