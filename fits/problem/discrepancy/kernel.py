"""How large errors of a model are where light and viewer are, and how alike at two such places.

A place is (4,): angles of half vector and of the difference along and across, in degrees, and the side (see
`fits.problem.discrepancy.inducing_points.places`). Arrays of numpy and of JAX are taken alike.
"""

from typing import Any

GRAZING = 85.0
"""Degrees from which errors grow no more."""


def matern(distance: Any, length: Any) -> Any:
    """Matern kernel of smoothness 5/2 (Rasmussen & Williams 2006, Eq. 4.17)."""
    x = 5.0**0.5 * distance / length
    return (1.0 + x + x**2 / 3.0) * distance.__array_namespace__().exp(-x)


def alike(one: Any, other: Any, half: Any, difference: Any) -> Any:
    """Correlation of errors at places (N, 4) and (M, 4), (N, M), that reach so far, in degrees: sides share none."""
    xp = one.__array_namespace__()
    tilt, along, across, side = (one[:, None, k] - other[None, :, k] for k in range(4))
    both = matern(xp.abs(tilt), half) * matern(xp.hypot(along, across), difference)
    return xp.where(side == 0.0, both, 0.0)


def log_sizes(where: Any) -> Any:
    """Logarithms, (N,), of by what errors are larger at places (N, 4) than along the normal, at a growth of 1."""
    xp = where.__array_namespace__()
    angles = xp.abs(where[:, 0]), xp.hypot(where[:, 1], where[:, 2])
    first, second = (xp.log(xp.cos(xp.radians(xp.minimum(angle, GRAZING)))) for angle in angles)
    return -first - second
