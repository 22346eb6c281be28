"""Rough interfaces and bases on the grid.

What a face reflects is its BRDF at the nodes, scaled to the energy that its visible facets reflect. What it refracts
is found facet by facet: those visible from a node are integrated over by quadrature, and what each passes is put
(*deposited*) on the nodes around (see `grid.spread`). The energy is that of the quadrature at any roughness.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._numerics import at_least, safe_div, safe_sqrt
from layerjax.channels import per_channel, pick
from layerjax.directions import Vector, dot, normalize, reflect, refract, sanitised
from layerjax.microsurface import Microfacets
from layerjax.microsurface.directional_albedo import interface_energies
from layerjax.normals import facets
from layerjax.quadrature import gauss_legendre
from layerjax.surfaces import Conductor, Surface
from layerjax.surfaces.interface import interface_reflection
from layerjax.transport.adding_doubling.grid import Grid, Region, spread
from layerjax.transport.adding_doubling.operators import Layer, Parts
from layerjax.transport.adding_doubling.sampling import BALANCING, balance, modes_at_nodes, straight_on

LEAST_FACETS = 24
"""Points of the quadrature of visible normals in either direction, at least (see `_visible_normals`)."""

AGREEING, RESOLVED, MOST_OFF = 0.3, 0.2, 50.0
"""Energies of light deposited on nodes are put right where they are off by a share that is well below the first.

It grows with the width of the lobe in distances between nodes, alpha times their number, above the second: what nodes
resolve is wrong only where little light passes. More times wrong than the third is only what rounding leaves.
"""


class Normals(NamedTuple):
    """Normals of an interface or a base."""

    alpha: Array
    distribution: facets.Distribution


def interface_layer(
    grid: Grid,
    above: Region,
    below: Region,
    normals: Normals,
    modes: int,
    microfacets: Microfacets,
    *,
    enters: bool = True,
) -> Layer:
    """Rough dielectric interface between two regions, as Fourier modes (Walter 2007).

    Light that enters the stack is deposited on the inner nodes; light that leaves is *gathered* from them (the adjoint,
    by reciprocity), which gives radiance at the outer nodes as exact as it is smooth inside. `enters`: whether light
    from above counts as entering.
    """
    near, far = (above, below) if enters else (below, above)
    outside, refracted, lost_outside = _shares(grid, near, far, normals, modes)
    inside, (_, passed), lost_inside = _shares(grid, far, near, normals, modes)
    down, up = jnp.sum(refracted[1], axis=-1), jnp.sum(passed, axis=-1)
    unresolved = 1.0 / (1.0 + (jnp.asarray(normals.alpha) * grid.nodes / RESOLVED) ** 4)
    through = _deposit(grid, *refracted, far, near, modes)
    through = _balanced(through, near, far, down, up, AGREEING / unresolved)
    back = _adjoint(through, near, far)
    outer, inner = (
        _face(a, level, b.ior / a.ior, normals, modes) + unresolved * _left_over(a, level, wanted, flux)
        for a, b, level, wanted, flux in ((near, far, outside, down, through), (far, near, inside, up, back))
    )
    operators = [outer, through, back, inner]
    if microfacets == "multiple":
        turned = [
            _turned_back(a, b.ior / a.ior, normals.alpha, level, lost)
            for a, b, level, lost in ((near, far, outside, lost_outside), (far, near, inside, lost_inside))
        ]
        operators = _returned(operators, (lost_outside, lost_inside), turned, (near.weight, far.weight))
    reflect_near, into, out, reflect_far = (Parts(operator[None]) for operator in operators)
    if enters:
        return Layer(reflect_near, reflect_far, into, out)
    return Layer(reflect_far, reflect_near, out, into)


def base_layer(grid: Grid, region: Region, base: Surface, modes: int, microfacets: Microfacets) -> Layer:
    """An opaque base under a region, as Fourier modes."""
    weight = _weight(region)
    kernels = modes_at_nodes(base.evaluate, region, region, modes)
    if isinstance(base, Conductor):
        return Layer(Parts(_conductor(grid, region, base, kernels, microfacets)))
    return Layer(Parts(jnp.stack(kernels) * weight[:, None]))


def _conductor(
    grid: Grid, region: Region, base: Conductor, kernels: Sequence[Array], microfacets: Microfacets
) -> Array:
    normals = Normals(base.alpha, base.distribution)
    m, weight, wi = _visible_normals(grid, region, normals, kernels[0].shape[0])
    cosine = dot(wi, m)
    seen = weight * _masking(reflect(wi, m), normals)
    ior, k = per_channel(base.ior), per_channel(base.k)
    operators = []
    for c, kernel in enumerate(kernels):
        energy = jnp.sum(seen * fresnel.conductor(cosine, pick(ior, c), pick(k, c)), axis=-1)
        operator = _scaled(region, kernel, energy)
        if microfacets == "multiple":
            operator = operator.at[0].add(_coloured_return(energy, jnp.sum(seen, axis=-1), region.weight))
        operators.append(operator)
    return jnp.stack(operators)


def _face(region: Region, energy: Array, ior: Array, normals: Normals, modes: int) -> Array:
    """Reflection at an interface, seen from one side."""
    (kernel,) = modes_at_nodes(lambda wi, wo: [interface_reflection(wi, wo, ior, *normals)], region, region, modes)
    return _scaled(region, kernel, energy)


def _scaled(region: Region, kernel: Array, energy: Array) -> Array:
    """Flux operator of a face from its BRDF at the nodes and its albedo, which decides."""
    weight = _weight(region)
    scale, missing = balance([(kernel[0], lambda d: d)], weight, jnp.where(region.weight > 0, energy, 0.0))
    return weight[:, None] * (scale[:, None] * kernel * scale + straight_on(missing, weight))


def _weight(region: Region) -> Array:
    """Weight of the measure cos dw over nodes and azimuth, in the region's own solid angle."""
    return 2.0 * jnp.pi * region.solid * region.cosine


