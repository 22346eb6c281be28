"""The content of an exported file, and how accurately it represents the stack."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from fits.data.geometry import Floats
from fits.exports.material import Material

PAIRS = 2048
"""Pairs of directions at which a file is compared with its stack: so many anywhere, so many near the mirror."""

LEAST_COSINE = np.cos(np.radians(80.0))
"""Least cosine of both directions of a pair: nearer to the horizon tables are inaccurate."""

NEAR_MIRROR = np.tan(np.radians(15.0))
"""Largest distance from the mirror direction of pairs near it."""


@dataclass(frozen=True)
class Contents:
    """Content of a file. notes: what it holds, how accurately, and what it omits, one sentence each."""

    content: bytes
    notes: tuple[str, ...]


def agreement(material: Material, look_up: Callable[[Floats, Floats], Floats]) -> str:
    """A sentence on the error of values that a reader of the file interpolates between its nodes.

    look_up: BSDF (N, C) of the file at pairs of directions (N, 3) in the upper hemisphere.
    """
    wi, wo = pairs()
    true = material.values(wi, wo)
    table = look_up(wi, wo)
    lit = true.max(axis=1) > 0
    if not lit.any():
        return "the stack reflects no light there"
    # relative to the brightest channel of a pair: the relative error of one that is nearly black means nothing
    scale = true[lit].max(axis=1, keepdims=True)
    error = (abs(table[lit] - true[lit]) / scale).max(axis=1)
    middle, most, worst = (f"{float(f'{100 * part:.2g}'):g} %" for part in np.quantile(error, [0.5, 0.99, 1.0]))
    return (
        f"read back between its nodes, at {lit.sum():,} pairs of directions up to 80 degrees, values are off by "
        f"{middle} in the median, {most} in 99 of 100, {worst} at worst"
    )


def pairs(count: int = PAIRS, seed: int = 7) -> tuple[Floats, Floats]:
    """Pairs of directions up to 80 degrees from the normal: `count` anywhere, as many around the mirror direction."""
    u = qmc.Sobol(4, rng=np.random.default_rng(seed)).random(2 * count)
    wi = _direction(u[:, 0], u[:, 1])
    wo = views(wi, u[:, 2], u[:, 3])
    above = wo[:, 2] >= LEAST_COSINE
    return wi[above], wo[above]


def views(wi: Floats, u: Floats, v: Floats) -> Floats:
    """A direction for each wi (N, 3) from numbers in [0, 1]: anywhere for one half, near the mirror for the other."""
    mirrored = wi * np.array([-1.0, -1.0, 1.0])
    away = NEAR_MIRROR * u[:, None] ** 2
    turn = 2.0 * np.pi * v
    near = mirrored + away * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)
    near /= np.linalg.norm(near, axis=-1, keepdims=True)
    return np.where(2 * np.arange(len(u))[:, None] < len(u), _direction(u, v), near)


def _direction(u: Floats, v: Floats) -> Floats:
    """Directions uniform in projected solid angle, down to `LEAST_COSINE`."""
    cosine = np.sqrt(LEAST_COSINE**2 + (1.0 - LEAST_COSINE**2) * u)
    sine, phi = np.sqrt(1.0 - cosine**2), 2.0 * np.pi * v
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
