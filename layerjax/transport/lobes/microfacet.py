"""Lobes of a stack as they are evaluated: of every one its energy, its scale and its roughness.

Nothing is prepared: all of it is computed at the requested cosines, from energies that are looked up.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from layerjax import channels, fresnel
from layerjax._numerics import clamp_min, safe_sqrt, unstack
from layerjax.channels import Channels, map_channels
from layerjax.directions import Vector
from layerjax.microsurface.energy_tables import escape_cone_share, mirror_energy, single_reflectance
from layerjax.normals.width_matrix import WidthMatrix, isotropic, width_matrix
from layerjax.normals.widths import Widths
from layerjax.stack import Interface, Stack
from layerjax.surfaces import Conductor
from layerjax.transport.lobes.statistics import (
    STEEPEST,
    Options,
    Plane,
    Statistics,
    bound_alpha,
    facet_width,
    lobe_roughness,
    mean_width,
    metal_levels,
    precision,
    refract_plane,
    statistics,
    width_seen,
)
from layerjax.transport.lobes.variance import bounded_refracted_cosine
from layerjax.transport.lobes.variance_tensor import Variances, VarianceTensor, as_tensor, roughness_matrix

LEAST_ENERGY = 1e-6
"""Least energy of an unscaled lobe that is divided by."""

GRAZING = 1e-6
"""Cosine that stands for 0."""


Facet = tuple[Interface | Conductor, Array, bool]
"""The first interface or base that light meets, the ratio of the indices behind and before it (of a conductor: the
index of what it is in), and whether it is smooth."""


LobeWidth = Array | WidthMatrix
"""GGX width of a lobe; a matrix in stacks that have facets of two widths."""


class MicrofacetLobe(NamedTuple):
    """A lobe by its energy, its energy over that of the unscaled lobe, and its roughness (None: the facet itself); and
    whether it is a delta, of light that has met smooth surfaces alone."""

    energy: Channels
    scale: Channels
    alpha: tuple[Any, ...] | None  # a `LobeWidth` for all channels, or one for each
    specular: bool


class _Lobe(NamedTuple):
    """A lobe by its energy, its variance (None: the facet itself) and its cosine; and whether it is a delta."""

    energy: Channels
    variance: Variances | None
    cosine: Array
    specular: bool


class MicrofacetLobes(NamedTuple):
    """Lobes for light along some cosines: the reflected ones, and the transmitted ones (none over a base)."""

    reflected: tuple[MicrofacetLobe, ...]
    transmitted: tuple[MicrofacetLobe, ...]
    facet: Facet | None

    def without_deltas(self) -> "MicrofacetLobes":
        """The lobes that have a width."""
        reflected, transmitted = (
            tuple(lobe for lobe in side if not lobe.specular) for side in (self.reflected, self.transmitted)
        )
        return self._replace(reflected=reflected, transmitted=transmitted)

    def at(self, index: Array) -> "MicrofacetLobes":
        """The reflected lobes for light along many directions, of cosines at these places, (n,).

        As products with a matrix of 0 and 1: XLA would compute the lobes again for each number that is gathered.
        """

        def spread(row: Array) -> Array:
            return row @ (jnp.arange(row.size)[:, None] == index).astype(row.dtype)

        def of(lobe: MicrofacetLobe) -> MicrofacetLobe:
            energy, scale, alpha = jax.tree.map(spread, (lobe.energy, lobe.scale, lobe.alpha))
            return MicrofacetLobe(energy, scale, alpha, lobe.specular)

        return MicrofacetLobes(tuple(map(of, self.reflected)), (), self.facet)

    def energies(self, dark: Array) -> tuple[Channels, Channels]:
        """Energies of all lobes on the side of the light and on the other, added to zeros."""
        lobes = self.reflected, self.transmitted
        near, far = (channels.total([(dark,), *(lobe.energy for lobe in side)]) for side in lobes)
        return near, far

    def shares(self) -> list[Array]:
        """Energies that sampling goes by, mean of the channels."""
        return [channels.mean(lobe.energy) for lobe in (*self.reflected, *self.transmitted)]

    def widths(self) -> tuple[list[Any], list[Any]]:
        """GGX widths, mean of the channels: of those reflected, and of those transmitted; all matrices if any is."""
        reflected, transmitted = ([self._width(lobe) for lobe in side] for side in (self.reflected, self.transmitted))
        if any(isinstance(width, WidthMatrix) for width in reflected + transmitted):
            return list(map(_as_matrix, reflected)), list(map(_as_matrix, transmitted))
        return reflected, transmitted

    def _width(self, lobe: MicrofacetLobe) -> LobeWidth:
        if lobe.alpha is None:
            assert self.facet is not None
            width = facet_width(self.facet[0])
            return width_matrix(width) if isinstance(width, Widths) else width
        if isinstance(lobe.alpha[0], WidthMatrix):
            return jax.tree.map(lambda *entries: channels.mean(entries), *lobe.alpha)
        return bound_alpha(channels.mean(lobe.alpha))


def _as_matrix(width: LobeWidth) -> WidthMatrix:
    return width if isinstance(width, WidthMatrix) else isotropic(width)


def microfacet_lobes(
    stack: Stack, options: Options, cosine: Array, upward: bool, plane: Plane | None = None
) -> MicrofacetLobes:
    """Lobes of a simplified stack, lit from above, or from below (`upward`). Diffuse bases are omitted.

    plane: of the direction of the light outside, where facets have two widths; see `width_seen`.
    """
    cosine = clamp_min(cosine, GRAZING)
    found = statistics(stack, cosine, options, upward, plane)
    reflected, facet = _reflected_lobes(found, cosine)
    transmitted, escaping = _transmitted_lobes(stack, found, cosine, upward)
    folded = None
    if plane is not None:
        outside = index_below(stack) if upward else jnp.ones(())
        folded = refract_plane(plane, outside, reference_index(stack))
    alphas, unscaled = _alphas_and_energies(reflected, transmitted, escaping, folded)
    if facet is not None:  # its lobe is the first
        unscaled[0] = _facet_energy(*facet, cosine, plane)
    lobes = tuple(map(_scale, [*reflected, *transmitted], alphas, unscaled))
    return MicrofacetLobes(lobes[: len(reflected)], lobes[len(reflected) :], facet)


def _scale(lobe: _Lobe, alpha: tuple[Any, ...], unscaled: Channels) -> MicrofacetLobe:
    scale = map_channels(lambda energy, whole: energy / clamp_min(whole, LEAST_ENERGY), lobe.energy, unscaled)
    return MicrofacetLobe(lobe.energy, scale, alpha or None, lobe.specular)


def index_below(stack: Stack) -> Array:
    """Refractive index below a stack without a base, over that above."""
    index = jnp.ones((), precision(stack))
    for layer in stack.layers:
        index = jnp.asarray(layer.ior) if isinstance(layer, Interface) else index
    return index


def reference_index(stack: Stack) -> Array:
    """Index of the medium in which transmitted lobes are described: the larger of those above and below."""
    return clamp_min(index_below(stack), 1.0)


def fold(w: Vector, ratio: Array) -> Vector:
    """The upper direction that w becomes, from either side, in a medium that is 1 / ratio times as dense."""
    squared = 1.0 - ratio * ratio + (ratio * w[2]) ** 2
    return ratio * w[0], ratio * w[1], safe_sqrt(squared)


def unfold(w: Vector, ratio: Array) -> Vector:
    """The lower direction that `fold` takes to w; in the tangent plane if there is none."""
    x, y = w[0] / ratio, w[1] / ratio
    return x, y, -jnp.where(w[2] > 0, safe_sqrt(1.0 - x * x - y * y), 0.0)


def _reflected_lobes(statistics: Statistics, cosine: Array) -> tuple[list[_Lobe], Facet | None]:
    """The reflected lobes by orders, and the facet that stands for one of them itself, if any does."""
    facet: Facet | None = None
    lobes = []
    for entry in statistics.reflected:
        for order, energy in enumerate(entry.lobe.energy):
            sigma: Variances | None = None
            if entry.facet is not None and order == 0:
                facet = entry.facet
            else:
                sigma = _order_variance(entry.lobe.variance, entry.spread, order)
            lobes.append(_Lobe(energy, sigma, cosine, entry.specular and order == 0))
    return lobes, facet


def _transmitted_lobes(stack: Stack, statistics: Statistics, cosine: Array, upward: bool) -> tuple[list[_Lobe], Array]:
    """The transmitted lobes by orders, in the medium of the reference index, none over a base.

    Also the largest sine there that is not totally reflected on the way out. What nothing meets (no interface, no
    collision) passes and is no lobe.
    """
    if statistics.transmitted is None:
        return [], jnp.ones_like(cosine)
    below, reference = index_below(stack), reference_index(stack)
    enters, leaves = (below, jnp.ones_like(below)) if upward else (jnp.ones_like(below), below)
    here, _ = bounded_refracted_cosine(cosine, reference / enters, 1.0 - GRAZING)
    behind, _ = bounded_refracted_cosine(cosine, leaves / enters, STEEPEST)
    widening = leaves * behind / (reference * here)  # variance in the reference medium of a unit of it behind
    met = any(isinstance(layer, Interface) for layer in stack.layers)
    lobes: list[_Lobe] = []
    for order, energy in enumerate(statistics.transmitted.energy):
        if order > 0 or met:
            sigma = _order_variance(statistics.transmitted.variance, statistics.transmitted_spread, order)
            specular = statistics.transmitted_specular and order == 0
            lobes.append(_Lobe(energy, tuple(widening * part for part in sigma), here, specular))
    return lobes, leaves / reference


def _alphas_and_energies(
    reflected: Sequence[_Lobe], transmitted: Sequence[_Lobe], escaping: Array, folded: Plane | None
) -> tuple[list[tuple[Any, ...]], list[Channels]]:
    """Roughness and unscaled energy of every lobe and channel, at one look; nothing for the facet itself.

    Of what is transmitted: escaping is the largest sine that is not totally reflected, folded the plane of the light.
    """
    lobes = [*reflected, *transmitted]
    parts = [(lobe.cosine, sigma) for lobe in lobes for sigma in lobe.variance or ()]
    if not parts:
        return [() for _ in lobes], [() for _ in lobes]
    cosine = jnp.stack(jnp.broadcast_arrays(*(cosine for cosine, _ in parts)))
    alpha = _lobe_widths([sigma for _, sigma in parts])
    energy = mirror_energy(cosine, mean_width(alpha))
    beyond = sum(len(lobe.variance or ()) for lobe in transmitted)
    if beyond:
        cosine, width = cosine[-beyond:], jax.tree.map(lambda entry: entry[-beyond:], alpha)
        passed = energy[-beyond:] * escape_cone_share(cosine, width_seen(width, folded), escaping)
        energy = jnp.concatenate([energy[:-beyond], passed])
    rows = zip(_rows(alpha), unstack(energy), strict=True)
    found = [[next(rows) for _ in lobe.variance or ()] for lobe in lobes]
    return [tuple(a for a, _ in lobe) for lobe in found], [tuple(e for _, e in lobe) for lobe in found]


def _lobe_widths(sigmas: Sequence[Any]) -> LobeWidth:
    """Roughness of lobes, one a row: matrices if any variance is a tensor."""
    if not any(isinstance(sigma, VarianceTensor) for sigma in sigmas):
        return lobe_roughness(jnp.stack(jnp.broadcast_arrays(*sigmas)))
    tensors = list(map(as_tensor, sigmas))
    entries = [*(one.xx for one in tensors), *(one.xy for one in tensors), *(one.yy for one in tensors)]
    return roughness_matrix(VarianceTensor(*jnp.split(jnp.stack(jnp.broadcast_arrays(*entries)), 3)))


def _rows(width: LobeWidth) -> list[Any]:
    if not isinstance(width, WidthMatrix):
        return unstack(width)
    return [WidthMatrix(*row) for row in zip(*map(unstack, (width.xx, width.xy, width.yy)), strict=True)]


def _order_variance(variance: Variances, spread: Channels | None, order: int) -> Variances:
    return variance if spread is None or order == 0 else map_channels(lambda v, s: v + order * s, variance, spread)


def _facet_energy(
    what: Interface | Conductor, relative: Array, smooth: bool, cosine: Array, plane: Plane | None
) -> Channels:
    """Energy that the facets of the first interface or base reflect at their first collision."""
    if isinstance(what, Conductor):
        return metal_levels(what, cosine, relative, multiple=False, smooth=smooth)
    if smooth:
        return (fresnel.dielectric(cosine, relative),)
    return (single_reflectance(cosine, width_seen(facet_width(what), plane), relative),)
