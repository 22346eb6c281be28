"""Energies of rough metals by quadrature over their facets, what the tables are compared with."""

from functools import partial

import jax
import jax.numpy as jnp

from layerjax import fresnel
from layerjax.microsurface.directional_albedo import POINTS, first_mirror, masking, reflection_region
from layerjax.microsurface.multiple_bounces import conductor_multiple_reflectance
from layerjax.microsurface.visible_facets import make_cap


@partial(jax.jit, static_argnames=("multiple", "points"))
def conductor_energy(cosine, alpha, ior, k, multiple, *, points=POINTS):
    """Reflectance, with the arguments of `layerjax.microsurface.energy_tables.conductor_energies`, of one channel."""
    cosine, alpha, ior, k = jnp.broadcast_arrays(*map(jnp.asarray, (cosine, alpha, ior, k)))
    if not multiple:
        upper = reflection_region(make_cap(cosine, alpha), points)
        reflectance = fresnel.conductor(upper.facing, ior[..., None, None], k[..., None, None])
        return upper.mean(reflectance * masking(upper.reflected_cosine(), upper.alpha))
    first, reflected_on = first_mirror(cosine, alpha, ior, k, points=points)
    return jnp.clip(first + reflected_on * conductor_multiple_reflectance(cosine, alpha, ior, k), 0.0, 1.0)
