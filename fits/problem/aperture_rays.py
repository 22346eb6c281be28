"""Rays that stand for the cones of an instrument: as many as the width of a lobe asks for, see `ray_counts`.

A cone is a disc of directions: Gauss's rule in the squared radius, and rings of evenly spread azimuths. A mean over a
disc of radius q of a lobe 1 / (1 + h^2)^2, as GGX facets of unit width have it, is then within 1e-3 of its peak for
q up to 0.41 n - 0.16 with n rings of 3 n + 1 rays, wherever the disc lies. Of two cones azimuths go together along a
lattice, so that all products of few turns of both average to zero; where one ring of each will do, four pairs of
rays, the detector's a quarter of a turn behind the source's, are exact to second order in either direction, and in both
for functions of the half vector or in the plane of incidence of what is its own mirror image.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MOST_RINGS = 8
"""The most rings of a cone."""

MOST_PAIRS = 1500
"""Of rays that stand for a measurement: more rings are not taken for two cones."""

PER_RING, AT_NONE = 0.41, 0.16
"""Radius of a disc in widths of a lobe that n rings resolve: the first times n, less the second."""

BOTH_WIDE = 1.2
"""Factor by which radii of two cones count more than that of one."""

Floats = NDArray[np.float64]
Counts = tuple[int, int, int]


class Rays(NamedTuple):
    """Pairs of rays of two unit discs: places (K, 2) each, and their weights (K,), which sum to 1."""

    source: Floats
    detector: Floats
    weights: Floats


def resolved_radius(rings: int) -> float:
    """Radius of a disc, in widths of a lobe, that so many rings resolve."""
    return PER_RING * rings - AT_NONE


def both_wide(source: float, detector: float) -> float:
    """The factor by which the radius of two cones together counts more than that of one."""
    return BOTH_WIDE if source > 0.0 and detector > 0.0 else 1.0


def most_rings(source: float, detector: float) -> int:
    """Rings of cones of these widths that `ray_counts` takes at most."""
    rings = MOST_RINGS
    while rings > 1:
        whole = resolved_radius(rings) / both_wide(source, detector) / float(np.hypot(source, detector))
        wanted = _wanted(np.array([whole * source]), np.array([whole * detector]))
        if _affordable(*wanted[0].tolist()) == tuple(wanted[0].tolist()):
            break
        rings -= 1
    return rings


def ray_counts(source: Floats, detector: Floats, other: bool = False) -> NDArray[np.int64]:
    """Rings of the source, of the detector, and pairs of azimuths, for each measurement, (N, 3).

    source, detector: (N,), radii of the discs in widths of the lobe, 0 for a single direction. other: a ring more of
    each, or one less where that would be too many: the difference tells the error.
    """
    few = (source > 0.0) & (detector > 0.0) & (_rings(BOTH_WIDE * np.hypot(source, detector)) == 1)
    found = []
    for wanted, four in zip(_wanted(source, detector).tolist(), few, strict=True):
        rings = _affordable(*wanted)
        if other and not four:
            more = _affordable(*(count + (count > 0) for count in wanted))
            less = max(rings[0] - 1, min(rings[0], 1)), max(rings[1] - 1, min(rings[1], 1))
            rings = more if sum(more) > sum(rings) else less
        found.append((1, 1, 4) if four and not other else (*rings, _turns(*rings)[0]))
    return np.array(found, int).reshape(-1, 3)


@cache
def rays(counts: Counts) -> Rays:
    """The rule of these numbers of rings, and of pairs of azimuths."""
    first, second, turns = counts
    generator = 1 if counts == (1, 1, 4) else _turns(first, second)[1]
    place = np.arange(turns) / turns
    # a quarter of a step aside, so that the first turns that the azimuths do not average out vanish in symmetric planes
    aside = 0.25 / turns
    angles = 2.0 * np.pi * (place + aside), 2.0 * np.pi * (generator * place % 1.0 + aside + (0.25 if first else 0.0))
    (radii, own), (others, theirs) = (_radii(count) for count in (first, second))
    shape = len(own), len(theirs), turns
    weights = np.broadcast_to((own[:, None] * theirs)[..., None] / turns, shape).ravel()
    discs = []
    for radius, angle in ((radii[:, None, None], angles[0]), (others[None, :, None], angles[1])):
        disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
        discs.append(np.broadcast_to(disc, (*shape, 2)).reshape(-1, 2))
    return Rays(discs[0], discs[1], weights)


def _wanted(source: Floats, detector: Floats) -> NDArray[np.int64]:
    """Rings of the source and of the detector, (N, 2), however many pairs of rays these make."""
    alone = (source == 0.0) | (detector == 0.0)
    both = np.hypot(source, detector)
    own = [np.where(alone, both, 0.5 * BOTH_WIDE * (radius + both)) for radius in (source, detector)]
    rings = [np.where(radius > 0.0, _rings(one), 0) for radius, one in zip((source, detector), own, strict=True)]
    return np.stack(rings, axis=-1)


def _rings(radius: Floats) -> NDArray[np.int64]:
    return np.clip(np.ceil((radius + AT_NONE) / PER_RING - 1e-9), 1, MOST_RINGS).astype(int)


@cache
def _affordable(first: int, second: int) -> tuple[int, int]:
    """Rings of two cones, fewer where pairs of rays would be too many."""
    while first and second and first * second * _turns(first, second)[0] > MOST_PAIRS:
        first, second = (first - 1, second) if first >= second else (first, second - 1)
    return first, second


@cache
def _turns(first: int, second: int) -> tuple[int, int]:
    """Pairs of azimuths for these numbers of rings, and of how many steps the second takes where the first takes one.

    The fewest for which a exp(i k t) exp(i l u) averages to zero over them for all |k| / (3 first) + |l| / (3 second)
    up to 1 except k = l = 0.
    """
    if not first or not second:
        return 3 * max(first, second) + 1, 1
    most = 3 * first, 3 * second
    k, l = (part.ravel() for part in np.mgrid[-most[0] : most[0] + 1, -most[1] : most[1] + 1])
    inside = (np.abs(k) * most[1] + np.abs(l) * most[0] <= most[0] * most[1]) & ((k != 0) | (l != 0))
    k, l = k[inside], l[inside]
    count = 4
    while True:
        for step in range(1, count):
            if np.all((k + step * l) % count):
                return count, step
        count += 1


def _radii(rings: int) -> tuple[Floats, Floats]:
    """Radii of rings on the unit disc, and their shares of it; a single direction is its middle."""
    if not rings:
        return np.zeros(1), np.ones(1)
    x, weights = np.polynomial.legendre.leggauss(rings)
    return np.sqrt(0.5 * (1.0 + x)), 0.5 * weights
