"""What a model lacks, as a Gaussian process: errors relative to its value that are alike where directions are alike.

With model value f, datum d and noise sigma, d = f (1 + e) + sigma n. e has Matern kernels of the angles of half vector
and difference (Rusinkiewicz 1998), folded so that light and viewer may change places: errors follow a lobe from one
incidence to the next, and a reading at 10 and 70 degrees tells of that at 70 and 10. Channels have one correlation. The
process lives on nodes of a grid, a cubic between them, and costs a matrix of as many rows as nodes that readings touch.

The negative log-density of all readings is half a sum of squares again, up to a constant: with A from white numbers c
to errors in standard deviations of the noise, z the residuals, and B = 1 + A'A = C C',

    (z'(1 + A A')^-1 z + log det (1 + A A')) / 2 = min_c (|z - A c|^2 + |c|^2) / 2 + sum log diag C.
"""

from itertools import product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

STEP, LEAST_STEP = 7.0, 0.1
"""Of the grid of nodes, in degrees, where readings reach far, and at least."""

STEPS = 10
"""At least across readings that do not reach far."""

MOST_NODES, COARSER = 300, 1.25
"""Where more would be touched, the grid is made so much coarser until they are not."""

TINY, FLAT = 1e-9, 1e-6

JITTER = 1e-8
"""On the diagonal of a kernel's matrix: what rounding leaves of its smallest eigenvalues."""


class Correlation(NamedTuple):
    """The numbers of a process, as `fits.problem.correlated.Correlated` says of them."""

    amplitude: Any
    half: Any
    difference: Any
    channels: Any


class Whitened(NamedTuple):
    """Residuals that are independent, of N readings in C channels, and R nodes.

    residuals: z - A c, (N, C). latent: c, (R C,). matrix: B, (R C, R C). levels: the logarithms of its root's diagonal,
    (R C,), none below 0.
    """

    residuals: Array
    latent: Array
    matrix: Array
    levels: Array


class Process(eqx.Module):
    """A process on R nodes. weights: (N, R), from nodes to readings. nodes: (R, 4), their `places`. steps: (2,), of the
    grid, in degrees.
    """

    weights: Array
    nodes: Array
    steps: Array

    def rows_beside(self, channels: int) -> int:
        """Residuals beside those of the readings: of white numbers, and of levels."""
        return 2 * channels * self.nodes.shape[0]

    def whitened(self, z: Array, relative: Array, at: Correlation) -> Whitened:
        """What is left of residuals z (N, C) in units of the noise; relative: the model's value in the same."""
        channels, nodes = self._roots(at, z.shape[-1])
        square = jnp.stack([self.weights.T @ (column[:, None] ** 2 * self.weights) for column in relative.T])
        square = nodes.T @ square @ nodes
        square = jnp.einsum("cd,ce,cij->idje", channels, channels, square)
        size = nodes.shape[0] * channels.shape[0]
        matrix = square.reshape(size, size) + jnp.eye(size)
        wanted = nodes.T @ (self.weights.T @ (relative * z)) @ channels
        latent, levels = _solved(matrix, wanted.reshape(size))
        errors = self.weights @ (nodes @ latent.reshape(wanted.shape)) @ channels.T
        return Whitened(z - relative * errors, latent, matrix, levels)

    def drawn(self, white: Array, at: Correlation) -> Array:
        """Relative errors of the readings, (N, C), from standard normal numbers (R, C)."""
        channels, nodes = self._roots(at, white.shape[1])
        return self.weights @ (nodes @ white) @ channels.T

    def given_others(self, found: Whitened, relative: Array, at: Correlation) -> tuple[Array, Array]:
        """Of each reading its weighted residual and precision, (N, C): given all others it has mean residual /
        precision and variance 1 / precision, in units of the noise.
        """
        channels, nodes = self._roots(at, relative.shape[-1])
        mixed = jnp.einsum("nc,ni,cd->ncid", relative, self.weights @ nodes, channels)
        solved = solve_triangular(jnp.linalg.cholesky(found.matrix), mixed.reshape(relative.size, -1).T, lower=True)
        return found.residuals, 1.0 - jnp.sum(solved**2, axis=0).reshape(relative.shape)

    def elsewhere(self, found: Whitened, at_places: Array, at: Correlation, channels: int) -> tuple[Array, Array]:
        """Relative errors of the model at other `places`, given residuals that were whitened: mean and sd, (M, C)."""
        between, nodes = self._roots(at, channels)
        across = solve_triangular(nodes, _kernel(self.nodes, at_places, at), lower=True).T
        mixed = jnp.einsum("mi,cd->mcid", across, between).reshape(len(across), channels, -1)
        solved = solve_triangular(jnp.linalg.cholesky(found.matrix), mixed.reshape(-1, mixed.shape[-1]).T, lower=True)
        told = jnp.sum(mixed**2, axis=-1) - jnp.sum(solved**2, axis=0).reshape(mixed.shape[:2])
        variance = at.amplitude**2 - told
        return -mixed @ found.latent, jnp.sqrt(jnp.maximum(variance, 0.0))

    def _roots(self, at: Correlation, channels: int) -> tuple[Array, Array]:
        """Roots of the kernel between channels, and between nodes, with the amplitude."""
        one = jnp.eye(channels)
        between = _kernel_root(at.channels + (1.0 - at.channels) * one) if channels > 1 else one
        plain = at._replace(amplitude=1.0)
        return between, at.amplitude * _kernel_root(_kernel(self.nodes, self.nodes, plain))


