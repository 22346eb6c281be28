"""Directions drawn from the lobes of a stack: one lobe by its share, then a facet that is seen from the light."""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from layerjax._numerics import horizon
from layerjax.directions import Vector, flip, half_vector, reflect, sanitise, select
from layerjax.normals.facets import reflection_pdf
from layerjax.normals.ggx import ggx_sample
from layerjax.normals.width_matrix import WidthMatrix, isotropic, matrix_pdf, matrix_sample
from layerjax.transport.lobes.microfacet import LobeWidth, MicrofacetLobes, fold, unfold


def draw_lobe(
    lobes: MicrofacetLobes,
    shares: Sequence[Array],
    wi: Vector,
    uniforms: tuple[Array, Array, Array],
    entry: Array,
    exit: Array,
) -> tuple[Vector, Array]:
    """Outgoing directions for light above, and which no lobe took; what is lost is sent along the tangent plane.

    shares: probabilities of the lobes, in their order. entry, exit: indices before and behind over that of the medium
    in which transmitted lobes are described.
    """
    u, u1, u2 = uniforms
    reflected, transmitted = lobes.widths()
    one = jnp.ones_like(u)
    anisotropic = any(isinstance(width, WidthMatrix) for width in reflected + transmitted)
    alpha: LobeWidth = isotropic(one) if anisotropic else one
    passes, left = jnp.zeros(u.shape, bool), jnp.ones(u.shape, bool)
    reached = jnp.zeros_like(u)
    for index, width in enumerate(reflected + transmitted):
        chosen = left & (u < reached + shares[index]) & (u >= reached)
        reached = reached + shares[index]
        alpha = jax.tree.map(partial(jnp.where, chosen), width, alpha)
        passes = passes | (chosen & (index >= len(reflected)))
        left = left & ~chosen
    light = wi if not transmitted else select(passes, fold(wi, entry), wi)
    wo = reflect(light, sample_facet(light, alpha, u1, u2))
    if transmitted:
        wo = select(passes, unfold(wo, exit), wo)
    return (wo[0], wo[1], jnp.where(~passes & (wo[2] < 0), 0.0, wo[2])), left


def sample_facet(wi: Vector, width: LobeWidth, u1: Array, u2: Array) -> Vector:
    """A facet of a lobe that is seen from wi (above the horizon), from two uniform numbers."""
    return matrix_sample(wi, width, u1, u2) if isinstance(width, WidthMatrix) else ggx_sample(wi, width, u1, u2)


def facet_pdf(h: Vector, wi: Vector, width: LobeWidth) -> Array:
    """Density, 1/sr, of directions mirrored at what `sample_facet` draws, by their half vector with wi."""
    return matrix_pdf(h, wi, width) if isinstance(width, WidthMatrix) else reflection_pdf(h, wi, width)


def lobe_density(
    lobes: MicrofacetLobes, shares: Sequence[Array], wi: Vector, wo: Vector, entry: Array, exit: Array
) -> Array:
    """Density of `draw_lobe` in solid angle, 1/sr, of what the lobes take."""
    edge = horizon(wi[2].dtype)
    reflected, transmitted = lobes.widths()
    above = wo[2] > edge
    h, _ = half_vector(wi, sanitise(wo, above), same_side=True)
    total = jnp.zeros_like(wi[2] * wo[2])
    for share, alpha in zip(shares, reflected, strict=False):
        total = total + share * facet_pdf(h, wi, alpha)
    total = jnp.where(above, total, 0.0)
    if transmitted:
        below = wo[2] < -edge
        under = sanitise(flip(wo), below)
        a, b = fold(wi, entry), fold(under, exit)
        below = below & (a[2] > edge) & (b[2] > edge)
        a, b = sanitise(a, below), sanitise(b, below)
        h, _ = half_vector(a, b, same_side=True)
        stretch = exit * exit * under[2] / b[2]
        for share, alpha in zip(shares[len(reflected) :], transmitted, strict=False):
            total = total + jnp.where(below, share * stretch * facet_pdf(h, a, alpha), 0.0)
    return total
