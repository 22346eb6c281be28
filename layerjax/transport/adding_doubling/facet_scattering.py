"""What the facets of an interface or a base do to light from every node: how much they reflect, what they let pass.

Energies are sums over `visible_normals`, right to 1e-4 with few points. Light that is to be put on nodes needs points
as dense as the nodes, unless only smooth functions are ever summed over it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._batching import map_row_chunks
from layerjax._numerics import clamp_max, clamp_min, safe_sqrt
from layerjax.directions import Vector, combine, dot, normalize, reflect, sanitise
from layerjax.normals import facets
from layerjax.normals.facet_rule import FacetEvent, Parallels, parallels, polar_angles, visible_normals
from layerjax.normals.widths import StudentWidth, Width, Widths, cast_width, narrowest
from layerjax.quadrature import gauss_legendre
from layerjax.transport.adding_doubling.grid import Grid, Region

ENERGY_POINTS = (12, 8)
"""Points a panel, and in azimuth, of the quadrature of energies."""

LEAST_FACETS, LEAST_OF_SEVERAL = 16, 24
"""Points of the dense quadrature of visible normals in either direction, at least (`dense_refracted_rays`): of a single
interface, and where there are several, between which light continues."""

DENSER = 3
"""Times as many in either direction where a mirror sends light back through facets that no closed form knows: it passes
the same facets twice, and nodes must not distinguish them. Index 1.7 and alpha 0.3 under a smooth one of 1.3 and over a
mirror, at 69 degrees: 3.79 at 32 nodes without, 3.744 with; the walk has 3.742 +- 0.008."""

CRITICAL = 7.5
"""Times the distance between facets: half the width over which the critical angle of refraction is rounded off."""


class Normals(NamedTuple):
    """Normals of an interface or a base."""

    alpha: Width
    distribution: facets.Distribution


def film_from(film: fresnel.Film | None, region: Region) -> fresnel.Film | None:
    """A film that is counted in the surroundings of the stack, as it is seen from a region."""
    return None if film is None else film.seen_from(region.ior)


def facet_energies(
    near: Region, far: Region, normals: Normals, film: fresnel.Film | None = None
) -> tuple[Array, Array, Array]:
    """Of light from every near node: the energy that facets reflect, that they refract, and that masking takes.

    film: on the facets, counted in the surroundings of the stack.
    """
    seen = film_from(film, near)
    reflected = reflected_energy(near, far.ior / near.ior, normals, seen)
    _, passed = refracted_rays(near, far.ior / near.ior, normals, ENERGY_POINTS, seen)
    # by quadrature it may be a little more than there is
    refracted = clamp_max(jnp.sum(passed, axis=-1), 1.0 - reflected)
    return reflected, refracted, jnp.where(near.exists, 1.0 - reflected - refracted, 0.0)


def reflected_energy(region: Region, ratio: Array, normals: Normals, film: fresnel.Film | None = None) -> Array:
    """Of light from every node: what facets reflect; film: as seen from there."""

    def energy(m: Vector, facing: Array, weight: Array, wi: Vector) -> Array:
        level = fresnel.dielectric(facing, ratio, film=film) * smith_masking(reflect(wi, m), normals)
        return jnp.sum(weight * level, axis=-1)

    return map_visible_normals(energy, region, normals, ratio, "reflected", ENERGY_POINTS)


def refracted_rays(
    region: Region, ratio: Array, normals: Normals, points: tuple[int, int], film: fresnel.Film | None = None
) -> tuple[Vector, Array]:
    """Of light from every node: where facets refract it to, and how much; film: as seen from there."""

    def rays(m: Vector, facing: Array, weight: Array, wi: Vector) -> tuple[Vector, Array]:
        return refract(wi, m, facing, weight, ratio, normals, film=film)

    return map_visible_normals(rays, region, normals, ratio, "refracted", points)


def map_visible_normals(
    function: Callable[..., Any],
    region: Region,
    normals: Normals,
    ratio: Array,
    event: FacetEvent,
    points: tuple[int, int],
) -> Any:
    """function(m, m . wi, weights, wi) of the normals seen from the nodes, (nodes, points); see `visible_normals`."""
    assert not isinstance(normals.alpha, Widths)
    width, kind = cast_width(normals.alpha, region.cosine.dtype), normals.distribution

    def of_nodes(rows: tuple[Array, ...]) -> Any:
        cosine, sine, *circles = rows
        wi: Vector = (-sine[:, None], jnp.zeros_like(sine[:, None]), cosine[:, None])
        return function(*visible_normals(cosine, sine, Parallels(*circles), width, kind, points[1]), wi)

    if kind == "gtr":
        points = _denser(points)
    polar = polar_angles(region.cosine, region.sine, width, kind, ratio, event, points[0])
    # outside of the loop: kept in memory, not computed again for each of the facets' numbers
    circles = parallels(region.cosine, region.sine, polar, width, kind, ratio, event)
    return map_row_chunks(of_nodes, (region.cosine, region.sine, *circles))


def _denser(points: tuple[int, int]) -> tuple[int, int]:
    """Points of Student-t slopes in the place of others': half as many again, for tails of any length."""
    return 3 * points[0] // 2, 3 * points[1] // 2


