"""MERL binary (Matusik et al. 2003): a table of an isotropic BRDF over half and difference angles, in three channels.

The file is three int32 (90, 90, 180) and then float64 values, red first, then green, then blue, each indexed (i, j, k)
by theta_h = i^2 / 90 degrees, which is finer near the mirror direction, theta_d = j degrees and phi_d = k degrees. By
reciprocity phi_d has a period of 180 degrees. A negative value marks what could not be measured.

Bin centres: the database's own lookup code truncates the index, so that bin i covers [i, i + 1). We take its value to
stand at i + 1/2 in each index. Readers that put it at i differ by half a bin, which near a sharp peak is a lot.

Measurements are taken at the centres of bins by default. Between them a table has to be interpolated, which is
off near peaks: from an exact table of flakes (roughness 0.02) over paint a fit of interpolated values, each taken to be
accurate to 1 %, finds an optical depth of 0.828 +- 0.002 for 0.8, and at the centres 0.8.
"""

import itertools
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fits.data.formats import merl_bins
from fits.data.formats._text import plural
from fits.data.geometry import LIGHT_AZIMUTH, Floats, Geometry, azimuth, polar, slices
from fits.data.measurements import Measurements, Source

Indices = NDArray[np.int_]

SHAPE = (90, 90, 180)  # theta_h, theta_d, phi_d
SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
CHANNELS = ("red", "green", "blue")
LOOKUPS = ("centre", "linear", "nearest")
SAME_INCIDENCE = 0.2  # degrees; slices stay slices: `fits.data.scans.incidences` needs less than 0.25
CONVENTION = "bin i taken to cover [i, i + 1) with its centre at i + 1/2, as in the database's own code"
REACH = 2  # bins to either side, in each index, among which a centre is sought
_HEADER = np.array(SHAPE, "<i4").tobytes()
_BYTES = len(_HEADER) + 8 * len(CHANNELS) * int(np.prod(SHAPE))


def recognises(head: bytes) -> bool:
    """Whether a file starts with the header of a MERL table."""
    return head.startswith(_HEADER)


def read(
    path: Path,
    geometry: Geometry | None = None,
    lookup: str = "centre",
    bins: int | Literal["all"] | None = None,
    strata: merl_bins.Strata = "bins",
    seed: int = 0,
) -> Measurements:
    """Look a MERL table up along slices, or read many bins all over it.

    geometry: the directions, both above the surface. Default: incidence 10, 30, 50, 70 degrees, detector from -85 to 85
        degrees in steps of 5 in the planes at azimuth 0, 30 and 60 degrees; for "centre" all polar angles are half a
        degree more, because the bins at mirror directions have theta_i = theta_o = j + 1/2 degrees.
    lookup: "centre" gives each bin's value as it is and, in place of the requested directions, those at the centre of
        a bin near them: the incidence within 0.2 degrees where there is such a bin, the viewer a few degrees away, and
        more only in azimuth around light near the normal. No bin is read twice, so that there may be fewer measurements
        than directions.
        "linear" interpolates between the 8 nearest bin centres, "nearest" takes the bin that the angles fall into, as
        the database's own code does: both keep the requested directions.
    bins: instead of slices, so many bins that hold a measurement, at most 100,000, or "all" of them (1.4 million).
    strata: what each of so many bins stands for an equal share of: "bins" of the table, which are dense around the
        mirror direction, or "flux", the projected solid angle of light and viewer, as in an integral over both.
    seed: of the choice.
    A sample that needs a bin without a measurement, or one that holds nan, is masked and holds 0; bins that are chosen
    all have one.
    """
    if lookup not in LOOKUPS:
        raise ValueError(f"lookup is {lookup!r}, must be one of {', '.join(LOOKUPS)}")
    if bins is not None:
        merl_bins.check(bins, strata, seed)
        if geometry is not None or lookup != "centre":
            raise ValueError("bins stands beside geometry or lookup: whole bins are read, at their centres")
        return _of_bins(path, bins, strata, seed)
    if geometry is None:
        more = 0.5 if lookup == "centre" else 0.0
        incidence, outgoing = np.array([10.0, 30.0, 50.0, 70.0]) + more, np.arange(-85.0, 86.0, 5.0) + more
        geometry = slices(incidence, outgoing, azimuth=(0.0, 30.0, 60.0))
    if (geometry.wi[:, 2] <= 0).any() or (geometry.wo[:, 2] <= 0).any():
        raise ValueError("geometry holds directions at or below the horizon, a MERL table has only reflection above it")
    table = _table(path)
    notes = [f"{lookup} lookup; {CONVENTION}"]
    if lookup == "centre":
        geometry, found, choice = _at_centres(geometry)
        notes += choice
        corners, weights = found[None], np.ones((1, len(found)))
    else:
        index = index_of(*half_difference(geometry.wi, geometry.wo))
        if lookup == "nearest":
            corners, weights = np.minimum(index, np.array(SHAPE) - 1e-9).astype(int)[None], np.ones((1, len(index)))
        else:
            corners, weights = corners_around(index)
    values, valid, more_notes = _looked_up(path, table, corners, weights)
    return _samples(path, geometry, values, valid, notes + more_notes)


