"""How the table of a transport is made: terms of each series by what lines through the box say, checked elsewhere."""

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import fft
from scipy.stats import qmc

from fits.maps.tabulated import Table, Tabulated, with_table
from fits.problem.compilation import cores, in_shares
from fits.problem.model import Model
from fits.problem.problem import Problem
from fits.progress import Progress

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

TOLERANCE = 0.05
"""Error of a table, in standard deviations of the data, that is aimed at."""

ACCEPTED = 0.1
"""The most that it may be at points that the table has not seen."""

MOST_SOLVES = 30_000
"""Of the transport, for one table."""

CORNERS, LINE_NODES, CHECKS, ROUNDS = 12, 33, 64, 3
"""Lines through the box beside its middle, nodes on each, points that a table is checked at, and tables tried."""

OFFSETS = (0.0, 0.01, 0.1, 1.0, 10.0)
"""Multiples of a reading's mean over the box that are added before the logarithm; values must be above 0 without."""

MORE = 1.25
"""Times as many terms are taken where a table does not hold, and so many fewer at first than the lines ask for."""

SHARE = 64
"""Solutions that one call of a program finds."""


class Tried(NamedTuple):
    """A table, or None, its largest error at points that it had not seen, in standard deviations, and words on it."""

    problem: Problem | None
    error: float
    words: str


@dataclass(frozen=True)
class _Space:
    """The coordinates of a table: places (C, D) in the vector, low and high (D,), logarithmic (D,) bool."""

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
        """BSDF without the common scale at points (G, D), (G, N, C) in 1/sr, and standard deviations of readings."""
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


def tabulate(problem: Problem, progress: Progress | None = None, most: int = MOST_SOLVES) -> Tried:
    """The problem with its transport as a table over the box of its parameters, if one that holds can be made.

    most: solutions of the transport that it may take.
    """
    places = _places(problem)
    if isinstance(places, str):
        return Tried(None, np.inf, places)
    low, high = problem.low[places[0]], problem.high[places[0]]
    for of_channel in places:
        low, high = np.minimum(low, problem.low[of_channel]), np.maximum(high, problem.high[of_channel])
    space = _Space(problem, places, low, high, np.zeros(places.shape[1], bool))
    choice, mean = _chosen(space)
    if choice is None:
        return Tried(None, np.inf, f"no series of less than {LINE_NODES} terms a parameter holds")
    space = _Space(problem, places, low, high, choice.logarithmic)
    terms, error = tuple(max(2, int(count / MORE)) for count in choice.terms), np.inf
    for _ in range(ROUNDS):
        solves = int(np.prod(terms))
        if solves > most:
            break
        if progress is not None:
            progress("table", 0, solves, " x ".join(map(str, terms)))
        table = _table(space, terms, choice.offset * mean)
        ready = problem.with_model(with_table(problem.model, table))
        error = _error(space, ready)
        words = f"a table of {len(table.orders):,} terms from {solves:,} solutions, error {error:.2g} sd"
        if error <= ACCEPTED:
            return Tried(ready, error, words)
        terms = tuple(int(np.ceil(MORE * count)) for count in terms)
    count = int(np.prod(terms))
    return Tried(None, error, f"a table of {count:,} solutions would be needed, of {most:,} allowed")


def _places(problem: Problem) -> Integers | str:
    """Of the parameters of a stack for each channel, (C, D); or why there is none."""
    model = problem.model
    if model.optics is not None:
        return "an instrument stands between the transport and the readings"
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
        return "numbers of channels do not match those of the readings"
    if not common and not own:
        return "no parameter of the stack is free"
    return np.array([[*common, *(places[channel] for places in own.values())] for channel in range(channels)])


def _chosen(space: _Space) -> tuple[_Choice | None, Floats]:
    """How many terms each coordinate needs, by lines through the box, and the mean of each reading on them, (N, C)."""
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
                logarithmic: _terms(*found[coordinate, logarithmic], offset * mean)
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


def _terms(values: Floats, sigma: Floats, offset: Floats) -> int:
    """Terms that a series needs on lines, (lines, nodes, N, C); as many as there are nodes where none suffice."""
    if np.any(values + offset <= 0.0):
        return LINE_NODES
    series = np.abs(_series(np.log(values + offset), (1,)))
    tails = np.cumsum(series[:, ::-1], axis=1)[:, ::-1]  # of what is left out from each term on
    influence = np.max((values + offset) / sigma, axis=1, keepdims=True)
    errors = np.max(tails * influence, axis=(0, 2, 3))
    enough = np.flatnonzero(errors < TOLERANCE)
    return max(2, int(enough[0])) if enough.size else LINE_NODES


