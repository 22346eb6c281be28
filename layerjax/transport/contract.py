"""The contract that every transport keeps, and its two halves: deterministic transports and random ones.

`Transport` is what the public calls of `layerjax.evaluate` go by. A transport derives from one of the halves, which
turn batches of directions into what its own functions take: `DeterministicTransport` asks for values in closed form,
`RandomTransport` for means of draws with their standard errors.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from layerjax._batching import chunk_factor, map_direction_chunks
from layerjax._checks import require_key
from layerjax._numerics import safe_div
from layerjax.channels import Channels, pick
from layerjax.directions import UNIT_SLACK, Vector, dot, horizontal, select, split
from layerjax.stack import Interface, Stack
from layerjax.surfaces import Conductor
from layerjax.transport.known_directions import DirectionLookup, KnownPairs

Side = Literal["all", "reflection", "transmission"]
"""Requested pairs: any; both directions above; one above and one below. Others give 0."""

Uniforms = tuple[Array, Array, Array]


class Draws(NamedTuple):
    """Outgoing directions ``(..., 3)``, their densities ``(...)`` (of a delta the probability), weights ``(..., C)``,
    and whether each is along a delta ``(...)``."""

    wo: Array
    density: Array
    weight: Array
    specular: Array


TEXELS = 2000
"""Of a map of stacks, worked on together where a stack costs a few numbers: what they need stays in the cache.

No power of 2: arrays of 2048 numbers get into each other's way in it, and gradients take twice as long."""


class Transport(eqx.Module):
    """Base class of transports; options are static fields.

    Directions are components that are broadcast against each other; results are one array per channel. `state` is what
    `prepare` returned: a pytree of arrays with everything that does not depend on direction.

    `evaluate_batch`, `sample_batch` and `albedo_batch` take whole batches instead, arrays ``(..., 3)``, with a `key`
    that `resolve_key` made of the user's. They are defined by the two subclasses for deterministic and random
    transports.
    """

    random: ClassVar[bool]
    """Whether values are drawn at random, with a key."""

    uses_known_directions: ClassVar[bool] = False
    """Whether `prepare_for_directions` makes use of known directions."""

    uses_known_pairs: ClassVar[bool] = False
    """Whether `with_known_pairs` makes use of them."""

    texel_batch: ClassVar[int] = 1
    """How many texels of a map of stacks are computed together; `TEXELS` for stacks of a few numbers."""

    def texel_batch_size(self, stack: Stack) -> int:
        """How many texels of a map of this (simplified) stack are computed together."""
        return self.texel_batch

    @abc.abstractmethod
    def check(self, stack: Stack, names: Sequence[str]) -> None:
        """Raise a ValueError that names the first layer or base of a simplified stack that is not supported.

        names: what the user calls the layers, such as ``layers[2]`` (see `layerjax.stack.simplify_and_name`).
        """

    @abc.abstractmethod
    def prepare(self, stack: Stack) -> Any:
        """Precompute everything that does not depend on direction, for a simplified stack."""

    def resolve_options(self, stack: Stack, known: DirectionLookup) -> "Transport":
        """The same transport, with open options chosen for a simplified stack and known directions."""
        return self

    def resolve_options_for_albedo(self, stack: Stack) -> "Transport":
        """Like `resolve_options`, for energies only, for which narrow lobes do not need a finer resolution."""
        return self.resolve_options(stack, lambda: None)

    def prepare_for_directions(self, stack: Stack, known: DirectionLookup) -> Any:
        """Like `prepare`, for values at known directions only."""
        return self.prepare(stack)

    def with_known_pairs(self, state: Any, pairs: KnownPairs) -> Any:
        """What `prepare` returned, for values of just these pairs of directions."""
        return state

    def traceable_equivalent(self, stack: Stack, known: DirectionLookup) -> "Transport | None":
        """A transport with the same values, and with forward derivatives, inside a program where all parameters of the
        simplified stack are traced; None if there is none. Directions are known, and so is the stack except for the
        parameters by which it is differentiated."""
        return None

    def prepare_for_albedo(self, stack: Stack) -> Any:
        """Like `prepare`, for `albedo_batch` only."""
        return self.prepare(stack)

    @abc.abstractmethod
    def sample(self, state: Any, wi: Vector, uniforms: Uniforms) -> Vector:
        """Outgoing directions from three uniform numbers each."""

    @abc.abstractmethod
    def pdf(self, state: Any, wi: Vector, wo: Vector) -> Array:
        """Density of `sample` in solid angle, 1/sr."""

    @abc.abstractmethod
    def resolve_key(self, key: Array | None, function: str) -> Array | None:
        """The key, or None for a deterministic transport. ValueError for `function` if it is missing."""

    @abc.abstractmethod
    def comparison_transports(self) -> "Sequence[Transport] | None":
        """Transports for an error estimate; None if `evaluate_batch` returns errors. ValueError: there is none."""

    @abc.abstractmethod
    def evaluate_batch(
        self, state: Any, wi: Array, wo: Array, side: Side, channels: int, key: Array | None
    ) -> tuple[Array, Array | None]:
        """Values ``(..., C)`` of the BSDF in 1/sr, without the cosine, and their errors, or None."""

    def common_error(self, state: Any, wi: Array, wo: Array, side: Side, channels: int) -> Array | float:
        """Further error of values ``(..., C)`` that all resolutions share, for example where they are clamped to 0."""
        return 0.0

    def specular_draws(self, state: Any, wi: Vector, uniforms: Uniforms) -> tuple[Array, Array, Channels] | None:
        """Which draws of `sample` are along a delta, the probability of such a draw, and the energy of the delta; None
        if there are no deltas."""
        return None

    @abc.abstractmethod
    def sample_batch(self, state: Any, wi: Array, channels: int, key: Array) -> Draws:
        """Draws for each wi."""

    @abc.abstractmethod
    def albedo_batch(self, state: Any, wi: Array, channels: int, nodes: int, key: Array | None) -> tuple[Array, Array]:
        """Scattered energy ``(..., C)`` that leaves on wi's side and on the other, for unit irradiance."""

    def coarser(self) -> "Transport | None":
        """The same transport at a lower resolution, to estimate the error from the difference; None if it has none."""
        return None

    def finer(self) -> "Transport | None":
        """The same transport at a higher resolution; None if it has none."""
        return None

    def _sample_with_density(self, state: Any, wi: Vector, uniforms: Uniforms) -> tuple[Vector, Array]:
        """Directions drawn, and their densities.

        What leaves nowhere may be no unit vector: it becomes a direction in the tangent plane, where the BSDF is 0.
        """
        drawn = self.sample(state, wi, uniforms)
        left = jnp.abs(dot(drawn, drawn) - 1.0) < UNIT_SLACK
        wo = select(left, drawn, horizontal(drawn))
        return wo, jnp.where(left, self.pdf(state, wi, wo), 0.0)