def make_process(wi: ArrayLike, wo: ArrayLike) -> Process:
    """The process of readings along these directions, (N, 3) each."""
    where = places(wi, wo)
    spans = np.array([np.ptp(where[:, 0]), max(np.ptp(where[:, 1]), np.ptp(where[:, 2]))])
    steps = np.clip(spans / STEPS, LEAST_STEP, STEP)
    while True:
        weights, nodes = _touched(where, steps)
        if len(nodes) <= MOST_NODES:
            return Process(jnp.asarray(weights), jnp.asarray(nodes), jnp.asarray(steps))
        steps = COARSER * steps


def places(wi: ArrayLike, wo: ArrayLike) -> Floats:
    """Where pairs of directions (N, 3) lie, (N, 4), in degrees: angle of half vector and normal, that of light and
    viewer to it along the plane of both and across; and the side: 0 and 1 reflection above and below, 2 through.
    """
    wi, wo = np.asarray(wi, float), np.asarray(wo, float)
    side = np.where(wi[:, 2] * wo[:, 2] <= 0.0, 2.0, np.where(wi[:, 2] > 0.0, 0.0, 1.0))
    upright = np.array([1.0, 1.0, 0.0])
    first, second = (w * upright + np.abs(w) * (1.0 - upright) for w in (wi, wo))
    half = first + second
    length = np.linalg.norm(half, axis=-1, keepdims=True)
    half = np.where(length > TINY, half / np.maximum(length, TINY), [0.0, 0.0, 1.0])
    tilt = np.degrees(np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2]))
    apart = np.degrees(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(first - second, axis=-1), 0.0, 1.0))) / 2.0
    normal = np.array([0.0, 0.0, 1.0]) - half[:, 2:] * half  # in the plane of normal and half vector
    parts = [np.abs(np.sum(axis * (first - second), axis=-1)) for axis in (normal, np.cross(half, normal))]
    size = np.hypot(*parts)
    along, across = (
        np.where(size > TINY, part / np.maximum(size, TINY), one) for part, one in zip(parts, (1.0, 0.0), strict=True)
    )
    return np.stack([tilt, apart * along, apart * across, side], axis=-1)


def matern(distance: Any, length: Any) -> Array:
    """Matern kernel of smoothness 3/2."""
    x = jnp.sqrt(3.0) * distance / length
    return (1.0 + x) * jnp.exp(-x)


