"""Facets of two widths on the grid, with azimuths as ordinates: interfaces and metals.

As in `interfaces` a face reflects its BRDF at the nodes, scaled to the energy that its facets reflect, and what it
refracts is deposited facet by facet. Here light from every azimuth is followed by itself, and is deposited on cosines
by polynomials and on azimuths by a Fourier series.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._batching import map_row_chunks
from layerjax._numerics import clamp_max, clamp_min, safe_div, safe_sqrt
from layerjax._parameters import cast_arrays
from layerjax.directions import Vector, dot, half_vector, reflect
from layerjax.normals.facets import visible_grid
from layerjax.normals.widths import Widths
from layerjax.surfaces import Conductor
from layerjax.surfaces.microfacet import mirror_lobe
from layerjax.transport.adding_doubling.facet_scattering import (
    Normals,
    azimuth_count,
    blur_of_refraction,
    film_from,
    polar_count,
    refract,
    smith_masking,
)
from layerjax.transport.adding_doubling.grid import Grid, Region, interpolation_weights
from layerjax.transport.adding_doubling.interfaces import (
    LEAK,
    MOST_ENTRIES,
    adjoint,
    balance_flux,
    blur_of_edges,
    critical_blur,
    largest_correction,
    reconcile_energies,
    unsampled_share,
)
from layerjax.transport.adding_doubling.operators import Layer, Parts
from layerjax.transport.adding_doubling.sampling import scale_to_energy

METAL_FACETS = (24, 48)
"""Points from pole to rim and around of the facets of a metal."""


def anisotropic_interface(
    grid: Grid,
    above: Region,
    below: Region,
    normals: Normals,
    azimuths: int,
    *,
    enters: bool = True,
    film: fresnel.Film | None = None,
) -> Layer:
    """Interface of two widths between two regions, on ordinates.

    enters: whether light from above counts as entering; film: see `interface_layer`.
    """
    near, far = (spread_over_azimuths(region, azimuths) for region in ((above, below) if enters else (below, above)))
    points = polar_count(grid), 2 * azimuth_count(grid, azimuths // 2 + 1)
    (outside, down), (inside, up) = (
        _energies(one, other.ior / one.ior, normals, azimuths, points, film_from(film, one))
        for one, other in ((near, far), (far, near))
    )
    region = below if enters else above
    edges = blur_of_edges(grid, near, far, normals)
    rays = _rays(near, far.ior / near.ior, normals, azimuths, points, film_from(film, near))
    through = _deposit(grid, region, rays, near, edges, azimuths)
    through = balance_flux(through, near, far, *reconcile_energies(near, far, (down, up), (outside, inside)))
    rest_near = jnp.where(near.weight > 0, down - jnp.sum(through[0], axis=-2), 0.0)
    rest_far = jnp.where(far.weight > 0, up - safe_div(through[0] @ near.weight, far.weight), 0.0)
    share = unsampled_share(grid, normals)
    outer, inner = (
        _reflection(one, level, rest, share, other.ior / one.ior, normals, azimuths, film_from(film, one))
        for one, other, level, rest in ((near, far, outside, rest_near), (far, near, inside, rest_far))
    )
    parts = [Parts(operator[None]) for operator in (outer, through, adjoint(through, near.weight, far), inner)]
    outer_part, into, out, inner_part = parts
    return Layer(outer_part, inner_part, into, out) if enters else Layer(inner_part, outer_part, out, into)


def anisotropic_metal(region: Region, base: Conductor, azimuths: int) -> Layer:
    """Metal of two widths under a region, on ordinates."""
    normals = Normals(cast_arrays(base.width, region.cosine.dtype), base.distribution)
    flat = spread_over_azimuths(region, azimuths)

    def energy(wi: Vector, m: Vector, share: Array) -> Array:
        seen = share * smith_masking(reflect(wi, m), normals)
        return jnp.stack([jnp.sum(seen * level, axis=-1) for level in base.reflectance(dot(wi, m))], axis=-1)

    energies = _map_facets(energy, flat, normals, azimuths, METAL_FACETS)
    wi, wo = _pairs(flat, azimuths)
    kernels = base.evaluate(wi, wo)
    shape = (flat.weight.size, flat.weight.size)
    operators = [
        scale_to_energy(flat, jnp.broadcast_to(kernel, shape)[None], jnp.where(flat.exists, energies[:, c], 0.0))
        for c, kernel in enumerate(kernels)
    ]
    return Layer(Parts(jnp.stack(operators)))


def spread_over_azimuths(region: Region, azimuths: int) -> Region:
    """A region whose nodes are cosines times azimuths, the azimuth fastest."""
    part = 1.0 / azimuths
    cosine, sine, weight, solid, exists = (
        jnp.repeat(array, azimuths)
        for array in (region.cosine, region.sine, region.weight, region.solid, region.exists)
    )
    return Region(region.ior, cosine, sine, part * weight, part * solid, exists)


def _travel(flat: Region, azimuths: int) -> tuple[Array, Array]:
    """Cosine and sine of the azimuth in which light travels along the nodes, (nodes,)."""
    phi = np.tile(2.0 * np.pi * np.arange(azimuths) / azimuths, flat.cosine.size // azimuths)
    return jnp.asarray(np.cos(phi), flat.cosine.dtype), jnp.asarray(np.sin(phi), flat.cosine.dtype)


def _pairs(flat: Region, azimuths: int) -> tuple[Vector, Vector]:
    """wi and wo above the horizon of all pairs of nodes, (out, in)."""
    c, s = _travel(flat, azimuths)
    wi: Vector = (-flat.sine * c, -flat.sine * s, flat.cosine)
    wo: Vector = ((flat.sine * c)[:, None], (flat.sine * s)[:, None], flat.cosine[:, None])
    return wi, wo


def _map_facets(
    function: Callable[[Vector, Vector, Array], Any],
    flat: Region,
    normals: Normals,
    azimuths: int,
    points: tuple[int, int],
) -> Any:
    """function(wi, m, shares) of the normals seen from every node, (nodes, points) in and (nodes, ...) out."""
    assert isinstance(normals.alpha, Widths)
    widths = normals.alpha
    c, s = _travel(flat, azimuths)

    def of_nodes(rows: tuple[Array, ...]) -> Any:
        wi: Vector = rows[0], rows[1], rows[2]
        m, share = visible_grid(wi, widths, normals.distribution, points)
        towards: Vector = (wi[0][:, None], wi[1][:, None], wi[2][:, None])
        return function(towards, m, jnp.asarray(share, wi[2].dtype))

    rows = -flat.sine * c, -flat.sine * s, flat.cosine
    return map_row_chunks(of_nodes, rows, flat.cosine.size * points[0] * points[1] * azimuths // MOST_ENTRIES)


def _energies(
    flat: Region, ratio: Array, normals: Normals, azimuths: int, points: tuple[int, int], film: fresnel.Film | None
) -> tuple[Array, Array]:
    """Of light from every node: what facets reflect, and what they refract."""

    def energies(wi: Vector, m: Vector, share: Array) -> tuple[Array, Array]:
        facing = dot(wi, m)
        level = fresnel.dielectric(facing, ratio, film=film) * smith_masking(reflect(wi, m), normals)
        _, passed = refract(wi, m, facing, share, ratio, normals, film=film)
        return jnp.sum(share * level, axis=-1), jnp.sum(passed, axis=-1)

    reflected, refracted = _map_facets(energies, flat, normals, azimuths, points)
    return reflected, clamp_max(refracted, 1.0 - reflected)


def _rays(
    flat: Region, ratio: Array, normals: Normals, azimuths: int, points: tuple[int, int], film: fresnel.Film | None
) -> Callable[[Callable[[Vector, Array], Array]], Array]:
    """Maps a function of refracted rays and their shares, (nodes, points), over all nodes."""

    def mapped(function: Callable[[Vector, Array], Array]) -> Array:
        def of_facets(wi: Vector, m: Vector, share: Array) -> Array:
            blur = blur_of_refraction(points[0], ratio, normals)
            return function(*refract(wi, m, dot(wi, m), share, ratio, normals, blur, film))

        return _map_facets(of_facets, flat, normals, azimuths, points)

    return mapped


def refracted_energy(
    w: Vector, ratio: Array, normals: Normals, points: tuple[int, int], film: fresnel.Film | None = None
) -> Array:
    """Of light along each direction w above the horizon: what facets of two widths refract; film: as seen from w."""
    assert isinstance(normals.alpha, Widths)
    m, share = visible_grid(w, normals.alpha, normals.distribution, points)
    wi: Vector = (w[0][..., None], w[1][..., None], w[2][..., None])
    _, passed = refract(wi, m, dot(wi, m), jnp.asarray(share, w[2].dtype), ratio, normals, film=film)
    return jnp.sum(passed, axis=-1)


def _deposit(
    grid: Grid,
    far: Region,
    rays: Callable[[Callable[[Vector, Array], Array]], Array],
    near: Region,
    blur: Array,
    azimuths: int,
) -> Array:
    """Flux operator (1, out, in) of light that goes from every near node along rays; see `interfaces`.

    Odd waves vanish at the pole like the sine: there the quotient by the sine is what polynomials interpolate.
    """
    orders = np.arange(azimuths // 2 + 1)
    odd = orders % 2 == 1
    weight = np.where((orders == 0) | (2 * orders == azimuths), 1.0, 2.0) / azimuths
    angles = 2.0 * np.pi * np.outer(orders, np.arange(azimuths)) / azimuths
    back = np.concatenate([np.cos(angles), np.sin(angles)]) * np.tile(weight, 2)[:, None]
    both_odd = np.tile(odd, 2)

    def deposit(wo: Vector, share: Array) -> Array:
        squared = wo[0] * wo[0] + wo[1] * wo[1]
        planar = safe_sqrt(squared)
        upright = squared == 0
        phi = jnp.arctan2(jnp.where(upright, 0.0, wo[1]), jnp.where(upright, 1.0, wo[0]))
        turns = jnp.asarray(orders, phi.dtype)[:, None] * phi[..., None, :]
        waves = jnp.concatenate([jnp.cos(turns), jnp.sin(turns)], axis=-2)
        spun = waves * jnp.where(both_odd[:, None], (share * planar)[..., None, :], share[..., None, :])
        found = spun @ interpolation_weights(grid, far.ior, jnp.abs(wo[2]), squared, blur)
        found = found / jnp.where(both_odd[:, None], far.sine, 1.0)
        return jnp.einsum("...mi,mk->...ik", found, jnp.asarray(back, found.dtype))

    flux = rays(deposit)
    flux = jnp.moveaxis(flux.reshape(flux.shape[0], -1), 0, -1)
    reached = jnp.repeat(far.weight > 0, azimuths)
    return jnp.where(reached[:, None] & near.exists, flux, 0.0)[None]


def _reflection(
    flat: Region,
    level: Array,
    rest: Array,
    share: Array,
    ior: Array,
    normals: Normals,
    azimuths: int,
    film: fresnel.Film | None,
) -> Array:
    """Reflection on one side, with the rest that nodes let pass too little or too much; see `interfaces`."""
    most = largest_correction(level)
    resolved = (1.0 - share) * clamp_max(clamp_min(rest, -most), most)
    energy = clamp_max(level + resolved, 1.0 - LEAK * float(jnp.finfo(level.dtype).eps))
    wi, wo = _pairs(flat, azimuths)
    h, cosine = half_vector(wi, wo, same_side=True)
    along, across = wi[0] * wo[0] + wi[1] * wo[1], wi[0] * wo[1] - wi[1] * wo[0]
    blur = critical_blur(along, across, wi[2] * wo[2], ior, 2.0 * np.pi / azimuths, 0.0)
    kernel = fresnel.dielectric(cosine, ior, blur, film) * mirror_lobe(h, wi, wo, *normals)
    lobe = scale_to_energy(flat, kernel[None], jnp.where(flat.exists, energy, 0.0))
    return lobe + share * jnp.diag(clamp_min(rest, -level))
