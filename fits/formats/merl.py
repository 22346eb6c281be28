"""MERL binary (Matusik et al. 2003): a table of an isotropic BRDF over half and difference angles, in three channels.

The file is three int32 (90, 90, 180) and then float64 values, red first, then green, then blue, each indexed (i, j, k)
by theta_h = i^2 / 90 degrees, which is finer near the mirror direction, theta_d = j degrees and phi_d = k degrees. By
reciprocity phi_d has a period of 180 degrees. A negative value marks what could not be measured.

Bin centres: the database's own lookup code truncates the index, so that bin i covers [i, i + 1). We take its value to
stand at i + 1/2 in each index. Readers that put it at i differ by half a bin, which near a sharp peak is a lot.
"""

from pathlib import Path

import numpy as np

from fits.formats._text import plural
from fits.geometry import Floats, Geometry, slices
from fits.measurements import Measurements, Source

SHAPE = (90, 90, 180)  # theta_h, theta_d, phi_d
SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
CHANNELS = ("red", "green", "blue")
LOOKUPS = ("linear", "nearest")
_HEADER = np.array(SHAPE, "<i4").tobytes()
_BYTES = len(_HEADER) + 8 * len(CHANNELS) * int(np.prod(SHAPE))


def recognises(head: bytes) -> bool:
    """Whether a file starts with the header of a MERL table."""
    return head.startswith(_HEADER)


def read(path: Path, geometry: Geometry | None = None, lookup: str = "linear") -> Measurements:
    """Look a MERL table up along slices.

    geometry: the directions, both above the surface. Default: incidence 10, 30, 50, 70 degrees, detector from -85 to 85
        degrees in steps of 5 in the planes at azimuth 0, 30 and 60 degrees.
    lookup: "linear" interpolates between the 8 nearest bin centres, "nearest" takes the bin that the angles fall into,
        as the database's own code does. A sample that needs a bin without a measurement is masked and holds 0.
    """
    if lookup not in LOOKUPS:
        raise ValueError(f"lookup is {lookup!r}, must be one of {', '.join(LOOKUPS)}")
    if geometry is None:
        geometry = slices(azimuth=(0.0, 30.0, 60.0))
    if (geometry.wi[:, 2] <= 0).any() or (geometry.wo[:, 2] <= 0).any():
        raise ValueError("geometry holds directions at or below the horizon, a MERL table has only reflection above it")
    table = _table(path)
    index = _index(*half_difference(geometry.wi, geometry.wo))
    if lookup == "nearest":
        corners, weights = np.minimum(index, np.array(SHAPE) - 1e-9).astype(int)[None], np.ones((1, len(index)))
    else:
        corners, weights = _corners(index)
    corner_values = table[:, corners[..., 0], corners[..., 1], corners[..., 2]]  # (3, corners, N)
    if not np.isfinite(corner_values).all():
        raise ValueError(f"{path}: the table holds {corner_values[~np.isfinite(corner_values)][0]}, must be finite")
    valid = ((corner_values >= 0) | (weights == 0)).all(axis=(0, 1))
    values = np.where(valid, (weights * corner_values).sum(axis=1), 0.0).T * SCALE
    notes = [
        f"{lookup} lookup; bin i taken to cover [i, i + 1) with its centre at i + 1/2, as in the database's own code"
    ]
    if not valid.all():
        notes.append(f"masked: {plural(int((~valid).sum()), 'sample')} that need a bin without a measurement")
    return Measurements(
        geometry.wi, geometry.wo, values, None, valid, CHANNELS, Source(str(path), "merl", "brdf", tuple(notes))
    )


def half_difference(wi: Floats, wo: Floats) -> tuple[Floats, Floats, Floats]:
    """theta_h in [0, pi/2], theta_d in [0, pi/2] and phi_d in [0, pi) of pairs of directions (N, 3), in radians."""
    half = wi + wo
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    theta_h = np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2])
    phi_h = np.arctan2(half[:, 1], half[:, 0])
    # the frame around the half vector: wi in it gives the difference angles
    tangent = np.stack([np.cos(theta_h) * np.cos(phi_h), np.cos(theta_h) * np.sin(phi_h), -np.sin(theta_h)], axis=-1)
    bitangent = np.stack([-np.sin(phi_h), np.cos(phi_h), np.zeros_like(phi_h)], axis=-1)
    x, y, z = ((wi * axis).sum(axis=-1) for axis in (tangent, bitangent, half))
    theta_d, phi_d = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x) % np.pi
    return theta_h, theta_d, np.where(phi_d < np.pi, phi_d, 0.0)


def _index(theta_h: Floats, theta_d: Floats, phi_d: Floats) -> Floats:
    """Continuous table indices (N, 3), each in [0, size of its axis]."""
    share_h, share_d = theta_h / (np.pi / 2), theta_d / (np.pi / 2)
    return np.stack([np.sqrt(share_h), share_d, phi_d / np.pi], axis=-1) * SHAPE


def _corners(index: Floats) -> tuple[np.ndarray, Floats]:
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