class DeterministicTransport(Transport):
    """A transport whose values are in closed form, or interpolated from what `prepare` has solved."""

    random: ClassVar[bool] = False

    @abc.abstractmethod
    def evaluate(self, state: Any, wi: Vector, wo: Vector, side: Side) -> Channels:
        """BSDF values in 1/sr, without the cosine."""

    @abc.abstractmethod
    def albedo(self, state: Any, wi: Vector, nodes: int) -> tuple[Channels, Channels]:
        """Scattered energy that leaves on wi's side and on the other, for unit irradiance."""

    def resolve_key(self, key: Array | None, function: str) -> None:
        if key is not None:
            require_key(key)

    def comparison_transports(self) -> "Sequence[Transport]":
        coarser = self.coarser()
        if coarser is None:
            name = type(self).__name__
            raise ValueError(f"transport: {name} has no resolution to vary and no standard error: evaluate_with_error")
        return [coarser]

    def evaluate_batch(
        self, state: Any, wi: Array, wo: Array, side: Side, channels: int, key: Array | None
    ) -> tuple[Array, None]:
        def values(wi: Vector, wo: Vector) -> Channels:
            found = self.evaluate(state, wi, wo, side)
            return tuple(pick(found, c) for c in range(channels))

        return map_direction_chunks(values, wi, wo), None

    def sample_batch(self, state: Any, wi: Array, channels: int, key: Array) -> Draws:
        def draw(wi: Vector, uniforms: Vector) -> tuple[Array, ...]:
            wo, density = self._sample_with_density(state, wi, uniforms)
            values = self.evaluate(state, wi, wo, "all")
            weights = [safe_div(pick(values, c) * jnp.abs(wo[2]), density) for c in range(channels)]
            deltas = self.specular_draws(state, wi, uniforms)
            if deltas is None:
                return (*wo, density, *weights)
            along, probability, energies = deltas
            density = jnp.where(along, probability, density)
            weights = [
                jnp.where(along, safe_div(pick(energies, c), probability), weight) for c, weight in enumerate(weights)
            ]
            return (*wo, density, *weights, along.astype(density.dtype))

        found = map_direction_chunks(draw, wi, jax.random.uniform(key, wi.shape, dtype=wi.dtype))
        along = jnp.zeros(found.shape[:-1], bool) if found.shape[-1] == 4 + channels else found[..., -1] > 0
        return Draws(found[..., :3], found[..., 3], found[..., 4 : 4 + channels], along)

    def albedo_batch(self, state: Any, wi: Array, channels: int, nodes: int, key: Array | None) -> tuple[Array, Array]:
        def one(wi: Array) -> tuple[Array, Array]:
            sides = self.albedo(state, split(wi), nodes)
            near, far = (jnp.stack([pick(side, c) for c in range(channels)], axis=-1) for side in sides)
            return near, far

        batch = wi.shape[:-1]
        if 0 in batch:
            return (jnp.zeros((*batch, channels), wi.dtype),) * 2
        near, far = jax.lax.map(one, wi.reshape(-1, 3), batch_size=chunk_factor() if chunk_factor() > 1 else None)
        return near.reshape(*batch, -1), far.reshape(*batch, -1)


