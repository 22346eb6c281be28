"""The table in a file of RGL's measured materials (Dupuy & Jakob 2018), which Mitsuba and pbrt read.

For each direction of the light, at the nodes ``theta_i`` and ``phi_i``, the file holds a grid of values over the unit
square. A point of the square has its direction by ``vndf``, a density on the square (u, v) of half vectors, u =
sqrt(2 theta / pi) and v = (phi + pi) / 2 pi, with phi from that of the light where the material is isotropic: the point
is the pair of numbers that draws the half vector from it. Values are f cos(theta_o) = value D / (4 sigma), with D the
table ``ndf`` over half vectors and sigma the table ``sigma`` over directions of the light (``jacobian`` 1), or as they
are (0). Here i is the light, and theta_o belongs to the viewer.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fits.data.formats._square import Density, Interpolation, bilinear
from fits.data.formats._tensor_file import Fields, fields_as_bytes, read_fields
from fits.data.geometry import Floats

RGB = ("red", "green", "blue")
_ISOTROPIC = 2
"""Azimuths of the light at most, of a material that is isotropic."""

_DIMENSIONS = {
    "theta_i": 1,
    "phi_i": 1,
    "ndf": 2,
    "sigma": 2,
    "vndf": 4,
    "luminance": 4,
    "description": 1,
    "jacobian": 1,
}


@dataclass(frozen=True)
class Table:
    """Content of such a file.

    theta_i (T,), phi_i (P,): of the light, radians, ascending. ndf, sigma: (h, w), rows over azimuth. vndf: (P, T, h,
    w). luminance: (P, T, n, n), what is drawn from. values: (P, T, C, n, n). wavelengths: (C,) nm; None for red, green
    and blue.
    """

    theta_i: Floats
    phi_i: Floats
    ndf: Floats
    sigma: Floats
    vndf: Floats
    luminance: Floats
    values: Floats
    wavelengths: Floats | None
    description: str
    jacobian: bool = True

    @property
    def isotropic(self) -> bool:
        return len(self.phi_i) <= _ISOTROPIC

    @property
    def channels(self) -> tuple[str, ...]:
        return RGB if self.wavelengths is None else tuple(f"{one:g} nm" for one in self.wavelengths)

    @property
    def turns(self) -> int:
        """Number of times that the azimuths of the file fill the circle; 1 for an isotropic material."""
        if self.isotropic:
            return 1
        return int(np.rint(2 * np.pi / (self.phi_i[-1] - self.phi_i[0])))

    @cached_property
    def density(self) -> Density:
        """Density of half vectors, for each direction of the light, azimuths first."""
        return Density(self.vndf.reshape(-1, *self.vndf.shape[2:]))

    def factor(self, theta_m: Floats, phi_m: Floats, theta_i: Floats, phi_i: Floats) -> Floats:
        """Factor of the values, (N,)."""
        if not self.jacobian:
            return np.ones_like(theta_m)
        sigma = bilinear(self.sigma[None], to_u(theta_i), to_v(phi_i))
        return bilinear(self.ndf[None], to_u(theta_m), to_v(phi_m)) / (4.0 * sigma)

    def nodes(self, place: slice = slice(None)) -> tuple[Floats, Floats, Floats, Floats]:
        """Nodes of the values: azimuth of the light (L,), its polar angle (L,), of half vectors theta, phi (L, n, n).

        The azimuth of half vectors is from that of the light where the material is isotropic. place: some of the L
        directions.
        """
        side = np.linspace(0.0, 1.0, self.values.shape[-1])
        phi_i, theta_i = (angle.ravel()[place] for angle in np.meshgrid(self.phi_i, self.theta_i, indexing="ij"))
        density = Density(self.density.tables[place])
        u, v = density.drawn(side, side)
        return phi_i, theta_i, from_u(u), from_v(v)


def to_u(theta: Floats) -> Floats:
    return np.sqrt(theta * (2.0 / np.pi))


def to_v(phi: Floats) -> Floats:
    """v of azimuths in any turn; the end of the square is its start."""
    v = (phi + np.pi) / (2.0 * np.pi)
    return v - np.floor(v)


def from_u(u: Floats) -> Floats:
    return u * u * (np.pi / 2.0)


def from_v(v: Floats) -> Floats:
    return (2.0 * v - 1.0) * np.pi


def unit(theta: Floats, phi: Floats) -> Floats:
    """Unit vectors (..., 3) from angles in radians."""
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def look_up(table: Table, wi: Floats, wo: Floats) -> Floats:
    """f cos(theta_o) at pairs of directions above the surface (N, 3), as renderers find it, (N, C)."""
    wi, wo = _turned(table, wi, wo)
    half = wi + wo
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    theta_i, phi_i = _angles(wi)
    theta_m, phi_m = _angles(half)
    turn = phi_m - phi_i if table.isotropic else phi_m
    interpolation = _interpolation(table, theta_i, phi_i)
    x, y, _ = table.density.undrawn(to_u(theta_m), to_v(turn), interpolation)
    values = table.values.reshape(len(table.phi_i) * len(table.theta_i), *table.values.shape[2:])
    found = [bilinear(values[:, channel], x, y, interpolation) for channel in range(values.shape[1])]
    return np.stack(found, axis=-1) * table.factor(theta_m, turn, theta_i, phi_i)[:, None]


def _turned(table: Table, wi: Floats, wo: Floats) -> tuple[Floats, Floats]:
    """Both directions, mirrored together so that the light stands where the file has it."""
    if table.turns < 2:
        return wi, wo
    y = np.where(wi[:, 1] > 0, -1.0, 1.0)
    x = np.where(wi[:, 0] > 0, -1.0, 1.0) if table.turns >= 4 else y
    mirror = np.stack([x, y, np.ones_like(x)], axis=-1)
    return wi * mirror, wo * mirror


def _angles(w: Floats) -> tuple[Floats, Floats]:
    return np.arctan2(np.hypot(w[:, 0], w[:, 1]), w[:, 2]), np.arctan2(w[:, 1], w[:, 0])


def _interpolation(table: Table, theta_i: Floats, phi_i: Floats) -> Interpolation:
    """Interpolation between the file's directions of the light, clamped to their range."""
    phi, share_phi = _around(table.phi_i, phi_i)
    theta, share_theta = _around(table.theta_i, theta_i)
    index = phi[:, :, None] * len(table.theta_i) + theta[:, None, :]
    share = share_phi[:, :, None] * share_theta[:, None, :]
    return Interpolation(index.reshape(len(index), -1), share.reshape(len(index), -1))


