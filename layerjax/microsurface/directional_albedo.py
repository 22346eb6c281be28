"""Directional energies of rough GGX interfaces: what a surface reflects and transmits of light from one direction.

Without multiple scattering between facets ("single") this is one event with separable Smith masking (Walter et al.
2007), by quadrature over the visible facets. With it ("multiple") it is the walk on the microsurface of Heitz et al.
2016 ("Multiple-scattering microfacet BSDFs with the Smith model"): its first event by quadrature, with height-
correlated masking, and of what that leaves on the surface the share that returns, a smooth function fitted to walks
(`layerjax.precompute.microsurface`). Of conductors there are the parts: the `reflection_region`, and `first_mirror` for
`conductor_multiple_reflectance` to go on.

Cosines are those of incidence, in (0, 1]; alpha is in [1e-4, 1]; all arguments broadcast. `points` is the number of
points from pole to rim of the cap of visible facets, for each of its parts. Absolute errors, largest and rms:

================================== ==================== ====================
quantity                           12 points            8 points
================================== ==================== ====================
reflectance ("single"), cones      6e-5, 7e-6           5e-4, 7e-5
lobes, conductors with k > 0.3     3e-4, 2e-5           1e-3, 1e-4
transmittance ("single"), ior > 1  2e-4, 2e-5           9e-4, 1e-4
transmittance ("single"), ior < 1  8e-4, 1e-4           2e-3, 4e-4
dielectrics ("multiple"), ior > 1  2e-3, 6e-4           2e-3, 6e-4
dielectrics ("multiple"), ior < 1  3.5e-3, 1e-3         3.5e-3, 1e-3
conductors ("multiple"), k > 0.3   1.6e-3, 4e-4         1.6e-3, 4e-4
================================== ==================== ====================

"multiple" is compared with walks, whose own errors of 1e-3 were taken off the rms. It is further off, by 0.02 to 0.03,
for ior in (0.97, 1) at cosines below 0.1, and for conductors with k < 0.1 and an index below 0.5, at which most facets
reflect totally (there by 0.01 if "single").
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from layerjax import fresnel
from layerjax._numerics import clamp_max, clamp_min
from layerjax.microsurface.multiple_bounces import interface_multiple_reflectance
from layerjax.microsurface.visible_facets import (
    Cap,
    Facets,
    cone,
    make_cap,
    refraction_region,
    region_facets,
    split_facets,
    whole_region,
)

POINTS = 12

SMOOTH_ALPHA = 1e-4
"""The least width. Of a surface known to be so narrow the energies are Fresnel's, and no quadrature is needed."""


def is_narrowest(alpha: Any) -> bool:
    """Whether a width is known while tracing to be `SMOOTH_ALPHA`."""
    return not isinstance(alpha, jax.core.Tracer) and bool(np.all(np.asarray(alpha) <= SMOOTH_ALPHA))


@partial(jax.jit, static_argnames=("multiple", "points"))
def interface_energies(
    cosine: ArrayLike, alpha: ArrayLike, ior: ArrayLike, multiple: bool, *, points: int = POINTS
) -> tuple[Array, Array]:
    """Reflectance and transmittance of a rough dielectric interface.

    Args:
        cosine, alpha: see above.
        ior: index on the far side over that on the side of incidence, in [0.25, 4].
        multiple: whether light that a facet sends into another is followed: R + T = 1; else R + T < 1.
    """
    cosine, alpha, ior = _arrays(cosine, alpha, ior)
    if not multiple:
        cap = make_cap(cosine, alpha)
        return _reflected_energy(cap, ior, points), _refracted_energies(cap, ior, points)[1]
    first, reflected_on, refracted_on = first_event(cosine, alpha, ior, points=points)
    returned = interface_multiple_reflectance(cosine, alpha, ior)
    reflected = _share(first + reflected_on * returned[0] + refracted_on * returned[1])
    return reflected, 1.0 - reflected


@partial(jax.jit, static_argnames="points")
def lobe_energy(cosine: ArrayLike, alpha: ArrayLike, *, points: int = POINTS) -> Array:
    """Reflectance of a rough surface of perfect mirrors, single scattering."""
    cosine, alpha = _arrays(cosine, alpha)
    return _lobe(reflection_region(make_cap(cosine, alpha), points))


@partial(jax.jit, static_argnames="points")
def escape_cone_share(cosine: ArrayLike, alpha: ArrayLike, ratio: ArrayLike, *, points: int = POINTS) -> Array:
    """Share of the lobe of `lobe_energy` that lies in sin(theta_o) < ratio: what a smooth interface above lets pass.

    Args:
        cosine, alpha: see above.
        ratio: sine of the critical angle, index above the interface over index below it, > 0; 1 and above give 1.

    This stands for the mean of 1 - F of Belcour 2018, Eq. 33, which would count Fresnel twice.
    """
    cosine, alpha, ratio = _arrays(cosine, alpha, ratio)
    cap = make_cap(cosine, alpha)
    share = _lobe(region_facets(cap, cone(cap, ratio), points)) / _lobe(reflection_region(cap, points))
    return jnp.where(ratio < 1.0, _share(share), 1.0)


