"""An emulator in the place of a dear transport: Chebyshev series over the bounds of all parameters at once.

What the exact transport says of the data is smooth in every parameter. An emulator is worth its making where thousands
of texels are fitted with the same directions: a value with its derivatives then takes tens of microseconds. Values are
kept as logarithms, of which a few directions in the space of the data hold all (a singular value decomposition), and
each channel has the coordinates of the parameters that matter to it alone. Lines through the box say how many terms
each series needs, and solutions elsewhere whether they were enough.
"""

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import fft
from scipy.stats import qmc

from fits.maps.options import USUAL, MapOptions
from fits.problem.compilation import cores, in_shares
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

CORNERS, LINE_NODES, CHECKS, ROUNDS = 12, 33, 64, 3
"""Lines through the box beside its middle, nodes on each, points that are checked, and emulators tried."""

OFFSETS = (0.0, 0.01, 0.1, 1.0, 10.0)
"""Multiples of a datum's mean over the box that are added before the logarithm; values must be above 0 without."""

MORE = 1.25
"""Times as many terms are taken where an emulator does not hold, and so many fewer at first than the lines ask for."""

SHARE = 64
"""Solutions that one call of a program finds."""


# ---- as a model ----


class Emulator(eqx.Module):
    """Series in D coordinates of the values of N data in C channels.

    Attributes:
        orders: (M, D) int, of the polynomials whose products the M terms are.
        coefficients: (C, M, R), of R directions in the space of data.
        directions: (C, R, N). mean: (C, N). offset: (C, N), in 1/sr: the emulator holds log(value + offset).
        logarithmic: (D,) bool, whether a coordinate is the logarithm of its parameter.
        low, high: (D,), ends of the coordinates.
        places: (C, D) where the parameters of each channel stand in the vector.
        highest: of the orders.
    """

    orders: Array
    coefficients: Array
    directions: Array
    mean: Array
    offset: Array
    logarithmic: Array
    low: Array
    high: Array
    places: Array
    highest: int = eqx.field(static=True)

    def values(self, vector: Array) -> Array:
        """BSDF of the data, (N, C), in 1/sr, with these parameters (P,)."""
        return _values(vector, emulator=self)

    def with_slopes(self, vector: Array) -> tuple[Array, Array]:
        """`values`, and their derivatives by the coordinates' parameters, (N, C, D)."""
        channels = [self._channel(vector, index) for index in range(self.coefficients.shape[0])]
        values, slopes = zip(*channels, strict=True)
        return jnp.stack(values, axis=1), jnp.stack(slopes, axis=1)

    def _channel(self, vector: Array, channel: int) -> tuple[Array, Array]:
        at = vector[self.places[channel]]
        tame = jnp.where(self.logarithmic, jnp.clip(at, jnp.exp(self.low), jnp.exp(self.high)), 1.0)
        coordinate = jnp.where(self.logarithmic, jnp.log(tame), at)
        width = self.high - self.low
        x = jnp.clip(2.0 * (coordinate - self.low) / width - 1.0, -1.0, 1.0)
        rate = 2.0 / width * jnp.where(self.logarithmic, 1.0 / tame, 1.0)
        sums = self._products(x) @ self.coefficients[channel]
        of_data = sums @ self.directions[channel]
        total = jnp.exp(of_data[0] + self.mean[channel])
        return total - self.offset[channel], (of_data[1:] * rate[:, None] * total).T

    def _products(self, x: Array) -> Array:
        """The M terms at x (D,), then their derivatives by each coordinate, (1 + D, M)."""
        count = self.highest + 1
        parts = [chebyshev(x[place], count) for place in range(x.size)]
        basis, slope = ([part[which][self.orders[:, place]] for place, part in enumerate(parts)] for which in (0, 1))
        before = [jnp.ones(len(self.orders), x.dtype)]
        for factor in basis:
            before.append(before[-1] * factor)
        rows, after = [], jnp.ones_like(before[0])
        for place in reversed(range(x.size)):
            rows.append(before[place] * slope[place] * after)
            after = after * basis[place]
        return jnp.stack([before[-1], *reversed(rows)])


def chebyshev(x: Array, count: int) -> tuple[Array, Array]:
    """The first polynomials at x in [-1, 1], and their derivatives, (count,) each."""
    basis, second = [jnp.ones_like(x), x], [jnp.ones_like(x), 2.0 * x]
    for _ in range(2, count):
        basis.append(2.0 * x * basis[-1] - basis[-2])
        second.append(2.0 * x * second[-1] - second[-2])
    slope = [jnp.zeros_like(x)] + [k * second[k - 1] for k in range(1, count)]
    return jnp.stack(basis[:count]), jnp.stack(slope[:count])


