"""Neighbouring readings along the scans of measurements, and whether what is left of them is alike."""

import numpy as np
from numpy.typing import NDArray

from fits.data.measurements import Measurements
from fits.data.scans import scans

Floats = NDArray[np.float64]


def neighbours(data: Measurements, residuals: Floats, lag: int = 1) -> tuple[Floats, Floats]:
    """Residuals (N, C) of pairs that lie `lag` readings apart in one plane, two arrays; NaN rows are left out."""
    # The mean is not subtracted: a bias over a stretch of angle is structure too.
    pairs = []
    for rows in scans(data):
        track = residuals[rows][np.isfinite(residuals[rows]).all(axis=-1)]
        if len(track) > lag:
            pairs.append((track[:-lag].ravel(), track[lag:].ravel()))
    if not pairs:
        return np.empty(0), np.empty(0)
    return np.concatenate([first for first, _ in pairs]), np.concatenate([second for _, second in pairs])


def alike(first: Floats, second: Floats) -> float:
    """Correlation of pairs about zero; NaN without any."""
    norm = np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(np.sum(first * second) / norm) if norm > 0.0 else float("nan")


def autocorrelation(data: Measurements, residuals: Floats, longest: int = 20) -> Floats:
    """Correlation of residuals (N, C) that lie 1, 2, ... `longest` readings apart in one plane; NaN where none do."""
    return np.array([alike(*neighbours(data, residuals, lag)) for lag in range(1, longest + 1)])
