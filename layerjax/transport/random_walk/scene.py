"""A stack as the walk sees it: tables of media, regions between interfaces, and positions in depth.

What is fixed while tracing (which layers there are, which of them share a phase function) is Python; what differs from
walker to walker is chosen by index among the few layers. A position is (layer, depth): `depth` in [0, 1] is the share
of that medium that lies above it. Keeping the layer apart keeps the digits of a position in a thin layer under thick
ones.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax.channels import Channels, per_channel, pick
from layerjax.directions import Vector, add, combine, dot, frame, half_vector, scale, select
from layerjax.phase import PhaseFunction
from layerjax.stack import Interface, Stack, is_known, media_of
from layerjax.surfaces import Conductor
from layerjax.surfaces.thin_film import BARE, Films, films_of
from layerjax.transport.random_walk.random_numbers import circle


def choose(index: Array | None, values: Sequence[Any]) -> Any:
    """The value with that index, walker by walker; None is index 0 of a table of one."""
    result = values[0]
    for j, value in enumerate(values[1:], 1):
        result = jnp.where(index == j, value, result)
    return result


class Scene:
    """Tables of a stack, built while tracing.

    Attributes:
        regions: number of regions, one more than interfaces. Region r lies under interface r - 1 and over interface r.
        surfaces: number of surfaces; interface i is surface i, the base comes last.
        levels: for each surface, the number of media above it.
        places: place of every interface among the layers. is_smooth: whether it is. is_mirrored: any surface is smooth.
        channels: number of channels of the walk.
        colored_depths: whether the channels differ in optical depth.
    """

    def __init__(self, stack: Stack, channels: int, dtype: jnp.dtype):
        self.dtype = dtype
        self.channels = channels
        self.media = media_of(stack)
        self.interfaces = [layer for layer in stack.layers if isinstance(layer, Interface)]
        self.base = stack.base
        self.stack = stack
        self.places = [place for place, layer in enumerate(stack.layers) if isinstance(layer, Interface)]
        self.is_smooth = [interface.is_smooth for interface in self.interfaces]
        self.is_mirrored = any(self.is_smooth) or (isinstance(stack.base, Conductor) and stack.base.is_smooth)
        self.regions = len(self.interfaces) + 1
        self.surfaces = len(self.interfaces) + (self.base is not None)
        self.levels: list[int] = []
        self.region_of: list[int] = []
        for layer in stack.layers:
            if isinstance(layer, Interface):
                self.levels.append(len(self.region_of))
            else:
                self.region_of.append(len(self.levels))
        if self.base is not None:
            self.levels.append(len(self.media))
        one = jnp.ones((), dtype)
        self.indices = [one, *(interface.ior for interface in self.interfaces)]
        self.thickness = [per_channel(medium.thickness) for medium in self.media]
        self.colored_depths = any(len(thickness) > 1 for thickness in self.thickness)
        self.groups = _groups([medium.phase for medium in self.media])

    # positions

    def fractions(self, layer: Array | int | None, depth: Array | float) -> list[Any]:
        """Share of each medium that lies above a position."""
        if layer is None:
            return [depth]
        return [jnp.where(layer > j, 1.0, jnp.where(layer == j, depth, 0.0)) for j in range(len(self.media))]

    def rates(self, w: Vector) -> list[Array]:
        """Extinction of each medium along w for a thickness of 1 and all of its depth, sigma(w) / |cos|."""
        inverse = 1.0 / jnp.maximum(jnp.abs(w[2]), jnp.finfo(self.dtype).tiny * 1e4)
        return [medium.phase.cross_section(w) * inverse for medium in self.media]

    def transmittance(self, crossed: Sequence[Array], rates: Sequence[Array]) -> Channels:
        """Share that passes through the given shares of the media, a channel each if they differ."""
        count = self.channels if self.colored_depths else 1
        depths = [
            sum(
                (share * (rate * pick(tau, c)) for share, rate, tau in zip(crossed, rates, self.thickness, strict=True))
            )
            for c in range(count)
        ]
        return tuple(jnp.exp(-depth) for depth in depths)

    # collisions

    def cross_section(self, medium: Array | None, w: Vector) -> Array:
        """Extinction of a medium along w per unit of thickness."""
        return choose(medium, [layer.phase.cross_section(w) for layer in self.media])

    def collide(self, medium: Array | None, wi: Vector, wo: Vector, areas: Array) -> tuple[Array, Channels]:
        """Phase function p(wi, wo), 1/sr, and the share that a collision from wi to wo keeps."""
        density = jnp.zeros_like(wi[2])
        shared = any(medium.phase.uses_half_vector for medium in self.media)
        half = half_vector(wi, wo) if shared or self._fresnel() else None
        for members, phase in self._merge_media(medium):
            if phase.uses_half_vector and half is not None:
                value = phase.kernel(wi, wo, half[0]) / areas
            else:
                value = phase.pdf(wi, wo)
            density = value if len(self.groups) == 1 else jnp.where(_is_in(medium, members), value, density)
        return density, self._scattered_share(medium, half[1] if half is not None else None)

    def deflect(self, medium: Array | None, wi: Vector, u1: Array, u2: Array) -> tuple[Vector, Channels]:
        """A direction drawn from the phase function, and the share that is kept."""
        wo: Vector = wi
        for members, phase in self._merge_media(medium):
            deflection = phase.deflection(u1)
            drawn = phase.sample(wi, u1, u2) if deflection is None else _deflect(wi, *deflection, u2)
            wo = drawn if len(self.groups) == 1 else select(_is_in(medium, members), drawn, wo)
        if not self._fresnel():
            return wo, self._scattered_share(medium, None)
        # |wi . h| of the pair: h is the flake's normal, along wi + wo
        return wo, self._scattered_share(medium, jnp.sqrt(jnp.maximum(0.5 + 0.5 * dot(wi, wo), 0.0)))

    @property
    def lossless(self) -> bool:
        """Whether no collision absorbs, as far as is known while tracing."""
        return all(is_known(medium.albedo, 1.0) for medium in self.media) and not self._fresnel()

    def _fresnel(self) -> bool:
        return any(medium.f0 is not None for medium in self.media)

    def _scattered_share(self, medium: Array | None, cosine: Array | None) -> Channels:
        shares = []
        for c in range(self.channels):
            albedos = [m.albedo if isinstance(m.albedo, float) else pick(per_channel(m.albedo), c) for m in self.media]
            share = choose(medium, albedos)
            if cosine is not None and self._fresnel():
                levels = [1.0 if m.f0 is None else m.f0 for m in self.media]
                f0 = choose(medium, [x if isinstance(x, float) else pick(per_channel(x), c) for x in levels])
                share = share * fresnel.schlick(cosine, f0)
            shares.append(jnp.asarray(share, self.dtype))
        return tuple(shares)

    def _merge_media(self, medium: Array | None) -> list[tuple[list[int], PhaseFunction]]:
        return [(members, _merge(medium, members, self.media)) for members in self.groups]

    # surfaces

    def surface_ior(self, surface: Array | None, from_above: Array) -> Array:
        """Index on the far side of an interface over the one that light arrives in."""
        below = choose(surface, [b for _, b in pairwise(self.indices)])
        above = choose(surface, [a for a, _ in pairwise(self.indices)])
        return jnp.where(from_above, below, above) / jnp.where(from_above, above, below)

    @property
    def film_channels(self) -> int:
        """Number of channels of what films reflect, 1 if there are none."""
        return self.channels if any(interface.film is not None for interface in self.interfaces) else 1

    def films(self, surface: Array | None, from_above: Array) -> Films:
        """Films of an interface, one a channel, as seen from the side that light arrives from; where only others have
        one, films without thickness."""
        if all(interface.film is None for interface in self.interfaces):
            return BARE
        here = jnp.where(
            from_above,
            choose(surface, [above for above, _ in pairwise(self.indices)]),
            choose(surface, [below for _, below in pairwise(self.indices)]),
        )
        one, zero = jnp.ones((), self.dtype), jnp.zeros((), self.dtype)

        def film(c: int) -> fresnel.Film:
            found = [pick(films_of(interface.film), c) or fresnel.Film(one, zero) for interface in self.interfaces]
            iors, phases = zip(*found, strict=True)
            return fresnel.Film(choose(surface, iors), choose(surface, phases)).seen_from(here)

        return tuple(map(film, range(self.channels)))


def _deflect(wi: Vector, cosine: Array, sine: Array, u2: Array) -> Vector:
    """`layerjax.phase.contract.deflect`, with the azimuth from a polynomial: the innermost work of most walks."""
    axis = scale(-1.0, wi)
    tangent, bitangent = frame(axis)
    c, s = circle(u2)
    x, y, cosine = jax.lax.optimization_barrier((sine * c, sine * s, cosine))
    return add(combine(x, tangent, y, bitangent), scale(cosine, axis))


def _groups(phases: Sequence[PhaseFunction]) -> list[list[int]]:
    """Media by kind of phase function: the members of a group differ in numbers alone and share their arithmetic."""
    groups: dict[Any, list[int]] = {}
    for j, phase in enumerate(phases):
        leaves, structure = jax.tree.flatten(phase)
        groups.setdefault((structure, *map(jnp.shape, leaves)), []).append(j)
    return list(groups.values())


def _merge(medium: Array | None, members: Sequence[int], media: Sequence[Any]) -> PhaseFunction:
    """One phase function whose parameters are those of the medium that each walker is in."""
    phases = [media[j].phase for j in members]
    if len(phases) == 1:
        return phases[0]
    assert medium is not None

    def pick_leaf(*leaves: Array) -> Array:
        result = leaves[0]
        for j, leaf in zip(members[1:], leaves[1:], strict=True):
            chosen = jnp.reshape(medium == j, (-1, *(1,) * jnp.ndim(leaf))) if jnp.ndim(leaf) else medium == j
            result = jnp.where(chosen, leaf, result)
        return result

    return jax.tree.map(pick_leaf, *phases)


def _is_in(medium: Array | None, members: Sequence[int]) -> Array:
    assert medium is not None
    found = medium == members[0]
    for j in members[1:]:
        found = found | (medium == j)
    return found