def _looked_up(
    path: Path, table: Floats, corners: Indices, weights: Floats
) -> tuple[Floats, NDArray[np.bool_], list[str]]:
    """Means (N, 3) over bins (K, N, 3) with weights (K, N), whether they were measured (N,), and notes."""
    corner_values = np.where(weights == 0, 0.0, table[:, corners[..., 0], corners[..., 1], corners[..., 2]])
    lost = _damaged(path, corner_values).any(axis=(0, 1))
    valid = np.asarray((corner_values >= 0).all(axis=(0, 1)))
    if lost.all():
        raise ValueError(f"{path}: all bins that are requested hold nan")
    values = np.where(valid, (weights * corner_values).sum(axis=1), 0.0).T * SCALE
    notes = []
    if lost.any():
        notes.append(f"skipped: {plural(int(lost.sum()), 'data point')} that need a bin that holds nan")
    if not (valid | lost).all():
        count = int((~valid & ~lost).sum())
        notes.append(f"masked: {plural(count, 'sample')} that need a bin without a measurement")
    return values, valid, notes


def _of_bins(path: Path, bins: int | Literal["all"], strata: merl_bins.Strata, seed: int) -> Measurements:
    """Measurements at the centres of bins that hold one."""
    table = _table(path)
    lost = _damaged(path, table).any(axis=0)
    wi, wo = centre(np.stack(np.unravel_index(np.arange(np.prod(SHAPE)), SHAPE), axis=-1))
    cosine_i, cosine_o = wi[:, 2].reshape(SHAPE), wo[:, 2].reshape(SHAPE)
    readable = (cosine_i > 0) & (cosine_o > 0) & (table >= 0).all(axis=0)
    if not readable.any():
        raise ValueError(f"{path}: no bin holds a measurement")
    if bins == "all":
        chosen, note = merl_bins.all_bins(readable)
    else:
        measure = np.ones(SHAPE)
        if strata == "flux":
            theta_h, theta_d, _ = np.meshgrid(*_angles(*(np.arange(size) for size in SHAPE)), indexing="ij")
            measure = merl_bins.projected_solid_angle(cosine_i, cosine_o, theta_h, theta_d)
        chosen, note = merl_bins.choice(readable, measure, bins, strata, seed)
    place = np.ravel_multi_index(tuple(chosen.T), SHAPE)
    wi, wo = wi[place], wo[place]
    turn = np.radians(LIGHT_AZIMUTH - azimuth(wi))
    values = table[:, *chosen.T].T * SCALE
    geometry = Geometry(_turned(wi, turn), _turned(wo, turn))
    notes = [CONVENTION, note]
    if lost.any():
        notes.append(f"skipped: {plural(int(lost.sum()), 'bin')} of the table that hold nan")
    return _samples(path, geometry, values, np.ones(len(values), bool), notes)


def _samples(
    path: Path, geometry: Geometry, values: Floats, valid: NDArray[np.bool_], notes: list[str]
) -> Measurements:
    source = Source(str(path), "merl", "brdf", tuple(notes))
    return Measurements(geometry.wi, geometry.wo, values, None, valid, CHANNELS, source)


def _damaged(path: Path, values: Floats) -> NDArray[np.bool_]:
    """Mask of values that are nan, which programs write for bins not measured; ValueError for infinite ones."""
    if np.isinf(values).any():
        raise ValueError(f"{path}: the table holds {values[np.isinf(values)][0]}, must be finite")
    return np.isnan(values)


