"""Materials that the network of `layerjax.transport.spongecake.transport` learns from, and their multiple scattering.

After Wang et al. 2022, Sec. 5: slabs of one or two media with random parameters, and the BSDF of all orders but the
first. The paper walks it; here `AddingDoubling` solves it, without noise. Materials come in shards of one structure
(kinds of media, level or tilted) that a program is compiled for once; a shard is a file, made from the seed and its
number alone, so that an interrupted run resumes where it was.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from layerjax.evaluate import evaluate
from layerjax.phase import SGGX, HenyeyGreenstein
from layerjax.preparation import prepare
from layerjax.stack import Medium, Stack
from layerjax.transport.adding_doubling import AddingDoubling

Split = Literal["train", "test"]

KINDS = ("surface", "fiber", "hg")
"""Kinds of media, in the order of their number."""

SHARD = 32
"""Materials a shard."""

SHARES = (0.425, 0.425, 0.15)
"""How often each kind is drawn."""

ORDINATES = {("train", 1): (10, 24), ("train", 2): (8, 20), ("test", 1): (10, 24), ("test", 2): (10, 24)}
"""Directions of the solver where an axis is tilted, (cosines, azimuths) a hemisphere: what is learned from may be
coarser than what is tested with, as the network takes a mean over many."""

INCIDENT, OUTGOING = 12, (4, 6)
"""Directions of light a side; outgoing ones of each, (polar, azimuth) strata a hemisphere."""

LEAST_COSINE = 0.02

WIDTHS = {False: (0.03, 1.0), True: (0.1, 1.0)}
"""Range of alpha, by whether the axis may be tilted: ordinates do not resolve narrower lobes."""

MEAN_COSINES = (-0.9, 0.9)
DEPTHS = (0.05, 30.0)
DEEPEST = (30.0, 1e4)
"""Range of thickness; and that of the share `DEEP` of media."""

DEEP = 0.1
TILTED = 0.6
"""Share of media of flakes or fibers with an axis of their own."""

LOSSLESS = 0.35
"""Share of media with albedo 1; half of all have no Fresnel term either."""


@dataclass(frozen=True)
class LayerParameters:
    """Parameters of n materials of k media each, all of one structure, (n, k) each; axis: (n, k, 3).

    kind: index in `KINDS`. alpha: roughness, or g of a Henyey-Greenstein medium.
    """

    kind: NDArray[np.int64]
    alpha: NDArray[np.float64]
    thickness: NDArray[np.float64]
    albedo: NDArray[np.float64]
    f0: NDArray[np.float64]
    axis: NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """Materials and their multiple scattering at pairs of directions, sides (above, below, through).

    wi: (n, 2, i, 3), lit from above and from below. wo: (n, 3, i, o, 3) on wi's side for both, then below for light
    from above. values: (n, 3, i, o), 1/sr. Lit from below only with two media: a slab of one is the same from there.
    """

    layers: LayerParameters
    wi: NDArray[np.float32]
    wo: NDArray[np.float32]
    values: NDArray[np.float32]


def stack_of(kinds: tuple[str, ...], tilted: bool, numbers: dict[str, Array]) -> Stack:
    """The stack of one material; numbers as in `LayerParameters`, without the first axis."""
    media = []
    for k, kind in enumerate(kinds):
        alpha = numbers["alpha"][k]
        if kind == "hg":
            phase: SGGX | HenyeyGreenstein = HenyeyGreenstein(alpha)
        else:
            phase = SGGX("surface" if kind == "surface" else "fiber", alpha, numbers["axis"][k] if tilted else None)
        media.append(Medium(numbers["thickness"][k], numbers["albedo"][k], phase, numbers["f0"][k]))
    return Stack(media)


def make(folder: Path, count: int, media: int, split: Split, seed: int) -> Iterator[int]:
    """Make the shards of `count` materials that the folder lacks; yields the number of materials that are there.

    Shards of this seed that are there are taken as they are.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(-(-count // SHARD)):
        path = _path(folder, media, split, seed, number)
        if not path.exists():
            samples = shard(number, media, split, seed)
            temporary = path.with_suffix(".part")
            with temporary.open("wb") as file:
                np.savez_compressed(file, **vars(samples.layers), wi=samples.wi, wo=samples.wo, values=samples.values)
            temporary.replace(path)
        yield (number + 1) * SHARD


def load(folder: Path, count: int, media: int, split: Split, seed: int) -> Samples:
    """The first materials that `make` has left in the folder, all shards put together."""
    parts = []
    for number in range(-(-count // SHARD)):
        with np.load(_path(folder, media, split, seed, number)) as archive:
            parts.append(dict(archive))
    whole = {name: np.concatenate([part[name] for part in parts])[:count] for name in parts[0]}
    layers = LayerParameters(**{field.name: whole.pop(field.name) for field in fields(LayerParameters)})
    return Samples(layers, **whole)


def shard(number: int, media: int, split: Split, seed: int) -> Samples:
    """Samples of one shard: the same for the same number and seed."""
    random = np.random.default_rng([seed, media, int(split == "test"), number])
    layers, tilted = draw_layers(random, media, SHARD)
    wi, wo = draw_directions(random, SHARD)
    sides = 3 if media > 1 else 2
    order = np.asarray((0, 1, 2) if media > 1 else (0, 2))
    light, view = (np.asarray(w, np.float32) for w in (wi[:, np.where(order == 1, 1, 0)], wo[:, order]))
    with jax.enable_x64(False):
        numbers = {name: jnp.asarray(array, jnp.float32) for name, array in vars(layers).items() if name != "kind"}
        teacher = AddingDoubling(nodes=32, modes=48, ordinates=ORDINATES[split, media], orders="multiple")
        found = _solve(
            teacher, tuple(KINDS[k] for k in layers.kind[0]), tilted, numbers, jnp.asarray(light), jnp.asarray(view)
        )
    values = np.zeros(wo.shape[:-1], np.float32)
    values[:, order] = np.asarray(found).reshape(SHARD, sides, *wo.shape[2:-1])
    return Samples(layers, wi.astype(np.float32), wo.astype(np.float32), values)


def draw_layers(
    random: np.random.Generator, media: int, count: int, widths: dict[bool, tuple[float, float]] = WIDTHS
) -> tuple[LayerParameters, bool]:
    """Parameters of `count` materials of one structure, and whether any of their media has an axis of its own.

    widths: range of alpha, as `WIDTHS`.
    """
    kinds = random.choice(len(KINDS), size=media, p=SHARES)
    tilted = (kinds != KINDS.index("hg")) & (random.uniform(size=media) < TILTED)
    size = (count, media)

    def uniform_in(low: float, high: float) -> NDArray[np.float64]:
        return np.exp(random.uniform(np.log(low), np.log(high), size))

    alpha = uniform_in(*widths[bool(tilted.any())])
    alpha = np.where(kinds == 2, random.uniform(*MEAN_COSINES, size), alpha)
    thickness = np.where(random.uniform(size=size) < DEEP, uniform_in(*DEEPEST), uniform_in(*DEPTHS))
    albedo = np.where(random.uniform(size=size) < LOSSLESS, 1.0, 1.0 - 0.95 * random.uniform(size=size) ** 2)
    f0 = np.where(random.uniform(size=size) < 0.5, 1.0, random.uniform(0.02, 1.0, size))
    cosine = np.where(random.uniform(size=size) < 0.4, 0.0, random.uniform(size=size))  # in the plane, or anywhere
    turn = random.uniform(0.0, 2.0 * np.pi, size)
    sine = np.sqrt(1.0 - cosine**2)
    axis = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], -1)
    axis = np.where(tilted[:, None], axis, [0.0, 0.0, 1.0])
    return LayerParameters(np.broadcast_to(kinds, size).copy(), alpha, thickness, albedo, f0, axis), bool(tilted.any())


def draw_directions(random: np.random.Generator, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """wi and wo of `Samples`: cosines of light spread evenly, outgoing light in proportion to its cosine."""
    rows, columns = OUTGOING
    shape = (count, 2, INCIDENT)
    strata = (np.arange(INCIDENT) + random.uniform(size=shape)) / INCIDENT
    turns = random.permuted(np.broadcast_to(np.arange(INCIDENT), shape), axis=-1) + random.uniform(size=shape)
    wi = _direction(LEAST_COSINE + (1.0 - LEAST_COSINE) * strata, turns / INCIDENT, np.asarray([1.0, -1.0])[:, None])
    full = (count, 3, INCIDENT, rows, columns)
    squared = (np.arange(rows)[:, None] + random.uniform(size=full)) / rows
    turns = (np.arange(columns) + random.uniform(size=full)) / columns
    cosine = np.sqrt(LEAST_COSINE**2 + (1.0 - LEAST_COSINE**2) * squared)
    side = np.asarray([1.0, -1.0, -1.0])[:, None, None, None]
    wo = _direction(cosine, turns, side)
    return wi, wo.reshape(count, 3, INCIDENT, rows * columns, 3)


def _direction(
    cosine: NDArray[np.float64], turn: NDArray[np.float64], side: NDArray[np.float64]
) -> NDArray[np.float64]:
    sine, phi = np.sqrt(1.0 - cosine**2), 2.0 * np.pi * turn
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), side * cosine], -1)


def _path(folder: Path, media: int, split: Split, seed: int, number: int) -> Path:
    return folder / f"{split}-{media}-{seed}-{number:05d}.npz"


@eqx.filter_jit
def _solve(
    teacher: AddingDoubling, kinds: tuple[str, ...], tilted: bool, numbers: dict[str, Array], wi: Array, wo: Array
) -> Array:
    """Values (n, sides, i, o)."""

    def one(material: tuple[dict[str, Array], Array, Array]) -> Array:
        values, light, view = material
        state = prepare(stack_of(kinds, tilted, values), teacher)
        return evaluate(state, jnp.broadcast_to(light[:, :, None], view.shape).reshape(-1, 3), view.reshape(-1, 3))[
            ..., 0
        ]

    return jax.lax.map(one, (numbers, wi, wo))
