"""The cones of an instrument: where a measurement has to be the mean over them, and by which rays.

Where it has to be follows from what the stack may hold (`spread_over_lobes`); how many rays stand for the cones from
their width beside the lobe there (`ray_counts`).

A cone is a disc of directions: Gauss's rule in the squared radius, and rings of evenly spread azimuths. A mean over a
disc of radius q of a lobe 1 / (1 + h^2)^2, as GGX facets of unit width have it, is then within 1e-3 of its peak for
q up to 0.41 n - 0.16 with n rings of 3 n + 1 rays, wherever the disc lies. Of two cones azimuths go together along a
lattice, so that all products of few turns of both average to zero; where one ring of each will do, four pairs of
rays, the detector's a quarter of a turn behind the source's, are exact to second order in either direction, and in both
for functions of the half vector or in the plane of incidence of what is its own mirror image.
"""

from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from fits.data.geometry import TANGENT_COSINE, Floats
from fits.problem.parameters import is_free
from layerjax.mixture import stacks_of

Counts = tuple[int, int, int]

MOST_RINGS = 8
"""The most rings of a cone."""

MOST_PAIRS = 1500
"""Of rays that stand for a measurement: more rings are not taken for two cones."""

PER_RING, AT_NONE = 0.41, 0.16
"""Radius of a disc in widths of a lobe that n rings resolve: the first times n, less the second."""

BOTH_WIDE = 1.2
"""Factor by which radii of two cones count more than that of one."""

SHIFT = 1e-3
"""Relative difference between a mean over a cone and its middle that does not count."""

STEEPEST = np.radians(85.0)
"""The steepest angle of a half vector."""

LEAST = 1e-6
"""The least squared sum of two directions."""

SOONER = 0.6
"""Share of the distance from the peak that counts for how steep a lobe is beside its own value."""

PASSING = 2.0
"""Degrees by which glass has to tilt to turn light that passes by one; half as many turn what it reflects."""


class Spread(NamedTuple):
    """How the cones of an instrument lie to the lobes of a stack, at N measurements.

    matters: (N,), whether the mean over the cones may differ from their middle by more than `SHIFT`. source, detector:
    (N,), radii of the cones in widths of the lobe there.
    """

    matters: NDArray[np.bool_]
    source: Floats
    detector: Floats


def spread_over_lobes(
    source: float, detector: float, stack: Any, wi: Floats, wo: Floats, tilt: float = 0.0, rings: int | None = None
) -> Spread:
    """See `Spread`.

    GGX facets of width alpha whose half vector lies at tangent t change by at most 2 r^2 / (t^2 + alpha^2) over a disc
    of radius r, half of that of the cones over the cosine of the difference angle; what faces elsewhere (particles,
    tilted flakes) counts as if it were met at its peak, light that passes as narrow. Cosines change by r^2 / (2 cos)^2.
    In the tangent plane there is nothing to take the mean of.

    Args:
        source, detector: full angles of the cones, degrees.
        stack: of free parameters the end counts at which lobes are narrowest; of anything but stacks all may be narrow.
        wi, wo: (N, 3).
        tilt: degrees by which the sample may be tilted, besides.
        rings: lobes count as no narrower than what so many resolve; None: as they are.
    """
    seen = np.minimum(np.abs(wi[:, 2]), np.abs(wo[:, 2])) > TANGENT_COSINE
    radii = np.radians(0.5 * source), np.radians(0.5 * detector)
    most = np.inf if rings is None else resolved_radius(rings) / both_wide(source, detector)
    if not isinstance(stack, lj.Stack | lj.Mixture):
        # nothing is known of it: one ring, or what was given
        return _spread(seen, np.full(len(wi), resolved_radius(rings or 1) / both_wide(source, detector)), radii)
    facets, others = _narrowest(stack)
    half = wi + wo
    passing = wi[:, 2] * wo[:, 2] < 0.0
    square = (radii[0] ** 2 + radii[1] ** 2) / np.maximum(np.sum(half**2, axis=-1), LEAST)
    half_angle = np.arctan2(np.hypot(half[:, 0], half[:, 1]), np.abs(half[:, 2])) - np.radians(tilt)
    nearest = np.maximum(np.tan(np.minimum(half_angle, STEEPEST)) - np.sqrt(square), 0.0)
    lobe = 2.0 * square / (nearest**2 + facets**2) + 2.0 * square / others**2
    steep = [0.25 * (r / np.maximum(np.abs(w[:, 2]), r)) ** 2 for r, w in zip(radii, (wi, wo), strict=True) if r > 0.0]
    matters = seen & ((np.maximum(lobe, sum(steep)) > SHIFT) | passing)
    through = PASSING * np.hypot(*radii) / min(facets, others)
    met = np.where(passing, through, np.sqrt(square) / others)
    across = np.sqrt(square / ((SOONER * nearest) ** 2 + np.maximum(facets**2, square / most**2)))
    return _spread(matters, np.maximum(np.where(passing, 0.0, across), np.minimum(met, most)), radii)


def _spread(matters: NDArray[np.bool_], both: Floats, radii: tuple[float, float]) -> Spread:
    """Rays of cones that are so wide together, (N,), in widths of the lobe, and have these radii."""
    whole = max(float(np.hypot(*radii)), np.finfo(float).tiny)
    both = np.maximum(both, LEAST)  # where cosines alone matter there are cones nonetheless
    return Spread(matters, both * radii[0] / whole, both * radii[1] / whole)


def _narrowest(material: lj.Stack | lj.Mixture) -> tuple[float, float]:
    """Width of the narrowest facets that face up, and of anything else; infinite where there are none."""
    facets, others = [np.inf], [np.inf]
    for stack in stacks_of(material):
        for part in (*stack.layers, stack.base):
            if isinstance(part, lj.Interface | lj.Conductor):
                least = part.alpha.arrays()[1] if is_free(part.alpha) else np.asarray(part.alpha)
                facets.append(float(np.min(least)))
            elif isinstance(part, lj.Medium | lj.TurbidMedium):
                for end in (1, 2):  # at the lower bounds of what is free, and at the upper
                    phase = jax.tree.map(
                        lambda x, end=end: x.arrays()[end] if is_free(x) else x, part.phase, is_leaf=is_free
                    )
                    upright = isinstance(phase, lj.SGGX) and phase.kind == "surface" and phase.is_upright
                    (facets if upright else others).append(float(np.min(phase.width)))
    return min(facets), min(others)


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
