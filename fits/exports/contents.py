"""What a writer gives, and how it finds out how far its file is from the stack."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from fits.data.geometry import Floats
from fits.exports.material import Material

PAIRS = 2048
"""Pairs of directions at which files are compared with their stacks, twice: anywhere, and near the mirror direction."""

STEEPEST = np.cos(np.radians(80.0))
"""Neither direction of a pair is nearer to the horizon: there tables have little to say."""

AROUND = np.tan(np.radians(15.0))
"""How far from the mirror direction pairs near it are, at most."""


@dataclass(frozen=True)
class Contents:
    """Of a file. notes: what it holds, how well, and what it does not, one sentence each."""

    content: bytes
    notes: tuple[str, ...]


def agreement(material: Material, look_up: Callable[[Floats, Floats], Floats]) -> str:
    """A sentence on how well a reader of the file finds the values of the stack between its nodes.

    look_up: BSDF (N, C) at pairs of directions (N, 3) above the surface.
    """
    wi, wo = pairs()
    true = material.values(wi, wo)
    read = look_up(wi, wo)
    seen = true.max(axis=1) > 0
    if not seen.any():
        return "the stack gives no light there"
    # of what a pair sends in all its channels: one that is nearly black says nothing
    scale = true[seen].max(axis=1, keepdims=True)
    error = (abs(read[seen] - true[seen]) / scale).max(axis=1)
    middle, most, worst = (f"{float(f'{100 * part:.2g}'):g} %" for part in np.quantile(error, [0.5, 0.99, 1.0]))
    return (
        f"read back between its nodes, at {seen.sum():,} pairs of directions up to 80 degrees, values are off by "
        f"{middle} in the median, {most} in 99 of 100, {worst} at worst"
    )


def pairs(count: int = PAIRS, seed: int = 7) -> tuple[Floats, Floats]:
    """Pairs of directions up to 80 degrees from the normal: `count` anywhere, as many around the mirror direction."""
    u = qmc.Sobol(4, rng=np.random.default_rng(seed)).random(2 * count)
    wi = _direction(u[:, 0], u[:, 1])
    wo = views(wi, u[:, 2], u[:, 3])
    kept = wo[:, 2] >= STEEPEST
    return wi[kept], wo[kept]


def views(wi: Floats, u: Floats, v: Floats) -> Floats:
    """A direction for each wi (N, 3) from numbers in [0, 1]: anywhere for the first half, then near the mirror."""
    mirrored = wi * np.array([-1.0, -1.0, 1.0])
    away = AROUND * u[:, None] ** 2
    turn = 2.0 * np.pi * v
    near = mirrored + away * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)
    near /= np.linalg.norm(near, axis=-1, keepdims=True)
    return np.where(2 * np.arange(len(u))[:, None] < len(u), _direction(u, v), near)


def _direction(u: Floats, v: Floats) -> Floats:
    """Uniform in projected solid angle, as far as directions go here."""
    cosine = np.sqrt(STEEPEST**2 + (1.0 - STEEPEST**2) * u)
    sine, phi = np.sqrt(1.0 - cosine**2), 2.0 * np.pi * v
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