def half_difference(wi: Floats, wo: Floats) -> tuple[Floats, Floats, Floats]:
    """theta_h in [0, pi/2], theta_d in [0, pi/2] and phi_d in [0, pi) of pairs of directions (N, 3), in radians."""
    theta_h, theta_d, phi_d = _half_difference(wi, wo)
    phi_d %= np.pi
    return theta_h, theta_d, np.where(phi_d < np.pi, phi_d, 0.0)


def _half_difference(wi: Floats, wo: Floats) -> tuple[Floats, Floats, Floats]:
    """Half and difference angles of pairs of directions (N, 3), in radians, with phi_d in [0, 2 pi].

    Beyond pi it is that of the pair with wi and wo exchanged, plus pi.
    """
    half = wi + wo
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    theta_h = np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2])
    tangent, bitangent, half = _frame(theta_h, np.arctan2(half[:, 1], half[:, 0]))
    # wi in the frame around the half vector gives the difference angles
    x, y, z = ((wi * axis).sum(axis=-1) for axis in (tangent, bitangent, half))
    return theta_h, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x) % (2 * np.pi)


def _frame(theta_h: Floats, phi_h: Floats) -> tuple[Floats, Floats, Floats]:
    """Tangent along the meridian, bitangent along the parallel, and the half vector itself, each (N, 3)."""
    tangent = np.stack([np.cos(theta_h) * np.cos(phi_h), np.cos(theta_h) * np.sin(phi_h), -np.sin(theta_h)], axis=-1)
    bitangent = np.stack([-np.sin(phi_h), np.cos(phi_h), np.zeros_like(phi_h)], axis=-1)
    half = np.stack([np.sin(theta_h) * np.cos(phi_h), np.sin(theta_h) * np.sin(phi_h), np.cos(theta_h)], axis=-1)
    return tangent, bitangent, half


def index_of(theta_h: Floats, theta_d: Floats, phi_d: Floats) -> Floats:
    """Continuous table indices (N, 3), each in [0, size of its axis]."""
    share_h, share_d = theta_h / (np.pi / 2), theta_d / (np.pi / 2)
    return np.stack([np.sqrt(share_h), share_d, phi_d / np.pi], axis=-1) * SHAPE


def _at_centres(requested: Geometry) -> tuple[Geometry, Indices, list[str]]:
    """Pairs of directions at centres of bins near the requested ones, their bins (M, 3), none twice, and notes on both.

    The azimuth of the light is kept: of an isotropic material it is free.
    """
    bins, found = _near(requested)
    if not found.any():
        raise ValueError("geometry holds only pairs too near the horizon: no bin there has its centre above it")
    _, first = np.unique((bins % SHAPE)[found], axis=0, return_index=True)
    kept = np.flatnonzero(found)[np.sort(first)]
    total, bins, requested = len(requested), bins[kept], Geometry(requested.wi[kept], requested.wo[kept])
    wi, wo = centre(bins)
    incidence, along, across = _distances(requested, wi, wo)
    notes = [
        f"measurements at the centres of {plural(len(bins), 'bin')}; from the requested directions the incidence "
        f"differs by up to {incidence.max():.2g} degrees, the viewer by up to {np.hypot(along, across).max():.2g}"
    ]
    if len(bins) < total:
        reason = "their bins were already read, or no bin near them has its centre above the horizon"
        notes.append(f"skipped: {total - len(bins)} of the {plural(total, 'pair')} requested: {reason}")
    turn = np.radians(_light_azimuth(requested.wi) - azimuth(wi))
    return Geometry(_turned(wi, turn), _turned(wo, turn)), bins % SHAPE, notes


def _near(requested: Geometry) -> tuple[Indices, NDArray[np.bool_]]:
    """A bin for each pair (N, 3), with phi_d counted on to 360 for exchanged directions, and whether there is one (N,).

    It is the one whose viewer is nearest, among those within `SAME_INCIDENCE` of the incidence where there are any.
    """
    theta_h, theta_d, phi_d = _half_difference(requested.wi, requested.wo)
    start = np.floor(index_of(theta_h, theta_d, phi_d)).astype(int)
    stride = np.ones_like(start)
    # where theta_d is small a step of phi_d hardly moves anything: several at once
    stride[:, 2] = np.rint(1 / np.maximum(np.sin(theta_d), 0.01))
    bins, least = start, np.full(len(requested), np.inf)
    for step in itertools.product(range(-REACH, REACH + 1), repeat=3):
        tried = start + stride * np.array(step)
        wi, wo = centre(tried)
        exists = ((tried >= 0) & (tried < SHAPE))[:, :2].all(axis=-1) & (wi[:, 2] > 0) & (wo[:, 2] > 0)
        incidence, along, across = _distances(requested, wi, wo)
        # across counts double, so that requests in the plane of incidence stays near it
        far = np.hypot(along, 2 * across) + 100 * np.maximum(incidence - SAME_INCIDENCE, 0)
        better = exists & (far < least - 1e-6)  # of equally near ones the first, whatever the rounding
        bins, least = np.where(better[:, None], tried, bins), np.where(better, far, least)
    return bins, np.isfinite(least)