@eqx.filter_custom_jvp
def _values(vector: Array, *, emulator: Emulator) -> Array:
    """All derivatives come at once, and are little more than a value: a Jacobian takes its columns from them."""
    return emulator.with_slopes(vector)[0]


@_values.def_jvp
def _(primals: tuple[Array], tangents: tuple[Array], *, emulator: Emulator) -> tuple[Array, Array]:
    (vector,), (moved,) = primals, tangents
    values, slopes = emulator.with_slopes(vector)
    return values, jnp.einsum("ncd,cd->nc", slopes, moved[emulator.places])


class EmulatedModel(Model):
    """A model whose values come from an emulator in the place of its transport."""

    emulator: Emulator

    def predict(self, vector: Array) -> Array:
        """Scaled BSDF, (N, C), in 1/sr."""
        return self.build(vector).scale * self.emulator.values(vector)


def with_emulator(model: Model, emulator: Emulator) -> EmulatedModel:
    """The model with the emulator."""
    return EmulatedModel(**{one.name: getattr(model, one.name) for one in fields(Model)}, emulator=emulator)


def coarser(emulator: Emulator) -> Emulator:
    """The emulator without the last terms of each series: how far it differs tells of its error."""
    last = jnp.max(emulator.orders, axis=0)
    kept = jnp.all(emulator.orders < jnp.maximum(last, 1), axis=1)
    return eqx.tree_at(lambda t: t.coefficients, emulator, jnp.where(kept[:, None], emulator.coefficients, 0.0))


# ---- how it is made ----


class Tried(NamedTuple):
    """An emulator, or None, its largest error at points that it had not seen, in standard deviations, and words."""

    problem: Problem | None
    error: float
    words: str


