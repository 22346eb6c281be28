"""An emulator in the place of a dear transport: Chebyshev series over the bounds of all parameters at once.

What the exact transport says of the data is smooth in every parameter. An emulator pays where thousands
of texels are fitted with the same directions: a value with its derivatives then takes tens of microseconds. Values are
kept as logarithms, of which a few directions in the space of the data hold all (a singular value decomposition), and
each channel has the coordinates of the parameters that matter to it alone. Lines through the box say how many terms
each series needs, and solutions elsewhere whether they were enough.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

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
Truths = NDArray[np.bool_]

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
        of_data = self._products(x) @ self.coefficients[channel] @ self.directions[channel]
        total = jnp.exp(of_data[0] + self.mean[channel])
        return total - self.offset[channel], (of_data[1:] * rate[:, None] * total).T

    def _products(self, x: Array) -> Array:
        """The M terms at x (D,), then their derivatives by each coordinate, (1 + D, M)."""
        parts = [chebyshev(x[place], self.highest + 1) for place in range(x.size)]
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


# ---- how it is made ----


@dataclass(frozen=True)
class _Space:
    """The coordinates of an emulator: places (C, D) in the vector, low and high (D,), logarithmic (D,) bool."""

    problem: Problem
    places: Integers
    low: Floats
    high: Floats
    logarithmic: Truths

    def ends(self) -> tuple[Floats, Floats]:
        """Scale and offset of the coordinates, (D,) each."""
        safe = (np.where(self.logarithmic, end, 1.0) for end in (self.low, self.high))
        logs = map(np.log, safe)
        low, high = (np.where(self.logarithmic, log, end) for log, end in zip(logs, (self.low, self.high), strict=True))
        return low, high

    def vectors(self, points: Floats) -> Floats:
        """Parameters (G, P) at points (G, D) of [-1, 1]."""
        low, high = self.ends()
        coordinates = low + 0.5 * (points + 1.0) * (high - low)
        physical = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, coordinates, 0.0)), coordinates)
        vectors = np.tile(self.problem.start, (len(points), 1))
        for of_channel in self.places:
            vectors[:, of_channel] = np.clip(physical, self.low, self.high)
        return vectors

    def values(self, points: Floats) -> tuple[Floats, Floats]:
        """BSDF without the common scale at points (G, D), (G, N, C) in 1/sr, and standard deviations of the data."""
        share = max(1, min(SHARE, -(-len(points) // cores())))
        values, sigma = in_shares(lambda rows: self.problem.call(_unscaled, rows), self.vectors(points), share)
        return values, sigma


def emulate(problem: Problem, options: MapOptions = USUAL) -> tuple[Emulator | None, str]:
    """An emulator of a problem's transport over the box of its parameters, if one that holds can be made; in words."""
    places = _places(problem)
    if isinstance(places, str):
        return None, places
    tolerance, low, high = 0.5 * options.emulator_error, problem.low[places].min(0), problem.high[places].max(0)
    space = _Space(problem, places, low, high, np.zeros(len(low), bool))
    chosen = _chosen(space, tolerance)
    if chosen is None:
        return None, f"no series of less than {LINE_NODES} terms a parameter holds"
    needed, logarithmic, offset = chosen
    space = replace(space, logarithmic=logarithmic)
    terms = tuple(max(2, int(count / MORE)) for count in needed)
    for _ in range(ROUNDS):
        solves = int(np.prod(terms))
        if solves > options.emulator_max_solves:
            break
        options.tell("emulator", 0, solves, " x ".join(map(str, terms)))
        emulator = _made(space, terms, offset, tolerance)
        # the largest error at points that it has not seen, in standard deviations of the data
        points = 2.0 * qmc.Sobol(len(low), rng=np.random.default_rng(1)).random(CHECKS) - 1.0
        values, sigma = space.values(points)
        ready = problem.with_model(with_emulator(problem.model, emulator))
        error = float(np.max(np.abs(np.asarray(ready.call(_emulated, space.vectors(points))) - values) / sigma))
        if error <= options.emulator_error:
            return emulator, (
                f"an emulator of {len(emulator.orders):,} terms from {solves:,} solutions, error {error:.2g} sd"
            )
        terms = tuple(int(np.ceil(MORE * count)) for count in terms)
    solves = int(np.prod(terms))
    return None, f"an emulator of {solves:,} solutions would be needed, of {options.emulator_max_solves:,} allowed"


def _places(problem: Problem) -> Integers | str:
    """Places of the parameters of a stack for each channel, (C, D); or why there is none."""
    model = problem.model
    if model.optics is not None:
        return "an instrument stands between the transport and the data"
    common: list[int] = []
    own: dict[str, dict[int, int]] = {}
    for place, name in enumerate(problem.names[: model.moving]):
        if found := re.fullmatch(r"(.*)\[(\d+)\]", name):
            own.setdefault(found[1], {})[int(found[2])] = place
        elif name != "scale":
            common.append(place)
    channels = range(model.values.shape[-1])
    if any(set(places) != set(channels) for places in own.values()):
        return "numbers of channels do not match those of the data"
    if not common and not own:
        return "no parameter of the stack is free"
    return np.array([[*common, *(places[channel] for places in own.values())] for channel in channels])