def _adjoint(flux: Array, near: Region, far: Region) -> Array:
    """The operator for the opposite way, by reciprocity: kernels F / W are transposes of each other."""
    kernel = safe_div(flux, jnp.broadcast_to(far.weight[:, None], flux.shape))
    return near.weight[:, None] * jnp.swapaxes(kernel, -1, -2)


def _shares(
    grid: Grid, near: Region, far: Region, normals: Normals, modes: int
) -> tuple[Array, tuple[Vector, Array], Array]:
    """Of light from every near node, by facets: the energy reflected; where to and how much is refracted; the loss."""
    ratio = far.ior / near.ior
    m, weight, wi = _visible_normals(grid, near, normals, modes)
    level = fresnel.dielectric(dot(wi, m), ratio)
    reflected = weight * level * _masking(reflect(wi, m), normals)
    down, exists = refract(wi, m, ratio)
    # z counted on the far side; under total reflection what `refract` gives is no direction, and one stands in
    wo: Vector = (
        jnp.where(exists, down[0], 0.6),
        jnp.where(exists, down[1], 0.0),
        jnp.where(exists, -down[2], 0.8),
    )
    refracted = jnp.where(exists, weight * (1.0 - level) * _masking(wo, normals), 0.0)
    lost = at_least(1.0 - jnp.sum(reflected + refracted, axis=-1), 0.0)
    return jnp.sum(reflected, axis=-1), (wo, refracted), jnp.where(near.weight > 0, lost, 0.0)


def entering_energy(grid: Grid, near: Region, far: Region, normals: Normals, modes: int) -> tuple[Array, Array]:
    """Of light from every near direction: the energy that an interface passes, and what it loses to masking."""
    _, (_, refracted), lost = _shares(grid, near, far, normals, modes)
    return jnp.sum(refracted, axis=-1), lost


