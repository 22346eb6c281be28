"""Teaches the networks of `layerjax.transport.spongecake.mapping` what `layerjax.precompute.spongecake.data` holds.

Media of all kinds are trained together, so their kind is a number here: the lobes are those of the transport, of a
phase function that picks its kind by that number.

Loss of a material: the relative L2 error of its BSDF, first order included (weighted with both cosines; all sides
together, and half of each side by itself), a fifth of that of its multiple scattering alone, and `ENERGY_WEIGHT` times
the error of its directional albedos. The mean of the channels that decides the lobe's shape is drawn at random for half
of the materials, so that a channel may differ from it.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from layerjax.channels import Channels
from layerjax.directions import Vector, split
from layerjax.phase import HenyeyGreenstein, PhaseFunction
from layerjax.precompute.learning import Schedule, learn
from layerjax.precompute.spongecake.data import KINDS, LayerParameters, Samples
from layerjax.stack import Medium
from layerjax.transport.contract import Side
from layerjax.transport.single_scattering import Media, SingleScattering
from layerjax.transport.spongecake.lobes import BlurredSGGX, SecondLobe, evaluate_second
from layerjax.transport.spongecake.mapping import Numbers, Weights, network, shape_of, weights_of

HG = KINDS.index("hg")
ENERGY_WEIGHT = 0.5
"""Weight of errors of albedos in the loss."""

TAIL_WEIGHT = 4.0
"""Weight of the squared error of R + T beside the error itself, for the sake of the few that are far off."""

MULTIPLE_WEIGHT, SIDE_WEIGHT = 0.2, 0.5
"""Weights of the error of multiple scattering alone, and of that of each side by itself."""

SPREAD = 0.2
"""How far mean albedos are drawn from those of the channel, standard deviation; half of it for f0."""


class LobeFeatures(NamedTuple):
    """What the second lobe has beyond the paper's: to measure the gain of each. `by_side`: weights of the two sides."""

    blur: bool = True
    rim: bool = True
    slopes: bool = True
    by_side: bool = True


ALL_PARTS = LobeFeatures()


class Batch(NamedTuple):
    """n materials with k media, s pairs of sides, i directions of light and o of view.

    wi: (n, s, i, 3). wo: (n, s, i, o, 3). values: multiple scattering, (n, s, i, o). first: the first order. size,
    size_multiple: norms of all and of multiple scattering, (n, s).
    """

    media: Numbers
    wi: Array
    wo: Array
    values: Array
    first: Array
    size: Array
    size_multiple: Array


def sides_of(media: int) -> tuple[int, ...]:
    """Pairs of sides that are learned from, by their number: a slab of one medium is the same from below."""
    return (0, 2) if media == 1 else (0, 1, 2)


def batch_of(samples: Samples) -> Batch:
    """The samples with their first order and norms."""
    numbers = numbers_of(samples.layers)
    sides = sides_of(samples.layers.kind.shape[1])
    wi = samples.wi[:, [1 if side == 1 else 0 for side in sides]]
    wo, values = samples.wo[:, sides], samples.values[:, sides]
    first = _map_parts(jax.vmap(_first), (jax.tree.map(jnp.asarray, numbers), wi, wo))
    weight = np.abs(wi[..., 2])[..., None]
    size, multiple = (np.sqrt(np.mean(weight * v * v, (2, 3))) for v in (values + first, values))
    return Batch(numbers, *(cast(Array, array) for array in (wi, wo, values, first, size, multiple)))


def numbers_of(layers: LayerParameters) -> Numbers:
    """The materials as the networks take them, on the host, where rows are picked."""
    kind = layers.kind
    hg = kind == HG
    return Numbers(
        *(
            cast(Array, np.asarray(part, np.float32))
            for part in (
                kind[..., None] == np.arange(len(KINDS)),
                np.where(hg, 1.0, layers.alpha),
                np.where(hg, layers.alpha, 0.0),
                layers.thickness,
                layers.albedo,
                layers.f0,
                layers.axis,
            )
        )
    )