def _series(values: Floats, axes: Sequence[int]) -> Floats:
    """Coefficients of Chebyshev series from values at the polynomials' zeros."""
    for axis in axes:
        values = fft.dct(values, type=2, axis=axis) / values.shape[axis]
        first = [slice(None)] * values.ndim
        first[axis] = slice(0, 1)
        values[tuple(first)] *= 0.5
    return values


def _table(space: _Space, terms: tuple[int, ...], offset: Floats) -> Table:
    nodes = [np.cos(np.pi * (np.arange(count) + 0.5) / count) for count in terms]
    points = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, len(terms))
    values, sigma = space.values(points)
    smallest = np.max(np.abs(values), axis=0) * np.finfo(float).tiny + np.finfo(float).tiny
    logarithms = np.log(np.maximum(values + offset, smallest))  # (G, N, C)
    mean = logarithms.mean(axis=0)
    influence = np.max((values + offset) / sigma, axis=0)
    parts = [_compressed((logarithms - mean)[:, :, c], influence[:, c]) for c in range(values.shape[2])]
    rank = max(len(directions) for _, directions in parts)
    low, high = space.ends()
    shape = (*terms, rank)
    filled = [_filled(left, rank, 1).reshape(shape) for left, _ in parts]
    series = np.stack([_series(one, range(len(terms))).reshape(-1, rank) for one in filled])
    directions = np.stack([_filled(directions, rank, 0) for _, directions in parts])
    orders = np.stack(np.meshgrid(*map(np.arange, terms), indexing="ij"), axis=-1).reshape(-1, len(terms))
    kept = _needed(series, directions * influence.T[:, None, :])
    return Table(
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


def _needed(series: Floats, directions: Floats) -> NDArray[np.bool_]:
    """Which of the terms, (C, M, R), are needed: the others come to a fifth of the tolerance at most.

    directions: (C, R, N), of readings in units of their standard deviations.
    """
    sizes = np.max(np.abs(series @ directions), axis=(0, 2))
    order = np.argsort(sizes)
    needed = np.ones(len(sizes), bool)
    # signs of so many terms are as good as random
    needed[order[np.sqrt(np.cumsum(sizes[order] ** 2)) <= 0.2 * TOLERANCE]] = False
    return needed


def _compressed(values: Floats, influence: Floats) -> tuple[Floats, Floats]:
    """Values (G, N) as a product of (G, R) and (R, N), to a fifth of the tolerance."""
    left, sizes, right = np.linalg.svd(values * influence, full_matrices=False)
    # from each direction on, what is left out at any node is at most the root of the sum of squares
    rest = np.sqrt(np.cumsum((left * sizes)[:, ::-1] ** 2, axis=1))[:, ::-1].max(axis=0)
    rank = max(1, int(np.sum(rest > 0.2 * TOLERANCE)))
    return left[:, :rank] * sizes[:rank], right[:rank] / influence


def _filled(part: Floats, size: int, axis: int) -> Floats:
    """With zeros at the end of an axis."""
    return np.pad(part, [(0, size - part.shape[axis]) if k == axis else (0, 0) for k in range(part.ndim)])


def _error(space: _Space, ready: Problem) -> float:
    """The largest error of a table at points that it has not seen, in standard deviations of the readings."""
    count = space.places.shape[1]
    points = 2.0 * qmc.Sobol(count, rng=np.random.default_rng(1)).random(CHECKS) - 1.0
    values, sigma = space.values(points)
    assert isinstance(ready.model, Tabulated)
    found = np.asarray(ready.call(_from_table, space.vectors(points)), float)
    return float(np.max(np.abs(found - values) / sigma))


def _unscaled(model: Model, vectors: Array) -> tuple[Array, Array]:
    def one(vector: Array) -> tuple[Array, Array]:
        predicted, scale = model.predict(vector), model.build(vector).scale
        return predicted / scale, model.sigma_at(vector, predicted) / scale

    return jax.lax.map(one, vectors)


def _from_table(model: Any, vectors: Array) -> Array:
    return jax.vmap(model.table.values)(vectors)
