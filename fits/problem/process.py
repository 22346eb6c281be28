"""What a model lacks, as a Gaussian process: errors relative to its value that are alike where directions are alike.

With model value f, datum d and noise sigma, d = f (1 + e) + sigma n. Along a scan e has a Matern kernel of the viewing
angle, and between scans one of the angle between their directions of light and one of that between their planes; the
channels have one correlation. All of these multiply, so that a process on nodes along each scan, a cubic between them,
costs a matrix of as many rows as there are nodes, whatever the number of readings (`Process.whitened`).

The negative log-density of all readings is half a sum of squares again, up to a constant: with A from white numbers c
to errors in standard deviations of the noise, z the residuals, and B = 1 + A'A = C C',

    (z'(1 + A A')^-1 z + log det (1 + A A')) / 2 = min_c (|z - A c|^2 + |c|^2) / 2 + sum log diag C.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from fits.data.geometry import LIGHT_AZIMUTH, direction
from fits.data.measurements import Measurements
from fits.data.scans import AT_NORMAL, incidences, planes, signed_angle

Floats = NDArray[np.float64]

NODES = 37
"""Along a scan, at most: every 5 degrees from horizon to horizon."""

FEWEST_NODES, LEAST_SPAN = 4, 0.1
"""Of a cubic, and of readings along a scan, in degrees."""

MOST_SCANS = 48
"""Data of more are no scans."""

TOLERANCE = 1e-6

JITTER = 1e-8
"""On the diagonal of a kernel's matrix: what rounding leaves of its smallest eigenvalues."""


class Correlation(NamedTuple):
    """The numbers of a process, as `fits.problem.correlated.Correlated` says of them."""

    amplitude: Any
    angle: Any
    incidence: Any
    azimuth: Any
    channels: Any


class Whitened(NamedTuple):
    """Residuals that are independent, of S scans of at most L readings in C channels, and R nodes.

    residuals: z - A c, (S, L, C), 0 where a scan has no more readings. latent: c, (R,). matrix: B, (R, R). levels: the
    logarithms of its root's diagonal, (R,), none below 0.
    """

    residuals: Array
    latent: Array
    matrix: Array
    levels: Array


class Places(NamedTuple):
    """Where readings lie: wi, plane and angle of each, (N, 3), (N,) and (N,), the last two in degrees."""

    wi: Any
    plane: Any
    angle: Any


class Process(eqx.Module):
    """A process on A nodes along each of S scans, whose readings it is interpolated to.

    rows, held: (S, L), the readings of each scan, and whether there is one. weights: (S, L, A), from nodes to readings.
    nodes: (A,), degrees. wi, plane: of each scan, (S, 3) and (S,).
    """

    rows: Array
    held: Array
    weights: Array
    nodes: Array
    wi: Array
    plane: Array

    @property
    def scans(self) -> int:
        """Number of scans."""
        return self.wi.shape[0]

    @property
    def several_incidences(self) -> bool:
        """Whether the light comes from more than one direction."""
        return bool(np.ptp(np.asarray(self.wi), axis=0).max() > TOLERANCE)

    @property
    def several_planes(self) -> bool:
        """Whether there are scans in more than one plane."""
        return bool(np.ptp(np.asarray(self.plane)) > TOLERANCE)

    def rows_beside(self, channels: int) -> int:
        """Residuals beside those of the readings: of white numbers, of levels, and of places that hold no reading."""
        empty = self.rows.size - int(np.sum(np.asarray(self.held)))
        return channels * (empty + 2 * self.scans * self.nodes.shape[0])

    def whitened(self, z: Array, relative: Array, at: Correlation) -> Whitened:
        """What is left of residuals z (N, C) in units of the noise; relative: the model's value in the same."""
        held = self.held[..., None]
        z, relative = (jnp.where(held, part[self.rows], 0.0) for part in (z, relative))
        scans, channels, nodes = self._roots(at, z.shape[-1])
        square = jnp.einsum("sla,slc,slb->scab", self.weights, relative**2, self.weights)
        square = jnp.einsum("ai,scab,bj->scij", nodes, square, nodes)
        square = jnp.einsum("sp,sq,cd,ce,scij->pdiqej", scans, scans, channels, channels, square)
        size = self.scans * channels.shape[0] * nodes.shape[0]
        matrix = square.reshape(size, size) + jnp.eye(size)
        wanted = jnp.einsum("sla,slc->sca", self.weights, relative * z)
        wanted = jnp.einsum("sp,cd,ai,sca->pdi", scans, channels, nodes, wanted).reshape(size)
        latent, levels = _solved(matrix, wanted)
        errors = jnp.einsum("sp,cd,ai,pdi->sca", scans, channels, nodes, latent.reshape(self.scans, -1, nodes.shape[0]))
        left = z - relative * jnp.einsum("sla,sca->slc", self.weights, errors)
        return Whitened(left, latent, matrix, levels)

    def drawn(self, white: Array, at: Correlation, count: int) -> Array:
        """Relative errors of `count` readings, (N, C), from standard normal numbers (S, C, A)."""
        scans, channels, nodes = self._roots(at, white.shape[1])
        errors = jnp.einsum("sp,cd,ai,pdi->sca", scans, channels, nodes, white)
        return self.by_reading(jnp.einsum("sla,sca->slc", self.weights, errors), count)

    def given_others(self, found: Whitened, relative: Array, at: Correlation) -> tuple[Array, Array]:
        """Of each of N readings its weighted residual and precision, (N, C): given all others it has mean residual /
        precision and variance 1 / precision, in units of the noise.
        """
        scans, channels, nodes = self._roots(at, relative.shape[-1])
        by_node = jnp.einsum("sla,ai->sli", self.weights, nodes)
        mixed = jnp.einsum("slc,sp,cd,sli->slcpdi", relative[self.rows], scans, channels, by_node)
        size = found.latent.size
        solved = solve_triangular(jnp.linalg.cholesky(found.matrix), mixed.reshape(-1, size).T, lower=True)
        precision = 1.0 - jnp.sum(solved**2, axis=0).reshape(found.residuals.shape)
        return self.by_reading(found.residuals, len(relative)), self.by_reading(precision, len(relative))

    def by_reading(self, part: Array, count: int) -> Array:
        """What is known of the readings of each scan, (S, L, C), in the order of all `count` of them, (N, C)."""
        return jnp.zeros((count, part.shape[-1])).at[self.rows].add(jnp.where(self.held[..., None], part, 0.0))

    def elsewhere(self, found: Whitened, places: Places, at: Correlation, channels: int) -> tuple[Array, Array]:
        """Relative errors of the model elsewhere, given residuals that were whitened: mean and sd, (M, C)."""
        scans, between, nodes = self._roots(at, channels)
        to_scans = at.amplitude**2 * _between_scans(places.wi, places.plane, self.wi, self.plane, at)
        to_nodes = matern(chord(places.angle, self.nodes), at.angle)
        by_scan = solve_triangular(scans, to_scans.T, lower=True).T
        by_node = solve_triangular(nodes, to_nodes.T, lower=True).T
        mixed = jnp.einsum("ms,cd,ma->mcsda", by_scan, between, by_node).reshape(len(places.angle), channels, -1)
        solved = solve_triangular(jnp.linalg.cholesky(found.matrix), mixed.reshape(-1, mixed.shape[-1]).T, lower=True)
        told = jnp.sum(mixed**2, axis=-1) - jnp.sum(solved**2, axis=0).reshape(mixed.shape[:2])
        variance = at.amplitude**2 - told
        return -mixed @ found.latent, jnp.sqrt(jnp.maximum(variance, 0.0))

    def _roots(self, at: Correlation, channels: int) -> tuple[Array, Array, Array]:
        """Roots of the kernel between scans, with the amplitude, between channels, and along a scan."""
        scans = at.amplitude * _kernel_root(_between_scans(self.wi, self.plane, self.wi, self.plane, at))
        one = jnp.eye(channels)
        between = _kernel_root(at.channels + (1.0 - at.channels) * one) if channels > 1 else one
        return scans, between, _kernel_root(matern(chord(self.nodes, self.nodes), at.angle))


