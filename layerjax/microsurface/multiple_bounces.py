"""What a rough surface gives back of the light that its first facet sends on to other facets.

In the walk of Heitz et al. 2016 light that has met one facet and not left is reflected to the near side in a share
that is smooth in the angle, the roughness and the index. It is written in polynomials; their coefficients are fitted to
walks by `layerjax.precompute.microsurface`.
"""

import itertools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._numerics import safe_sqrt
from layerjax.quadrature import gauss_legendre
from layerjax.tables import load


def interface_multiple_reflectance(cosine: Array, alpha: Array, ior: Array) -> tuple[Array, Array]:
    """Shares that end on the near side, of light first reflected, and first refracted, to other facets.

    They are to be multiplied by the amounts of `layerjax.microsurface.directional_albedo.first_event`, one of which is
    a little less than the light meant: shares may exceed 1.
    """
    table = load("microsurface")
    bases = interface_bases(cosine, alpha, ior)
    below, above = (
        [basis @ jnp.asarray(table[f"{name}_{side}"], basis.dtype) for name, basis in bases.items()]
        for side in ("below", "above")
    )
    reflected, refracted = (jnp.where(ior < 1.0, low, high) for low, high in zip(below, above, strict=True))
    return reflected, refracted


def conductor_multiple_reflectance(cosine: Array, alpha: Array, ior: Array, k: Array) -> Array:
    """Share that a conductor gives back, all facets after the first together; 1 for perfect mirrors."""
    basis, mean = conductor_basis(cosine, alpha, ior, k)
    return mean + basis @ jnp.asarray(load("microsurface")["conductor"], basis.dtype)


def interface_bases(cosine: Array, alpha: Array, ior: Array) -> dict[str, Array]:
    """Functions of which `interface_multiple_reflectance` is made, "reflected" and "refracted", on a new last axis."""
    lower = jnp.where(ior < 1.0, ior, 1.0 / ior)
    critical = (1.0 - lower) * (1.0 + lower)  # cosine of the critical angle, squared
    # near equal indices light passes facet after facet without a turn: it is reflected where they differ by this much
    turned = critical / (critical + 0.06 * cosine * (1.0 + 7.0 * cosine))
    root = jnp.sqrt(cosine)
    smooth = _products((root, alpha, safe_sqrt(critical)), (7, 5, 8), 1.5)
    steep = _products((root, alpha, turned), (7, 5, 8), 1.7)
    # no light is refracted elsewhere between equal indices
    return {
        "reflected": smooth,
        "refracted": (turned * turned)[..., None] * jnp.concatenate([smooth, steep], axis=-1),
    }


def conductor_basis(cosine: Array, alpha: Array, ior: Array, k: Array) -> tuple[Array, Array]:
    """Functions of which `conductor_multiple_reflectance` is made, on a new last axis, and its leading part.

    That part is the mean reflectance of a facet.
    """
    s, w = (jnp.asarray(array, cosine.dtype) for array in gauss_legendre(16))
    mean = fresnel.conductor(s, ior[..., None], k[..., None]) @ (2.0 * s * w)
    slope = fresnel.conductor(jnp.ones_like(ior), ior, k) - mean
    basis = _products((cosine, alpha, mean, 0.5 * (1.0 + slope)), (4, 4, 5, 5), 1.5)
    return (mean * (1.0 - mean))[..., None] * basis, mean


def _products(variables: Sequence[Array], degrees: tuple[int, ...], total: float) -> Array:
    """Products of Chebyshev polynomials on [0, 1], of degrees that relative to the greatest sum up to `total`."""
    every = itertools.product(*(range(degree + 1) for degree in degrees))
    kept = np.array([e for e in every if sum(np.divide(e, degrees)) <= total + 1e-9])
    result = None
    for x, degree, columns in zip(variables, degrees, kept.T, strict=True):
        polynomials = [jnp.ones_like(x), 2.0 * x - 1.0]
        for _ in range(degree - 1):
            polynomials.append(2.0 * polynomials[1] * polynomials[-1] - polynomials[-2])
        factor = jnp.stack(polynomials, axis=-1)[..., columns]
        result = factor if result is None else result * factor
    assert result is not None
    return result
