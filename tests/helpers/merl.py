"""Synthetic MERL tables: angles and directions at the centres of bins, and a writer."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fits.data.geometry import direction

SHAPE = (90, 90, 180)
SCALE = np.array([1.0, 1.15, 1.66]) / 1500


def smooth_bsdf(theta_h, theta_d, phi_d):
    """A smooth BRDF in three channels, with reciprocity: a period of pi in phi_d."""
    lobe = 0.1 + 2 * np.cos(theta_h) ** 6
    colour = [1 + 0.5 * theta_d, np.cos(theta_d) ** 2 + 0.3, 1 + 0.2 * np.sin(theta_d) ** 2 * np.cos(2 * phi_d + 0.4)]
    return np.stack([lobe * factor * np.ones_like(phi_d) for factor in colour])


def half_angles(wi, wo):
    """Half and difference angles (theta_h, phi_h, theta_d, phi_d), (4, N), by turning the half vector to the pole."""
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=1, keepdims=True)
    theta, phi = np.arccos(np.clip(half[:, 2], -1, 1)), np.arctan2(half[:, 1], half[:, 0])
    x, y, z = Rotation.from_euler("zy", np.stack([-phi, -theta], axis=1)).apply(np.array(wi)).T
    return np.array([theta, phi, np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)])


def centre_angles():
    i, j, k = (np.arange(size) + 0.5 for size in SHAPE)
    return np.meshgrid((i / 90) ** 2 * np.pi / 2, j / 90 * np.pi / 2, k / 180 * np.pi, indexing="ij")


def write_merl(path: Path, table: np.ndarray) -> Path:
    path.write_bytes(np.array(SHAPE, "<i4").tobytes() + (table / SCALE[:, None, None, None]).astype("<f8").tobytes())
    return path


def centre_pairs(bins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions at the centres of bins (N, 3): a direction at (theta_d, phi_d) and the normal, turned by theta_h."""
    theta_h, theta_d, phi_d = ((bins + 0.5) / SHAPE * [1, 90, 180]).T
    wi = direction(theta_d, phi_d)
    cosine, sine = np.cos(theta_h**2 * np.pi / 2), np.sin(theta_h**2 * np.pi / 2)
    wi, wo = (
        np.stack([cosine * x + sine * z, y, cosine * z - sine * x], axis=-1) for x, y, z in (wi.T, (wi * [-1, -1, 1]).T)
    )
    return wi, wo
