"""Spherical warping: how facets that scatter a beam spread it, in concentrations of von Mises-Fisher distributions.

A facet that turns by a small angle turns the reflected or refracted ray: |dm/dr| = 1 / (4 |o.m|) and its like (Guo et
al. 2015, Sec. 4.1). Here their reciprocals are carried, the gains of variance, which stay finite where an index is
matched and the facets deflect nothing. What a lobe of facets (or of a beam) of concentration kappa makes of the
outgoing light has the concentration kappa / gain; lobes that follow each other multiply their mean resultant lengths
(Eqs. 17, 18 and 21), and the extended normals that stand for all of them have kappa times the gain (Eqs. 19 and 22).

All cosines are absolute values. The one rule is a geometric mean over the two axes of a lobe, which reflection at an
angle stretches by different factors: concentrations are right within 1 % at normal incidence and up to 5 times too
large at 85 degrees (kappa = 100), where `reflected_moment` is exact and `refraction_trace` right to first order.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_min, safe_sqrt
from layerjax.directions import squared_cosine_of_refraction
from layerjax.normals.vmf import concentration_of, convolve, resultant

LEAST_VARIANCE = 1e-12
"""Floor of 1 / kappa, for facets of a matched index, which spread nothing: lobes stay wider than a millionth."""


class Gains(NamedTuple):
    """Solid angle of outgoing light over that of facet normals, and over that of the incoming beam."""

    facets: Array
    beam: Array


def refracted_cosine(cosine: Array, ior: Array) -> tuple[Array, Array]:
    """Cosine beyond a facet of relative index ior, and whether light passes there at all (else an interior number)."""
    squared = squared_cosine_of_refraction(cosine, ior)
    passes = squared > 1e-18
    return jnp.sqrt(jnp.where(passes, squared, 0.25)), passes


def reflection_gains(cosine: Array) -> Gains:
    """|dr/dm| = 4 |o.m| and |dr/do| = 1 (Guo 2015, Eqs. 12 and 18)."""
    return Gains(4.0 * cosine, jnp.ones_like(cosine))


def refraction_gains(cosine: Array, ior: Array) -> Gains:
    """|dt/dm| = (o.m + eta t.m)^2 / (eta^2 |t.m|), with t.m < 0, and |dt/do| = |o.m| / (eta^2 |t.m|) (Eqs. 13 and 21).

    The second is not the first's formula again, as which Eq. (21) may be read.
    """
    inside, _ = refracted_cosine(cosine, ior)
    below = ior * ior * inside
    bend = (ior - 1.0) * (ior + 1.0) / (ior * inside + cosine)  # eta |t.m| - |o.m|
    return Gains(bend * bend / below, cosine / below)


def joint_concentration(*lobes: tuple[Array, Array]) -> Array:
    """Concentration of light that several lobes, each (kappa, gain), spread one after the other (Eqs. 17, 18, 21)."""
    variances = (clamp_min(gain / kappa, LEAST_VARIANCE) for kappa, gain in lobes)
    return concentration_of(*convolve(*(resultant(1.0 / variance) for variance in variances)))


def reflect_beam(beam: Array, facets: Array, cosine: Array) -> Array:
    """Concentration of a beam after reflection at rough facets (Eq. 18; Eq. 12 for a beam without width).

    Args:
        beam: concentration of the incoming light.
        facets: concentration of the facet normals.
        cosine: between the means of both, in [0, 1].
    """
    gains = reflection_gains(cosine)
    return joint_concentration((facets, gains.facets), (beam, gains.beam))


def refract_beam(beam: Array, facets: Array, cosine: Array, ior: Array) -> Array:
    """Concentration of a beam after refraction at rough facets (Eq. 21; Eq. 13 for a beam without width)."""
    gains = refraction_gains(cosine, ior)
    return joint_concentration((facets, gains.facets), (beam, gains.beam))


def extended_concentration(outgoing: Array, gains: Gains) -> Array:
    """Concentration of the normals that would send a beam without width where the light goes (Eqs. 19 and 22)."""
    return outgoing * gains.facets


def reflected_moment(beam: Array, facets: Array, cosine: Array) -> Array:
    """Concentration with the exact mean resultant length of a reflected beam, of any widths (not in the paper)."""
    (length, rest), (turned, _) = resultant(beam), resultant(facets)
    share = turned / facets  # E[(o.m)^2] across the mean
    lost = 4.0 * share * (1.0 - share + (1.0 - 3.0 * share) * cosine * cosine)
    kept = safe_sqrt(1.0 - lost)
    return concentration_of(*convolve((length, rest), (kept, lost / (1.0 + kept))))


def refraction_trace(beam: Array, facets: Array, cosine: Array, ior: Array) -> Array:
    """Concentration of a refracted beam by the mean of both axes' variances, right to first order in 1 / kappa."""
    inside, _ = refracted_cosine(cosine, ior)
    ratio = cosine / (ior * inside)
    by_facets = 0.5 * ((1.0 - ratio) ** 2 + (inside - cosine / ior) ** 2)
    by_beam = 0.5 * (ratio * ratio + 1.0 / (ior * ior))
    return joint_concentration((facets, by_facets), (beam, by_beam))