def predict(
    net: eqx.nn.MLP,
    media: Numbers,
    mean_albedo: Array,
    mean_f0: Array,
    wi: Array,
    wo: Array,
    parts: LobeFeatures = ALL_PARTS,
) -> Array:
    """Multiple scattering of one material as the network has it, (s, i, o)."""
    shape = shape_of(net, media._replace(albedo=mean_albedo, f0=mean_f0))
    weights = weights_of(net, media, mean_albedo, mean_f0)
    if not parts.blur:
        shape = shape._replace(blur=jnp.zeros_like(shape.blur))
    if not parts.rim:
        weights = weights._replace(lobes=weights.lobes * jnp.asarray([1.0, 0.0]))
    if not parts.slopes:
        weights = weights._replace(slopes=jnp.zeros_like(weights.slopes), rims=jnp.zeros_like(weights.rims))
    if not parts.by_side:  # those of reflection above for all
        weights = Weights(*(jnp.broadcast_to(part[:1], part.shape) for part in weights))
    slab = _slab(media, shape.alpha, shape.thickness, shape.blur, jnp.ones_like(media.albedo), None)
    second = SecondLobe(slab, jax.tree.map(lambda part: part[None], weights))
    return _values(lambda wi, wo, side: evaluate_second(second, wi, wo, side, False), len(slab.media), wi, wo)


