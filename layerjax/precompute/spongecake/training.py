"""Teaches the networks of `layerjax.transport.spongecake.mapping` what `layerjax.precompute.spongecake.data` holds.

Media of all kinds are trained together, so their kind is a number here, and the lobes are written out once more for
that; a test holds them against those of the transport.

Loss of a material: the relative L2 error of its BSDF, first order included (weighted with both cosines; all sides
together, and half of each side by itself), a fifth of that of its multiple scattering alone, and `ENERGY` times the
error of its directional albedos. The mean of the channels that decides the lobe's shape is drawn at random for half of
the materials, so that a channel may differ from it.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from layerjax.precompute.learning import Schedule, learn
from layerjax.precompute.spongecake.data import KINDS, Layers, Samples
from layerjax.transport.spongecake.mapping import Numbers, Shape, Weights, network, shape_of, weights_of

HG = KINDS.index("hg")
ENERGY = 0.5
"""Weight of errors of albedos in the loss."""

FAR = 4.0
"""Weight of the squared error of R + T beside the error itself, for the sake of the few that are far off."""

MULTIPLE, APART = 0.2, 0.5
"""Weights of the error of multiple scattering alone, and of that of each side by itself."""

SPREAD = 0.2
"""How far mean albedos are drawn from those of the channel, standard deviation; half of it for f0."""


class Parts(NamedTuple):
    """What the second lobe has beyond the paper's: to show what each is worth. `apart`: weights of the two sides."""

    blur: bool = True
    rim: bool = True
    slopes: bool = True
    apart: bool = True


ALL_PARTS = Parts()


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
    first = _in_parts(jax.vmap(_first), (jax.tree.map(jnp.asarray, numbers), wi, wo))
    weight = np.abs(wi[..., 2])[..., None]
    size, multiple = (np.sqrt(np.mean(weight * v * v, (2, 3))) for v in (values + first, values))
    return Batch(numbers, *(cast(Array, array) for array in (wi, wo, values, first, size, multiple)))


def numbers_of(layers: Layers) -> Numbers:
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
    parts: Parts = ALL_PARTS,
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
    if not parts.apart:  # those of reflection above for all
        weights = Weights(*(jnp.broadcast_to(part[:1], part.shape) for part in weights))
    sides = sides_of(len(media.thickness))
    return jnp.stack([_second(media, shape, weights, side, wi[n], wo[n]) for n, side in enumerate(sides)])


