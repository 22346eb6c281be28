"""Correlation of residuals between neighbouring measurements along the scans."""

import numpy as np
from numpy.typing import NDArray

from fits.data.measurements import Measurements
from fits.data.scans import scans

Floats = NDArray[np.float64]


def neighbours(data: Measurements, residuals: Floats, lag: int = 1) -> tuple[Floats, Floats]:
    """Residuals (N, C) of pairs that lie `lag` measurements apart in a scan, two arrays; rows with NaN are skipped."""
    # The mean is not subtracted: a bias over a stretch of angle is structure too.
    pairs = []
    for rows in scans(data):
        scan = residuals[rows][np.isfinite(residuals[rows]).all(axis=-1)]
        if len(scan) > lag:
            pairs.append((scan[:-lag].ravel(), scan[lag:].ravel()))
    if not pairs:
        return np.empty(0), np.empty(0)
    return np.concatenate([first for first, _ in pairs]), np.concatenate([second for _, second in pairs])


def correlation(first: Floats, second: Floats) -> float:
    """Correlation of pairs about zero; NaN for no pairs."""
    norm = np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(np.sum(first * second) / norm) if norm > 0.0 else float("nan")


def autocorrelation(data: Measurements, residuals: Floats, longest: int = 20) -> Floats:
    """Correlation of residuals (N, C) at lags of 1, 2, ... `longest` measurements along scans; NaN without pairs."""
    return np.array([correlation(*neighbours(data, residuals, lag)) for lag in range(1, longest + 1)])
