"""Interfaces on the grid.

A smooth one sends nodes to nodes. What a rough face reflects is its BRDF at the nodes, scaled to the energy that its
visible facets reflect. What it refracts is found facet by facet: those visible from a node are integrated over by
quadrature, and what each passes is put (*deposited*) on the nodes around (see `grid.interpolation_weights`). The energy
is that of the quadrature at any roughness.
"""

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._batching import map_row_chunks
from layerjax._numerics import clamp_max, clamp_min, safe_div, safe_sqrt
from layerjax.directions import Vector, half_vector
from layerjax.microsurface.directional_albedo import interface_energies
from layerjax.normals.widths import narrowest
from layerjax.surfaces.microfacet import mirror_lobe
from layerjax.transport.adding_doubling.facet_scattering import (
    Normals,
    dense_refracted_rays,
    facet_energies,
    facet_spacing,
    film_from,
    polar_count,
    reflected_energy,
    refracted_rays,
)
from layerjax.transport.adding_doubling.grid import Grid, Region, interpolation_weights, join_regions
from layerjax.transport.adding_doubling.inverse import inverse
from layerjax.transport.adding_doubling.operators import Layer, Parts
from layerjax.transport.adding_doubling.sampling import azimuths, cosines, modes_at_nodes, scale_to_energy

NextEvent = Literal["diffuse", "narrow", "faces"]
"""Of an interface: what turns light into all directions, so that none is ballistic; what does not; or other faces
alone, which keep light between them."""

STRONG = 5.0
"""One over what an interface reflects of which all may be put right; of less, a share in proportion."""

LEAST_POINTS = {"ggx": (12, 6), "beckmann": (12, 8), "vmf": (12, 8), "gtr": (12, 8)}
"""Points a panel, and in azimuth, of light let in along few directions, at least, by the distribution of normals."""

MOST_ENTRIES = 1 << 20
"""Numbers that arrays of facets hold at most."""

ROUNDING_SHARE = 0.01
"""Times the root of the precision: a share of energy below it is only what rounding leaves of tables."""

HALF_RESOLVED_WIDTH = 0.2
"""Times the distance between nodes: a lobe of this width, alpha times their number, is half resolved by them."""

BLUR, BLUR_BETWEEN = 5.6, 2.5
"""Half the width in s^2 over which rays move from one panel to another, as far apart as they are next to each other, or
a few times that: of a single interface times the distance between facets; of several times that between rays."""

CRITICAL, CRITICAL_KEPT = 2.0, 1.0
"""Times the distance between azimuths, and, of light that faces keep between them, between nodes: half the width over
which the critical angle is rounded off.

Otherwise values of slabs ripple as the index moves it across the nodes. Index 1.83, alpha 0.38 and 0.54, thickness
0.17, 32 nodes: the ripple is 5e-5 of |f|, but slopes by the index are off by 1e-2, and with it by 1e-3. Clear slabs of
index 1.26 to 1.9: values off by up to 1e-3, and 3e-4 with it.
"""

LEAK = 16.0
"""Times the precision: of light that is totally reflected what is lost at least."""

LITTLE, RIDGE, TINY = 1.0, 1e-8, 1e-18
"""Of a typical flux, what counts as little: a flux changes its sign with the index over as much. With a tenth of it
values change by 1e-8 over 4e-5 of the index, which are bumps of the slope of 4e-4 of |f|, with a hundredth of it 0.1;
of an energy, what may be missing where nothing can be put right (in single precision the root of its epsilon); and
what keeps quotients finite, whose square is not 0 there either."""


