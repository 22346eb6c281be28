"""Opaque bases on the grid: the BRDF at the nodes, that of a metal scaled to the energy that its facets reflect."""

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_min, safe_div
from layerjax.channels import pick
from layerjax.directions import Vector, reflect
from layerjax.surfaces import Conductor, Surface
from layerjax.transport.adding_doubling.facet_scattering import (
    ENERGY_POINTS,
    Normals,
    map_visible_normals,
    smith_masking,
)
from layerjax.transport.adding_doubling.grid import Region
from layerjax.transport.adding_doubling.operators import Layer, Parts
from layerjax.transport.adding_doubling.sampling import modes_at_nodes, projected_weight, scale_to_energy


def base_layer(region: Region, base: Surface, modes: int, multiple: bool, *, grazing: bool = False) -> Layer:
    """An opaque base under a region, as Fourier modes; grazing: see `modes_at_nodes`."""
    if isinstance(base, Conductor) and base.is_smooth:
        return Layer(Parts(None), mirror_top=jnp.stack(base.reflectance(region.cosine))[:, None])
    weight = projected_weight(region)
    is_metal = isinstance(base, Conductor)
    kernels = modes_at_nodes(
        base.evaluate, region, region, modes, has_mirror_lobe=is_metal, grazing=grazing and is_metal
    )
    if isinstance(base, Conductor):
        return Layer(_conductor(region, base, kernels, multiple))
    return Layer(Parts(jnp.stack(kernels) * weight[:, None]))


def _conductor(region: Region, base: Conductor, kernels: Sequence[Array], multiple: bool) -> Parts:
    normals = Normals(base.width, base.distribution)

    def seen_by(m: Vector, facing: Array, weight: Array, wi: Vector) -> tuple[Array, Array]:
        return facing, weight * smith_masking(reflect(wi, m), normals)

    cosine, seen = map_visible_normals(
        seen_by, region, normals, jnp.ones((), region.cosine.dtype), "reflected", ENERGY_POINTS
    )
    levels = base.reflectance(cosine)
    operators, given = [], []
    for c, kernel in enumerate(kernels):
        energy = jnp.sum(seen * pick(levels, c), axis=-1)
        operators.append(scale_to_energy(region, kernel, energy))
        if multiple:
            gain = _coloured_return(energy, jnp.sum(seen, axis=-1), region.weight)
            given.append(jnp.zeros_like(operators[-1]).at[0].set(gain))
    return Parts(jnp.stack(operators), jnp.stack(given) if given else None)


def _coloured_return(energy: Array, lossless: Array, weight: Array) -> Array:
    """What a conductor returns of the light lost to masking: it loses its Fresnel share at every further facet."""
    lost = jnp.where(weight > 0, clamp_min(1.0 - lossless, 0.0), 0.0)
    total = jnp.sum(weight * lost)
    # mean reflectance of a facet, and mean share that escapes at each try (Kulla & Conty 2017)
    level = safe_div(jnp.sum(weight * energy), jnp.sum(weight * lossless))
    escapes = 1.0 - safe_div(total, jnp.sum(weight))
    kept = level * level * escapes / (1.0 - level * (1.0 - escapes))
    return kept * safe_div(jnp.outer(weight * lost, lost), total)
