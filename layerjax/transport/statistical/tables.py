"""Lobes of a stack ready to be evaluated: tables over the cosine of the light, one row a point, cubic in between.

Everything that needs a quadrature is done here, once for a stack: a pair of directions costs one look into a table.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

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


Facet = tuple[Interface | Conductor, Array]
"""The first interface or base that light meets, and the ratio of the indices behind and before it (of a conductor: the
index of what it is in)."""


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
    facet: Facet | None
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


class _ShapedLobe(NamedTuple):
    """A lobe by its energy (C or 1, POINTS), its roughness (None: the facet itself) and its cosine."""

    energy: Array
    alpha: Array | None
    cosine: Array


class _Rows:
    """Rows of a table as they fill up with the columns of one lobe after the other."""

    def __init__(self) -> None:
        self.columns: list[Array] = []

    def put(self, lobe: _ShapedLobe, unscaled: Array) -> Columns:
        """Add the columns of a lobe; unscaled: energy of the lobe of its roughness."""
        scale = self._put(lobe.energy / at_least(unscaled, LEAST_ENERGY))
        return Columns(scale, None if lobe.alpha is None else self._put(lobe.alpha))

    def _put(self, values: Array) -> tuple[int, int]:
        start = sum(column.shape[0] for column in self.columns)
        self.columns.append(values)
        return start, values.shape[0]


def make_table(stack: Stack, options: Options, upward: bool) -> Table:
    """Table of a simplified stack, lit from above, or from below (`upward`). Diffuse bases are left out."""
    dtype = precision(stack)
    cosine = at_least(points(dtype), GRAZING)
    found = statistics(stack, cosine, options, upward)
    reflected, facet = _returning(found, cosine)
    transmitted, escaping = _passing(stack, found, cosine, upward)
    lobes = [*reflected, *transmitted]
    unscaled = _lobe_energies(lobes)
    rows = _Rows()
    of_reflected = [
        rows.put(lobe, energy if facet is None or lobe.alpha is not None else _unscaled(*facet, cosine))
        for lobe, energy in zip(reflected, unscaled[: len(reflected)], strict=True)
    ]
    of_transmitted = [
        rows.put(lobe, energy * share)
        for lobe, energy, share in zip(transmitted, unscaled[len(reflected) :], escaping, strict=True)
    ]
    empty, dark = jnp.zeros((0, POINTS), dtype), jnp.zeros((1, POINTS), dtype)
    shares = [jnp.mean(lobe.energy, axis=0) for lobe in lobes]
    return Table(
        rows=jnp.concatenate(rows.columns or [empty]).T,
        shares=jnp.stack(shares, axis=-1) if shares else empty.T,
        near=sum((jnp.sum(entry.lobe.energy, axis=0) for entry in found.reflected), dark).T,
        far=sum((lobe.energy for lobe in transmitted), dark).T,
        facet=facet,
        reflected=tuple(of_reflected),
        transmitted=tuple(of_transmitted),
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


def _returning(found: Statistics, cosine: Array) -> tuple[list[_ShapedLobe], Facet | None]:
    """The reflected lobes by orders, and the facet that stands for one of them itself, if any does."""
    facet: Facet | None = None
    lobes = []
    for entry in found.reflected:
        for order, energy in enumerate(entry.lobe.energy):
            if entry.facet is not None and order == 0:
                facet, alpha = entry.facet, None
            else:
                alpha = lobe_roughness(_widened(entry.lobe.variance, entry.spread, order))
            lobes.append(_ShapedLobe(energy, alpha, cosine))
    return lobes, facet


def _passing(stack: Stack, found: Statistics, cosine: Array, upward: bool) -> tuple[list[_ShapedLobe], list[Array]]:
    """The transmitted lobes by orders, in the medium of the reference index, none over a base.

    Also the share of each that is not totally reflected on the way out of that medium. What nothing meets (no
    interface, no collision) passes straight and is no lobe.
    """
    if found.transmitted is None:
        return [], []
    below, reference = index_below(stack), reference_index(stack)
    enters, leaves = (below, jnp.ones_like(below)) if upward else (jnp.ones_like(below), below)
    here, _ = bounded_refracted_cosine(cosine, reference / enters, 1.0 - GRAZING)
    behind, _ = bounded_refracted_cosine(cosine, leaves / enters, STEEPEST)
    widening = leaves * behind / (reference * here)  # variance in the reference medium of a unit of it behind
    met = any(isinstance(layer, Interface) for layer in stack.layers)
    lobes: list[_ShapedLobe] = []
    for order, energy in enumerate(found.transmitted.energy):
        if order > 0 or met:
            sigma = _widened(found.transmitted.variance, found.transmitted_spread, order)
            lobes.append(_ShapedLobe(energy, lobe_roughness(widening * sigma), here))
    widths = [lobe.alpha for lobe in lobes if lobe.alpha is not None]
    if not widths:
        return [], []
    ends = np.cumsum([alpha.shape[0] for alpha in widths])
    return lobes, jnp.split(retained(here, jnp.concatenate(widths), leaves / reference), ends[:-1])


def _lobe_energies(lobes: Sequence[_ShapedLobe]) -> list[Array]:
    """Energies of the lobes of a surface that reflects all, by one quadrature; 1 for facets themselves."""
    widths = [lobe.alpha for lobe in lobes if lobe.alpha is not None]
    if not widths:
        return [jnp.ones(()) for _ in lobes]
    cosines = [jnp.broadcast_to(lobe.cosine, lobe.alpha.shape) for lobe in lobes if lobe.alpha is not None]
    energies = lobe_energy(jnp.concatenate(cosines), jnp.concatenate(widths))
    found, start = [], 0
    for lobe in lobes:
        count = 0 if lobe.alpha is None else lobe.alpha.shape[0]
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
