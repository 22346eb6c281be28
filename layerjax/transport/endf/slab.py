"""Light through a slab with two rough sides, and through one rough interface.

A slab's two refractions are one lobe about the half vector of the light and the mirror image of where it goes (Guo et
al. 2015, Sec. 4.3, which gives the concentration of the transmitted light alone, Eq. 23, and no value). In form
"reciprocal" it is evaluated below the surface, as the chains of a coat are: of several forms that were compared with a
Monte Carlo it has the smallest error in energy and shape. One interface is exact: Walter et al. 2007 with vMF normals.
"""

import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._numerics import clamp_min
from layerjax.channels import Channels, multiply
from layerjax.directions import Vector, flip, half_vector
from layerjax.normals import vmf
from layerjax.surfaces.interface import refraction_lobe
from layerjax.transport.endf.chains import (
    Coat,
    LowerSide,
    Options,
    UpperSide,
    half_vector_ratio,
    masking_over_cosine,
    refract_in,
    refract_pair,
    smith_masking,
    transmittance,
    width,
)
from layerjax.transport.endf.warping import (
    LEAST_VARIANCE,
    extended_concentration,
    joint_concentration,
    reflection_gains,
    refracted_cosine,
    refraction_gains,
)


def transmissions(coat: Coat, options: Options, wi: Vector, under: Vector) -> list[Channels]:
    """BTDF of every lobe: light without a round trip, and after one or more.

    wi is above the horizon, and so is `under`, the mirror image of where the light goes.
    """
    if coat.top is None:
        return []
    if coat.base is None:
        return [(_refraction(coat.top, options.masking, wi, under),)]
    through = _mean_direction_lobes if options.form == "paper" else _inner_half_vector_lobes
    return through(coat, coat.top, coat.base, options, wi, under)


def _mean_direction_lobes(
    coat: Coat, top: UpperSide, base: LowerSide, options: Options, wi: Vector, under: Vector
) -> list[Channels]:
    """All terms at the mean direction, that of light which is not deflected."""
    h, _ = half_vector(wi, under, same_side=True)
    inner, enters = refract_in(wi, top.ior)
    level = fresnel.dielectric(wi[2], top.ior)
    sides = masking_over_cosine(wi, top.kappa, options.masking) * masking_over_cosine(
        under, base.kappa, options.masking
    )
    within = smith_masking(inner, top.kappa, options.masking) * smith_masking(inner, base.kappa, options.masking)
    energy: Channels = (jnp.where(enters, 0.25 * (1.0 - level) ** 2 * sides * within, 0.0),)
    energy = multiply(energy, transmittance(coat, inner, inner, 0.5))
    step = multiply((level * level,), transmittance(coat, inner, (-inner[0], -inner[1], inner[2])))
    lobes: list[Channels] = []
    for j in range(options.bounces + 1):
        energy = multiply(energy, step) if j else energy
        lobes.append(multiply(energy, (vmf.hemisphere_density(h, slab_concentration(j, wi[2], top, base)),)))
    return lobes


def _inner_half_vector_lobes(
    coat: Coat, top: UpperSide, base: LowerSide, options: Options, wi: Vector, under: Vector
) -> list[Channels]:
    """About the half vector of both directions inside the slab."""
    inner_i, inner_o, through, inside = refract_pair(top, wi, under)
    h, cosine = half_vector(inner_i, inner_o, same_side=True)
    through = (
        through * smith_masking(wi, top.kappa, options.masking) * smith_masking(under, base.kappa, options.masking)
    )
    through = (
        through
        * masking_over_cosine(inner_i, top.kappa, options.masking)
        * masking_over_cosine(inner_o, base.kappa, options.masking)
    )
    energy: Channels = multiply((0.25 * through,), transmittance(coat, inner_i, flip(inner_o), 0.5))
    step = multiply((inside * inside,), transmittance(coat, inner_i, flip(inner_o)))
    lobes: list[Channels] = []
    for j in range(options.bounces + 1):
        energy = multiply(energy, step) if j else energy
        lobes.append(multiply(energy, (vmf.hemisphere_density(h, inner_slab_concentration(j, cosine, top, base)),)))
    return lobes


def slab_concentration(j: int, cosine: Array, top: UpperSide, base: LowerSide) -> Array:
    """kappa of the extended normals after j reflections at each side, by the cosine outside (Guo 2015, Eqs. 23, 24)."""
    inside, _ = refracted_cosine(cosine, top.ior)
    entry, exit = refraction_gains(cosine, top.ior), refraction_gains(inside, 1.0 / top.ior)
    bounce = reflection_gains(inside).facets * exit.beam
    lobes = [(top.kappa, entry.facets * exit.beam), (base.kappa, exit.facets)]
    lobes += j * [(top.kappa, bounce), (base.kappa, bounce)]
    return extended_concentration(joint_concentration(*lobes), reflection_gains(cosine))


def inner_slab_concentration(j: int, cosine: Array, top: UpperSide, base: LowerSide) -> Array:
    """kappa of the extended normals after j reflections at each side about the half vector inside, by its cosine with
    the light: variances add there."""
    spread = half_vector_ratio(cosine, top.ior)
    inverse = (j + 0.25 * spread * spread) * (1.0 / top.kappa + 1.0 / base.kappa)
    return 1.0 / clamp_min(inverse, LEAST_VARIANCE)


def _refraction(top: UpperSide, masking: vmf.Masking | None, wi: Vector, under: Vector) -> Array:
    """BTDF of one rough interface (Walter et al. 2007, Eq. 21, with its eta_o^2); a delta, given as 0, at eta = 1."""
    lobe, (transmitted,) = refraction_lobe(wi, flip(under), top.ior, width(top.kappa), "vmf")
    return (
        lobe
        * transmitted
        * masking_over_cosine(wi, top.kappa, masking)
        * masking_over_cosine(under, top.kappa, masking)
    )