def errors(
    net: eqx.nn.MLP, batch: Batch, parts: LobeFeatures = ALL_PARTS
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Norms of the error for each pair of sides, (n, s), and errors of directional albedos, (n, s, i)."""
    return _map_parts(lambda piece: _errors(net, piece, parts), (batch,))


def train(
    media: int,
    samples: Samples,
    seed: int,
    schedule: Schedule,
    state: Path | None = None,
    report: Callable[[str], Any] = print,
    energy: float = ENERGY_WEIGHT,
    parts: LobeFeatures = ALL_PARTS,
) -> tuple[eqx.nn.MLP, NDArray[np.float32]]:
    """The trained network, and the mean loss of each epoch; the rest as in `layerjax.precompute.learning.learn`."""
    batch = batch_of(samples)

    def drawn(random: np.random.Generator, rows: NDArray[np.int64]) -> tuple[Batch, Array, Array]:
        part = jax.tree.map(lambda array: array[rows], batch)
        return part, *_means(random, part.media)

    def loss(net: eqx.nn.MLP, part: Batch, mean_albedo: Array, mean_f0: Array) -> Array:
        return _loss(net, part, mean_albedo, mean_f0, energy, parts)

    net = network(media, jax.random.key(seed))
    return learn(net, loss, drawn, len(batch.values), [seed, media], schedule, state, report)


def _loss(
    net: eqx.nn.MLP, batch: Batch, mean_albedo: Array, mean_f0: Array, energy: float, parts: LobeFeatures
) -> Array:
    squares, albedos = jax.vmap(functools.partial(_residual, net, parts))(batch, mean_albedo, mean_f0)
    whole, apart = jnp.sum(batch.size**2, -1), batch.size**2
    tiny = 1e-8
    full = jnp.sqrt(jnp.sum(squares, -1) / whole + tiny)
    each = jnp.mean(jnp.sqrt(squares / (apart + 1e-3 * whole[:, None]) + tiny), -1)
    multiple = jnp.sqrt(jnp.sum(squares, -1) / (jnp.sum(batch.size_multiple**2, -1) + 1e-12) + tiny)
    sums = albedos[:, 0] + albedos[:, -1]
    both = jnp.mean(jnp.abs(sums) + TAIL_WEIGHT * sums * sums, -1)
    single = jnp.mean(jnp.abs(albedos), (1, 2))
    return jnp.mean(full + SIDE_WEIGHT * each + MULTIPLE_WEIGHT * multiple + energy * (both + 0.5 * single))


def _residual(
    net: eqx.nn.MLP, parts: LobeFeatures, batch: Batch, mean_albedo: Array, mean_f0: Array
) -> tuple[Array, Array]:
    """Squared norms of the error, (s,), and errors of albedos, (s, i), of one material."""
    error = predict(net, batch.media, mean_albedo, mean_f0, batch.wi, batch.wo, parts) - batch.values
    weight = jnp.abs(batch.wi[..., 2])[..., None]
    return jnp.mean(weight * error * error, (1, 2)), jnp.pi * jnp.mean(error, -1)


@eqx.filter_jit
def _errors(net: eqx.nn.MLP, batch: Batch, parts: LobeFeatures) -> tuple[Array, Array]:
    squares, albedos = jax.vmap(functools.partial(_residual, net, parts))(batch, batch.media.albedo, batch.media.f0)
    return jnp.sqrt(squares), albedos


def _means(random: np.random.Generator, media: Numbers) -> tuple[Array, Array]:
    """Mean albedo and f0 of the channels beside the one that is learned."""
    size = media.albedo.shape
    spread = SPREAD * random.uniform(size=(size[0], 1)) * (random.uniform(size=(size[0], 1)) < 0.5)
    albedo = np.clip(media.albedo + spread * random.standard_normal(size), 0.0, 1.0)
    f0 = np.clip(media.f0 + 0.5 * spread * random.standard_normal(size) * (media.f0 < 1.0), 0.0, 1.0)
    return jnp.asarray(albedo, jnp.float32), jnp.asarray(f0, jnp.float32)


class PhaseOfKind(PhaseFunction):
    """Any of `KINDS`, by a number.

    kind: 1 at its place, 0 elsewhere. alpha: roughness, or g; blur: see `BlurredSGGX`.
    """

    uses_half_vector: ClassVar[bool] = True

    kind: Array
    alpha: Array
    axis: Array
    blur: Array

    def cross_section(self, w: Vector) -> Array:
        return self._choose([phase.cross_section(w) for phase in self._phases()])

    def kernel(self, wi: Vector, wo: Vector, h: Vector | None) -> Array:
        return self._choose([phase.kernel(wi, wo, h) for phase in self._phases()])

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        return self.kernel(wi, wo, None) / self.cross_section(wi)

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        drawn = [phase.sample(wi, u1, u2) for phase in self._phases()]
        x, y, z = (self._choose(list(part)) for part in zip(*drawn, strict=True))
        return x, y, z

    def _phases(self) -> list[PhaseFunction]:
        """In the order of `KINDS`; those that are not chosen are isotropic, and finite with their derivatives."""
        hg = self.kind[HG] > 0
        width, g = jnp.where(hg, 1.0, self.alpha), jnp.where(hg, self.alpha, 0.0)
        flakes = (BlurredSGGX(kind, width, self.axis, self.blur) for kind in ("surface", "fiber"))
        return [*flakes, HenyeyGreenstein(g)]

    def _choose(self, values: list[Array]) -> Array:
        return functools.reduce(lambda other, k: jnp.where(self.kind[k] > 0, values[k], other), range(HG), values[HG])


def _first(media: Numbers, wi: Array, wo: Array) -> Array:
    """Single scattering of one material, (s, i, o)."""
    alpha = jnp.where(media.kind[:, HG] > 0, media.g, media.alpha)
    slab = _slab(media, alpha, media.thickness, jnp.zeros_like(alpha), media.albedo, media.f0)
    first = SingleScattering()
    return _values(lambda wi, wo, side: first.evaluate(slab, wi, wo, side), len(slab.media), wi, wo)


def _slab(media: Numbers, alpha: Array, thickness: Array, blur: Array, albedo: Array, f0: Array | None) -> Media:
    """Media of the same kinds and axes, with other numbers; f0 None: no Fresnel term."""
    phases = [PhaseOfKind(*numbers) for numbers in zip(media.kind, alpha, media.axis, blur, strict=True)]
    levels = [None] * len(phases) if f0 is None else list(f0)
    return Media(tuple(map(Medium, thickness, albedo, phases, levels)), None)


def _values(values: Callable[[Vector, Vector, Side], Channels], media: int, wi: Array, wo: Array) -> Array:
    """Values of the only channel for each pair of sides, (s, i, o). wi: (s, i, 3). wo: (s, i, o, 3)."""
    sides: tuple[Side, ...] = ("reflection", "all", "transmission")  # from below there is nothing less than all
    pairs = [(split(wi[n, :, None]), split(wo[n]), sides[side]) for n, side in enumerate(sides_of(media))]
    return jnp.stack([values(*pair)[0] for pair in pairs])


def _map_parts(work: Callable[..., Any], arguments: tuple[Any, ...], size: int = 256) -> Any:
    """work on parts of a batch, put together again."""
    count = len(jax.tree.leaves(arguments)[0])
    run = eqx.filter_jit(work)
    parts = [run(*jax.tree.map(lambda a, n=n: a[n : n + size], arguments)) for n in range(0, count, size)]
    return jax.tree.map(lambda *pieces: np.concatenate(pieces), *parts)
