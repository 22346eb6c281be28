"""The kernel of the model discrepancy: its scale at a pair of directions, and the correlation of two of them.

A place is (4,): angles of half vector and of the difference along and across, in degrees, and the side (see
`fits.problem.discrepancy.inducing_points.places`). Arrays of numpy and of JAX are both taken.
"""

from typing import Any

GRAZING = 85.0
"""Degrees from which the discrepancy grows no more."""


def matern(distance: Any, length: Any) -> Any:
    """Matern kernel of smoothness 5/2 (Rasmussen & Williams 2006, Eq. 4.17)."""
    x = 5.0**0.5 * distance / length
    return (1.0 + x + x**2 / 3.0) * distance.__array_namespace__().exp(-x)


def correlation(one: Any, other: Any, half: Any, difference: Any) -> Any:
    """Correlation at places (N, 4) and (M, 4), (N, M), by length scales in degrees; none between the two sides."""
    xp = one.__array_namespace__()
    tilt, along, across, side = (one[:, None, k] - other[None, :, k] for k in range(4))
    both = matern(xp.abs(tilt), half) * matern(xp.hypot(along, across), difference)
    return xp.where(side == 0.0, both, 0.0)


def log_scales(where: Any) -> Any:
    """Logarithms, (N,), of the scale at places (N, 4) over that along the normal, at a grazing exponent of 1."""
    xp = where.__array_namespace__()
    angles = xp.abs(where[:, 0]), xp.hypot(where[:, 1], where[:, 2])
    first, second = (xp.log(xp.cos(xp.radians(xp.minimum(angle, GRAZING)))) for angle in angles)
    return -first - second
