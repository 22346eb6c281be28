"""Lobes of a stack ready to be evaluated: tables over the cosine of the light, one row a point, cubic in between.

Everything that needs a quadrature is done here, once for a stack: a pair of directions costs one look into a table.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._numerics import at_least, safe_sqrt
from layerjax.directions import Vector
from layerjax.microsurface.directional_albedo import conductor_energy, is_smooth, lobe_energy, retained, single_energy
from layerjax.stack import Interface, Stack
from layerjax.surfaces import Conductor
from layerjax.transport.adding_doubling.grid import cubic
from layerjax.transport.statistical.lobes import STEEPEST, Options, Statistics, lobe_roughness, precision, statistics
from layerjax.transport.statistical.variance import bounded_refracted_cosine

POINTS = 97
"""Cosines of a table, uniform in the angle above the horizon."""

LEAST_ENERGY = 1e-6
"""Of an unscaled lobe, what it is divided by at least."""

GRAZING = 1e-6
"""Cosine that stands for 0."""


class Columns(eqx.Module):
    """Where the quantities of a lobe stand in a row: first column and count of its scale and of its roughness.

    The scale is energy over that of the unscaled lobe. No roughness: the lobe is that of the facet itself.
    """

    scale: tuple[int, int] = eqx.field(static=True)
    alpha: tuple[int, int] | None = eqx.field(static=True)


class Table(eqx.Module):
    """Lobes for light on one side.

    rows: (POINTS, columns), as `reflected` and `transmitted` say. shares: (POINTS, lobes), the energies (mean of the
    channels) that sampling goes by. near, far: (POINTS, C or 1), all energy reflected and transmitted.
    """

    rows: Array
    shares: Array
    near: Array
    far: Array
    facet: tuple[Interface | Conductor, Array] | None
    reflected: tuple[Columns, ...]
    transmitted: tuple[Columns, ...]


def points(dtype: Any) -> Array:
    """Cosines of the rows of a table."""
    return jnp.asarray(np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, POINTS)), dtype)


def look_up(rows: Array, cosine: Array, sine: Array) -> Array:
    """Row of a table at a cosine, cubic between its points: shape cosine.shape + (columns,)."""
    place = jnp.arctan2(cosine, sine) * (2.0 * (POINTS - 1) / np.pi)
    first = jnp.clip(jnp.floor(place) - 1.0, 0.0, POINTS - 4.0).astype(jnp.int32)
    weights = cubic(place - first)
    return sum((weights[j][..., None] * rows[first + j] for j in range(1, 4)), weights[0][..., None] * rows[first])


def make_table(stack: Stack, options: Options, upward: bool) -> Table:
    """Table of a simplified stack, lit from above, or from below (`upward`). Diffuse bases are left out."""
    dtype = precision(stack)
    cosine = at_least(points(dtype), GRAZING)
    found = statistics(stack, cosine, options, upward)
    columns: list[Array] = []

    def put(values: Array) -> tuple[int, int]:
        start = sum(column.shape[0] for column in columns)
        columns.append(values)
        return start, values.shape[0]

    near = far = jnp.zeros((1, POINTS), dtype)
    facet: tuple[Interface | Conductor, Array] | None = None
    lobes: list[tuple[Array, Array | None, Array]] = []  # energy, roughness (None: the facet itself), cosine
    for entry in found.reflected:
        near = near + jnp.sum(entry.lobe.energy, axis=0)
        for order, energy in enumerate(entry.lobe.energy):
            if entry.facet is not None and order == 0:
                facet = entry.facet
                lobes.append((energy, None, cosine))
            else:
                lobes.append((energy, lobe_roughness(_widened(entry.lobe.variance, entry.spread, order)), cosine))
    reflecting = len(lobes)
    within: list[Array] = []
    if found.transmitted is not None:
        passing, within = _passing(stack, found, cosine, upward)
        far = sum((energy for energy, _, _ in passing), far)
        lobes += passing
    shares = [jnp.mean(energy, axis=0) for energy, _, _ in lobes]
    reached = _lobe_energies(lobes)
    reflected, transmitted = [], []
    for k, (energy, alpha, _) in enumerate(lobes):
        if alpha is None:
            assert facet is not None
            reflected.append(Columns(put(energy / at_least(_unscaled(*facet, cosine), LEAST_ENERGY)), None))
        elif k < reflecting:
            reflected.append(Columns(put(energy / at_least(reached[k], LEAST_ENERGY)), put(alpha)))
        else:
            leaving = reached[k] * within[k - reflecting]
            transmitted.append(Columns(put(energy / at_least(leaving, LEAST_ENERGY)), put(alpha)))
    empty = jnp.zeros((0, POINTS), dtype)
    return Table(
        rows=jnp.concatenate(columns or [empty]).T,
        shares=jnp.stack(shares, axis=-1) if shares else empty.T,
        near=near.T,
        far=far.T,
        facet=facet,
        reflected=tuple(reflected),
        transmitted=tuple(transmitted),
    )


def index_below(stack: Stack) -> Array:
    """Refractive index below a stack without a base, over that above."""
    index = jnp.ones((), precision(stack))
    for layer in stack.layers:
        index = jnp.asarray(layer.ior) if isinstance(layer, Interface) else index
    return index


def reference_index(stack: Stack) -> Array:
    """Index of the medium in which transmitted lobes are described: the larger of those above and below."""
    return at_least(index_below(stack), 1.0)


def folded(w: Vector, ratio: Array) -> Vector:
    """The upper direction that w becomes, from either side, in a medium that is 1 / ratio times as dense."""
    squared = 1.0 - ratio * ratio + (ratio * w[2]) ** 2
    return ratio * w[0], ratio * w[1], safe_sqrt(squared)


def unfolded(w: Vector, ratio: Array) -> Vector:
    """The lower direction that `folded` takes to w; in the tangent plane if there is none."""
    x, y = w[0] / ratio, w[1] / ratio
    return x, y, -jnp.where(w[2] > 0, safe_sqrt(1.0 - x * x - y * y), 0.0)


def _passing(
    stack: Stack, found: Statistics, cosine: Array, upward: bool
) -> tuple[list[tuple[Array, Array | None, Array]], list[Array]]:
    """Energy, roughness and cosine of the transmitted lobes, by orders, in the medium of the reference index.

    Also the share of each that is not totally reflected on the way out of that medium. What nothing meets (no
    interface, no collision) passes straight and is no lobe.
    """
    assert found.transmitted is not None
    below, reference = index_below(stack), reference_index(stack)
    enters, leaves = (below, jnp.ones_like(below)) if upward else (jnp.ones_like(below), below)
    here, _ = bounded_refracted_cosine(cosine, reference / enters, 1.0 - GRAZING)
    behind, _ = bounded_refracted_cosine(cosine, leaves / enters, STEEPEST)
    widening = leaves * behind / (reference * here)  # variance in the reference medium of a unit of it behind
    met = any(isinstance(layer, Interface) for layer in stack.layers)
    lobes: list[tuple[Array, Array | None, Array]] = []
    for order, energy in enumerate(found.transmitted.energy):
        if order > 0 or met:
            sigma = _widened(found.transmitted.variance, found.transmitted_spread, order)
            lobes.append((energy, lobe_roughness(widening * sigma), here))
    if not lobes:
        return [], []
    sizes = np.cumsum([alpha.shape[0] for _, alpha, _ in lobes if alpha is not None])
    widths = jnp.concatenate([alpha for _, alpha, _ in lobes if alpha is not None])
    return lobes, jnp.split(retained(here, widths, leaves / reference), sizes[:-1])


def _lobe_energies(lobes: Sequence[tuple[Array, Array | None, Array]]) -> list[Array]:
    """Energies of the lobes of a surface that reflects all, by one quadrature; 1 for facets themselves."""
    widths = [alpha for _, alpha, _ in lobes if alpha is not None]
    if not widths:
        return [jnp.ones(()) for _ in lobes]
    cosines = [jnp.broadcast_to(cosine, alpha.shape) for _, alpha, cosine in lobes if alpha is not None]
    energies = lobe_energy(jnp.concatenate(cosines), jnp.concatenate(widths))
    found, start = [], 0
    for _, alpha, _ in lobes:
        count = 0 if alpha is None else alpha.shape[0]
        found.append(energies[start : start + count] if count else jnp.ones(()))
        start += count
    return found


def _widened(variance: Array, spread: Array | None, order: int) -> Array:
    return variance if spread is None or order == 0 else variance + order * spread


def _unscaled(what: Interface | Conductor, relative: Array, cosine: Array) -> Array:
    """Energy (C or 1, n) that the facets of the first interface or base reflect at their first collision."""
    alpha = jnp.asarray(what.alpha)
    smooth = is_smooth(what.alpha)
    if isinstance(what, Interface):
        return (fresnel.dielectric(cosine, relative) if smooth else single_energy(cosine, alpha, relative))[None]
    ior, k = (jnp.reshape(value, (-1, 1)) / relative for value in (what.ior, what.k))
    if smooth:
        return fresnel.conductor(cosine, ior, k)
    return conductor_energy(cosine, alpha, ior, k, "single")
