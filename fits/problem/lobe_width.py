"""Where a measurement has to be the mean over a cone of directions, by what a stack may hold: see
`spread_over_lobes`."""

from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from fits.data.geometry import TANGENT_COSINE
from fits.problem.aperture_rays import both_wide, resolved_radius
from fits.problem.parameters import is_free
from layerjax.mixture import stacks_of

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

Floats = NDArray[np.float64]


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
                facets.append(_least(part.alpha))
            elif isinstance(part, lj.Medium | lj.TurbidMedium):
                for phase in (_at(part.phase, end) for end in (1, 2)):
                    upright = isinstance(phase, lj.SGGX) and phase.kind == "surface" and phase.is_upright
                    (facets if upright else others).append(float(np.min(phase.width)))
    return min(facets), min(others)


def _least(alpha: Any) -> float:
    return float(np.min(alpha.arrays()[1] if is_free(alpha) else np.asarray(alpha)))


def _at(phase: lj.PhaseFunction, end: int) -> lj.PhaseFunction:
    """A stack with free parameters at their lower (1) or upper (2) bounds."""
    return jax.tree.map(lambda leaf: leaf.arrays()[end] if is_free(leaf) else leaf, phase, is_leaf=is_free)