def centre(bins: Indices) -> tuple[Floats, Floats]:
    """wi and wo (N, 3) at the centres of bins (N, 3), the half vector at azimuth 0; phi_d may count beyond 180."""
    theta_h, theta_d, phi_d = (angle[:, None] for angle in _angles(*bins.T))
    tangent, bitangent, half = _frame(theta_h[:, 0], np.zeros(len(bins)))
    across = np.sin(theta_d) * (np.cos(phi_d) * tangent + np.sin(phi_d) * bitangent)
    return np.cos(theta_d) * half + across, np.cos(theta_d) * half - across


def _angles(i: Indices, j: Indices, k: Indices) -> tuple[Floats, Floats, Floats]:
    """theta_h, theta_d and phi_d at the centres of bins, in radians."""
    share_h, share_d, share_phi = ((index + 0.5) / size for index, size in zip((i, j, k), SHAPE, strict=True))
    return share_h**2 * (np.pi / 2), share_d * (np.pi / 2), share_phi * np.pi


def _distances(requested: Geometry, wi: Floats, wo: Floats) -> tuple[Floats, Floats, Floats]:
    """Distance from the requested pairs, (N,) degrees: incidence, viewer in polar angle, and viewer sideways."""
    turn = azimuth(wo) - azimuth(wi) - azimuth(requested.wo) + _light_azimuth(requested.wi)
    sideways = ((turn + 180.0) % 360.0 - 180.0) * np.sin(np.radians(polar(requested.wo)))
    return abs(polar(wi) - polar(requested.wi)), polar(wo) - polar(requested.wo), sideways


def _light_azimuth(wi: Floats) -> Floats:
    """Azimuth of the light, (N,) degrees; light along the normal counts as standing at `LIGHT_AZIMUTH`."""
    return np.where(polar(wi) < 1e-6, LIGHT_AZIMUTH, azimuth(wi))


def _turned(w: Floats, angle: Floats) -> Floats:
    """Directions (N, 3) turned about the normal by angles (N,) in radians."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([cosine * w[:, 0] - sine * w[:, 1], sine * w[:, 0] + cosine * w[:, 1], w[:, 2]], axis=-1)


def corners_around(index: Floats) -> tuple[np.ndarray, Floats]:
    """The 8 bins around each index (8, N, 3) and their weights (8, N) in a linear interpolation between bin centres."""
    low = np.floor(index - 0.5)
    fraction = index - 0.5 - low
    corners, weights = [], []
    for step in np.ndindex(2, 2, 2):
        corner = (low + step).astype(int)
        corner[:, :2] = np.clip(corner[:, :2], 0, np.array(SHAPE[:2]) - 1)  # beyond the outermost centres: their value
        corner[:, 2] %= SHAPE[2]
        corners.append(corner)
        weights.append(np.where(step, fraction, 1 - fraction).prod(axis=-1))
    return np.stack(corners), np.stack(weights)


def _table(path: Path) -> np.ndarray:
    """The raw table (3, 90, 90, 180), mapped and not read."""
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(len(_HEADER))
    if len(header) < len(_HEADER):
        raise ValueError(f"{path}: truncated MERL file, {size} bytes found, {_BYTES} expected")
    if header != _HEADER:
        found = tuple(int(number) for number in np.frombuffer(header, "<i4"))
        raise ValueError(f"{path}: MERL header says {found}, must be {SHAPE}")
    if size != _BYTES:
        problem = "truncated MERL file" if size < _BYTES else "MERL file too long"
        raise ValueError(f"{path}: {problem}, {size} bytes found, {_BYTES} expected")
    return np.memmap(path, "<f8", "r", offset=len(_HEADER), shape=(len(CHANNELS), *SHAPE))