def errors(net: eqx.nn.MLP, batch: Batch, parts: Parts = ALL_PARTS) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Norms of the error for each pair of sides, (n, s), and errors of directional albedos, (n, s, i)."""
    return _in_parts(lambda piece: _errors(net, piece, parts), (batch,))


def train(
    media: int,
    samples: Samples,
    seed: int,
    schedule: Schedule,
    state: Path | None = None,
    report: Callable[[str], Any] = print,
    energy: float = ENERGY,
    parts: Parts = ALL_PARTS,
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


def _loss(net: eqx.nn.MLP, batch: Batch, mean_albedo: Array, mean_f0: Array, energy: float, parts: Parts) -> Array:
    squares, albedos = jax.vmap(functools.partial(_residual, net, parts))(batch, mean_albedo, mean_f0)
    whole, apart = jnp.sum(batch.size**2, -1), batch.size**2
    tiny = 1e-8
    full = jnp.sqrt(jnp.sum(squares, -1) / whole + tiny)
    each = jnp.mean(jnp.sqrt(squares / (apart + 1e-3 * whole[:, None]) + tiny), -1)
    multiple = jnp.sqrt(jnp.sum(squares, -1) / (jnp.sum(batch.size_multiple**2, -1) + 1e-12) + tiny)
    sums = albedos[:, 0] + albedos[:, -1]
    both = jnp.mean(jnp.abs(sums) + FAR * sums * sums, -1)
    single = jnp.mean(jnp.abs(albedos), (1, 2))
    return jnp.mean(full + APART * each + MULTIPLE * multiple + energy * (both + 0.5 * single))


def _residual(net: eqx.nn.MLP, parts: Parts, batch: Batch, mean_albedo: Array, mean_f0: Array) -> tuple[Array, Array]:
    """Squared norms of the error, (s,), and errors of albedos, (s, i), of one material."""
    error = predict(net, batch.media, mean_albedo, mean_f0, batch.wi, batch.wo, parts) - batch.values
    weight = jnp.abs(batch.wi[..., 2])[..., None]
    return jnp.mean(weight * error * error, (1, 2)), jnp.pi * jnp.mean(error, -1)


@eqx.filter_jit
def _errors(net: eqx.nn.MLP, batch: Batch, parts: Parts) -> tuple[Array, Array]:
    squares, albedos = jax.vmap(functools.partial(_residual, net, parts))(batch, batch.media.albedo, batch.media.f0)
    return jnp.sqrt(squares), albedos


def _means(random: np.random.Generator, media: Numbers) -> tuple[Array, Array]:
    """Mean albedo and f0 of the channels beside the one that is learned."""
    size = media.albedo.shape
    spread = SPREAD * random.uniform(size=(size[0], 1)) * (random.uniform(size=(size[0], 1)) < 0.5)
    albedo = np.clip(media.albedo + spread * random.standard_normal(size), 0.0, 1.0)
    f0 = np.clip(media.f0 + 0.5 * spread * random.standard_normal(size) * (media.f0 < 1.0), 0.0, 1.0)
    return jnp.asarray(albedo, jnp.float32), jnp.asarray(f0, jnp.float32)


def _first(media: Numbers, wi: Array, wo: Array) -> Array:
    """Single scattering of one material, (s, i, o)."""
    kind_alpha = jnp.where(media.kind[:, HG] > 0, media.g, media.alpha)
    shape = Shape(kind_alpha, media.thickness, jnp.zeros_like(media.thickness))
    strength = media.albedo[:, None] * jnp.stack([media.f0, 1.0 - media.f0], -1)
    weights = Weights(jnp.stack([strength] * 3), jnp.zeros(3), *[jnp.zeros((2, 2))] * 2)
    sides = sides_of(len(media.thickness))
    return jnp.stack([_second(media, shape, weights, side, wi[n], wo[n]) for n, side in enumerate(sides)])


def _second(media: Numbers, shape: Shape, weights: Weights, side: int, wi: Array, wo: Array) -> Array:
    """The lobes and the level for one pair of sides; wi (i, 3), wo (i, o, 3)."""
    wi = jnp.broadcast_to(wi[:, None], wo.shape)
    ci, co = jnp.abs(wi[..., 2]), jnp.abs(wo[..., 2])
    total = wi + wo
    squared = jnp.sum(total * total, -1)
    schlick = (1.0 - 0.5 * jnp.sqrt(squared + 1e-9)) ** 5
    depths = [
        [_area(media, shape, k, w) * shape.thickness[k] / jnp.abs(w[..., 2]) for w in (wi, wo)] for k in _media(media)
    ]
    way = int(side == 2)
    ends = [(weights.slopes[way, end], weights.rims[way, end]) for end in ((0, 0), (1, 1), (0, 1))[side]]
    value, rim = weights.levels[side], jnp.ones_like(ci)
    for (slope, steep), cosine in zip(ends, (ci, co), strict=True):
        value = value * (1.0 + slope * (1.0 - cosine))
        rim = rim * (1.0 + steep * (1.0 - cosine) ** 4)
    for k in _media(media):
        over_i, over_o = (
            sum((depths[j][which] for j in _media(media) if (j < k if up else j > k)), jnp.zeros_like(ci))
            for which, up in ((0, side != 1), (1, side == 0))
        )
        into, out = depths[k]
        same, apart = into + out, jnp.abs(into - out)
        y = jnp.maximum(apart if side == 2 else same, 1e-4)
        start = jnp.minimum(into, out) if side == 2 else 0.0
        gain = shape.thickness[k] / (ci * co) * jnp.exp(-start - over_i - over_o) * -jnp.expm1(-y) / y
        plain, edge = weights.lobes[side, k]
        value = value + rim * (plain + edge * schlick) * gain * _kernel(media, shape, k, total, squared, wi, wo)
    return value


def _media(media: Numbers) -> range:
    return range(len(media.thickness))


def _radii(media: Numbers, shape: Shape, k: int) -> tuple[Array, Array]:
    kind, alpha = media.kind[k], shape.alpha[k]
    return 1.0 + kind[0] * (alpha - 1.0), 1.0 + kind[1] * (alpha - 1.0)


def _area(media: Numbers, shape: Shape, k: int, w: Array) -> Array:
    radial, axial = _radii(media, shape, k)
    along = (w @ media.axis[k]) ** 2
    return jnp.sqrt(radial**2 * jnp.maximum(1.0 - along, 0.0) + axial**2 * along + 1e-12)


def _kernel(media: Numbers, shape: Shape, k: int, total: Array, squared: Array, wi: Array, wo: Array) -> Array:
    radial, axial = _radii(media, shape, k)
    along = (total @ media.axis[k]) ** 2
    blur = shape.blur[k] + 1e-12
    stretched = jnp.maximum(squared - along, 0.0) / radial**2 + along / axial**2
    flakes = 0.25 / (jnp.pi * radial**2 * axial * ((stretched + blur) / (squared + blur)) ** 2)
    g = media.kind[k, HG] * shape.alpha[k]
    hg = (1.0 - g * g) / (4.0 * jnp.pi * (1.0 + g * g + 2.0 * g * jnp.sum(wi * wo, -1)) ** 1.5)
    return jnp.where(media.kind[k, HG] > 0, hg, flakes)


def _in_parts(work: Callable[..., Any], arguments: tuple[Any, ...], size: int = 256) -> Any:
    """work on parts of a batch, put together again."""
    count = len(jax.tree.leaves(arguments)[0])
    run = eqx.filter_jit(work)
    parts = [run(*jax.tree.map(lambda a, n=n: a[n : n + size], arguments)) for n in range(0, count, size)]
    return jax.tree.map(lambda *pieces: np.concatenate(pieces), *parts)
