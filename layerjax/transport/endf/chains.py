"""Lobes of a rough coat: chains of refractions and reflections as microfacet lobes with extended normals.

One chain is light that enters, meets the lower side `k` times and the upper one from inside `k - 1` times, and leaves.
Guo et al. 2015 give the concentration of its extended normals (Sec. 5.1). Their remaining terms M_t M_r M_t contain the
Jacobians that had already turned normals into directions, and so count them twice (36 times too bright at normal
incidence and eta = 1.5). Counted once they leave a microfacet lobe with these normals, and the Fresnel, masking and
absorption terms of the chain,

    f_k(i, o) = T^2 R^k F^(k-1) A G D(h; kappa) / (4 cos_i cos_o).        form "paper"

The kappa taken at one of the two directions makes that irreciprocal, and T at the mean direction sees no total
reflection. Evaluated below the surface, with both directions refracted there at a level facet, it is neither:

    f_k(i, o) = T(i) T(o) / eta^2 R^k F^(k-1) A G D(h'; kappa') / (4 cos_i' cos_o'),        form "reciprocal"

which is exact for a smooth coat. That form, and the formula for k > 1, are not in the paper.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._numerics import clamp_max, clamp_min, safe_sqrt
from layerjax.channels import Channels, map_channels, multiply, total
from layerjax.directions import Vector, half_vector
from layerjax.normals import vmf
from layerjax.stack import Medium, optical_depths
from layerjax.transport.endf.warping import (
    LEAST_VARIANCE,
    extended_concentration,
    joint_concentration,
    reflection_gains,
    refracted_cosine,
    refraction_gains,
)

Form = Literal["paper", "reciprocal"]


class Options(NamedTuple):
    """What is fixed while tracing. masking None: every facet is lit and seen."""

    bounces: int
    form: Form
    masking: vmf.Masking | None


class UpperSide(eqx.Module):
    """The upper side: index below over index above, and concentration of the normals."""

    ior: Array
    kappa: Array


class LowerSide(eqx.Module):
    """The lower side, from inside: concentration of its normals, and index n + i k relative to what lies above it."""

    kappa: Array
    ior: tuple[Array, ...]
    k: tuple[Array, ...] | None
    """None: a dielectric."""

    def reflectance(self, cosine: Array) -> Channels:
        """Fresnel reflectance, one array a channel."""
        if self.k is None:
            return (fresnel.dielectric(cosine, self.ior[0]),)
        return map_channels(lambda ior, k: fresnel.conductor(cosine, ior, k), self.ior, self.k)


class Coat(eqx.Module):
    """What light from above meets: a rough side, what absorbs, a lower side; each may be missing.

    turned: where the coat lies upside down, and directions in its media with it; None: nowhere.
    """

    top: UpperSide | None
    media: tuple[Medium, ...]
    base: LowerSide | None
    turned: Array | None = None


def reflections(coat: Coat, options: Options, wi: Vector, wo: Vector) -> list[Channels]:
    """BRDF of every lobe, for directions above the horizon: that of the surface first, then one a chain."""
    if coat.top is not None:
        h, cosine = half_vector(wi, wo, same_side=True)
        level = fresnel.dielectric(cosine, coat.top.ior)
        lobes: list[Channels] = [(level * _facets(h, wi, wo, coat.top.kappa, options.masking),)]
        if coat.base is not None and options.bounces:
            chains = _mean_direction_lobes if options.form == "paper" else _inner_half_vector_lobes
            lobes += chains(coat, coat.top, coat.base, options, wi, wo)
        return lobes
    if coat.base is not None:
        h, cosine = half_vector(wi, wo, same_side=True)
        shape = (_facets(h, wi, wo, coat.base.kappa, options.masking),)
        return [multiply(multiply(shape, coat.base.reflectance(cosine)), transmittance(coat, wi, wo))]
    return []


def _facets(h: Vector, wi: Vector, wo: Vector, kappa: Array, masking: vmf.Masking | None) -> Array:
    """Microfacet lobe of normals that reflect all, D G / (4 cos cos), 1/sr."""
    return (
        0.25
        * vmf.hemisphere_density(h, kappa)
        * masking_over_cosine(wi, kappa, masking)
        * masking_over_cosine(wo, kappa, masking)
    )


def _mean_direction_lobes(
    coat: Coat, top: UpperSide, base: LowerSide, options: Options, wi: Vector, wo: Vector
) -> list[Channels]:
    """Chains with all terms at the mean directions that follow from wi (Guo 2015, Secs. 5.1 and 5.3, corrected)."""
    h, _ = half_vector(wi, wo, same_side=True)
    inner, enters = refract_in(wi, top.ior)
    level = fresnel.dielectric(wi[2], top.ior)
    within = smith_masking(inner, top.kappa, options.masking) * smith_masking(inner, base.kappa, options.masking)
    sides = masking_over_cosine(wi, top.kappa, options.masking) * masking_over_cosine(wo, top.kappa, options.masking)
    energy: Channels = (jnp.where(enters, 0.25 * (1.0 - level) ** 2 * sides * within * within, 0.0),)
    step = multiply(
        base.reflectance(inner[2]), transmittance(coat, inner, (-inner[0], -inner[1], inner[2]))
    )  # R A, Eq. (27)
    lobes: list[Channels] = []
    for k in range(1, options.bounces + 1):
        energy = multiply(multiply(energy, step), (level,)) if k > 1 else multiply(energy, step)
        lobes.append(multiply(energy, (vmf.hemisphere_density(h, chain_concentration(k, wi[2], top, base)),)))
    return lobes


def _inner_half_vector_lobes(
    coat: Coat, top: UpperSide, base: LowerSide, options: Options, wi: Vector, wo: Vector
) -> list[Channels]:
    """Chains about the half vector of both directions below the surface."""
    inner_i, inner_o, through, inside = refract_pair(top, wi, wo)
    h, cosine = half_vector(inner_i, inner_o, same_side=True)
    for w in (inner_i, inner_o):
        through = through * masking_over_cosine(w, base.kappa, options.masking)
    for w in (wi, wo, inner_i, inner_o):
        through = through * smith_masking(w, top.kappa, options.masking)
    energy: Channels = (0.25 * through,)
    step = multiply(base.reflectance(cosine), transmittance(coat, inner_i, inner_o))
    lobes: list[Channels] = []
    for k in range(1, options.bounces + 1):
        energy = multiply(multiply(energy, step), (inside,)) if k > 1 else multiply(energy, step)
        lobes.append(multiply(energy, (vmf.hemisphere_density(h, inner_concentration(k, cosine, top, base)),)))
    return lobes


def refract_pair(top: UpperSide, wi: Vector, wo: Vector) -> tuple[Vector, Vector, Array, Array]:
    """Both directions below a level facet, upward; T(i) T(o) / eta^2; and the reflectance from inside.

    The last is sqrt(F(i) F(o)), F of the mean angle: T(i) T(o) (1 + F + F^2 + ...) is then never above 1.
    """
    (inner_i, enters), (inner_o, leaves) = refract_in(wi, top.ior), refract_in(wo, top.ior)
    level_i, level_o = fresnel.dielectric(wi[2], top.ior), fresnel.dielectric(wo[2], top.ior)
    through = jnp.where(enters & leaves, (1.0 - level_i) * (1.0 - level_o) / (top.ior * top.ior), 0.0)
    return inner_i, inner_o, through, safe_sqrt(level_i * level_o)


def chain_concentration(k: int, cosine: Array, top: UpperSide, base: LowerSide) -> Array:
    """kappa of the extended normals of a chain, by the cosine outside (Guo 2015, Eq. 26 and Fig. 12)."""
    inside, _ = refracted_cosine(cosine, top.ior)
    entry, exit = refraction_gains(cosine, top.ior), refraction_gains(inside, 1.0 / top.ior)
    turn = reflection_gains(inside)
    bounce = turn.facets * exit.beam
    lobes = [(top.kappa, entry.facets * turn.beam * exit.beam), (top.kappa, exit.facets)]
    lobes += k * [(base.kappa, bounce)] + (k - 1) * [(top.kappa, bounce)]
    return extended_concentration(joint_concentration(*lobes), reflection_gains(cosine))


def inner_concentration(k: int, cosine: Array, top: UpperSide, base: LowerSide) -> Array:
    """kappa of the extended normals after k reflections at the base about the half vector below the surface, by its
    cosine with the light: variances add there."""
    spread = half_vector_ratio(cosine, top.ior)
    inverse = k / base.kappa + 0.5 * spread * spread / top.kappa
    return 1.0 / clamp_min(inverse + (k - 1) / top.kappa if k > 1 else inverse, LEAST_VARIANCE)


def half_vector_ratio(cosine: Array, ior: Array) -> Array:
    """1 - cos_out / (eta cos): turn of a half vector inside over that of the facet crossed; 1 where nothing leaves."""
    squared = (1.0 - ior) * (1.0 + ior) + ior * ior * cosine * cosine
    leaves = squared > 0
    outside = jnp.sqrt(jnp.where(leaves, squared, 0.25))
    scaled = ior * cosine
    return jnp.where(leaves, (ior - 1.0) * (ior + 1.0) / (scaled * (scaled + outside)), 1.0)


def refract_in(w: Vector, ior: Array) -> tuple[Vector, Array]:
    """Where w goes below a level facet, turned upward, and whether it does; else with an interior cosine."""
    inside, enters = refracted_cosine(w[2], ior)
    return (w[0] / ior, w[1] / ior, inside), enters


def transmittance(coat: Coat, down: Vector, up: Vector, share: float = 1.0) -> Channels:
    """What is left of light that comes along `down` and goes along `up`, exp(-depths): Eq. (27); `share` of the path.

    Both point away from where they meet.
    """
    if not coat.media:
        return (jnp.ones_like(down[2]),)
    depths: list[Channels] = []
    for w in (down, up):
        if coat.turned is not None:
            w = (w[0], w[1], jnp.where(coat.turned, -w[2], w[2]))
        depths += optical_depths(coat.media, w)
    return tuple(jnp.exp(-share * depth) for depth in total(depths))


def masking_over_cosine(w: Vector, kappa: Array, masking: vmf.Masking | None) -> Array:
    """G1 / cos, for a direction above."""
    cosine = clamp_max(w[2], 1.0)
    return 1.0 / cosine if masking is None else vmf.masking_over_cosine(cosine, kappa, masking)


def smith_masking(w: Vector, kappa: Array, masking: vmf.Masking | None) -> Array:
    """G1, for a direction above."""
    return clamp_max(w[2], 1.0) * masking_over_cosine(w, kappa, masking)


def width(kappa: Array) -> Array:
    """The width alpha of normals of concentration kappa, at most 45."""
    return jnp.sqrt(2.0 / clamp_min(kappa, 1e-3))