def _chosen(space: _Space, tolerance: float) -> tuple[tuple[int, ...], Truths, Floats] | None:
    """How many terms each coordinate needs, which are logarithms, and the offset (N, C), by lines through the box."""
    count, nodes = len(space.low), _nodes(LINE_NODES)
    # through its middle and some of its corners, near which series are worst
    corners = np.random.default_rng(0).permuted(np.arange(2**count))[:CORNERS]
    through = np.concatenate([np.zeros((1, count)), 2.0 * (corners[:, None] >> np.arange(count) & 1) - 1.0])
    found: list[dict[bool, Any]] = []
    for coordinate in range(count):
        lines = np.repeat(through, LINE_NODES, axis=0)
        lines[:, coordinate] = np.tile(nodes, len(through))
        ways = [False, True] if space.low[coordinate] > 0.0 else [False]
        found.append({})
        for way in ways:
            both = replace(space, logarithmic=way & (np.arange(count) == coordinate)).values(lines)
            found[-1][way] = [part.reshape(-1, LINE_NODES, *part.shape[1:]) for part in both]
    means = [np.mean(np.abs(values), axis=(0, 1)) for ways in found for values, _ in ways.values()]
    best = None
    for offset in OFFSETS:
        shift = offset * np.mean(means, axis=0)
        terms = [{way: _terms(lines, shift, tolerance) for way, lines in ways.items()} for ways in found]
        logs = [min(ways, key=ways.__getitem__) for ways in terms]
        needed = tuple(ways[way] for ways, way in zip(terms, logs, strict=True))
        if max(needed) < LINE_NODES and (best is None or np.prod(needed) < np.prod(best[0])):
            best = needed, np.array(logs), shift
    return best


def _terms(lines: Sequence[Floats], offset: Floats, tolerance: float) -> int:
    """Terms that a series needs for values with these standard deviations on lines, (lines, nodes, N, C) each; as many
    as there are nodes where none suffice."""
    values, sigma = lines
    if np.any(values + offset <= 0.0):
        return LINE_NODES
    series = np.abs(_series(np.log(values + offset), 1))
    tails = np.cumsum(series[:, ::-1], axis=1)[:, ::-1]  # of what is omitted from each term on
    influence = np.max((values + offset) / sigma, axis=1, keepdims=True)
    enough = np.flatnonzero(np.max(tails * influence, axis=(0, 2, 3)) < tolerance)
    return max(2, int(enough[0])) if enough.size else LINE_NODES


def _nodes(count: int) -> Floats:
    """Zeros of a Chebyshev polynomial."""
    return np.cos(np.pi * (np.arange(count) + 0.5) / count)


def _series(values: Floats, axis: int) -> Floats:
    """Coefficients of Chebyshev series along an axis from values at the polynomial's zeros."""
    found = fft.dct(values, type=2, axis=axis) / values.shape[axis]
    np.moveaxis(found, axis, 0)[0] *= 0.5
    return np.asarray(found)


def _made(space: _Space, terms: tuple[int, ...], offset: Floats, tolerance: float) -> Emulator:
    def grid(axes: list[Any]) -> NDArray[Any]:
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(terms))

    values, sigma = space.values(grid([_nodes(count) for count in terms]))
    smallest = np.max(np.abs(values), axis=0) * np.finfo(float).tiny + np.finfo(float).tiny
    logarithms = np.log(np.maximum(values + offset, smallest))  # (G, N, C)
    mean = logarithms.mean(axis=0)
    influence = np.max((values + offset) / sigma, axis=0)
    parts = [_compressed((logarithms - mean)[:, :, c], influence[:, c], tolerance) for c in range(values.shape[2])]
    rank = max(len(directions) for _, directions in parts)
    series = np.stack([np.pad(left, [(0, 0), (0, rank - left.shape[1])]).reshape(*terms, rank) for left, _ in parts])
    for axis in range(len(terms)):
        series = _series(series, axis + 1)
    series = series.reshape(len(parts), -1, rank)
    directions = np.stack([np.pad(own, [(0, rank - len(own)), (0, 0)]) for _, own in parts])
    # terms are omitted that come to a fifth of the tolerance at most: signs of so many are as good as random
    sizes = np.max(np.abs(series @ (directions * influence.T[:, None, :])), axis=(0, 2))
    order = np.argsort(sizes)
    kept = np.ones(len(sizes), bool)
    kept[order[np.sqrt(np.cumsum(sizes[order] ** 2)) <= 0.2 * tolerance]] = False
    orders, (low, high) = grid([np.arange(count) for count in terms])[kept], space.ends()
    return Emulator(
        orders=jnp.asarray(orders),
        coefficients=jnp.asarray(series[:, kept]),
        directions=jnp.asarray(directions),
        mean=jnp.asarray(mean.T),
        offset=jnp.asarray(offset.T),
        logarithmic=jnp.asarray(space.logarithmic),
        low=jnp.asarray(low),
        high=jnp.asarray(high),
        places=jnp.asarray(space.places),
        highest=int(orders.max()),
    )


def _compressed(values: Floats, influence: Floats, tolerance: float) -> tuple[Floats, Floats]:
    """Values (G, N) as a product of (G, R) and (R, N), to a fifth of the tolerance."""
    left, sizes, right = np.linalg.svd(values * influence, full_matrices=False)
    # from each direction on, what is omitted at any node is at most the root of the sum of squares
    rest = np.sqrt(np.cumsum((left * sizes)[:, ::-1] ** 2, axis=1))[:, ::-1].max(axis=0)
    rank = max(1, int(np.sum(rest > 0.2 * tolerance)))
    return left[:, :rank] * sizes[:rank], right[:rank] / influence


def _unscaled(model: Model, vectors: Array) -> tuple[Array, Array]:
    def one(vector: Array) -> tuple[Array, Array]:
        predicted, scale = model.predict(vector), model.build(vector).scale
        return predicted / scale, model.sigma_at(vector, predicted) / scale

    return jax.lax.map(one, vectors)


def _emulated(model: Any, vectors: Array) -> Array:
    return jax.vmap(model.emulator.values)(vectors)
