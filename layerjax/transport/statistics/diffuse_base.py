"""Light that has reached a diffuse base, in closed form (after de Dinechin & Belcour 2022, Eqs. 2-3).

A Lambertian base forgets where light came from, so that its inter-reflection with whatever lies above is a geometric
series of numbers, and the BSDF a product of two transmittances,

    f = T(i) T(o) rho / (pi n^2 (1 - rho R)),

with T(i) the share of light along i that arrives at the base, n the index above the base, and R the share of diffuse
light from the base that is sent back to it. It is exact and reciprocal, and needs energies only: one Fourier mode of
the adding-doubling solver, whatever the layers are.
"""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import at_least, horizon, safe_sqrt
from layerjax.channels import Channels, per_channel, pick
from layerjax.directions import Vector
from layerjax.quadrature import gauss_legendre
from layerjax.stack import Stack, optical_depths
from layerjax.surfaces import Lambertian, Surface
from layerjax.transport.adding_doubling import AddingDoubling, Solved
from layerjax.transport.statistics.diffuse import closed_form, indirect_energy
from layerjax.transport.statistics.lobes import precision
from layerjax.transport.statistics.tables import GRAZING, index_below, look_up, points

NODES = 24
"""Cosines of the solver, and of the mean over diffuse light."""

AZIMUTHS = 24
"""Azimuths of the mean reflectance of a base that is not Lambertian."""


class DiffuseBase(eqx.Module):
    """arriving: T at the points of a table, (POINTS, C or 1). level: rho / (pi n^2 (1 - rho R)), (C or 1,).

    energy: albedo over T(i), (C or 1,).
    """

    arriving: Array
    level: Array
    energy: Array


def make_diffuse(stack: Stack, base: Surface, microfacets: Literal["single", "multiple"]) -> DiffuseBase:
    """The diffuse part of a simplified stack over a diffuse base."""
    bare = Stack(stack.layers, None)
    solver = AddingDoubling(nodes=NODES, modes=1, microfacets=microfacets)
    # solved out here: what is known of the layers while tracing saves the solver work
    return _closed_form(bare, base, solver, solver.prepare(bare) if stack.layers else None, precision(stack))


@eqx.filter_jit
def _closed_form(bare: Stack, base: Surface, solver: AddingDoubling, state: Solved | None, dtype: Any) -> DiffuseBase:
    albedo = _mean_albedo(base, dtype)
    ior = index_below(bare)
    x, w = (jnp.asarray(array, dtype) for array in gauss_legendre(NODES))

    def energies(cosine: Array, side: float) -> tuple[Array, Array]:
        """Reflected and transmitted, (C or 1, n), with what nothing meets."""
        if state is None:
            return jnp.zeros_like(cosine)[None], jnp.ones_like(cosine)[None]
        wi: Vector = (safe_sqrt(1.0 - cosine * cosine), jnp.zeros_like(cosine), side * cosine)
        near, far = solver.albedo(state, wi, NODES)
        straight = jnp.zeros_like(cosine)[None]
        if not state.first.layered:
            depths = [jnp.stack(depth) for depth in optical_depths(state.first.upper.media, wi)]
            straight = jnp.exp(-sum(depths[1:], depths[0]))
        return jnp.stack(near), jnp.stack(far) + straight

    _, arriving = energies(at_least(points(dtype), GRAZING), 1.0)
    back = jnp.sum(2.0 * w * x * energies(x, -1.0)[0], axis=-1)
    leaving = jnp.sum(2.0 * w * x * energies(x, 1.0)[1], axis=-1) / (ior * ior)  # by reciprocity
    one = jnp.ones_like(back)
    return DiffuseBase(
        arriving.T, closed_form(one, one, back, albedo, ior), indirect_energy(one, leaving, back, albedo)
    )


def diffuse_value(part: DiffuseBase, wi: Vector, wo: Vector) -> Channels:
    """BRDF of the light that has reached the base, 0 unless both directions are above."""
    edge = horizon(wi[2].dtype)
    valid = (wi[2] > edge) & (wo[2] > edge)
    there, back = (_arriving(part, (w[0], w[1], jnp.where(valid, w[2], 0.5))) for w in (wi, wo))
    level = per_channel(part.level)
    count = max(len(there), len(level))
    return tuple(jnp.where(valid, pick(there, c) * pick(back, c) * pick(level, c), 0.0) for c in range(count))


def diffuse_albedo(part: DiffuseBase, wi: Vector) -> Channels:
    """Energy of `diffuse_value` for light along wi, above."""
    there, factor = _arriving(part, wi), per_channel(part.energy)
    return tuple(pick(there, c) * pick(factor, c) for c in range(max(len(there), len(factor))))


def _arriving(part: DiffuseBase, w: Vector) -> Channels:
    rows = look_up(part.arriving, w[2], safe_sqrt(w[0] * w[0] + w[1] * w[1]))
    return tuple(rows[..., c] for c in range(rows.shape[-1]))


def _mean_albedo(base: Surface, dtype: Any) -> Array:
    """Share of diffuse light that the base reflects, (C or 1,)."""
    if isinstance(base, Lambertian):
        return jnp.stack(per_channel(jnp.asarray(base.albedo)))
    x, w = (jnp.asarray(array, dtype) for array in gauss_legendre(NODES))
    phi = jnp.asarray((np.arange(AZIMUTHS) + 0.5) * np.pi / AZIMUTHS, dtype)
    sine = safe_sqrt(1.0 - x * x)
    wi: Vector = (sine[:, None, None], jnp.zeros((1, 1, 1), dtype), x[:, None, None])
    wo: Vector = (sine[:, None] * jnp.cos(phi), sine[:, None] * jnp.sin(phi), x[:, None] * jnp.ones_like(phi))
    weight = 4.0 * np.pi / AZIMUTHS * (w * x)[:, None, None] * (w * x)[:, None]
    return jnp.stack([jnp.sum(weight * value) for value in base.evaluate(wi, wo)])