def first_event(
    cosine: ArrayLike, alpha: ArrayLike, ior: ArrayLike, *, points: int = POINTS
) -> tuple[Array, Array, Array]:
    """First event of the walk on a dielectric: shares reflected away, reflected to and refracted to other facets.

    The last one is counted with separable masking, for the height-correlated one of refraction is costly.
    """
    cosine, alpha, ior = _arrays(cosine, alpha, ior)
    cap = make_cap(cosine, alpha)
    upper = split_facets(cap, cone(cap, jnp.ones_like(cosine)), refraction_region(cap, ior), points)
    first = upper.mean(fresnel.dielectric(upper.facing, ior[..., None, None]) * escape(upper))
    crossing, transmitted = _refracted_energies(cap, ior, points)
    return first, clamp_min(1.0 - crossing - first, 0.0), clamp_min(crossing - transmitted, 0.0)


def first_mirror(
    cosine: ArrayLike, alpha: ArrayLike, ior: ArrayLike, k: ArrayLike, *, points: int = POINTS
) -> tuple[Array, Array]:
    """First event of the walk on a conductor: shares reflected away, and to other facets."""
    cosine, alpha, ior, k = _arrays(cosine, alpha, ior, k)
    cap = make_cap(cosine, alpha)
    upper, seen = reflection_region(cap, points), region_facets(cap, whole_region(cap), points)
    levels = [fresnel.conductor(part.facing, ior[..., None, None], k[..., None, None]) for part in (upper, seen)]
    first = upper.mean(levels[0] * escape(upper))
    return first, clamp_min(seen.mean(levels[1]) - first, 0.0)


def _arrays(*values: ArrayLike) -> list[Array]:
    dtype = jnp.result_type(*values)
    dtype = dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)
    return jnp.broadcast_arrays(*(jnp.asarray(value, dtype) for value in values))


def reflection_region(cap: Cap, points: int) -> Facets:
    """Facets that reflect above the horizon."""
    return region_facets(cap, cone(cap, jnp.ones_like(cap.cosine)), points)


def _lobe(facets: Facets) -> Array:
    return facets.mean(masking(facets.reflected_cosine(), facets.alpha))


def _reflected_energy(cap: Cap, ior: Array, points: int) -> Array:
    """Reflected by dielectric facets and not masked."""
    upper = split_facets(cap, cone(cap, jnp.ones_like(cap.cosine)), refraction_region(cap, ior), points)
    return upper.mean(
        fresnel.dielectric(upper.facing, ior[..., None, None]) * masking(upper.reflected_cosine(), upper.alpha)
    )


def _refracted_energies(cap: Cap, ior: Array, points: int) -> tuple[Array, Array]:
    """Refracted by dielectric facets: all, and what is not masked."""
    passing, index = region_facets(cap, refraction_region(cap, ior), points), ior[..., None, None]
    crossing = 1.0 - fresnel.dielectric(passing.facing, index)
    return passing.mean(crossing), passing.mean(crossing * masking(passing.refracted_cosine(index), passing.alpha))


def _sigma(cosine: Array, alpha: Array) -> Array:
    """Projected area sigma of the facets and of their backs, see `layerjax.normals.ggx.ggx_area`."""
    return jnp.sqrt(alpha * alpha * (1.0 - cosine) * (1.0 + cosine) + cosine * cosine)


def masking(cosine: Array, alpha: Array) -> Array:
    """Smith masking G1, 0 below the horizon."""
    above = cosine > 0
    cosine = jnp.where(above, cosine, 0.5)
    return jnp.where(above, 2.0 * cosine / (cosine + _sigma(cosine, alpha)), 0.0)


def escape(facets: Facets) -> Array:
    """Share that leaves the surface of what facets reflect, given the heights at which wi meets them: G2 / G1(wi)."""
    reflected = facets.reflected_cosine()
    above = reflected > 0
    z = jnp.where(above, reflected, 0.5)
    sigma_i, sigma_o = _sigma(facets.cosine, facets.alpha), _sigma(z, facets.alpha)
    return jnp.where(above, (sigma_i + facets.cosine) * z / (z * sigma_i + facets.cosine * sigma_o), 0.0)


def _share(x: Array) -> Array:
    """x, kept in [0, 1] against errors of quadrature and fit."""
    return clamp_max(clamp_min(x, 0.0), 1.0)
