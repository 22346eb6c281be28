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

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._devices import exact_products
from layerjax._numerics import clamp_max, clamp_min, horizon, safe_div, safe_sqrt
from layerjax.channels import Channels, multiply, per_channel, pick, select
from layerjax.directions import Vector, bend, sanitise
from layerjax.quadrature import gauss_legendre
from layerjax.stack import Interface, Stack, media_of, optical_depths
from layerjax.surfaces import Lambertian, Surface
from layerjax.transport.adding_doubling.facet_scattering import Normals, facet_energies
from layerjax.transport.adding_doubling.grid import Grid, Region, interpolate_rows, table_region, table_values
from layerjax.transport.adding_doubling.operators import Parts
from layerjax.transport.adding_doubling.resolution import Resolution
from layerjax.transport.adding_doubling.solve import Plan, make_plan, solve
from layerjax.transport.first_order import collision_probability
from layerjax.transport.lobes.statistics import precision
from layerjax.transport.specular import Window, smooth_window, specular_shares
from layerjax.transport.statistical.diffuse import closed_form, indirect_energy

NODES = 24
"""Cosines of the solver, and of means over diffuse light."""

LEAST_ENTERING = 1e-4
"""Share of light that an interface lets in below which it counts as light of every other direction behind it."""

AZIMUTHS = 24
"""Azimuths of the albedo of a base that is not Lambertian."""

LEAST_ALBEDO = 1e-6
"""Replaces the albedo 0 of a base where its shape is needed."""

LARGEST_RETURN = 1.0 - 1e-4
"""Bound of R, and of rho R, over a base that is not Lambertian: one that reflects too much would amplify on and on."""


class DiffuseBase(eqx.Module):
    """arriving: T at the points of the solver's table, (points, C or 1), whose panels end at critical angles, where T
    does what no polynomial does. level: rho / (pi n^2 (1 - rho R)), (C or 1,). energy: albedo over T(i), (C or 1,).
    """

    grid: Grid
    transmittance: Array
    level: Array
    energy: Array

    def value(self, wi: Vector, wo: Vector) -> Channels:
        """BRDF of the light that has reached the base, 0 unless both directions are above."""
        edge = horizon(wi[2].dtype)
        valid = (wi[2] > edge) & (wo[2] > edge)
        incoming, back = (_transmittance(self, sanitise(w, valid)) for w in (wi, wo))
        return select(valid, multiply(incoming, back, per_channel(self.level)))

    def albedo(self, wi: Vector) -> Channels:
        """Energy of `value` for light along wi, above."""
        incoming, factor = _transmittance(self, wi), per_channel(self.energy)
        return tuple(pick(incoming, c) * pick(factor, c) for c in range(max(len(incoming), len(factor))))


def make_diffuse(stack: Stack, base: Surface, multiple: bool) -> DiffuseBase:
    """The diffuse part of a simplified stack over a diffuse base."""
    bare = Stack(stack.layers, None)
    # planned out here: what is known of the layers while tracing saves the solver work
    plan = make_plan(bare, Resolution(NODES, 1, (2, 4)), multiple)
    return _closed_form(bare, base, plan, precision(stack))


@eqx.filter_jit
@exact_products
def _closed_form(bare: Stack, base: Surface, plan: Plan, dtype: Any) -> DiffuseBase:
    grid, whole, *_ = solve(bare, plan)
    top, bottom = grid.regions[0], grid.regions[-1]
    if isinstance(base, Lambertian):
        albedo = jnp.stack(per_channel(jnp.asarray(base.albedo)))
    else:
        x, w = (jnp.asarray(array, dtype) for array in gauss_legendre(NODES))
        albedo = jnp.sum(2.0 * w * x * _directional_albedo(base, x), axis=-1)
    counted = _share(base, bottom.cosine)

    def arriving(parts: Parts) -> Array:
        """Share of the diffuse light along every node that arrives at the base, (C or 1, nodes)."""
        flux = parts.total
        return (
            jnp.zeros_like(counted) if flux is None else jnp.einsum("cij,ci->cj", *_broadcast_pair(flux[:, 0], counted))
        )

    scattered, back = arriving(whole.transmit_down), arriving(whole.reflect_bottom)
    if whole.mirror_bottom is not None:
        back = back + whole.mirror_bottom[:, 0] * counted
    first = next((layer for layer in bare.layers if isinstance(layer, Interface)), None)
    if first is not None and first.is_smooth:
        ballistic = jnp.zeros_like(counted) if whole.direct_down is None else whole.direct_down[:, 0] * counted
        incoming, table = scattered + ballistic, _smooth_table(bare, base, grid, scattered)
    elif whole.direct_down is None:
        incoming, table = scattered, _refracted_table(bare, grid, scattered, plan)
    else:
        ballistic = whole.direct_down[:, 0] * counted
        incoming, table = scattered + ballistic, _ballistic_table(bare, base, grid, scattered)
    # means over diffuse light at the nodes of the solver: they know the critical angles
    inward, outward = (2.0 * region.weight / region.ior**2 for region in (bottom, top))
    returned = jnp.sum(inward * counted * back, axis=-1)
    if not isinstance(base, Lambertian):
        returned = clamp_max(returned, LARGEST_RETURN / clamp_min(albedo, 1.0))
    leaving = jnp.sum(outward * incoming, axis=-1) / bottom.ior**2  # by reciprocity
    one = jnp.ones_like(returned)
    level = closed_form(one, one, returned, albedo, bottom.ior)
    return DiffuseBase(grid, table.T, level, indirect_energy(one, leaving, returned, albedo))