def _visible_normals(grid: Grid, region: Region, normals: Normals, modes: int) -> tuple[Vector, Array, Vector]:
    """Normals visible from every node, (nodes, points), their weights, and the nodes' wi.

    Of GGX a spherical cap, stretched: the cap of Dupuy & Benyoub 2023, by quadrature from its pole to its rim and over
    half a turn (the other half is its mirror image). Denser than what it is put on: light that goes straight through
    two interfaces meets the points of both, and the nodes and modes between must not tell them apart. Tails are sparse
    from pole to rim.
    """
    polar_facets, azimuth_facets = max(LEAST_FACETS, 3 * grid.nodes // 2), max(LEAST_FACETS, 3 * modes // 4)
    alpha = jnp.asarray(normals.alpha, region.cosine.dtype)
    wi: Vector = (-region.sine[:, None], jnp.zeros_like(region.sine[:, None]), region.cosine[:, None])
    if normals.distribution == "vmf":
        return *facets.seen_normals(wi, alpha, polar_facets, azimuth_facets), wi
    v = normalize((alpha * wi[0], alpha * wi[1], wi[2]))
    s, w = (jnp.asarray(array, alpha.dtype) for array in gauss_legendre(polar_facets))
    rim = jnp.arctan2(safe_sqrt(v[0] * v[0]), -v[2])  # cosine -v_z
    polar = (rim * s)[:, :, None]
    phi = jnp.asarray((np.arange(azimuth_facets) + 0.5) * np.pi / azimuth_facets, alpha.dtype)
    weight = jnp.sin(polar) * (rim * w / (1.0 + v[2]))[:, :, None] * (jnp.ones_like(phi) / azimuth_facets)
    sine, cosine = jnp.sin(polar), jnp.cos(polar)
    x, y = v[0][:, :, None] + sine * jnp.cos(phi), sine * jnp.sin(phi)
    z = at_least(v[2][:, :, None] + cosine, 0.0) * jnp.ones_like(phi)
    nodes = region.cosine.shape[0]
    flat = tuple(jnp.reshape(part, (nodes, -1)) for part in (alpha * x, alpha * y, z))
    return normalize((flat[0], flat[1], flat[2])), weight.reshape(nodes, -1), wi


def _masking(wo: Vector, normals: Normals) -> Array:
    """Smith masking of the outgoing direction, 0 below the horizon."""
    above = wo[2] > 0
    return jnp.where(above, facets.masking(sanitised(wo, above), *normals), 0.0)


def _deposit(grid: Grid, wo: Vector, share: Array, far: Region, near: Region, modes: int) -> Array:
    """Flux operator (modes, out, in) of light that goes from node j to the directions wo_jq, a share of it each.

    Odd modes vanish at the pole like the sine: there the quotient by the sine is what polynomials interpolate. One
    panel of nodes after the other: their facets times the nodes of a panel are the largest arrays of a solution.
    """
    odd = np.arange(modes) % 2 == 1
    share = jnp.where(near.weight[:, None] > 0, share, 0.0)

    def deposit(rays: tuple[Vector, Array]) -> Array:
        wo, share = rays
        planar = safe_sqrt(wo[0] * wo[0] + wo[1] * wo[1])
        turn = jnp.arctan2(wo[1], jnp.where(planar > 0, wo[0], 1.0))
        weights, panel = spread(grid, far.ior, jnp.abs(wo[2]), planar * planar)
        angle = turn[..., None] * np.arange(modes)
        spun = jnp.cos(angle) * jnp.where(odd, (share * planar)[..., None], share[..., None])
        spun = panel[..., None] * spun[..., None, :] if panel.shape[-1] > 1 else spun[..., None, :]
        return jnp.einsum("jqi,jqpm->jmpi", weights, spun)

    panels = grid.edges.shape[0]
    rays = jax.tree.map(lambda x: jnp.reshape(x, (panels, grid.nodes, -1)), (wo, share))
    flux = jax.lax.map(deposit, rays) if panels > 1 else deposit(jax.tree.map(lambda x: x[0], rays))
    flux = jnp.moveaxis(flux.reshape(grid.size, modes, grid.size), 0, -1)
    flux = flux / jnp.where(odd[:, None], far.sine, 1.0)[:, :, None]
    return jnp.where(far.weight[:, None] > 0, flux, 0.0)


def _balanced(flux: Array, near: Region, far: Region, down: Array, up: Array, agreeing: Array) -> Array:
    """Deposited flux, scaled towards passing the energy `down` of light from near nodes, and its adjoint `up` from far
    ones.

    Both are known by quadrature at the nodes. Where nodes do not resolve what happens between them (next to a critical
    angle, on a smooth interface) the two do not agree: there it is left as it is deposited.
    """
    into, out = jnp.ones_like(down), jnp.ones_like(up)
    for _ in range(BALANCING):
        out = _scale(up * far.weight, flux[0] @ (near.weight * into), agreeing)
        into = _scale(down, out @ flux[0], 10.0 * agreeing)  # it is deposited with the right energy
    return out[:, None] * flux * into


def _scale(wanted: Array, found: Array, agreeing: Array) -> Array:
    """Their quotient; it fades to 1 where they differ by a share as large as `agreeing`."""
    near = (found > 0.0) & (wanted < MOST_OFF * found) & (found < MOST_OFF * wanted)
    excess = jnp.where(near, (wanted - found) / jnp.where(near, found, 1.0), 0.0)
    return 1.0 + excess * jnp.exp(-((excess / agreeing) ** 2))


def _left_over(region: Region, level: Array, wanted: Array, flux: Array) -> Array:
    """What nodes that do not resolve an interface let pass too little or too much: it is reflected like by a mirror."""
    rest = jnp.where(region.weight > 0, wanted - jnp.sum(flux[0], axis=-2), 0.0)
    return jnp.diag(at_least(rest, -level))


def _turned_back(region: Region, ratio: Array, alpha: Array, once: Array, lost: Array) -> Array:
    """Of the energy lost to masking what ends on its own side, by the walk on the microsurface (Heitz et al. 2016)."""
    exists = region.weight > 0
    level, _ = interface_energies(jnp.where(exists, region.cosine, 0.5), alpha, ratio, "multiple")
    gain = at_least(level - once, 0.0)
    return jnp.where(exists, jnp.where(gain < lost, gain, lost), 0.0)


def _returned(
    operators: Sequence[Array], lost: tuple[Array, Array], turned: Sequence[Array], weights: tuple[Array, Array]
) -> list[Array]:
    """The four operators with the energy lost to masking given back (after Kulla & Conty 2017), both sides at a time.

    What ends on its own side, r, comes back diffusely as r r' / <r>, and what crosses, t, as t t' / <t>: reciprocal,
    and all that is lost returns. As much must cross one way as the other; where the two differ, the smaller decides.
    """
    crossing = [l - r for l, r in zip(lost, turned, strict=True)]
    sums = [jnp.sum(weight * t) for weight, t in zip(weights, crossing, strict=True)]
    least = jnp.where(sums[0] < sums[1], sums[0], sums[1])
    crossing = [t * safe_div(least, total) for t, total in zip(crossing, sums, strict=True)]
    staying = [l - t for l, t in zip(lost, crossing, strict=True)]
    given = []
    for operator, (out, into) in zip(operators, ((0, 0), (1, 0), (0, 1), (1, 1)), strict=True):
        parts, mean = (staying, jnp.sum(weights[out] * staying[out])) if out == into else (crossing, least)
        given.append(operator.at[0].add(safe_div(jnp.outer(weights[out] * parts[out], parts[into]), mean)))
    return given


def _coloured_return(energy: Array, lossless: Array, weight: Array) -> Array:
    """What a conductor returns of the light lost to masking: it loses its Fresnel share at every further facet."""
    lost = jnp.where(weight > 0, at_least(1.0 - lossless, 0.0), 0.0)
    total = jnp.sum(weight * lost)
    # mean reflectance of a facet, and mean share that escapes at each try (Kulla & Conty 2017)
    level = safe_div(jnp.sum(weight * energy), jnp.sum(weight * lossless))
    escapes = 1.0 - safe_div(total, jnp.sum(weight))
    kept = level * level * escapes / (1.0 - level * (1.0 - escapes))
    return kept * safe_div(jnp.outer(weight * lost, lost), total)