def interface_layer(
    grid: Grid,
    above: Region,
    below: Region,
    normals: Normals,
    modes: int,
    multiple: bool,
    *,
    enters: bool = True,
    requested: Region | None = None,
    next_event: NextEvent,
    film: fresnel.Film | None = None,
) -> Layer:
    """Rough dielectric interface between two regions, as Fourier modes (Walter 2007).

    Light that enters the stack is deposited on the inner nodes; light that leaves is *gathered* from them (the adjoint,
    by reciprocity), which gives radiance at the outer nodes as exact as it is smooth inside.

    Args:
        enters: whether light from above counts as entering.
        requested: directions outside that stand in the place of the outer nodes. The operators are then those of light
            that comes from them, and per projected solid angle over 2 pi for light that leaves along them; what the
            interface reflects outside is omitted.
        next_event: what light that enters meets next.
        film: on the interface, counted in the surroundings of the stack.
    """
    near, far = (above, below) if enters else (below, above)
    if requested is None:
        operators = _operators(grid, near, far, normals, modes, multiple, next_event, film)
    elif not multiple:
        operators = _requested_operators(grid, requested, far, normals, modes, next_event, film)
    else:  # what masking loses is returned in proportion to sums over all directions outside
        operators = _operators(
            grid,
            join_regions(requested, near),
            far,
            normals,
            modes,
            multiple,
            next_event,
            film,
            requested.weight.size,
        )
    outer, into, out, inner = (_add_channel_axis(parts) for parts in operators)
    return Layer(outer, inner, into, out) if enters else Layer(inner, outer, out, into)


def smooth_layer(above: Region, below: Region, film: fresnel.Film | None = None) -> Layer:
    """Smooth dielectric interface between two regions, whose nodes it refracts to each other; film: see
    `interface_layer`."""
    dtype = above.cosine.dtype
    crosses = above.exists & below.exists
    ratio, seen = below.ior / above.ior, film_from(film, above)
    level = fresnel.dielectric_towards(above.cosine, ratio, below.cosine, crosses, seen)
    # light that two faces reflect totally would go back and forth for ever: a little is lost
    mirrored = clamp_max(level, 1.0 - LEAK * float(jnp.finfo(dtype).eps))[None, None]
    passed = jnp.where(crosses, 1.0 - level, 0.0)[None, None]
    return Layer(Parts(None), direct_down=passed, direct_up=passed, mirror_top=mirrored, mirror_bottom=mirrored)


def _add_channel_axis(parts: Parts) -> Parts:
    return Parts(*(None if operator is None else operator[None] for operator in (parts.first, parts.rest)))


def _operators(
    grid: Grid,
    near: Region,
    far: Region,
    normals: Normals,
    modes: int,
    multiple: bool,
    next_event: NextEvent,
    film: fresnel.Film | None = None,
    requested: int = 0,
) -> list[Parts]:
    """Reflection outside, light that enters, light that leaves, reflection inside: of the first `requested`, or of all.

    What is returned after it was lost to masking has met several facets: it is no path of one event.
    """
    outside, down, lost_outside = facet_energies(near, far, normals, film)
    inside, up, lost_inside = facet_energies(far, near, normals, film)
    share = unsampled_share(grid, normals)
    through = _deposit(
        grid,
        *dense_refracted_rays(grid, near, far, normals, modes, film),
        far,
        near,
        modes,
        blur_of_edges(grid, near, far, normals),
    )
    through = balance_flux(through, near, far, *reconcile_energies(near, far, (down, up), (outside, inside)))
    leaving = jnp.where(np.arange(near.weight.size) < requested, 1.0, near.weight)
    outer = None
    if not requested:
        rest = jnp.where(near.weight > 0, down - jnp.sum(through[0], axis=-2), 0.0)
        outer = _reflection(near, outside, rest, share, far.ior / near.ior, normals, modes, film_from(film, near))
    rest = jnp.where(far.weight > 0, up - safe_div(through[0] @ near.weight, far.weight), 0.0)
    seen, blur = film_from(film, far), _trapped_blur(grid, next_event)
    inner = _reflection(far, inside, rest, share, near.ior / far.ior, normals, modes, seen, blur)
    once: list[Array | None] = [outer, through, adjoint(through, leaving, far), inner]
    compensation: list[Array | None] = [None] * 4
    if multiple:
        reflected = [
            _multiple_reflected_energy(a, b.ior / a.ior, narrowest(normals.alpha), level, lost)
            for a, b, level, lost in ((near, far, outside, lost_outside), (far, near, inside, lost_inside))
        ]
        gains = _energy_compensation(
            (lost_outside, lost_inside), reflected, (near.weight, far.weight), (leaving, far.weight)
        )
        compensation = [jnp.zeros((modes, *gain.shape), gain.dtype).at[0].set(gain) for gain in gains]
    found = list(map(Parts, once, compensation))
    return [_select_requested(parts, place, requested) for place, parts in enumerate(found)] if requested else found