def _around(nodes: Floats, at: Floats) -> tuple[NDArray[np.int_], Floats]:
    if len(nodes) == 1:
        return np.zeros((len(at), 1), int), np.ones((len(at), 1))
    low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    share = np.clip((at - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)
    return np.stack([low, low + 1], axis=-1), np.stack([1.0 - share, share], axis=-1)


def table_as_bytes(table: Table) -> bytes:
    """The file."""
    fields: dict[str, NDArray | str] = {
        "description": table.description,
        "jacobian": np.array([table.jacobian], np.uint8),
    }
    for name in ("phi_i", "theta_i", "ndf", "sigma", "vndf", "luminance"):
        fields[name] = np.asarray(getattr(table, name), np.float32)
    fields["rgb" if table.wavelengths is None else "spectra"] = table.values.astype(np.float32)
    if table.wavelengths is not None:
        fields["wavelengths"] = np.asarray(table.wavelengths, np.float32)
    return fields_as_bytes(fields)


def read_table(path: Path) -> Table:
    """The table in a file; ValueError that names the field which is missing or is not what it must be."""
    fields = read_fields(path)
    for name, dimensions in _DIMENSIONS.items():
        if name not in fields:
            raise ValueError(f"{path}: no field {name!r} (fields: {', '.join(fields) or 'none'})")
        if fields[name].ndim != dimensions or fields[name].size == 0:
            raise ValueError(
                f"{path}: field {name!r} has shape {fields[name].shape}, must have {dimensions} dimensions"
            )
    holds = [name for name in ("spectra", "rgb") if name in fields]
    if not holds:
        raise ValueError(f"{path}: no field 'spectra' or 'rgb' (fields: {', '.join(fields)})")
    values = _numbers(path, fields, holds[0])
    light = (len(fields["phi_i"]), len(fields["theta_i"]))
    wavelengths = None
    if holds[0] == "spectra":
        if "wavelengths" not in fields:
            raise ValueError(f"{path}: no field 'wavelengths' beside 'spectra'")
        wavelengths = _numbers(path, fields, "wavelengths")
    channels = 3 if wavelengths is None else len(wavelengths)
    _require_shape(path, holds[0], values, (*light, channels, values.shape[-1], values.shape[-1]))
    for name in ("vndf", "luminance"):
        _require_shape(path, name, fields[name], (*light, *fields[name].shape[2:]))
    table = Table(
        **{name: _numbers(path, fields, name) for name in ("theta_i", "phi_i", "ndf", "sigma", "vndf", "luminance")},
        values=values,
        wavelengths=wavelengths,
        description=bytes(fields["description"]).decode("utf-8", "replace").rstrip("\0"),
        jacobian=bool(fields["jacobian"].ravel()[0]),
    )
    _require_ranges(path, table)
    return table


def _numbers(path: Path, fields: Fields, name: str) -> Floats:
    with np.errstate(invalid="ignore"):  # of values that are no numbers, which are refused next
        values = np.asarray(fields[name], float)
    if not np.isfinite(values).all():
        raise ValueError(f"{path}: field {name!r} holds {values[~np.isfinite(values)][0]}, must be finite")
    return values


def _require_shape(path: Path, name: str, values: NDArray, shape: tuple[int, ...]) -> None:
    if values.shape != shape or min(shape[-2:]) < 2:
        raise ValueError(f"{path}: field {name!r} has shape {values.shape}, must be {shape}, the last two 2 at least")


def _require_ranges(path: Path, table: Table) -> None:
    ranges = {"theta_i": (0.0, np.pi / 2 + 1e-3), "phi_i": (-np.pi - 1e-3, 2 * np.pi + 1e-3)}
    for name, (low, high) in ranges.items():
        angles = getattr(table, name)
        if (angles < low).any() or (angles > high).any():
            worst = angles[(angles < low) | (angles > high)][0]
            raise ValueError(f"{path}: field {name!r} holds {worst:.4g}, must be in [{low:.4g}, {high:.4g}] radians")
        if (np.diff(angles) <= 0).any():
            raise ValueError(f"{path}: field {name!r} must ascend")
    for name in ("ndf", "sigma", "vndf"):
        values = getattr(table, name)
        if min(values.shape[-2:]) < 2:
            raise ValueError(f"{path}: field {name!r} has shape {values.shape}, the last two must be 2 at least")
        if (values < 0).any():
            raise ValueError(f"{path}: field {name!r} holds {values.min():.4g}, must be >= 0")
    if table.jacobian and (table.sigma == 0).any():
        raise ValueError(f"{path}: field 'sigma' holds 0, must be above it")
    if (table.vndf.max(axis=(2, 3)) == 0).any():
        raise ValueError(f"{path}: field 'vndf' is 0 everywhere for a direction of the light")
