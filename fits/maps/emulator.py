"""An emulator in the place of a dear transport: Chebyshev series over the bounds of all parameters at once.

It pays where thousands of texels are fitted with the same directions: a value with its derivatives takes tens of
microseconds. Values are kept as logarithms, of which a few directions in the space of the data hold all (a singular
value decomposition); each channel has the coordinates of the parameters that matter to it alone. Lines through the box
say how many terms each series needs, and solutions elsewhere whether they were enough.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.polynomial.chebyshev import chebpts1
from numpy.typing import NDArray
from scipy import fft
from scipy.stats import qmc

from fits.data.geometry import Booleans, Floats, Integers
from fits.maps.options import DEFAULT, MapOptions
from fits.problem.compilation import cores, in_shares
from fits.problem.model import Model
from fits.problem.problem import Problem

CORNERS, LINE_NODES, CHECKS, ROUNDS = 12, 33, 64, 3
"""Lines through the box beside its middle, nodes on each, points that are checked, and emulators tried."""

LOGARITHMIC_ABOVE = 5.0  # ratio of the bounds of a parameter from which its logarithm is the coordinate

MORE = 1.25
"""Times as many terms are taken where an emulator does not hold, and so many fewer at first than the lines ask for."""

SHARE = 64  # solutions that one call of a program finds


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

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> "Emulator":
        """The emulator of these arrays, of all but the highest order."""
        orders = np.asarray(arrays["orders"])
        parts = {one.name: jnp.asarray(arrays[one.name]) for one in fields(cls) if one.name != "highest"}
        return cls(**parts, highest=int(orders.max()))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What `of` takes."""
        return {one.name: np.asarray(getattr(self, one.name)) for one in fields(self) if one.name != "highest"}

    def predict(self, model: Model, vector: Array) -> Array:
        """Scaled BSDF of a model, (N, C), in 1/sr."""
        return model.build(vector).scale * self.values(vector)

    def values(self, vector: Array) -> Array:
        """BSDF of the data, (N, C), in 1/sr, with these parameters (P,)."""

        def channel(places: Array, coefficients: Array, directions: Array, mean: Array, offset: Array) -> Array:
            at = vector[places]
            coordinate = jnp.where(self.logarithmic, jnp.log(jnp.where(self.logarithmic, at, 1.0)), at)
            x = 2.0 * (coordinate - self.low) / (self.high - self.low) - 1.0
            x += jax.lax.stop_gradient(jnp.clip(x, -1.0, 1.0) - x)  # on a bound a slope does not end
            basis = chebyshev(x, self.highest + 1)
            terms = reduce(jnp.multiply, [basis[self.orders[:, k], k] for k in range(places.size)])
            return jnp.exp(terms @ coefficients @ directions + mean) - offset

        return jax.vmap(channel, out_axes=1)(self.places, self.coefficients, self.directions, self.mean, self.offset)


def chebyshev(x: Array, count: int) -> Array:
    """The first polynomials at x (D,) in [-1, 1], (count, D)."""
    basis = [jnp.ones_like(x), x]
    for _ in range(2, count):
        basis.append(2.0 * x * basis[-1] - basis[-2])
    return jnp.stack(basis[:count])


# ---- how it is made ----


