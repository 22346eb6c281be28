"""Directions drawn from the lobes of a stack: one lobe by its energy, then a facet that is seen from the light."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import horizon, safe_div
from layerjax.channels import Channels
from layerjax.directions import Vector, sanitise, select
from layerjax.surfaces import Surface
from layerjax.surfaces.lambertian import sample_cosine
from layerjax.transport.lobes.microfacet import MicrofacetLobes
from layerjax.transport.lobes.sampling import draw_lobe, lobe_density
from layerjax.transport.single_scattering import Media, SingleScattering
from layerjax.transport.statistical.coated_base import CoatedBase
from layerjax.transport.statistical.diffuse_base import DiffuseBase
from layerjax.transport.statistical.diffuse_lobe import DiffuseLobe
from layerjax.transport.statistical.hazy_base import HazyBase
from layerjax.transport.statistical.streamed_base import StreamedBase

DiffusePart = DiffuseBase | CoatedBase | StreamedBase | HazyBase | DiffuseLobe | Surface
"""Light that has met a diffuse base, in closed form or as a lobe; or that base itself, if nothing lies on it."""


def draw(
    lobes: MicrofacetLobes,
    diffuse: DiffusePart | None,
    wi: Vector,
    uniforms: tuple[Array, Array, Array],
    entry: Array,
    exit: Array,
) -> Vector:
    """Outgoing directions for light above, of these lobes.

    entry, exit: indices before and behind over that of the folded medium.
    """
    valid = wi[2] > horizon(wi[2].dtype)
    wi = sanitise(wi, valid)
    # what no lobe took is diffuse; where nothing is diffuse that is rounding, and drawn from a lobe of width 1
    wo, scatters = draw_lobe(lobes, _probabilities(lobes, diffuse, wi), wi, uniforms, entry, exit)
    if diffuse is not None:
        wo = select(scatters, sample_cosine(*uniforms[1:]), wo)
    return (wo[0], wo[1], jnp.where(valid, wo[2], 0.0))


def density(
    lobes: MicrofacetLobes, diffuse: DiffusePart | None, wi: Vector, wo: Vector, entry: Array, exit: Array
) -> Array:
    """Density of `draw` in solid angle, 1/sr."""
    edge = horizon(wi[2].dtype)
    lit = wi[2] > edge
    wi = sanitise(wi, lit)
    shares = _probabilities(lobes, diffuse, wi)
    total = lobe_density(lobes, shares, wi, wo, entry, exit)
    if diffuse is not None:
        above = wo[2] > edge
        rest = 1.0 - sum(shares, jnp.zeros_like(wi[2]))
        total = total + jnp.where(above, rest * jnp.where(above, wo[2], 0.0) / np.pi, 0.0)
    return jnp.where(lit, total, 0.0)


def diffuse_energy(diffuse: DiffusePart, wi: Vector, nodes: int) -> Channels:
    """Energy of the light that has met a diffuse base, of any form; `nodes`: see `layerjax.albedo`."""
    if isinstance(diffuse, Surface):
        return SingleScattering().albedo(Media((), diffuse), wi, nodes)[0]
    return diffuse.albedo(wi)


def diffuse_part(diffuse: DiffusePart, wi: Vector, wo: Vector) -> Channels:
    """BRDF of the light that has met a diffuse base, of any form; 0 unless both directions are above."""
    if isinstance(diffuse, Surface):
        return SingleScattering().evaluate(Media((), diffuse), wi, wo, "reflection")
    return diffuse.value(wi, wo)


def _probabilities(lobes: MicrofacetLobes, diffuse: DiffusePart | None, wi: Vector) -> list[Array]:
    """Probabilities of the lobes, in their order; the rest to 1 is that of the diffuse part."""
    energies = [jnp.where(share > 1e-6, share, 1e-6) for share in lobes.shares()]
    if not energies:
        return []
    total = sum(energies, jnp.zeros_like(wi[2]))
    if diffuse is not None:
        assert not isinstance(diffuse, Surface)  # which has no lobes beside it
        parts = diffuse_energy(diffuse, wi, 0)
        total = total + 1e-6 + sum(parts, jnp.zeros_like(wi[2])) / len(parts)
    return [safe_div(energy, total) for energy in energies]
