"""Lobes of a stack as they are evaluated: of every one its energy, its scale and its roughness.

Nothing is prepared: all of it is found at the cosines that are asked for, from energies that are looked up.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax import channels, fresnel
from layerjax._numerics import at_least, safe_sqrt, unstacked
from layerjax.channels import Channels, each
from layerjax.directions import Vector
from layerjax.microsurface.energy_tables import mirror_energy, retained_share, single_reflectance
from layerjax.stack import Interface, Stack
from layerjax.surfaces import Conductor
from layerjax.transport.statistical.lobes import (
    STEEPEST,
    Options,
    Statistics,
    bounded,
    lobe_roughness,
    metal_levels,
    precision,
    statistics,
)
from layerjax.transport.statistical.variance import bounded_refracted_cosine

LEAST_ENERGY = 1e-6
"""Of an unscaled lobe, what it is divided by at least."""

GRAZING = 1e-6
"""Cosine that stands for 0."""


Facet = tuple[Interface | Conductor, Array, bool]
"""The first interface or base that light meets, the ratio of the indices behind and before it (of a conductor: the
index of what it is in), and whether it is smooth."""


class ShapedLobe(NamedTuple):
    """A lobe by its energy, its energy over that of the unscaled lobe, and its roughness; None: the facet itself."""

    energy: Channels
    scale: Channels
    alpha: Channels | None


class _Lobe(NamedTuple):
    """A lobe by its energy, its roughness (None: the facet itself) and its cosine."""

    energy: Channels
    alpha: Channels | None
    cosine: Array


class Shaped(NamedTuple):
    """Lobes for light along some cosines: those on its own side, and those on the other (none over a base)."""

    reflected: tuple[ShapedLobe, ...]
    transmitted: tuple[ShapedLobe, ...]
    facet: Facet | None

    def energies(self, dark: Array) -> tuple[Channels, Channels]:
        """Of all lobes on the side of the light and on the other, added to zeros."""
        lobes = self.reflected, self.transmitted
        near, far = (channels.total([(dark,), *(lobe.energy for lobe in side)]) for side in lobes)
        return near, far

    def shares(self) -> list[Array]:
        """Energies that sampling goes by, mean of the channels."""
        return [channels.mean(lobe.energy) for lobe in (*self.reflected, *self.transmitted)]

    def widths(self) -> tuple[list[Array], list[Array]]:
        """GGX widths, mean of the channels: of those reflected, and of those transmitted."""
        reflected, transmitted = ([self._width(lobe) for lobe in side] for side in (self.reflected, self.transmitted))
        return reflected, transmitted

    def _width(self, lobe: ShapedLobe) -> Array:
        if lobe.alpha is None:
            assert self.facet is not None
            return jnp.asarray(self.facet[0].alpha)
        return bounded(channels.mean(lobe.alpha))


def shaped(stack: Stack, options: Options, cosine: Array, upward: bool) -> Shaped:
    """Lobes of a simplified stack, lit from above, or from below (`upward`). Diffuse bases are left out."""
    cosine = at_least(cosine, GRAZING)
    found = statistics(stack, cosine, options, upward)
    reflected, facet = _returning(found, cosine)
    transmitted, escaping = _passing(stack, found, cosine, upward)
    unscaled = _together(mirror_energy, [*reflected, *transmitted])
    if facet is not None:  # its lobe is the first
        unscaled[0] = _of_facet(*facet, cosine)
    count = len(reflected)
    beyond = [channels.times(energy, share) for energy, share in zip(unscaled[count:], escaping, strict=True)]
    return Shaped(tuple(map(_scaled, reflected, unscaled[:count])), tuple(map(_scaled, transmitted, beyond)), facet)


def _scaled(lobe: _Lobe, unscaled: Channels) -> ShapedLobe:
    scale = each(lambda energy, of: energy / at_least(of, LEAST_ENERGY), lobe.energy, unscaled)
    return ShapedLobe(lobe.energy, scale, lobe.alpha)


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


def _returning(found: Statistics, cosine: Array) -> tuple[list[_Lobe], Facet | None]:
    """The reflected lobes by orders, and the facet that stands for one of them itself, if any does."""
    facet: Facet | None = None
    lobes = []
    for entry in found.reflected:
        for order, energy in enumerate(entry.lobe.energy):
            alpha: Channels | None = None
            if entry.facet is not None and order == 0:
                facet = entry.facet
            else:
                alpha = tuple(map(lobe_roughness, _widened(entry.lobe.variance, entry.spread, order)))
            lobes.append(_Lobe(energy, alpha, cosine))
    return lobes, facet


def _passing(stack: Stack, found: Statistics, cosine: Array, upward: bool) -> tuple[list[_Lobe], list[Channels]]:
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
    lobes: list[_Lobe] = []
    for order, energy in enumerate(found.transmitted.energy):
        if order > 0 or met:
            sigma = _widened(found.transmitted.variance, found.transmitted_spread, order)
            lobes.append(_Lobe(energy, tuple(lobe_roughness(widening * part) for part in sigma), here))
    return lobes, _together(lambda cosine, width: retained_share(cosine, width, leaves / reference), lobes)


def _together(energy: Callable[[Array, Array], Array], lobes: Sequence[_Lobe]) -> list[Channels]:
    """energy(cosine, alpha) of every lobe and channel, at one look; nothing for a lobe that is the facet itself."""
    widths = [(lobe.cosine, width) for lobe in lobes for width in lobe.alpha or ()]
    if not widths:
        return [() for _ in lobes]
    cosines, alphas = (jnp.stack(jnp.broadcast_arrays(*part)) for part in zip(*widths, strict=True))
    values = iter(unstacked(energy(cosines, alphas)))
    return [tuple(next(values) for _ in lobe.alpha or ()) for lobe in lobes]


def _widened(variance: Channels, spread: Channels | None, order: int) -> Channels:
    return variance if spread is None or order == 0 else each(lambda v, s: v + order * s, variance, spread)


def _of_facet(what: Interface | Conductor, relative: Array, smooth: bool, cosine: Array) -> Channels:
    """Energy that the facets of the first interface or base reflect at their first collision."""
    if isinstance(what, Conductor):
        return metal_levels(what, cosine, relative, "single", smooth)
    if smooth:
        return (fresnel.dielectric(cosine, relative),)
    return (single_reflectance(cosine, jnp.asarray(what.alpha), relative),)
