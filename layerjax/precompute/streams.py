"""streams.npz: rough interfaces between diffuse light, for `layerjax.transport.statistical.streams`.

Of light from one direction the facets that it sees tell where it goes, as moments of the polynomials of that module.
What is left on the surface after the first facet leaves it as such light would come from there, t t' / <t> and r r' /
<r> (as in the solver, after Kulla & Conty 2017): reciprocal. The moments of what enters are a table of their own, over
cosine, roughness and index; their means against the polynomials of the direction make matrices.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax.microsurface import directional_albedo as by_quadrature
from layerjax.microsurface.energy_tables import LARGEST_INDEX, LEAST_ALPHA
from layerjax.microsurface.splines import fit_splines
from layerjax.microsurface.visible_facets import cone, make_cap, refraction_region, region_facets, split_facets
from layerjax.precompute.energies import LEAST_COSINE, Values, all_facets, dielectric_grid, map_batches
from layerjax.quadrature import panels
from layerjax.transport.statistical.diffuse import GRAIN
from layerjax.transport.statistical.streams import ENTERING, INTERFACES, STREAMS, pack, polynomials

POINTS = 16
"""Nodes from pole to rim of the cap of facets."""
COSINES = 24
"""Nodes of a mean over diffuse light, on either side of the critical cosine."""
LEAST_ENTERING, LEAST_REST = 1e-3, 1e-6
"""Added to the shares of light that enters, and of all that first facets leave on the surface, that are divided by."""


class Moments(NamedTuple):
    """Of light along directions, or of diffuse light. through, back: of what the first facet sends on, by polynomials
    of where it goes, (..., STREAMS); later, returned: shares of the rest that pass in the end and that do not.
    """

    through: Any
    back: Any
    later: Any
    returned: Any


def make(coarse: bool = False, report: Callable[[str], Any] = print) -> dict[str, np.ndarray]:
    """The tables, from points along each axis of which there are twice as many as coefficients."""
    dense = 1.0 if coarse else 2.0
    begin = time.perf_counter()
    made = {"interface": interfaces(dense)}
    report(f"streams: interfaces, {time.perf_counter() - begin:.0f} s")
    sides = [entering(side, dense) for side in ("denser", "thinner")]
    made["entering"] = np.concatenate([columns[k] for k in range(STREAMS - 1) for columns in sides])
    report(f"streams: light that enters, {time.perf_counter() - begin:.0f} s")
    return {name: values.astype(np.float32) for name, values in made.items()}


def interfaces(dense: float) -> Values:
    """Coefficients of the entries of `streams.pack`, one after the other."""
    x, y = (np.linspace(0.0, 1.0, int(dense * count)) for count in INTERFACES)
    alpha = np.clip(GRAIN * np.sinh(x * np.arcsinh(1.0 / GRAIN)), LEAST_ALPHA, 1.0)[:, None]
    ior = np.exp(np.log(LARGEST_INDEX) * y**3)[None, :]
    alpha, ior = np.broadcast_arrays(alpha, ior)
    inward, outward = diffuse_moments(alpha, ior), diffuse_moments(alpha, 1.0 / ior)
    squared = (ior * ior)[..., None, None]
    # by reciprocity what goes in and what comes out are one: take the mean of the two
    first = 0.5 * (inward.through + squared * np.swapaxes(outward.through, -1, -2))
    symmetric = [
        0.5 * (side.back + np.swapaxes(side.back, -1, -2)) + _product(side.returned, side.returned)
        for side in (inward, outward)
    ]
    values = pack(first + _product(outward.later, inward.later), *symmetric)
    return np.concatenate([fit_splines(values[..., k], INTERFACES).ravel() for k in range(values.shape[-1])])


def _product(out: Values, into: Values) -> Values:
    """Matrix of light that comes out as `out`, with the energy that goes in by `into`."""
    shape = out / (out[..., :1] + LEAST_REST)
    return shape[..., :, None] * into[..., None, :]


def diffuse_moments(alpha: Values, ior: Values) -> Moments:
    """Means of the moments against the polynomials of the direction: (..., out, in), and (..., in) of the rest."""
    critical = np.sqrt(np.maximum((1.0 - ior) * (1.0 + ior), 0.0))
    edges = np.stack([np.zeros_like(critical), critical, np.ones_like(critical)], axis=-1)
    cosine, weight = (np.asarray(part) for part in panels(jnp.asarray(edges), COSINES))
    cosine = np.clip(cosine, LEAST_COSINE, 1.0)
    arguments = np.broadcast_arrays(cosine, alpha[..., None], ior[..., None])
    found = Moments(*map_batches(_moments, *arguments))
    into = 2.0 * (weight * cosine)[..., None] * np.asarray(polynomials(cosine))
    through, back = (np.swapaxes(part, -1, -2) @ into for part in (found.through, found.back))
    later, returned = ((part[..., None, :] @ into)[..., 0, :] for part in (found.later, found.returned))
    return Moments(through, back, later, returned)


def entering(side: str, dense: float) -> list[Values]:
    """Columns of coefficients of the moments of light that enters, over the share that does, for a side of 1."""
    shape = ENTERING[side]
    cosine, alpha, ior = dielectric_grid(side, shape, dense)
    found = Moments(*map_batches(_moments, cosine, alpha, ior))
    leaving = diffuse_moments(alpha[0], 1.0 / ior[0]).later
    sums = found.through + found.later[..., None] * leaving / (leaving[..., :1] + LEAST_REST)
    share = sums[..., 1:] / (sums[..., :1] + LEAST_ENTERING)
    return [fit_splines(share[..., k], shape).ravel() for k in range(STREAMS - 1)]


def _moments(cosine: Array, alpha: Array, ior: Array) -> Moments:
    """The same of light along directions (n,)."""
    cap = make_cap(cosine, alpha)
    index = ior[..., None, None]
    passing = region_facets(cap, refraction_region(cap, ior), POINTS)
    inside = passing.refracted_cosine(index)
    through = (1.0 - fresnel.dielectric(passing.facing, index)) * by_quadrature.masking(inside, passing.alpha)
    upper = split_facets(cap, cone(cap, jnp.ones_like(cosine)), refraction_region(cap, ior), POINTS)
    back = fresnel.dielectric(upper.facing, index) * by_quadrature.masking(upper.reflected_cosine(), upper.alpha)
    reflectance = all_facets(cosine, alpha, ior)[0]
    sums = []
    for facets, way, share in ((passing, inside, through), (upper, upper.reflected_cosine(), back)):
        values = polynomials(jnp.clip(way, 0.0, 1.0))
        sums.append(jnp.stack([facets.mean(share * values[..., k]) for k in range(STREAMS)], axis=-1))
    later, returned = 1.0 - reflectance - sums[0][..., 0], reflectance - sums[1][..., 0]
    return Moments(sums[0], sums[1], jnp.maximum(later, 0.0), jnp.maximum(returned, 0.0))