@dataclass(frozen=True)
class _Space:
    """The coordinates of an emulator: places (C, D) in the vector, low and high (D,), logarithmic (D,) bool."""

    problem: Problem
    places: Integers
    low: Floats
    high: Floats
    logarithmic: NDArray[np.bool_]

    def vectors(self, points: Floats) -> Floats:
        """Parameters (G, P) at points (G, D) of [-1, 1]."""
        low, high = self.ends()
        coordinates = low + 0.5 * (points + 1.0) * (high - low)
        physical = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, coordinates, 0.0)), coordinates)
        vectors = np.tile(self.problem.start, (len(points), 1))
        for of_channel in self.places:
            vectors[:, of_channel] = np.clip(physical, self.low, self.high)
        return vectors

    def ends(self) -> tuple[Floats, Floats]:
        """Of the coordinates."""
        tame = np.where(self.logarithmic, self.low, 1.0), np.where(self.logarithmic, self.high, 1.0)
        low, high = (
            np.where(self.logarithmic, np.log(part), end) for part, end in zip(tame, (self.low, self.high), strict=True)
        )
        return low, high

    def values(self, points: Floats) -> tuple[Floats, Floats]:
        """BSDF without the common scale at points (G, D), (G, N, C) in 1/sr, and standard deviations of data."""
        values, sigma = in_shares(
            lambda rows: self.problem.call(_unscaled, rows),
            self.vectors(points),
            max(1, min(SHARE, -(-len(points) // cores()))),
        )
        return values, sigma


class _Choice(NamedTuple):
    """Terms of each series, (D,), which coordinates are logarithms, and the offset as a multiple of the mean."""

    terms: tuple[int, ...]
    logarithmic: NDArray[np.bool_]
    offset: float


def emulate(problem: Problem, options: MapOptions = USUAL) -> Tried:
    """The problem with an emulator of its transport over the box of its parameters, if one that holds can be made."""
    places = _places(problem)
    if isinstance(places, str):
        return Tried(None, np.inf, places)
    low, high = problem.low[places[0]], problem.high[places[0]]
    for of_channel in places:
        low, high = np.minimum(low, problem.low[of_channel]), np.maximum(high, problem.high[of_channel])
    most, tolerance = options.emulator_max_solves, 0.5 * options.emulator_error
    space = _Space(problem, places, low, high, np.zeros(places.shape[1], bool))
    choice, mean = _chosen(space, tolerance)
    if choice is None:
        return Tried(None, np.inf, f"no series of less than {LINE_NODES} terms a parameter holds")
    space = _Space(problem, places, low, high, choice.logarithmic)
    terms, error = tuple(max(2, int(count / MORE)) for count in choice.terms), np.inf
    for _ in range(ROUNDS):
        solves = int(np.prod(terms))
        if solves > most:
            break
        options.tell("emulator", 0, solves, " x ".join(map(str, terms)))
        emulator = _made(space, terms, choice.offset * mean, tolerance)
        ready = problem.with_model(with_emulator(problem.model, emulator))
        error = _error(space, ready)
        words = f"an emulator of {len(emulator.orders):,} terms from {solves:,} solutions, error {error:.2g} sd"
        if error <= options.emulator_error:
            return Tried(ready, error, words)
        terms = tuple(int(np.ceil(MORE * count)) for count in terms)
    count = int(np.prod(terms))
    return Tried(None, error, f"an emulator of {count:,} solutions would be needed, of {most:,} allowed")


def _places(problem: Problem) -> Integers | str:
    """Of the parameters of a stack for each channel, (C, D); or why there is none."""
    model = problem.model
    if model.optics is not None:
        return "an instrument stands between the transport and the data"
    common: list[int] = []
    own: dict[str, dict[int, int]] = {}
    for place, name in enumerate(problem.names[: model.moving]):
        if name == "scale":
            continue
        found = re.fullmatch(r"(.*)\[(\d+)\]", name)
        if found:
            own.setdefault(found[1], {})[int(found[2])] = place
        else:
            common.append(place)
    channels = model.values.shape[-1]
    if any(set(places) != set(range(channels)) for places in own.values()):
        return "numbers of channels do not match those of the data"
    if not common and not own:
        return "no parameter of the stack is free"
    return np.array([[*common, *(places[channel] for places in own.values())] for channel in range(channels)])


def _chosen(space: _Space, tolerance: float) -> tuple[_Choice | None, Floats]:
    """How many terms each coordinate needs, by lines through the box, and the mean of each datum on them, (N, C)."""
    count = space.places.shape[1]
    nodes = np.cos(np.pi * (np.arange(LINE_NODES) + 0.5) / LINE_NODES)
    through = _through(count)
    ways = [np.zeros(count, bool), space.low > 0.0]
    found: dict[tuple[int, bool], tuple[Floats, Floats]] = {}
    for coordinate, logarithmic in itertools.product(range(count), (False, True)):
        if logarithmic and not ways[1][coordinate]:
            continue
        lines = np.repeat(through, LINE_NODES, axis=0)
        lines[:, coordinate] = np.tile(nodes, len(through))
        way = np.zeros(count, bool)
        way[coordinate] = logarithmic
        own = _Space(space.problem, space.places, space.low, space.high, way)
        values, sigma = own.values(lines)
        found[coordinate, logarithmic] = tuple(
            part.reshape(-1, LINE_NODES, *part.shape[1:]) for part in (values, sigma)
        )  # type: ignore[assignment]
    mean = np.mean([np.mean(np.abs(values), axis=(0, 1)) for values, _ in found.values()], axis=0)
    best: _Choice | None = None
    for offset in OFFSETS:
        terms, logs = [], []
        for coordinate in range(count):
            ways_of = {
                logarithmic: _terms(*found[coordinate, logarithmic], offset * mean, tolerance)
                for logarithmic in (False, True)
                if (coordinate, logarithmic) in found
            }
            logs.append(min(ways_of, key=lambda way: ways_of[way]))
            terms.append(ways_of[logs[-1]])
        if max(terms) < LINE_NODES and (best is None or np.prod(terms) < np.prod(best.terms)):
            best = _Choice(tuple(terms), np.array(logs), offset)
    return best, mean


def _through(count: int) -> Floats:
    """What lines through the box pass: its middle and some of its corners, near which series are worst, (lines, D)."""
    corners = np.random.default_rng(0).permuted(np.arange(2**count))[:CORNERS]
    signs = 2.0 * (corners[:, None] >> np.arange(count) & 1) - 1.0
    return np.concatenate([np.zeros((1, count)), signs])


def _terms(values: Floats, sigma: Floats, offset: Floats, tolerance: float) -> int:
    """Terms that a series needs on lines, (lines, nodes, N, C); as many as there are nodes where none suffice."""
    if np.any(values + offset <= 0.0):
        return LINE_NODES
    series = np.abs(_series(np.log(values + offset), (1,)))
    tails = np.cumsum(series[:, ::-1], axis=1)[:, ::-1]  # of what is left out from each term on
    influence = np.max((values + offset) / sigma, axis=1, keepdims=True)
    errors = np.max(tails * influence, axis=(0, 2, 3))
    enough = np.flatnonzero(errors < tolerance)
    return max(2, int(enough[0])) if enough.size else LINE_NODES


def _series(values: Floats, axes: Sequence[int]) -> Floats:
    """Coefficients of Chebyshev series from values at the polynomials' zeros."""
    for axis in axes:
        values = fft.dct(values, type=2, axis=axis) / values.shape[axis]
        first = [slice(None)] * values.ndim
        first[axis] = slice(0, 1)
        values[tuple(first)] *= 0.5
    return values


def _made(space: _Space, terms: tuple[int, ...], offset: Floats, tolerance: float) -> Emulator:
    nodes = [np.cos(np.pi * (np.arange(count) + 0.5) / count) for count in terms]
    points = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, len(terms))
    values, sigma = space.values(points)
    smallest = np.max(np.abs(values), axis=0) * np.finfo(float).tiny + np.finfo(float).tiny
    logarithms = np.log(np.maximum(values + offset, smallest))  # (G, N, C)
    mean = logarithms.mean(axis=0)
    influence = np.max((values + offset) / sigma, axis=0)
    parts = [_compressed((logarithms - mean)[:, :, c], influence[:, c], tolerance) for c in range(values.shape[2])]
    rank = max(len(directions) for _, directions in parts)
    low, high = space.ends()
    shape = (*terms, rank)
    filled = [_filled(left, rank, 1).reshape(shape) for left, _ in parts]
    series = np.stack([_series(one, range(len(terms))).reshape(-1, rank) for one in filled])
    directions = np.stack([_filled(directions, rank, 0) for _, directions in parts])
    orders = np.stack(np.meshgrid(*map(np.arange, terms), indexing="ij"), axis=-1).reshape(-1, len(terms))
    kept = _needed(series, directions * influence.T[:, None, :], tolerance)
    return Emulator(
        orders=jnp.asarray(orders[kept]),
        coefficients=jnp.asarray(series[:, kept]),
        directions=jnp.asarray(directions),
        mean=jnp.asarray(mean.T),
        offset=jnp.asarray(offset.T),
        logarithmic=jnp.asarray(space.logarithmic),
        low=jnp.asarray(low),
        high=jnp.asarray(high),
        places=jnp.asarray(space.places),
        highest=max(terms) - 1,
    )


def _needed(series: Floats, directions: Floats, tolerance: float) -> NDArray[np.bool_]:
    """Which of the terms, (C, M, R), are needed: the others come to a fifth of the tolerance at most.

    directions: (C, R, N), of data in units of their standard deviations.
    """
    sizes = np.max(np.abs(series @ directions), axis=(0, 2))
    order = np.argsort(sizes)
    needed = np.ones(len(sizes), bool)
    # signs of so many terms are as good as random
    needed[order[np.sqrt(np.cumsum(sizes[order] ** 2)) <= 0.2 * tolerance]] = False
    return needed


def _compressed(values: Floats, influence: Floats, tolerance: float) -> tuple[Floats, Floats]:
    """Values (G, N) as a product of (G, R) and (R, N), to a fifth of the tolerance."""
    left, sizes, right = np.linalg.svd(values * influence, full_matrices=False)
    # from each direction on, what is left out at any node is at most the root of the sum of squares
    rest = np.sqrt(np.cumsum((left * sizes)[:, ::-1] ** 2, axis=1))[:, ::-1].max(axis=0)
    rank = max(1, int(np.sum(rest > 0.2 * tolerance)))
    return left[:, :rank] * sizes[:rank], right[:rank] / influence


def _filled(part: Floats, size: int, axis: int) -> Floats:
    """With zeros at the end of an axis."""
    return np.pad(part, [(0, size - part.shape[axis]) if k == axis else (0, 0) for k in range(part.ndim)])


def _error(space: _Space, ready: Problem) -> float:
    """The largest error of an emulator at points that it has not seen, in standard deviations of the data."""
    count = space.places.shape[1]
    points = 2.0 * qmc.Sobol(count, rng=np.random.default_rng(1)).random(CHECKS) - 1.0
    values, sigma = space.values(points)
    assert isinstance(ready.model, EmulatedModel)
    found = np.asarray(ready.call(_emulated, space.vectors(points)), float)
    return float(np.max(np.abs(found - values) / sigma))


def _unscaled(model: Model, vectors: Array) -> tuple[Array, Array]:
    def one(vector: Array) -> tuple[Array, Array]:
        predicted, scale = model.predict(vector), model.build(vector).scale
        return predicted / scale, model.sigma_at(vector, predicted) / scale

    return jax.lax.map(one, vectors)


def _emulated(model: Any, vectors: Array) -> Array:
    return jax.vmap(model.emulator.values)(vectors)