def make_process(data: Measurements) -> Process:
    """The process of used samples.

    Raises:
        ValueError: they do not lie on scans.
    """
    places = places_of(data)
    keys = np.stack([_group(data), planes(data)], axis=-1)
    unique, which = np.unique(keys, axis=0, return_inverse=True)
    which = which.ravel()
    if len(unique) > MOST_SCANS:
        raise ValueError(
            f"noise.correlated: {len(data)} readings lie on {len(unique)} scans, at most {MOST_SCANS} may be; "
            "it needs readings along a few scans, each of one incidence and one plane"
        )
    nodes = _nodes(places.angle)
    longest = int(np.bincount(which).max())
    rows = np.zeros((len(unique), longest), int)
    held = np.zeros((len(unique), longest), bool)
    for scan in range(len(unique)):
        own = np.flatnonzero(which == scan)
        rows[scan, : len(own)], held[scan, : len(own)] = own, True
    cardinal = make_interp_spline(nodes, np.eye(len(nodes)), k=3)(places.angle)
    firsts = rows[:, 0]
    return Process(
        rows=jnp.asarray(rows),
        held=jnp.asarray(held),
        weights=jnp.asarray(np.where(held[..., None], cardinal[rows], 0.0)),
        nodes=jnp.asarray(nodes),
        wi=jnp.asarray(places.wi[firsts]),
        plane=jnp.asarray(places.plane[firsts]),
    )


def places_of(data: Measurements) -> Places:
    """Where all samples lie."""
    wi = np.where((data.theta_i < AT_NORMAL)[:, None], direction(0.0, LIGHT_AZIMUTH), data.wi)
    return Places(wi, planes(data).astype(float), signed_angle(data))


def matern(distance: Any, length: Any) -> Array:
    """Matern kernel of smoothness 3/2."""
    x = jnp.sqrt(3.0) * distance / length
    return (1.0 + x) * jnp.exp(-x)


def chord(one: Any, other: Any) -> Array:
    """Distances on the circle between angles in degrees, (M, A), as the crow flies."""
    return jnp.degrees(2.0 * jnp.abs(jnp.sin(jnp.radians(0.5 * (one[:, None] - other[None, :])))))


def _between_scans(wi: Any, plane: Any, other_wi: Any, other_plane: Any, at: Correlation) -> Array:
    # as the crow flies, so that the kernel is positive on the sphere too
    apart = jnp.degrees(jnp.linalg.norm(jnp.asarray(wi)[:, None, :] - other_wi[None, :, :], axis=-1))
    turned = 0.5 * chord(2.0 * plane, 2.0 * other_plane)
    return matern(apart, at.incidence) * matern(turned, at.azimuth)


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


def _nodes(angles: Floats) -> Floats:
    """Nodes that the angles of all readings lie between, in degrees: from horizon to horizon where they go that far."""
    low, high = float(angles.min()), float(angles.max())
    count = min(max(len(np.unique(angles.round(1))), FEWEST_NODES), NODES)
    if high - low < LEAST_SPAN:
        low, high = low - LEAST_SPAN, high + LEAST_SPAN
    return np.linspace(low, high, count)


def _group(data: Measurements) -> NDArray[np.int_]:
    group = np.zeros(len(data), int)
    for number, incidence in enumerate(incidences(data)):
        group[incidence.rows] = number
    return group