class RandomTransport(Transport):
    """A transport by Monte Carlo: it takes a key, and also returns standard errors."""

    random: ClassVar[bool] = True

    @abc.abstractmethod
    def estimate(
        self, state: Any, wi: Vector, wo: Vector, side: Side, channels: int, key: Array
    ) -> tuple[Array, Array]:
        """Values of n pairs and their standard errors, shape (n, channels) each."""

    @abc.abstractmethod
    def estimate_albedo(self, state: Any, wi: Vector, channels: int, key: Array) -> tuple[Array, Array]:
        """Shares scattered to wi's side, then to the other, and standard errors: (n, 2 channels) each."""

    def resolve_key(self, key: Array | None, function: str) -> Array:
        if key is None:
            name = type(self).__name__
            raise ValueError(f"key: {name} draws random numbers: {function}(..., key=jax.random.key(seed))")
        require_key(key)
        return key

    def comparison_transports(self) -> None:
        return None

    def evaluate_batch(
        self, state: Any, wi: Array, wo: Array, side: Side, channels: int, key: Array | None
    ) -> tuple[Array, Array]:
        batch = jnp.broadcast_shapes(wi.shape, wo.shape)[:-1]
        if 0 in batch:
            return (jnp.zeros((*batch, channels), wi.dtype),) * 2
        i, o = (split(jnp.broadcast_to(w, (*batch, 3)).reshape(-1, 3)) for w in (wi, wo))
        assert key is not None
        values, errors = self.estimate(state, i, o, side, channels, key)
        return values.reshape(*batch, -1), errors.reshape(*batch, -1)

    def sample_batch(self, state: Any, wi: Array, channels: int, key: Array) -> Draws:
        def draw(wi: Vector, uniforms: Vector) -> tuple[Array, ...]:
            wo, density = self._sample_with_density(state, wi, uniforms)
            deltas = self.specular_draws(state, wi, uniforms)
            if deltas is None:
                return (*wo, density)
            along, probability, energies = deltas
            parts = [safe_div(pick(energies, c), probability) for c in range(channels)]
            return (*wo, jnp.where(along, probability, density), along.astype(density.dtype), *parts)

        found = map_direction_chunks(draw, wi, jax.random.uniform(key, wi.shape, dtype=wi.dtype))
        wo, density = found[..., :3], found[..., 3]
        values, _ = self.evaluate_batch(state, wi, wo, "all", channels, jax.random.fold_in(key, 1))
        weight = safe_div(values * jnp.abs(wo[..., 2:]), density[..., None])
        if found.shape[-1] == 4:
            return Draws(wo, density, weight, jnp.zeros(density.shape, bool))
        along = found[..., 4] > 0
        return Draws(wo, density, jnp.where(along[..., None], found[..., 5:], weight), along)

    def albedo_batch(self, state: Any, wi: Array, channels: int, nodes: int, key: Array | None) -> tuple[Array, Array]:
        batch = wi.shape[:-1]
        if 0 in batch:
            return (jnp.zeros((*batch, channels), wi.dtype),) * 2
        assert key is not None
        found, _ = self.estimate_albedo(state, split(wi.reshape(-1, 3)), channels, key)
        near, far = jnp.split(found, 2, axis=-1)
        return near.reshape(*batch, -1), far.reshape(*batch, -1)


