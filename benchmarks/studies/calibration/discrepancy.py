"""Model discrepancy, drawn for the calibration: from the definition alone, by dense matrices."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import fits
from fits.data.measurements import Measurements

FREE = {
    "amplitude": fits.Free(0.05, 0.01, 0.3, fits.LogNormal(0.05, 0.5)),
    "length_half": fits.Free(18.0, 10.0, 40.0, fits.LogNormal(18.0, 0.35)),
    "length_difference": fits.Free(18.0, 10.0, 40.0, fits.LogNormal(18.0, 0.35)),
    "grazing_exponent": fits.Free(0.5, 0.0, 1.0),
}
"""Free parameters of `fits.Discrepancy`."""

LABELS = {
    "amplitude": "amplitude",
    "length_half": "length scale, half angle",
    "length_difference": "length scale, difference angle",
    "grazing_exponent": "grazing exponent",
}

Floats = NDArray[np.float64]


def with_discrepancy(data: Measurements, parameters: dict[str, float], generator: np.random.Generator) -> Measurements:
    """Measurements in the plane of incidence, with a discrepancy of their logarithms that is drawn here."""
    half = data.wi + data.wo
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosines = half[:, 2], _dot(half, data.wi)
    half_angle, difference_angle = (np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) for cosine in cosines)
    covariance = _matern(half_angle, parameters["length_half"])
    covariance *= _matern(difference_angle, parameters["length_difference"])
    root = np.linalg.cholesky(covariance + 1e-10 * np.eye(len(half_angle)))
    cosine = 0.5 * (data.wi[:, 2] + data.wo[:, 2])
    amplitude = parameters["amplitude"] * cosine ** -parameters["grazing_exponent"]
    discrepancy = amplitude * (root @ generator.standard_normal(len(half_angle)))
    return replace(data, values=data.values * np.exp(discrepancy)[:, None])


def _dot(one: Floats, other: Floats) -> Floats:
    return np.einsum("nk,nk->n", one, other)


def _matern(angle: Floats, length: float) -> Floats:
    """Matern 5/2 (Rasmussen & Williams 2006, Eq. 4.17), (N, N)."""
    x = np.sqrt(5.0) * np.abs(angle[:, None] - angle) / length
    return (1.0 + x + x * x / 3.0) * np.exp(-x)