def refract(
    wi: Vector,
    m: Vector,
    facing: Array,
    weight: Array,
    ratio: Array,
    normals: Normals,
    blur: Array | None = None,
    film: fresnel.Film | None = None,
) -> tuple[Vector, Array]:
    """Where facets refract light to, z counted on the far side, and how much: nothing under total reflection.

    blur, film: see `fresnel.dielectric`.
    """
    refracted, exists = fresnel.cosine_of_refraction(facing, ratio, blur)
    level = fresnel.dielectric_towards(facing, ratio, refracted, exists, film)
    down = combine(facing / ratio - refracted, m, -1.0 / ratio, wi)
    if blur is not None:
        down = normalize(down)
    # under total reflection what `refract` gives is no direction, and one stands in
    wo: Vector = (
        jnp.where(exists, down[0], 0.6),
        jnp.where(exists, down[1], 0.0),
        jnp.where(exists, -down[2], 0.8),
    )
    return wo, jnp.where(exists, weight * (1.0 - level) * smith_masking(wo, normals), 0.0)


def dense_refracted_rays(
    grid: Grid, near: Region, far: Region, normals: Normals, modes: int, film: fresnel.Film | None = None
) -> tuple[Vector, Array]:
    """Of light from every near node, by facets: where to and how much is refracted; film: see `facet_energies`."""
    ratio, seen = far.ior / near.ior, film_from(film, near)
    if normals.distribution != "ggx":
        # about the direction, not the normal: what a mirror sends back through them asks for more than their own caps
        points = 3 * polar_count(grid) // 2, 3 * azimuth_count(grid, modes) // 2
        return refracted_rays(near, ratio, normals, points, seen)
    assert not isinstance(normals.alpha, Widths | StudentWidth)
    m, weight, wi = _ggx_normals(grid, near, normals.alpha, modes)
    blur = blur_of_refraction(polar_count(grid), ratio, normals)
    return refract(wi, m, dot(wi, m), weight, ratio, normals, blur, seen)


def blur_of_refraction(points: int, ratio: Array, normals: Normals) -> Array:
    """See `fresnel.dielectric`, of so many facets from pole to rim."""
    # the squared cosine of refraction changes by so much with the angle at the facet where it is 0
    steepness = 2.0 * safe_sqrt((1.0 - ratio) * (1.0 + ratio)) / ratio
    return CRITICAL * facet_spacing(points, normals) * steepness


def facet_spacing(points: int, normals: Normals) -> Array:
    """Angle between facets of so many points from pole to rim, about."""
    alpha = narrowest(normals.alpha)
    return alpha / (1.0 + 2.0 * alpha) / points


def polar_count(grid: Grid) -> int:
    """Points from pole to rim of the dense quadrature of visible normals."""
    return max(_least_points(grid), 3 * grid.nodes // 2) * (DENSER if grid.mirrored else 1)


def azimuth_count(grid: Grid, modes: int) -> int:
    """Azimuths at each of them."""
    return max(_least_points(grid), 3 * modes // 4) * (DENSER if grid.mirrored else 1)


def _least_points(grid: Grid) -> int:
    return LEAST_OF_SEVERAL if grid.interfaces > 1 else LEAST_FACETS


def _ggx_normals(grid: Grid, region: Region, width: Array, modes: int) -> tuple[Vector, Array, Vector]:
    """GGX normals visible from every node, (nodes, points), their weights, and the nodes' wi.

    A spherical cap, stretched: the cap of Dupuy & Benyoub 2023, by quadrature from its pole to its rim and over half a
    turn (the other half is its mirror image). Denser than what it is put on: light that passes
    two interfaces meets the points of both, and the nodes and modes between must not distinguish them. Tails are sparse
    from pole to rim.
    """
    polar_facets, azimuth_facets = polar_count(grid), azimuth_count(grid, modes)
    alpha = jnp.asarray(width, region.cosine.dtype)
    wi: Vector = (-region.sine[:, None], jnp.zeros_like(region.sine[:, None]), region.cosine[:, None])
    v = normalize((alpha * wi[0], alpha * wi[1], wi[2]))
    s, w = (jnp.asarray(array, alpha.dtype) for array in gauss_legendre(polar_facets))
    rim = jnp.arctan2(safe_sqrt(v[0] * v[0]), -v[2])  # cosine -v_z
    polar = (rim * s)[:, :, None]
    phi = jnp.asarray((np.arange(azimuth_facets) + 0.5) * np.pi / azimuth_facets, alpha.dtype)
    weight = jnp.sin(polar) * (rim * w / (1.0 + v[2]))[:, :, None] * (jnp.ones_like(phi) / azimuth_facets)
    sine, cosine = jnp.sin(polar), jnp.cos(polar)
    x, y = v[0][:, :, None] + sine * jnp.cos(phi), sine * jnp.sin(phi)
    z = clamp_min(v[2][:, :, None] + cosine, 0.0) * jnp.ones_like(phi)
    nodes = region.cosine.shape[0]
    flat = tuple(jnp.reshape(part, (nodes, -1)) for part in (alpha * x, alpha * y, z))
    return normalize((flat[0], flat[1], flat[2])), weight.reshape(nodes, -1), wi


def smith_masking(wo: Vector, normals: Normals) -> Array:
    """Smith masking of the outgoing direction, 0 below the horizon."""
    above = wo[2] > 0
    return jnp.where(above, facets.masking(sanitise(wo, above), *normals), 0.0)
