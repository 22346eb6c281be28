"""Trains the networks of `layerjax.transport.spongecake.energy_correction` by `layerjax.precompute.spongecake.energy`.

Materials are drawn as those that second lobes are learned from, but without absorption, and narrow lobes with an axis
are there as well: nothing has to be solved for them. Loss of a material: what is missing of the energy that several
collisions leave, energy times the relative error of c, as a root mean square over directions of light, and
`TAIL_WEIGHT` times its square.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from layerjax.precompute.learning import CURVE, Schedule, learn
from layerjax.precompute.spongecake.data import KINDS, WIDTHS, draw_layers, stack_of
from layerjax.precompute.spongecake.energy import Rule, balance
from layerjax.precompute.spongecake.training import numbers_of
from layerjax.stack import media_of
from layerjax.transport.spongecake.energy_correction import POWER, coefficients_of, correction_network, polynomial
from layerjax.transport.spongecake.mapping import Numbers

SHARD = 256
"""Materials a shard, of one structure."""

TAIL_WEIGHT = 8.0
"""Weight of the squared error beside the error itself, for the sake of the few that are far off."""

RULE = Rule(nodes=12, cosines=6, azimuths=8, rounds=8)
"""How finely energies are balanced."""

SALT = 1
"""Tells random numbers from those of other materials of the same seed."""


class Corrections(NamedTuple):
    """n materials, and what c is at d directions: wi (n, d, 3), energy and log c (n, d)."""

    media: Numbers
    wi: Array
    energy: Array
    log: Array


def make(folder: Path, count: int, media: int, nets: Mapping[int, eqx.nn.MLP], seed: int) -> Iterator[int]:
    """Make what the folder lacks of `count` materials; yields how many are there.

    It is of these networks: another training wants another folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(-(-count // SHARD)):
        path = _path(folder, media, seed, number)
        if not path.exists():
            corrections = shard(number, media, nets, seed)
            temporary = path.with_suffix(".part")
            with temporary.open("wb") as file:
                np.savez_compressed(
                    file,
                    **corrections.media._asdict(),
                    wi=corrections.wi,
                    energy=corrections.energy,
                    log=corrections.log,
                )
            temporary.replace(path)
        yield (number + 1) * SHARD


def load(folder: Path, count: int, media: int, seed: int) -> Corrections:
    """The first materials that `make` has left in the folder, all shards put together."""
    parts = []
    for number in range(-(-count // SHARD)):
        with np.load(_path(folder, media, seed, number)) as archive:
            parts.append(dict(archive))
    whole: dict[str, Any] = {name: np.concatenate([part[name] for part in parts])[:count] for name in parts[0]}
    return Corrections(Numbers(*(whole[name] for name in Numbers._fields)), whole["wi"], whole["energy"], whole["log"])


def shard(number: int, media: int, nets: Mapping[int, eqx.nn.MLP], seed: int) -> Corrections:
    """Materials of one shard: the same for the same number, seed and networks."""
    # one number more than other materials are drawn with: what is tested with there must not be learned from here
    random = np.random.default_rng([seed, media, SALT, SALT, number])
    layers, _ = draw_layers(random, media, SHARD, {True: WIDTHS[False], False: WIDTHS[False]})
    names = tuple(KINDS[k] for k in layers.kind[0])
    with jax.enable_x64(False):
        given = {name: jnp.asarray(array, jnp.float32) for name, array in vars(layers).items() if name != "kind"}
        wi, energy, log = _balances(names, nets, given)
    turns = RULE.azimuths if set(names) == {"hg"} else 1  # as many directions for all
    return Corrections(numbers_of(layers), *(cast(Array, np.repeat(part, turns, axis=1)) for part in (wi, energy, log)))


def train(
    media: int,
    corrections: Corrections,
    seed: int,
    schedule: Schedule,
    state: Path | None = None,
    report: Callable[[str], Any] = print,
) -> tuple[eqx.nn.MLP, CURVE]:
    """The trained network, and the mean loss of each epoch; as `layerjax.precompute.learning.learn`."""

    def drawn(random: np.random.Generator, rows: NDArray[np.int64]) -> tuple[Corrections]:
        return (select(corrections, rows),)

    net = correction_network(media, jax.random.key(seed))
    return learn(net, _loss, drawn, len(corrections.log), [seed, media, SALT], schedule, state, report)


def select(corrections: Corrections, rows: NDArray[np.int64] | slice) -> Corrections:
    """Some of the materials."""
    return jax.tree.map(lambda part: part[rows], corrections)


def errors(net: eqx.nn.MLP, corrections: Corrections) -> Array:
    """Energy that is missing, by material and direction of light, to the first order, (n, d)."""
    return jax.vmap(lambda one: one.energy * POWER * (_root(net, one) * jnp.exp(-one.log / POWER) - 1.0))(corrections)


def _loss(net: eqx.nn.MLP, corrections: Corrections) -> Array:
    squares = jnp.mean(errors(net, corrections) ** 2, axis=-1)
    return jnp.mean(jnp.sqrt(squares + 1e-8) + TAIL_WEIGHT * squares)


def _root(net: eqx.nn.MLP, corrections: Corrections) -> Array:
    """Root of c of one material at its directions, (d,)."""
    sides = coefficients_of(net, corrections.media, True)
    wi = (corrections.wi[:, 0], corrections.wi[:, 1], corrections.wi[:, 2])
    if len(sides) == 1:
        return polynomial(sides[0], wi, True)
    above, below = (polynomial(side, wi, False) for side in sides)
    return jnp.where(wi[2] > 0, above, below)


@eqx.filter_jit
def _balances(
    kinds: tuple[str, ...], nets: Mapping[int, eqx.nn.MLP], materials: dict[str, Array]
) -> tuple[Array, Array, Array]:
    """Directions, energies and log c of n materials: (n, d, 3), (n, d), (n, d)."""

    def one(numbers: dict[str, Array]) -> tuple[Array, Array, Array]:
        found = balance(tuple(media_of(stack_of(kinds, True, numbers))), nets, RULE)
        return jnp.stack(found.wi, axis=-1), found.energy, found.log

    return jax.lax.map(one, materials)


def _path(folder: Path, media: int, seed: int, number: int) -> Path:
    return folder / f"bend-{media}-{seed}-{number:05d}.npz"
