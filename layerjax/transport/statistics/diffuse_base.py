"""Light that has reached a diffuse base, in closed form (after de Dinechin & Belcour 2022, Eqs. 2-3).

A Lambertian base forgets where light came from, so that its inter-reflection with whatever lies above is a geometric
series of numbers, and the BSDF a product of two transmittances,

    f = T(i) T(o) rho / (pi n^2 (1 - rho R)),

with T(i) the share of light along i that arrives at the base, n the index above the base, and R the share of diffuse
light from the base that is sent back to it. It is exact and reciprocal, and needs energies only: one Fourier mode of
the adding-doubling solver, whatever the layers are.

Any other diffuse base is taken for one that forgets as well, with its own directional albedo A(u): f_b = A(i) A(o) /
(pi rho), rho the mean of A over diffuse light. Then the same holds with light that arrives along u counted A(u) / rho
times, in T and R, and with R that of light that leaves the base in those proportions. Energies are the base's own; of
its shape what depends on the azimuth is lost, and what does not is a product.
"""

from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import at_least, at_most, horizon, safe_div, safe_sqrt
from layerjax.channels import Channels, per_channel, pick
from layerjax.directions import Vector
from layerjax.quadrature import gauss_legendre
from layerjax.stack import Stack, optical_depths
from layerjax.surfaces import Lambertian, Surface
from layerjax.transport.adding_doubling import AddingDoubling, Solved
from layerjax.transport.discrete.solve import Plan, make_plan, solve
from layerjax.transport.discrete.tables import Tables, make_tables
from layerjax.transport.first_order import FirstOrder, caught, first_order
from layerjax.transport.statistics.diffuse import closed_form, indirect_energy
from layerjax.transport.statistics.lobes import precision
from layerjax.transport.statistics.tables import GRAZING, index_below, look_up, points

NODES = 24
"""Cosines of the solver, and of the mean over diffuse light."""

AZIMUTHS = 24
"""Azimuths of the albedo of a base that is not Lambertian."""


LARGEST_RETURN = 1.0 - 1e-4
"""Bound of R, and of rho R, over a base that is not Lambertian: one that reflects too much would amplify on and on."""


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
    state: Solved | None = None
    # solved out here: what is known of the layers while tracing saves the solver work
    if bare.layers and isinstance(base, Lambertian):
        state = solver.prepare(bare)
    elif bare.layers:
        first = first_order(bare)
        plan = make_plan(bare, NODES, 1, solver.ordinates, microfacets)
        state = Solved(first, _counted(bare, base, first, plan))
    return _closed_form(bare, base, solver, state, precision(stack))


@eqx.filter_jit
def _counted(bare: Stack, base: Surface, first: FirstOrder, plan: Plan) -> Tables:
    """Tables of the solved layers, with light that arrives below counted by the base's albedo."""
    grid, whole = solve(bare, plan)
    share = _share(base, grid.regions[-1].cosine)[:, None, :, None]
    every = jnp.ones_like(share[:, :, :1])  # as many channels everywhere
    whole = whole.map(lambda flux: every * flux, lambda direct: every[..., 0] * direct)
    arriving = jax.tree.map(lambda flux: share * flux, (whole.reflect_bottom, whole.transmit_down))
    whole = eqx.tree_at(lambda layer: (layer.reflect_bottom, layer.transmit_down), whole, arriving)
    return make_tables(grid, whole, plan.azimuths, False, partial(caught, first))


@eqx.filter_jit
def _closed_form(bare: Stack, base: Surface, solver: AddingDoubling, state: Solved | None, dtype: Any) -> DiffuseBase:
    ior = index_below(bare)
    x, w = (jnp.asarray(array, dtype) for array in gauss_legendre(NODES))
    if isinstance(base, Lambertian):
        albedo = jnp.stack(per_channel(jnp.asarray(base.albedo)))
    else:
        albedo = jnp.sum(2.0 * w * x * _directional_albedo(base, x), axis=-1)

    def energies(cosine: Array, side: float) -> tuple[Array, Array]:
        """Reflected and transmitted, (C or 1, n), with what nothing meets."""
        if state is None:
            return jnp.zeros_like(cosine)[None], _share(base, cosine)
        wi: Vector = (safe_sqrt(1.0 - cosine * cosine), jnp.zeros_like(cosine), side * cosine)
        near, far = solver.albedo(state, wi, NODES)
        straight = jnp.zeros_like(cosine)[None]
        if not state.first.layered:
            depths = [jnp.stack(depth) for depth in optical_depths(state.first.upper.media, wi)]
            straight = jnp.exp(-sum(depths[1:], depths[0]))
        return jnp.stack(near), jnp.stack(far) + straight * _share(base, cosine)

    _, arriving = energies(at_least(points(dtype), GRAZING), 1.0)
    back = jnp.sum(2.0 * w * x * _share(base, x) * energies(x, -1.0)[0], axis=-1)
    if not isinstance(base, Lambertian):
        back = at_most(back, LARGEST_RETURN / at_least(albedo, 1.0))
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


def _share(base: Surface, cosine: Array) -> Array:
    """Albedo of the base along cosines (n,) over its mean for diffuse light, (C or 1, n)."""
    if isinstance(base, Lambertian):
        return jnp.ones_like(cosine)[None]
    x, w = (jnp.asarray(array, cosine.dtype) for array in gauss_legendre(NODES))
    mean = jnp.sum(2.0 * w * x * _directional_albedo(base, x), axis=-1)
    return safe_div(_directional_albedo(base, cosine), mean[:, None], 1.0)


def _directional_albedo(base: Surface, cosine: Array) -> Array:
    """Share of light at cosines (n,) that the base reflects, (C or 1, n)."""
    x, w = (jnp.asarray(array, cosine.dtype) for array in gauss_legendre(NODES))
    phi = jnp.asarray((np.arange(AZIMUTHS) + 0.5) * np.pi / AZIMUTHS, cosine.dtype)
    across, sine = safe_sqrt((1.0 - cosine) * (1.0 + cosine)), safe_sqrt(1.0 - x * x)
    nothing = jnp.zeros_like(cosine)
    wi: Vector = (across[:, None, None], nothing[:, None, None], cosine[:, None, None])
    wo: Vector = (sine[:, None] * jnp.cos(phi), sine[:, None] * jnp.sin(phi), x[:, None] * jnp.ones_like(phi))
    weight = (2.0 * np.pi / AZIMUTHS * w * x)[:, None]
    return jnp.stack([jnp.sum(weight * value, axis=(-2, -1)) for value in base.evaluate(wi, wo)])
