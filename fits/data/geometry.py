"""Measurement geometry in degrees and float64, for data that must not depend on jax's precision setting.

The conventions are those of `layerjax.directions`; data files count angles in degrees. Where only one azimuth matters,
the light stands at phi_i = 180, so that phi_o = 0 is the forward (mirror) side.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

LIGHT_AZIMUTH = 180.0  # degrees; the plane of incidence is x-z and the mirror direction lies at azimuth 0
AT_NORMAL = 1e-6  # degrees from the normal below which a direction has no azimuth
TANGENT_COSINE = 1e-9  # a direction with a smaller |cos theta| counts as lying in the surface


class Pairs:
    """N pairs of directions: unit vectors `wi` and `wo`, (N, 3), towards the light and towards the viewer."""

    wi: Floats
    wo: Floats

    def __len__(self) -> int:
        return len(self.wi)

    @property
    def theta_i(self) -> Floats:
        """Polar angle of the light, (N,), degrees in [0, 180]."""
        return polar(self.wi)

    @property
    def phi_i(self) -> Floats:
        """Azimuth of the light, (N,), degrees in [0, 360)."""
        return azimuth(self.wi)

    @property
    def theta_o(self) -> Floats:
        """Polar angle of the viewer, (N,), degrees in [0, 180]; above 90 is transmission for light from above."""
        return polar(self.wo)

    @property
    def phi_o(self) -> Floats:
        """Azimuth of the viewer, (N,), degrees in [0, 360)."""
        return azimuth(self.wo)


@dataclass(frozen=True, eq=False)
class Geometry(Pairs):
    """Pairs of directions of light and viewer, for example to predict or simulate measurements.

    Args:
        wi: (N, 3), unit vectors towards the light, pointing away from the surface.
        wo: (N, 3), unit vectors towards the viewer.
    """

    wi: Floats
    wo: Floats

    def __post_init__(self) -> None:
        for name in ("wi", "wo"):
            if np.shape(w := getattr(self, name))[-1:] != (3,):
                raise ValueError(f"{name} has shape {np.shape(w)}, must be (N, 3)")

    def __repr__(self) -> str:
        return f"<Geometry: {len(self):,} pairs of directions>"


def direction(theta: ArrayLike, phi: ArrayLike) -> Floats:
    """Unit vectors (..., 3) from polar angle and azimuth in degrees; a negative theta tilts to the opposite azimuth."""
    tilt, turn = np.broadcast_arrays(np.radians(np.asarray(theta, float)), np.radians(np.asarray(phi, float)))
    sine = np.sin(tilt)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), np.cos(tilt)], axis=-1)


def polar(w: Floats) -> Floats:
    """Polar angle of unit vectors (..., 3), in degrees in [0, 180], rounded to 1e-10."""
    angle: Floats = np.degrees(np.arctan2(np.hypot(w[..., 0], w[..., 1]), w[..., 2]))
    return angle.round(10)


def azimuth(w: Floats) -> Floats:
    """Azimuth of unit vectors (..., 3), in degrees in [0, 360), rounded to 1e-10; 0 at the pole."""
    at_pole = np.hypot(w[..., 0], w[..., 1]) < 1e-12
    return np.where(at_pole, 0.0, np.round(np.degrees(np.arctan2(w[..., 1], w[..., 0])), 10) % 360.0)


def slices(
    incidence: ArrayLike = (10.0, 30.0, 50.0, 70.0),
    outgoing: ArrayLike | None = None,
    azimuth: float | Sequence[float] = 0.0,
) -> Geometry:
    """Goniometer slices, all angles in degrees.

    Args:
        incidence: polar angles of the light, in [0, 180] (above 90 lights from below).
        outgoing: signed polar angles of the detector in each plane, in [-180, 180]; positive is the side at `azimuth`.
            Default -85 to 85 in steps of 5. Beyond +-90 looks at transmitted light.
        azimuth: one or more planes through the normal, as the azimuth of their positive side, in [-360, 360]; 0 is the
            plane of incidence, mirror direction on the positive side. The normal is taken once for each incidence.

    Returns:
        All pairs of an incidence with a detector position, the incidences one after the other.

    Raises:
        ValueError: an angle out of its range, or none at all.
    """
    incident = _angles("incidence", incidence, 0.0, 180.0)
    signed = _angles("outgoing", np.arange(-85.0, 86.0, 5.0) if outgoing is None else outgoing, -180.0, 180.0)
    planes = _angles("azimuth", azimuth, -360.0, 360.0)

    plane, theta_o = (grid.ravel() for grid in np.meshgrid(planes, signed, indexing="ij"))
    repeated_pole = (abs(np.sin(np.radians(theta_o))) < 1e-12) & (plane != planes[0])
    wo = direction(theta_o, plane)[~repeated_pole]
    wi = direction(incident, LIGHT_AZIMUTH)
    return Geometry(wi=np.repeat(wi, len(wo), axis=0), wo=np.tile(wo, (len(wi), 1)))


def _angles(name: str, values: ArrayLike, low: float, high: float) -> Floats:
    try:
        array = np.atleast_1d(np.asarray(values, float)).ravel()
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {' '.join(repr(values).split()):.60}, must be angles in degrees") from None
    if array.size == 0:
        raise ValueError(f"{name} is empty: it needs at least one angle in degrees in [{low:g}, {high:g}]")
    bad = ~((array >= low) & (array <= high))
    if bad.any():
        raise ValueError(f"{name} is {array[bad][0]:g}, must be in [{low:g}, {high:g}] degrees")
    return array