def _select_requested(parts: Parts, place: int, requested: int) -> Parts:
    """The first `requested` directions outside alone: outer reflection, light that enters, that leaves, inner one."""
    rows, columns = (requested if place in (0, 2) else None), (requested if place in (0, 1) else None)
    return Parts(*(None if part is None else part[:, :rows, :columns] for part in (parts.first, parts.rest)))


def _requested_operators(
    grid: Grid,
    requested: Region,
    inner: Region,
    normals: Normals,
    modes: int,
    next_event: NextEvent,
    film: fresnel.Film | None,
) -> list[Parts]:
    """The four operators (see `_operators`) for requested directions, where what masking loses is lost: no sum over
    directions outside is needed."""
    ratio = inner.ior / requested.ior
    if next_event == "diffuse":  # only smooth functions are summed over what is let in
        least = LEAST_POINTS[normals.distribution]
        points = max(least[0], grid.nodes), max(least[1], modes // 2)
        rays = refracted_rays(requested, ratio, normals, points, film_from(film, requested))
    else:
        rays = dense_refracted_rays(grid, requested, inner, normals, modes, film)
    through = _deposit(grid, *rays, inner, requested, modes, blur_of_edges(grid, requested, inner, normals))
    seen = film_from(film, inner)
    inside = reflected_energy(inner, 1.0 / ratio, normals, seen)
    back = adjoint(through, jnp.ones_like(requested.weight), inner)
    face = _face(inner, inside, 1.0 / ratio, normals, modes, seen, _trapped_blur(grid, next_event))
    return [Parts(operator) for operator in (None, through, back, face)]


def unsampled_share(grid: Grid, normals: Normals) -> Array:
    """Of the light that an interface lets pass: how much of it nodes do not resolve."""
    return 1.0 / (1.0 + (narrowest(normals.alpha) * grid.nodes / HALF_RESOLVED_WIDTH) ** 4)


def blur_of_edges(grid: Grid, near: Region, far: Region, normals: Normals) -> Array:
    """See `interpolation_weights`: none where nodes do not resolve the lobe, for refraction sends them to nodes there.

    Between several interfaces no wider than rays are apart: light that is kept there by total reflection meets the edge
    again and again. As wide as for a single one, a clear slab of index 1.2 and alpha 0.5 would be off by 4e-3.
    """
    apart = facet_spacing(polar_count(grid), normals) * (1.0 - unsampled_share(grid, normals))
    if grid.interfaces == 1:
        return BLUR * apart * jnp.ones_like(grid.edges)
    steepness = 2.0 * safe_sqrt(grid.edges * (far.ior * far.ior - grid.edges))
    return BLUR_BETWEEN * apart * jnp.abs(1.0 - near.ior / far.ior) * steepness


def _face(
    region: Region,
    energy: Array,
    ior: Array,
    normals: Normals,
    modes: int,
    film: fresnel.Film | None = None,
    trapped_blur: float = 0.0,
) -> Array:
    """Reflection at an interface, seen from one side, and so is the film; trapped_blur: see `_trapped_blur`.

    Light that two interfaces reflect totally would go back and forth for ever: a little is lost.
    """
    energy = clamp_max(energy, 1.0 - LEAK * float(jnp.finfo(energy.dtype).eps))

    def reflection(wi: Vector, wo: Vector) -> list[Array]:
        h, cosine = half_vector(wi, wo, same_side=True)
        blur = _critical_blur(wi, wo, ior, np.pi / azimuths(modes), trapped_blur)
        level = fresnel.dielectric(cosine, ior, blur, film)
        return [level * mirror_lobe(h, wi, wo, *normals)]

    return scale_to_energy(region, modes_at_nodes(reflection, region, region, modes, has_mirror_lobe=True)[0], energy)


def _trapped_blur(grid: Grid, next_event: NextEvent) -> float:
    """Angle between nodes, of which two panels or more are in any medium between faces, where light is kept there."""
    return 0.25 * np.pi / grid.nodes if next_event == "faces" else 0.0


def _critical_blur(wi: Vector, wo: Vector, ior: Array, azimuth: float, polar: float) -> Array:
    """`critical_blur` of light that comes in along x."""
    return critical_blur(wi[0] * wo[0], wi[0] * wo[1], wi[2] * wo[2], ior, azimuth, polar)


def critical_blur(along: Array, across: Array, upright: Array, ior: Array, azimuth: float, polar: float) -> Array:
    """See `fresnel.dielectric`: as wide as a few azimuths and, unless `polar` is 0, nodes are apart.

    With the root at the critical angle between them, values would change by steps as the index does, and derivatives
    would be those of no difference of values.

    Args:
        along, across: scalar and vector product of what two directions have in the plane of the surface.
        upright: product of their z.
        azimuth, polar: distances of azimuths and of nodes.
    """
    squared = (CRITICAL * azimuth) ** 2 * (across * across + (azimuth * along) ** 2)
    if polar:
        cosine = along + upright
        squared = squared + (CRITICAL_KEPT * polar) ** 2 * clamp_min((1.0 - cosine) * (1.0 + cosine), 0.0)
    return jnp.sqrt(squared) / (2.0 * ior * ior)


def adjoint(flux: Array, leaving: Array, far: Region) -> Array:
    """The operator for the opposite way, by reciprocity: kernels F / W are transposes of each other."""
    kernel = safe_div(flux, jnp.broadcast_to(far.weight[:, None], flux.shape))
    return leaving[:, None] * jnp.swapaxes(kernel, -1, -2)


def _deposit(grid: Grid, wo: Vector, share: Array, far: Region, near: Region, modes: int, blur: Array) -> Array:
    """Flux operator (modes, out, in) of light that goes from node j to the directions wo_jq, a share of it each.

    Odd modes vanish at the pole like the sine: there the quotient by the sine is what polynomials interpolate. A few
    nodes at a time: their facets times modes are the largest arrays of a solution.
    """
    odd = np.arange(modes) % 2 == 1
    share = jnp.where(near.exists[:, None], share, 0.0)

    def deposit(rays: tuple[Vector, Array]) -> Array:
        wo, share = rays
        squared = wo[0] * wo[0] + wo[1] * wo[1]
        planar = safe_sqrt(squared)
        weights = interpolation_weights(grid, far.ior, jnp.abs(wo[2]), squared, blur)
        waves = cosines(jnp.where(squared > 0, wo[0] / jnp.where(squared > 0, planar, 1.0), 1.0), modes)
        spun = waves * jnp.where(odd[:, None], share * planar, share)
        return spun @ weights

    rows, points = share.shape
    chunks = points * max(modes, grid.size) * rows // MOST_ENTRIES
    flux = jnp.moveaxis(map_row_chunks(jax.vmap(deposit), (wo, share), chunks), 0, -1)
    flux = flux / jnp.where(odd[:, None], far.sine, 1.0)[:, :, None]
    return jnp.where(far.weight[:, None] > 0, flux, 0.0)


def balance_flux(flux: Array, near: Region, far: Region, down: Array, up: Array) -> Array:
    """Deposited flux F, changed least so that it passes the energy `down` of light from near nodes, and its adjoint
    `up` from far ones.

    Polynomials put negative energies on some nodes, too, so that factors could be of any size. What is added goes with
    the size of what is there, F_ij + |F_ij| (a_i + b_j), the same for all modes: a and b solve a symmetric positive
    system.
    """
    up = up * far.weight
    typical = safe_div(jnp.outer(up, down), jnp.sum(up))
    sign = flux[0] / safe_sqrt(flux[0] ** 2 + clamp_min(LITTLE * typical, TINY) ** 2)  # without a step
    size = flux[0] * sign
    crossing = size * near.weight
    ridge = max(RIDGE, np.sqrt(jnp.finfo(size.dtype).eps))
    rows = clamp_min(jnp.sum(crossing, axis=1) + ridge * up, TINY)
    columns = jnp.sum(crossing, axis=0) + ridge * down * near.weight
    missing = up - flux[0] @ near.weight
    # rows are eliminated: columns alone are left
    wanted = (down - jnp.sum(flux[0], axis=0)) * near.weight - (missing / rows) @ crossing
    schur = jnp.diag(jnp.where(columns > 0, columns, 1.0)) - crossing.T @ (crossing / rows[:, None])
    a = (missing - crossing @ (inverse(schur) @ wanted)) / rows
    # only a_i + b_j of nodes that exchange light is known: directions of no weight have a b alone
    of_nodes = jnp.where(near.weight > 0, a[:, None], 0.0)
    b = safe_div(down - jnp.sum(flux[0] + size * of_nodes, axis=0), jnp.sum(size, axis=0))
    return flux * (1.0 + sign * (of_nodes + b))


def reconcile_energies(
    near: Region, far: Region, energies: tuple[Array, Array], reflected: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Energies that pass both ways, made equal in total: the rest counts as reflected, where much is."""
    down, up = energies
    rest = up @ far.weight - down @ near.weight
    most = [largest_correction(level) for level in reflected]
    whole = most[0] @ near.weight + most[1] @ far.weight
    step = safe_div(rest, clamp_min(whole, jnp.abs(rest)))
    return down + step * most[0], up - step * most[1]


def largest_correction(level: Array) -> Array:
    """By how much what is reflected may be changed: a weak reflection by a small share alone."""
    return level * clamp_max(STRONG * level, 1.0)


def _reflection(
    region: Region,
    level: Array,
    rest: Array,
    share: Array,
    ior: Array,
    normals: Normals,
    modes: int,
    film: fresnel.Film | None = None,
    trapped_blur: float = 0.0,
) -> Array:
    """Reflection on one side, with the rest that nodes let pass too little or too much: none of it is lost.

    Of an interface that they do not resolve it is reflected like by a mirror, else with the lobe: a weak one is left as
    it is, and may change by a larger share the stronger it is.
    """
    most = largest_correction(level)
    resolved = (1.0 - share) * clamp_max(clamp_min(rest, -most), most)
    lobe = _face(region, level + resolved, ior, normals, modes, film, trapped_blur)
    return lobe + share * jnp.diag(clamp_min(rest, -level))


def _multiple_reflected_energy(region: Region, ratio: Array, alpha: Array, once: Array, lost: Array) -> Array:
    """Share of the energy lost to masking that is reflected, by the walk on the microsurface (Heitz et al. 2016)."""
    exists = region.exists
    level, _ = interface_energies(jnp.where(exists, region.cosine, 0.5), alpha, ratio, multiple=True)
    gain = clamp_min(level - once, 0.0)
    return jnp.where(exists, jnp.where(gain < lost, gain, lost), 0.0)


def _energy_compensation(
    lost: tuple[Array, Array], reflected: Sequence[Array], weights: tuple[Array, Array], leaving: tuple[Array, Array]
) -> list[Array]:
    """What the four operators gain when energy lost to masking is returned (after Kulla & Conty 2017), both sides.

    What is reflected, r, comes back diffusely as r r' / <r>, and what crosses, t, as t t' / <t>: reciprocal,
    and all that is lost returns. As much must cross one way as the other; where the two differ, the smaller decides.
    """
    crossing = [l - r for l, r in zip(lost, reflected, strict=True)]
    sums = [jnp.sum(weight * t) for weight, t in zip(weights, crossing, strict=True)]
    least = jnp.where(sums[0] < sums[1], sums[0], sums[1])
    crossing = [t * safe_div(least, total) for t, total in zip(crossing, sums, strict=True)]
    down, up = (
        safe_div(jnp.outer(leaving[out] * crossing[out], crossing[into]), least) for out, into in ((1, 0), (0, 1))
    )
    near, far = (_diffuse_compensation(*side) for side in zip(lost, crossing, weights, leaving, strict=True))
    return [near, down, up, far]


def _diffuse_compensation(lost: Array, crossing: Array, weight: Array, leaving: Array) -> Array:
    """What is reflected. Where nothing is, at equal indices, it comes back like all that is lost:
    the product has no derivative there, and energy needs one."""
    reflected = lost - crossing
    mean, whole = jnp.sum(weight * reflected), jnp.sum(weight * lost)
    some = mean > ROUNDING_SHARE * np.sqrt(jnp.finfo(mean.dtype).eps) * whole
    profile = jnp.where(some, reflected / jnp.where(some, mean, 1.0), safe_div(lost, whole))
    return jnp.outer(leaving * profile, reflected)