@dataclass(frozen=True)
class _Space:
    """The coordinates of an emulator: places (C, D) in the vector, low and high (D,), logarithmic (D,) bool."""

    problem: Problem
    places: Integers
    low: Floats
    high: Floats
    logarithmic: Booleans

    def vectors(self, points: Floats) -> Floats:
        """Parameters (G, P) at points (G, D) of [-1, 1]."""
        coordinates = self.low + 0.5 * (points + 1.0) * (self.high - self.low)
        physical = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, coordinates, 0.0)), coordinates)
        vectors = np.tile(self.problem.start, (len(points), 1))
        for of_channel in self.places:
            vectors[:, of_channel] = np.clip(physical, self.problem.low[of_channel], self.problem.high[of_channel])
        return vectors

    def values(self, points: Floats) -> list[Floats]:
        """BSDF without the common scale at points (G, D), (G, N, C) in 1/sr, and standard deviations of the data."""
        share = max(1, min(SHARE, -(-len(points) // cores())))
        return in_shares(lambda rows: self.problem.call(_unscaled, rows), self.vectors(points), share)


def emulate(problem: Problem, options: MapOptions = DEFAULT) -> tuple[Emulator | None, str]:
    """An emulator of a problem's transport over the box of its parameters, if one that holds can be made; in words."""
    places = _places(problem)
    if isinstance(places, str):
        return None, places
    tolerance, low, high = 0.5 * options.emulator_error, problem.low[places].min(0), problem.high[places].max(0)
    logarithmic = (low > 0.0) & (high > LOGARITHMIC_ABOVE * low)
    low, high = (np.where(logarithmic, np.log(np.where(logarithmic, end, 1.0)), end) for end in (low, high))
    space = _Space(problem, places, low, high, logarithmic)
    needed, offset = _needed_terms(space, tolerance)
    if max(needed) == LINE_NODES:
        return None, f"no series of less than {LINE_NODES} terms a parameter holds"
    terms = tuple(max(2, int(count / MORE)) for count in needed)
    for _ in range(ROUNDS):
        solves = int(np.prod(terms))
        if solves > options.emulator_max_solves:
            break
        options.progress("emulator", 0, solves, " x ".join(map(str, terms)))
        emulator = _make(space, terms, offset, tolerance)
        # the largest error at points that were not solved for it, in standard deviations of the data
        points = 2.0 * qmc.Sobol(len(low), rng=np.random.default_rng(1)).random(CHECKS) - 1.0
        values, sigma = space.values(points)
        found = np.asarray(jax.vmap(emulator.values)(jnp.asarray(space.vectors(points))))
        error = float(np.max(np.abs(found - values) / sigma))
        if error <= options.emulator_error:
            count = len(emulator.orders)
            return emulator, f"an emulator of {count:,} terms from {solves:,} solutions, error {error:.2g} sd"
        terms = tuple(int(np.ceil(MORE * count)) for count in terms)
    solves = int(np.prod(terms))
    return None, f"an emulator of {solves:,} solutions would be needed, of {options.emulator_max_solves:,} allowed"


def _places(problem: Problem) -> Integers | str:
    """Places of the parameters of a stack for each channel, (C, D); or why there is none."""
    model = problem.model
    if model.optics is not None:
        return "an instrument stands between the transport and the data"
    common: list[int] = []
    channelwise: dict[str, dict[int, int]] = {}
    for place, name in enumerate(problem.names[: model.moving]):
        if parts := re.fullmatch(r"(.*)\[(\d+)\]", name):
            channelwise.setdefault(parts[1], {})[int(parts[2])] = place
        elif name != "scale":
            common.append(place)
    channels = range(model.values.shape[-1])
    if any(set(places) != set(channels) for places in channelwise.values()):
        return "numbers of channels do not match those of the data"
    if not common and not channelwise:
        return "no parameter of the stack is free"
    return np.array([[*common, *(places[channel] for places in channelwise.values())] for channel in channels])


def _needed_terms(space: _Space, tolerance: float) -> tuple[tuple[int, ...], Floats]:
    """How many terms each coordinate needs, `LINE_NODES` where fewer do not suffice, and the offset (N, C), by lines
    through the middle of the box and some of its corners, near which series are worst."""
    count, nodes = len(space.low), chebpts1(LINE_NODES)[::-1]
    corners = np.random.default_rng(0).permuted(np.arange(2**count))[:CORNERS]
    through = np.concatenate([np.zeros((1, count)), 2.0 * (corners[:, None] >> np.arange(count) & 1) - 1.0])
    lines = np.broadcast_to(through[None, :, None], (count, len(through), LINE_NODES, count)).copy()
    for coordinate in range(count):
        lines[coordinate, ..., coordinate] = nodes
    values, sigma = (part.reshape(*lines.shape[:3], *part.shape[1:]) for part in space.values(lines.reshape(-1, count)))
    offset = np.mean(np.abs(values), axis=(0, 1, 2))  # with a datum's mean, series of the logarithm are shortest
    if np.any(values + offset <= 0.0):
        return (LINE_NODES,), offset
    series = np.abs(_series(np.log(values + offset), 2))
    tails = np.cumsum(series[:, :, ::-1], axis=2)[:, :, ::-1]  # of what is omitted from each term on
    influence = np.max((values + offset) / sigma, axis=2, keepdims=True)
    errors = np.max(tails * influence, axis=(1, 3, 4))
    terms = [np.append(np.flatnonzero(error < tolerance), LINE_NODES)[0] for error in errors]
    return tuple(max(2, int(one)) for one in terms), offset


def _series(values: Floats, axis: int) -> Floats:
    """Coefficients of Chebyshev series along an axis from values at the polynomial's zeros."""
    coefficients = np.asarray(fft.dct(values, type=2, axis=axis)) / values.shape[axis]
    np.moveaxis(coefficients, axis, 0)[0] *= 0.5
    return coefficients


def _make(space: _Space, terms: tuple[int, ...], offset: Floats, tolerance: float) -> Emulator:
    orders = np.indices(terms).reshape(len(terms), -1).T
    nodes = np.stack([chebpts1(count)[::-1][order] for count, order in zip(terms, orders.T, strict=True)], axis=1)
    values, sigma = space.values(nodes)
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
    arrays: dict[str, Any] = {"orders": orders[kept], "coefficients": series[:, kept]}
    arrays |= {"directions": directions, "mean": mean.T, "offset": offset.T, "logarithmic": space.logarithmic}
    return Emulator.of(arrays | {"low": space.low, "high": space.high, "places": space.places})


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