def _kernel(one: Any, other: Any, at: Correlation) -> Array:
    """Between places (M, 4) and (R, 4)."""
    gaps = [jnp.asarray(one)[:, None, k] - jnp.asarray(other)[None, :, k] for k in range(4)]
    apart = jnp.sqrt(gaps[1] ** 2 + gaps[2] ** 2)
    alike = matern(jnp.abs(gaps[0]), at.half) * matern(apart, at.difference)
    return at.amplitude**2 * jnp.where(gaps[3] == 0.0, alike, 0.0)


def _touched(where: Floats, steps: Floats) -> tuple[Floats, Floats]:
    """Weights (N, R) from the nodes that readings touch, and these, (R, 4)."""
    sizes = np.array([steps[0], steps[1], steps[1]])
    flat = np.ptp(where[:, :3], axis=0) < FLAT
    scaled = where[:, :3] / sizes
    first = np.floor(scaled).astype(int)
    part = scaled - first
    entries: dict[tuple[int, ...], int] = {}
    rows, columns, values = [], [], []
    for offsets in product(*([0] if level else range(-1, 3) for level in flat)):
        weight = np.ones(len(where))
        key = np.where(flat, 0, first + np.array(offsets))
        for axis in range(3):
            if not flat[axis]:
                weight = weight * _cubic(part[:, axis] - offsets[axis])
        for row in np.flatnonzero(weight):
            entry = (*map(int, key[row]), int(where[row, 3]))
            rows.append(int(row))
            columns.append(entries.setdefault(entry, len(entries)))
            values.append(float(weight[row]))
    weights = np.zeros((len(where), len(entries)))
    np.add.at(weights, (rows, columns), values)
    keys = np.array(list(entries), float)
    nodes = np.where(flat, where[0, :3], keys[:, :3] * sizes)
    return weights, np.concatenate([nodes, keys[:, 3:]], axis=-1)


def _cubic(x: Floats) -> Floats:
    """Cubic convolution (Keys 1981): what a node counts at a distance of x steps."""
    x = np.abs(x)
    near = 1.5 * x**3 - 2.5 * x**2 + 1.0
    far = -0.5 * x**3 + 2.5 * x**2 - 4.0 * x + 2.0
    return np.where(x < 1.0, near, np.where(x < 2.0, far, 0.0))


def _kernel_root(matrix: Array) -> Array:
    return _root(matrix + JITTER * jnp.eye(len(matrix)))


@jax.custom_jvp
def _root(matrix: Array) -> Array:
    """Cholesky's: JAX's own solves for every derivative, which takes a hundred times as long as to multiply."""
    return jnp.linalg.cholesky(matrix)


@_root.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    root = _root(*primals)
    inverse = _inverse(root)
    inner = inverse @ tangents[0] @ inverse.T
    return root, root @ (jnp.tril(inner) - 0.5 * jnp.diag(jnp.diagonal(inner)))


@jax.custom_jvp
def _solved(matrix: Array, wanted: Array) -> tuple[Array, Array]:
    """matrix^-1 wanted, and the logarithms of the diagonal of the matrix's root."""
    root = jnp.linalg.cholesky(matrix)
    half = solve_triangular(root, wanted, lower=True)
    return solve_triangular(root, half, lower=True, trans=1), jnp.log(jnp.diagonal(root))


@_solved.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    root = jnp.linalg.cholesky(primals[0])
    inverse = _inverse(root)
    found = inverse.T @ (inverse @ primals[1])
    moved, wanted = tangents
    change = inverse.T @ (inverse @ (wanted - moved @ found))
    return (found, jnp.log(jnp.diagonal(root))), (change, 0.5 * jnp.sum((inverse @ moved) * inverse, axis=-1))


def _inverse(root: Array) -> Array:
    return solve_triangular(root, jnp.eye(len(root), dtype=root.dtype), lower=True)
