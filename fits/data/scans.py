"""How measurements lie in angle: their incidences, planes, and scans along a plane."""

from dataclasses import dataclass

import numpy as np

from fits.data.geometry import AT_NORMAL as AT_NORMAL
from fits.data.geometry import LIGHT_AZIMUTH, Pairs

SAME_ANGLE = 0.5  # degrees: closer incidences are one incidence, closer azimuths one plane
SHORTEST_SCAN = 5  # points in one plane before neighbours in it mean anything


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
    """The distinct incident directions, by polar angle then azimuth; rows within `SAME_ANGLE` count as the same."""
    # Angles come back from unit vectors: rounding first keeps a value that sits between two bins in one of them.
    theta, phi = np.round(data.theta_i, 6), np.round(data.phi_i, 6) % 360.0
    phi = np.where(theta < AT_NORMAL, LIGHT_AZIMUTH, phi)
    keys = np.stack([np.round(theta / SAME_ANGLE), np.round(phi / SAME_ANGLE) % round(360 / SAME_ANGLE)], axis=-1)
    unique, which = np.unique(keys, axis=0, return_inverse=True)
    groups = [np.flatnonzero(which.ravel() == index) for index in range(len(unique))]
    return [Incidence(_tidy(theta[rows]), _tidy(phi[rows]), rows) for rows in groups]


def relative_azimuth(data: Pairs) -> np.ndarray:
    """Azimuth of the viewer seen from the mirror side, (N,) degrees in (-180, 180]: 0 is forward, 180 backward.

    Light along the normal has no azimuth of its own: it counts as standing at `LIGHT_AZIMUTH`.
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
    """Plane that the viewer of each sample lies in, degrees in [0, 180) from that of incidence, (N,)."""
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


def _tidy(angles: np.ndarray) -> float:
    return round(float(np.mean(angles)), 2)
