"""How far values are from the truth: the two figures of the tables, and the scale that both are relative to."""

import numpy as np
from numpy.typing import NDArray

from benchmarks.suite.cases import Directions

FLOOR = 0.01
"""Share of the value of a Lambertian surface of the same albedo below which a value counts as that."""

LEAST = 1e-12
"""Least albedo of the scale: a smaller share of the light counts as this."""

Values = NDArray[np.float64]
"""BSDF values of pairs, (n, C)."""

WORDS = f"""\
Relative L2 error: the root of sum w (f - f*)^2 / sum w f*^2 over all pairs and channels, f* the truth, w = cos_i cos_o.
Worst error: the largest |f - f*| / scale, where scale is the larger of f* and {100 * FLOOR:g} % of the value that a
Lambertian surface of the same albedo (that light, side and channel; 1e-12 at least) would have. Error of the albedo:
the largest difference of a directional albedo (any light of the set, side and channel), as a share of the light."""


def relative_l2(error: Values, truth: Values, weights: NDArray[np.float64]) -> float:
    """The weighted L2 norm of the error over that of the truth (0 if both are 0)."""
    size = np.sum(weights[:, None] * error**2)
    whole = np.sum(weights[:, None] * truth**2)
    return float(np.sqrt(size / whole)) if whole > 0 else float(np.sqrt(size))


def scale(truth: Values, albedo: NDArray[np.float64], directions: Directions) -> Values:
    """What errors of single values are relative to, (n, C).

    albedo: directional albedos of the lights, reflected and transmitted, (2, k, C).
    """
    reflected, transmitted = albedo[:, directions.light]
    same = np.where(directions.transmits[:, None], transmitted, reflected)
    return np.maximum(np.abs(truth), FLOOR * np.maximum(same, LEAST) / np.pi)


def worst(error: Values, scale: Values) -> float:
    """The largest error relative to the scale."""
    return float(np.max(np.abs(error) / scale))
