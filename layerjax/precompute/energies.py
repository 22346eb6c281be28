"""energies.npz: directional energies of rough GGX surfaces, as splines of `layerjax.microsurface.energy_tables`.

Single scattering is by quadrature over the facets that are seen, at points twice as dense as the coefficients along
every axis, to which splines are fitted by least squares. What is left on the surface after the first facet ends on its
sides in the shares of `layerjax.microsurface.multiple_bounces`, which are smooth where walks have noise.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.optimize import minimize

from layerjax import fresnel
from layerjax.microsurface import directional_albedo as by_quadrature
from layerjax.microsurface import energy_tables as tables
from layerjax.microsurface.energy_tables import (
    DENSER,
    ENERGY_OFFSET,
    ESCAPE_CONE,
    LEAST_ALPHA,
    MIRROR,
    REST,
    SHAPES,
    SLICES,
    STEEPEST,
    THINNER,
    alpha_of_place,
)
from layerjax.microsurface.multiple_bounces import conductor_multiple_reflectance, interface_multiple_reflectance
from layerjax.microsurface.splines import fit_splines
from layerjax.microsurface.visible_facets import Facets, cone, make_cap, split_facets, whole_region

Values = np.ndarray
Report = Callable[[str], Any]

POINTS = 24
"""Nodes from pole to rim of the cap of facets."""
BATCH_SIZE = 4096
METALS, LEAST_K, TOLERATED = 150, 0.3, 1e-3
"""That shares are fitted to, their least k, and the error of energy that counts as one of the usual numbers."""
NEXT = 0.03
"""Step of differences of cosines, in widths of a lobe."""
LEAST_COSINE = 1e-6
NARROWEST_WALKED = 0.01
"""Alpha below which the reflected share is that at this one, at a cosine that is as much larger."""


def make(coarse: bool = False, report: Report = print) -> dict[str, np.ndarray]:
    """The tables, from points along each axis of which there are twice as many as coefficients."""
    dense = 1.0 if coarse else 2.0
    begin = time.perf_counter()
    parts = [dielectric(name, dense) for name in ("denser", "thinner")]
    report(f"energies: interfaces, {time.perf_counter() - begin:.0f} s")
    columns = [part[name].ravel() for name in ("multiple", "single", "passed") for part in parts]
    made = {"dielectric": np.concatenate(columns)} | metals(dense) | {"retained": escape_cones(dense)}
    report(f"energies: metals and visible light, {time.perf_counter() - begin:.0f} s")
    return {name: values.astype(np.float32) for name, values in made.items()}


def dielectric(side: str, dense: float) -> dict[str, Values]:
    """Coefficients of the energies of interfaces on one side of an index of 1."""
    shape = SHAPES[side]
    cosine, alpha, ior = dielectric_grid(side, shape, dense)
    reflected, passed = map_batches(
        lambda c, a, n: by_quadrature.interface_energies(c, a, n, multiple=False, points=POINTS), cosine, alpha, ior
    )
    mirror = map_batches(lambda c, a, n: (by_quadrature.lobe_energy(c, a, points=POINTS),), cosine, alpha, ior)[0]
    multiple = map_batches(all_facets, cosine, alpha, ior)[0]
    return {
        "multiple": fit_splines(np.sqrt(multiple + ENERGY_OFFSET), shape),
        "single": fit_splines(np.sqrt(reflected / mirror + ENERGY_OFFSET), shape),
        "passed": fit_splines(passed, shape),
    }


def dielectric_grid(side: str, shape: Sequence[int], dense: float) -> tuple[Values, Values, Values]:
    """Cosine, alpha and index at points of the axes of a table of so many coefficients, (x, y, z) each."""
    x, y, z = (np.linspace(0.0, 1.0, int(dense * count)) for count in shape)
    warp, sign = (DENSER, 1.0) if side == "denser" else (THINNER, -1.0)
    alpha = np.maximum(alpha_of_place(y, warp.grain), LEAST_ALPHA)[None, :, None]
    ior = np.exp(sign * np.log(tables.LARGEST_INDEX) * z**3)[None, None, :]
    critical = np.sqrt(np.maximum((1.0 - ior) * (1.0 + ior), 0.0))
    width = warp.cosine[0] + warp.cosine[1] * alpha * (ior if side == "thinner" else 1.0)
    cosine = tables.cosine_of_place(x[:, None, None], critical, width)
    cosine = np.clip(cosine, LEAST_COSINE, 1.0)
    cosine, alpha, ior = np.broadcast_arrays(cosine, alpha, ior)
    return cosine, alpha, ior


def all_facets(cosine: Array, alpha: Array, ior: Array) -> tuple[Array]:
    """Reflectance of interfaces, all facets together: the first by quadrature, of the rest what walks give back."""
    first, reflected_on, refracted_on = by_quadrature.first_event(cosine, alpha, ior, points=POINTS)
    wide = jnp.maximum(alpha, NARROWEST_WALKED)
    c = jnp.clip(cosine * wide / alpha, LEAST_COSINE, 1.0)
    reflected, refracted = interface_multiple_reflectance(c, wide, ior)
    return (jnp.clip(first + reflected_on * reflected + refracted_on * refracted, 0.0, 1.0),)


def metals(dense: float) -> dict[str, Values]:
    """Coefficients of the energy of mirrors, and of how far the facets of a metal face the light, slice by slice."""
    x, y = (np.linspace(0.0, 1.0, int(dense * count)) for count in SHAPES["mirror"])
    alpha = alpha_of_place(y, MIRROR.grain)[None, :]
    cosine = tables.cosine_of_place(x[:, None], np.zeros((1, 1)), MIRROR.cosine[0] + MIRROR.cosine[1] * alpha)
    cosine, alpha = np.broadcast_arrays(np.clip(cosine, LEAST_COSINE, 1.0), alpha)

    def columns(values: Values) -> Values:
        return np.concatenate([fit_splines(values[..., k], SHAPES["mirror"]).ravel() for k in range(values.shape[-1])])

    return {name: columns(map_batches(way, cosine, alpha)[0]) for name, way in (("mirror", _single), ("first", _all))}


def _single(cosine: Array, alpha: Array) -> tuple[Array]:
    """Energy of facets that reflect all, and the slices of those that light leaves, (n, 1 + slices)."""
    facets = by_quadrature.reflection_region(make_cap(cosine, alpha), POINTS)
    return (_slice(facets, facets.weight * by_quadrature.masking(facets.reflected_cosine(), facets.alpha), SLICES),)


def _all(cosine: Array, alpha: Array) -> tuple[Array]:
    """The same of the first facet that light meets in a walk, and the slices of those that send it on to others."""
    cap = make_cap(cosine, alpha)
    upper = by_quadrature.reflection_region(cap, POINTS)
    seen = split_facets(cap, whole_region(cap), cone(cap, jnp.ones_like(cosine)), POINTS)
    first = _slice(upper, upper.weight * by_quadrature.escape(upper), SLICES)
    sent_on = _slice(seen, seen.weight * (1.0 - by_quadrature.escape(seen)), REST)
    return (jnp.concatenate([first, sent_on[:, 1:], jax.vmap(_returns)(cosine, alpha, 1.0 - first[:, 0])], axis=-1),)


def _returns(cosine: Array, alpha: Array, sent_on: Array) -> Array:
    """What `tables.multiple_reflectance` goes by: nearest to the polynomials of walks for metals of all kinds."""
    u, v = (jnp.asarray((0.5 + np.arange(METALS)) * golden % 1.0) for golden in (0.7548776662, 0.5698402910))
    ior, k = jnp.exp(jnp.log(0.02) + jnp.log(500.0) * u), LEAST_K + 20.0 * v**1.5
    wide = jnp.maximum(alpha, NARROWEST_WALKED)
    c = jnp.clip(cosine * wide / alpha, LEAST_COSINE, 1.0)
    wanted = conductor_multiple_reflectance(*jnp.broadcast_arrays(c, wide, ior, k))
    places, weights = jnp.asarray(tables.DIFFUSE)
    mean = weights @ fresnel.conductor(places[:, None], ior, k)
    normal = fresnel.conductor(jnp.ones(()), ior, k)
    likely = jnp.asarray([0.8, 0.0, 0.0])

    def misfit(returns: Array) -> Array:
        apart = sent_on * (tables.multiple_reflectance(tuple(returns), mean, normal) - wanted)
        return jnp.mean((apart / TOLERATED) ** 2) + jnp.sum((returns - likely) ** 2)

    return minimize(misfit, likely, method="BFGS").x


def _slice(facets: Facets, weight: Array, shares: Sequence[float]) -> Array:
    """Total weight, and mean facing cosine of each share of it in the order of that cosine, (n, 1 + slices)."""

    def one(facing: Array, weight: Array) -> Array:
        order = jnp.argsort(facing)
        facing, weight = facing[order], weight[order]
        total = jnp.sum(weight)
        reached, moment = jnp.cumsum(weight) / total, jnp.cumsum(weight * facing) / total
        edges = jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.asarray(shares))])
        sums = jnp.interp(edges, jnp.insert(reached, 0, 0.0), jnp.insert(moment, 0, 0.0))
        return jnp.concatenate([total[None], jnp.diff(sums) / jnp.asarray(shares)])

    rows = facets.facing.shape[0], -1
    facing = jnp.clip(facets.facing, 0.0, 1.0)
    return jax.vmap(one)(facing.reshape(rows), jnp.broadcast_to(weight, facing.shape).reshape(rows))


def escape_cones(dense: float) -> Values:
    """Coefficients of the share of a lobe that is not totally reflected."""
    x, y, z = (np.linspace(0.0, 1.0, int(dense * count)) for count in SHAPES["retained"])
    alpha = alpha_of_place(y, ESCAPE_CONE.grain)[None, :, None]
    half = ESCAPE_CONE.cosine[1] * alpha
    critical = np.maximum(half * np.sinh(z * np.arcsinh(STEEPEST / half)), LEAST_COSINE)
    width = half * np.sqrt(1.0 - critical**2 + alpha**2)
    low, high = np.arcsinh(critical / width), np.arcsinh(1.0 / width)
    beyond = critical + width * np.sinh(x[:, None, None] * (low + high) - low)
    ratio = np.sqrt(1.0 - critical**2)

    def odds(cosine: Values) -> Values:
        arguments = np.broadcast_arrays(np.clip(cosine, LEAST_COSINE, 1.0), alpha, ratio)
        share = map_batches(lambda c, a, r: (by_quadrature.escape_cone_share(c, a, r, points=POINTS),), *arguments)[0]
        with np.errstate(divide="ignore"):
            return np.clip(np.arctanh(2.0 * share - 1.0), -tables.LARGEST_ATANH, tables.LARGEST_ATANH)

    # linear beyond the normal, as splines are inaccurate at ends
    upright, beside = odds(np.ones_like(beyond[:1])), odds(1.0 - NEXT * width)
    further = np.clip(
        upright + (upright - beside) / (NEXT * width) * (beyond - 1.0), -tables.LARGEST_ATANH, tables.LARGEST_ATANH
    )
    return fit_splines(np.where(beyond > 1.0, further, odds(beyond)), SHAPES["retained"]).ravel()


def map_batches(function: Callable[..., tuple[Array, ...]], *arguments: Values) -> list[Values]:
    """function of arrays of one shape, a few thousand entries at a time."""
    shape = arguments[0].shape
    flat = [argument.ravel() for argument in arguments]
    compiled = jax.jit(function)
    rows = []
    for start in range(0, flat[0].size, BATCH_SIZE):
        few = [jnp.asarray(np.resize(part[start : start + BATCH_SIZE], BATCH_SIZE)) for part in flat]
        rows.append([np.asarray(value)[: flat[0].size - start] for value in compiled(*few)])
    return [np.concatenate(part).reshape(*shape, *part[0].shape[1:]) for part in zip(*rows, strict=True)]
