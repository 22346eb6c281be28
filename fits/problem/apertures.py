"""The cones of an instrument: where a measurement has to be the mean over them, and by which rays.

How many rays stand for the cones at a measurement follows from how wide they are beside the lobe there. A cone is a
disc of directions: Gauss's rule in the squared radius, and rings of evenly spread azimuths. A mean over a disc of
radius q of a lobe 1 / (1 + h^2)^2, as GGX facets of unit width have it, is then within 1e-3 of its peak for q up to
0.41 n - 0.16 with n rings of 3 n + 1 rays, wherever the disc lies. Of two cones azimuths go together along a lattice,
so that all products of few turns of both average to zero; where one ring of each will do, four pairs of rays, the
detector's a quarter of a turn behind the source's, are exact to second order in either direction, and in both for
functions of the half vector or in the plane of incidence of what is its own mirror image.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from fits.data.geometry import TANGENT_COSINE, Floats
from fits.problem.parameters import at_start
from layerjax.mixture import stacks_of

MOST_RINGS, MOST_OF_TWO = 8, 4  # rings of a cone, and of each of two
PER_RING, AT_NONE = 0.41, 0.16  # radius of a disc, in widths of a lobe, that n rings resolve: PER_RING n - AT_NONE
BOTH_WIDE = 1.2  # factor by which the radius of two cones together counts more than that of one
SHIFT = 1e-3  # relative difference between a mean over a cone and its middle that does not count
STEEPEST, LEAST = np.radians(85.0), 1e-6  # angle of a half vector at most; squared sum of two directions at least
SOONER = 0.6  # share of the distance from the peak that counts for how steep a lobe is beside its own value
PASSING = 2.0  # degrees by which glass has to tilt to turn light that passes by one; half as many turn a reflection

LATTICE = {1: (4, 1), 2: (25, 7), 3: (50, 9), 4: (85, 13)}
"""Of two cones of n rings each: pairs of azimuths, and how many steps the second takes where the first takes one. The
fewest for which a exp(i k t) exp(i l u) averages to zero over them for all |k| + |l| up to 3 n except k = l = 0; of one
ring those of the four pairs above."""


def ring_counts(
    source: float, detector: float, stack: Any, wi: Floats, wo: Floats, tilt: float = 0.0, most: int | None = None
) -> NDArray[np.int64]:
    """Rings of rays that the lobes of a stack ask for at N measurements, (N,); 0 where the middle of the cones will do.

    GGX facets of width alpha whose half vector lies at tangent t change by at most 2 r^2 / (t^2 + alpha^2) over a disc
    of radius r, half of that of the cones over the cosine of the difference angle; what faces elsewhere (particles,
    tilted flakes) counts as if it were met at its peak, light that passes as narrow. Cosines change by r^2 / (2 cos)^2.
    In the tangent plane there is nothing to take the mean of.

    source, detector: full angles of the cones, degrees. stack: of free parameters the end counts at which lobes are
    narrowest; of anything but stacks one ring is taken everywhere, or `most`. tilt: of the sample, at most, in degrees.
    """
    both = source > 0.0 and detector > 0.0
    seen = np.minimum(np.abs(wi[:, 2]), np.abs(wo[:, 2])) > TANGENT_COSINE
    if not isinstance(stack, lj.Stack | lj.Mixture):
        return np.where(seen, most or 1, 0)
    radii = np.radians(0.5 * source), np.radians(0.5 * detector)
    facets, others = _narrowest(stack)
    half = wi + wo
    passing = wi[:, 2] * wo[:, 2] < 0.0
    square = (radii[0] ** 2 + radii[1] ** 2) / np.maximum(np.sum(half**2, axis=-1), LEAST)
    half_angle = np.arctan2(np.hypot(half[:, 0], half[:, 1]), np.abs(half[:, 2])) - np.radians(tilt)
    nearest = np.maximum(np.tan(np.minimum(half_angle, STEEPEST)) - np.sqrt(square), 0.0)
    lobe = 2.0 * square / (nearest**2 + facets**2) + 2.0 * square / others**2
    steep = [0.25 * (r / np.maximum(np.abs(w[:, 2]), r)) ** 2 for r, w in zip(radii, (wi, wo), strict=True) if r > 0.0]
    matters = seen & ((np.maximum(lobe, sum(steep)) > SHIFT) | passing)
    # the radius of the cones in widths of the lobe
    reflected = np.sqrt(square) * np.maximum(1.0 / np.hypot(SOONER * nearest, facets), 1.0 / others)
    radius = np.where(passing, PASSING * np.hypot(*radii) / min(facets, others), reflected)
    rings = np.ceil((radius * (BOTH_WIDE if both else 1.0) + AT_NONE) / PER_RING - 1e-9)
    most = min(most or MOST_RINGS, MOST_OF_TWO if both else MOST_RINGS)
    return np.where(matters, np.clip(rings, 1, most), 0).astype(int)


def _narrowest(material: lj.Stack | lj.Mixture) -> tuple[float, float]:
    """Width of the narrowest facets that face up, and of anything else; infinite where there are none."""
    facets, others = [np.inf], [np.inf]
    for stack in stacks_of(material):
        for part in (*stack.layers, stack.base):
            if isinstance(part, lj.Interface | lj.Conductor):
                if part.is_smooth:  # what it mirrors is not in the values
                    continue
                facets += [
                    float(np.min(at_start(width, 1))) for width in (part.alpha, part.alpha_y) if width is not None
                ]
            elif isinstance(part, lj.Medium | lj.TurbidMedium):
                for end in (1, 2):  # at the lower bounds of what is free, and at the upper
                    phase = at_start(part.phase, end)
                    upright = isinstance(phase, lj.SGGX) and phase.kind == "surface" and phase.is_axisymmetric
                    (facets if upright else others).append(float(np.min(phase.width)))
    return min(facets), min(others)


class Rays(NamedTuple):
    """Pairs of rays of two unit discs: places (K, 2) each, and their weights (K,), which sum to 1."""

    source: Floats
    detector: Floats
    weights: Floats


@cache
def rays(rings: int, source: bool, detector: bool) -> Rays:
    """Those of so many rings of each cone that there is; the other is a single direction."""
    turns, generator = LATTICE[rings] if source and detector else (3 * rings + 1, 1)
    place = np.arange(turns) / turns
    # a quarter of a step aside, so that the first turns that the azimuths do not average out vanish in symmetric planes
    aside = 0.25 / turns
    angles = 2.0 * np.pi * (place + aside), 2.0 * np.pi * (generator * place % 1.0 + aside + (0.25 if source else 0.0))
    x, shares = np.polynomial.legendre.leggauss(rings)
    (radii, own), (others, theirs) = (
        (np.sqrt(0.5 * (1.0 + x)), 0.5 * shares) if there else (np.zeros(1), np.ones(1)) for there in (source, detector)
    )
    shape = len(own), len(theirs), turns
    weights = np.broadcast_to((own[:, None] * theirs)[..., None] / turns, shape).ravel()
    discs = []
    for radius, angle in ((radii[:, None, None], angles[0]), (others[None, :, None], angles[1])):
        disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
        discs.append(np.broadcast_to(disc, (*shape, 2)).reshape(-1, 2))
    return Rays(discs[0], discs[1], weights)