def _refracted_table(bare: Stack, grid: Grid, incoming: Array, plan: Plan) -> Array:
    """T at the points of a table, from its values at the nodes, where the first interface is rough.

    What becomes of the light behind that interface varies slowly: it is interpolated. What the interface lets in, which
    rises within its roughness at a critical angle, is integrated at the points themselves.
    """
    face = next(layer for layer in bare.layers if isinstance(layer, Interface))
    normals = Normals(jnp.asarray(face.alpha, incoming.dtype), face.distribution)
    top, below = grid.regions[:2]

    def entering(region: Region) -> Array:
        _, passed, lost = facet_energies(region, below, normals)
        return passed + lost if plan.multiple else passed

    at_nodes, at_points = entering(top), entering(table_region(grid, top))
    typical = safe_div(incoming @ top.weight, at_nodes @ top.weight)[:, None]
    behind = (incoming + LEAST_ENTERING * typical) / (at_nodes + LEAST_ENTERING)
    return table_values(grid, behind) * at_points


def _ballistic_table(bare: Stack, base: Surface, grid: Grid, scattered: Array) -> Array:
    """T at the points of a table, where there are media alone: of what is scattered the share of what meets anything
    is interpolated, and what passes without a collision is known."""
    top, media = grid.regions[0], media_of(bare)

    def along(region: Region) -> Vector:
        return region.sine, jnp.zeros_like(region.sine), region.cosine

    points = table_region(grid, top)
    at_nodes, at_points = (jnp.stack(collision_probability(media, along(region))) for region in (top, points))
    depths = [jnp.stack(depth) for depth in optical_depths(media, along(points))]
    ballistic = jnp.exp(-sum(depths[1:], depths[0])) * _share(base, points.cosine)
    scattered, at_nodes = _broadcast_pair(scattered, at_nodes)
    return table_values(grid, scattered / at_nodes) * at_points + ballistic


def _smooth_table(bare: Stack, base: Surface, grid: Grid, scattered: Array) -> Array:
    """T at the points of a table, where the first interface is smooth: of what is scattered the share of what enters is
    interpolated, and what no event meets is known."""
    top, points = grid.regions[0], table_region(grid, grid.regions[0])
    window = smooth_window(bare, upward=False) or Window(())

    def along(region: Region) -> Vector:
        return region.sine, jnp.zeros_like(region.sine), region.cosine

    (at_nodes,), (at_points,) = (window.cross(along(region))[1] for region in (top, points))
    typical = safe_div(scattered @ top.weight, at_nodes @ top.weight)[:, None]
    behind = (scattered + LEAST_ENTERING * typical) / (at_nodes + LEAST_ENTERING)
    passed = jnp.stack(specular_shares(bare, along(points))[1])
    below, _ = bend(along(points), grid.regions[-1].ior)
    counted = _share(base, jnp.abs(below[2]))
    return table_values(grid, behind) * at_points + jnp.multiply(*_broadcast_pair(passed, counted))


def _broadcast_pair(a: Array, b: Array) -> tuple[Array, Array]:
    """Both with as many channels, their first axis."""
    channels = max(a.shape[0], b.shape[0])
    return jnp.broadcast_to(a, (channels, *a.shape[1:])), jnp.broadcast_to(b, (channels, *b.shape[1:]))


def _transmittance(part: DiffuseBase, w: Vector) -> Channels:
    rows = interpolate_rows(part.grid, part.transmittance, part.grid.regions[0].ior, w[2], w[0] * w[0] + w[1] * w[1])
    return tuple(clamp_min(rows[..., c], 0.0) for c in range(rows.shape[-1]))


def _share(base: Surface, cosine: Array) -> Array:
    """Albedo of the base along cosines (n,) over its mean for diffuse light, (C or 1, n)."""
    if isinstance(base, Lambertian):
        return jnp.ones_like(cosine)[None]
    diffuse: Any = base
    base = eqx.tree_at(lambda surface: surface.albedo, diffuse, clamp_min(jnp.asarray(diffuse.albedo), LEAST_ALBEDO))
    x, w = (jnp.asarray(array, cosine.dtype) for array in gauss_legendre(NODES))
    mean = jnp.sum(2.0 * w * x * _directional_albedo(base, x), axis=-1)
    return _directional_albedo(base, cosine) / mean[:, None]


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