def refuse_film(stack: Stack, names: Sequence[str], transport: str) -> None:
    """Raise a ValueError for a thin film, on behalf of a transport that takes interfaces and metals from tables."""
    refuse_interface_film(stack, names, transport)
    if isinstance(stack.base, Conductor) and stack.base.film is not None:
        raise ValueError(
            f"base.film: {transport} carries no ThinFilm; AddingDoubling, RandomWalk, SingleScattering, SpongeCake and "
            "WeidlichWilkie do"
        )


def refuse_interface_film(stack: Stack, names: Sequence[str], transport: str, *, rough_only: bool = False) -> None:
    """Raise a ValueError that names the first (rough) interface with a thin film, on behalf of a transport without
    them."""
    for name, layer in zip(names, stack.layers, strict=True):
        if isinstance(layer, Interface) and layer.film is not None and not (rough_only and layer.is_smooth):
            raise ValueError(
                f"{name}.film: {transport} carries no ThinFilm on {'a rough' if rough_only else 'an'} Interface; "
                "AddingDoubling and RandomWalk with facet_multiple_scattering=False do"
            )


def refuse_smooth(stack: Stack, names: Sequence[str], transport: str) -> None:
    """Raise a ValueError that names the first smooth interface or mirror, on behalf of a transport without them."""
    for name, part in [*zip(names, stack.layers, strict=True), ("base", stack.base)]:
        if isinstance(part, Interface | Conductor) and part.is_smooth:
            raise ValueError(
                f"{name}.alpha: {transport} carries no smooth {type(part).__name__} (give alpha, in [0.0001, 1]); "
                "AddingDoubling, RandomWalk and Statistical do"
            )


def refuse_anisotropic(stack: Stack, names: Sequence[str], transport: str) -> None:
    """Raise a ValueError that names the first facets of two widths, on behalf of a transport without them."""
    for name, part in [*zip(names, stack.layers, strict=True), ("base", stack.base)]:
        if isinstance(part, Interface | Conductor) and part.is_anisotropic:
            raise ValueError(
                f"{name}.alpha_y: {transport} carries no facets of two widths; AddingDoubling and RandomWalk with "
                "facet_multiple_scattering=False do, Statistical for GGX normals, and of a bare or hazy metal "
                "SingleScattering and SpongeCake"
            )


def require_ggx(stack: Stack, names: Sequence[str], transport: str) -> None:
    """Raise a ValueError that names the first facets that are not GGX of one width, on behalf of a transport without
    others."""
    refuse_anisotropic(stack, names, transport)
    refuse_other_normals(stack, names, transport)


def refuse_other_normals(stack: Stack, names: Sequence[str], transport: str) -> None:
    """Raise a ValueError that names the first facets that are not GGX, on behalf of a transport without others."""
    for name, part in [*zip(names, stack.layers, strict=True), ("base", stack.base)]:
        if isinstance(part, Interface | Conductor) and part.distribution != "ggx":
            by_endf = part.distribution == "beckmann" and not part.is_anisotropic
            others = ", and ENDF for metals, coated metals and slabs" if by_endf else ""
            raise ValueError(
                f'{name}.distribution: {transport} carries no "{part.distribution}" normals; AddingDoubling and '
                f"RandomWalk with facet_multiple_scattering=False do{others}"
            )


def refuse_student(stack: Stack, names: Sequence[str], transport: str) -> None:
    """Raise a ValueError that names the first facets of Student-t slopes, on behalf of a transport that carries normals
    by their width alone."""
    for name, part in [*zip(names, stack.layers, strict=True), ("base", stack.base)]:
        if isinstance(part, Interface | Conductor) and part.distribution == "gtr":
            raise ValueError(
                f'{name}.distribution: {transport} carries no "gtr" normals; AddingDoubling and RandomWalk with '
                "facet_multiple_scattering=False do"
            )
