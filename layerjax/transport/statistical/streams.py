"""Diffuse light between the layers of a stack by few streams, and interfaces between them.

The light that goes up, and that which goes down, is a polynomial of the cosine of degree 3, so that a layer is a matrix
of 4 by 4 and a stack a few products of them (`layerjax.transport.statistical.stream_layers`). Interfaces are read off
tables (``python -m layerjax.precompute streams``), in the basis of polynomials that are orthonormal in the weight 2 u
du; there the first one is diffuse light, and no energy is lost whatever else the tables say. Elsewhere streams are the
amplitudes sqrt(2 u w) L(u) at the Gauss nodes, where absorption is diagonal.

Errors beside the quadratures at random points (rms, largest): entries of interfaces 3e-4, 4e-3; moments of what enters
a denser medium 3e-3, 4e-2; and a thinner one 1e-2, 0.2, these where alpha is below 0.01, about the critical cosine.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_max, clamp_min
from layerjax.microsurface.energy_tables import dielectric_places, index_variable, interface_energies
from layerjax.microsurface.splines import read
from layerjax.quadrature import gauss_legendre
from layerjax.tables import load
from layerjax.transport.statistical.diffuse import roughness_variable

STREAMS = 4
"""Moments of the light up, and of that down."""

INTERFACES = (16, 16)
"""Coefficients of the table of interfaces along roughness and index."""

TRIANGLE = STREAMS * (STREAMS - 1) // 2
ENTRIES = STREAMS * STREAMS + 2 * TRIANGLE
"""Numbers of an interface: its transmission, and what its reflections are but for their first rows."""

ENTERING = {"denser": (16, 12, 12), "thinner": (32, 14, 12)}
"""Coefficients of the tables of light that enters, along cosine, roughness and index."""

NODES, WEIGHTS = gauss_legendre(STREAMS)


def polynomials(cosine: Array | np.ndarray) -> Array:
    """The polynomials that are orthonormal in 2 u du on [0, 1], (..., STREAMS); the first is 1."""
    powers = jnp.stack([cosine**j for j in range(STREAMS)], axis=-1)
    return matvec(jnp.asarray(_coefficients(), powers.dtype), powers)


@functools.cache
def _coefficients() -> np.ndarray:
    moments = 2.0 / (np.arange(STREAMS)[:, None] + np.arange(STREAMS) + 2.0)  # of powers in 2 u du
    return np.linalg.inv(np.linalg.cholesky(moments))


AT_NODES = np.sqrt(2.0 * NODES * WEIGHTS)[:, None] * (NODES[:, None] ** np.arange(STREAMS) @ _coefficients().T)
"""From coefficients of the polynomials to amplitudes at the nodes: an orthogonal matrix."""

DIFFUSE = AT_NODES[:, 0]
"""Amplitudes of diffuse light, and what sums amplitudes to flux."""


_MOMENTS_OF = np.linalg.inv(_coefficients())
"""Matrix from means of the polynomials to those of the powers of the cosine."""

LEAST_SPREAD, SKEWED, LEAST_COSINE = 1e-4, 3e-3, 0.02
"""Of a lobe: its least variance, that at which its skewness fades, and the least of the two cosines."""


class InterfaceMatrices(NamedTuple):
    """An interface between diffuse light, at the nodes: down and up through it, and back from above and from below."""

    down: Array
    up: Array
    top: Array
    bottom: Array


def entering(cosine: Array, alpha: Array, ior: Array) -> tuple[Array, Array]:
    """What an interface lets in of light along a cosine, and the means over that of the polynomials of the cosine
    behind it, (..., STREAMS), the first of them 1.
    """
    cosine, alpha, ior = jnp.broadcast_arrays(cosine, alpha, ior)
    passed = interface_energies(cosine, alpha, ior, multiple=True)[1]
    places, below = dielectric_places(cosine, alpha, ior), (ior < 1.0)[..., None]
    denser, thinner = ENTERING["denser"], ENTERING["thinner"]
    counts = [jnp.where(below, t, d) for d, t in zip(denser, thinner, strict=True)]
    sizes = [int(np.prod(shape)) for shape in (denser, thinner)]
    start = jnp.where(below, sizes[0], 0) + sum(sizes) * np.arange(STREAMS - 1)
    shares = _columns("entering", start, counts, places)
    return passed, jnp.concatenate([jnp.ones_like(passed)[..., None], shares], axis=-1)


def _columns(name: str, start: Array | np.ndarray, counts: Sequence[Any], places: Sequence[Array]) -> Array:
    """Splines that start at `start` in a table, (..., columns): side by side, so that a look is traced once for all."""
    shape = jnp.broadcast_shapes(start.shape, (*places[0].shape, start.shape[-1]))
    (found,) = read(
        load("streams")[name],
        jnp.asarray(start),
        counts,
        [jnp.broadcast_to(place[..., None], shape) for place in places],
    )
    return found


def arrival_share(shares: Array, arrival: Array) -> Array:
    """Share of such light that arrives, by its polynomials."""
    return dot(shares, arrival)


def two_cosines(shares: Array) -> tuple[Array, Array, Array]:
    """Two cosines that have the moments of light by its polynomials (Gauss' rule), their weights, (2, ...) each, and
    the variance of its cosine.

    Of a beam, whose third moment is the rounding of a table, they are even about the mean.
    """
    _, mean, square, cube = (dot(shares, jnp.asarray(row, shares.dtype)) for row in _MOMENTS_OF)
    spread = clamp_min(square - mean * mean, LEAST_SPREAD)
    skew = cube - mean * (3.0 * square - 2.0 * mean * mean)
    lean = skew * spread / (spread * spread + SKEWED * SKEWED)
    apart = jnp.sqrt(lean * lean + 4.0 * spread)
    low, high = mean + 0.5 * (lean - apart), mean + 0.5 * (lean + apart)
    share = (mean - low) / apart
    cosines = clamp_max(clamp_min(jnp.stack([low, high]), LEAST_COSINE), 1.0)
    return cosines, jnp.stack([1.0 - share, share]), spread


def interface_matrices(alpha: Array, ior: Array) -> InterfaceMatrices:
    """An interface. ior: index below it over that above."""
    inverted = ior < 1.0
    dense = jnp.where(inverted, 1.0 / ior, ior)
    places = roughness_variable(alpha), index_variable(dense)
    entries = _columns("interface", int(np.prod(INTERFACES)) * np.arange(ENTRIES), INTERFACES, places)
    inward, outer, inner = unpack(entries, dense)
    outward = jnp.swapaxes(inward, -1, -2) / (dense * dense)[..., None, None]
    turn = jnp.asarray(AT_NODES, entries.dtype)
    inward, outward, outer, inner = (matmul(matmul(turn, part), turn.T) for part in (inward, outward, outer, inner))
    flipped = inverted[..., None, None]

    def chosen(dense_below: Array, dense_above: Array) -> Array:
        return jnp.where(flipped, dense_above, dense_below)

    return InterfaceMatrices(
        chosen(inward, outward), chosen(outward, inward), chosen(outer, inner), chosen(inner, outer)
    )


def pack(inward: np.ndarray, outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """The entries of an interface that a table holds, (..., ENTRIES), of matrices (..., STREAMS, STREAMS)."""
    rows, columns = np.triu_indices(STREAMS - 1)
    parts = [part[..., 1 + rows, 1 + columns] for part in (outer, inner)]
    return np.concatenate([inward.reshape(*inward.shape[:-2], -1), *parts], axis=-1)


def unpack(entries: Array, dense: Array) -> tuple[Array, Array, Array]:
    """Transmission into the denser side and both reflections; their first rows are what is not transmitted."""
    whole = STREAMS * STREAMS
    inward = entries[..., :whole].reshape(*entries.shape[:-1], STREAMS, STREAMS)
    lost = jnp.asarray(np.eye(STREAMS)[0], entries.dtype)
    returned = lost - inward[..., :, 0] / (dense * dense)[..., None]
    reflections = []
    for row, first in ((lost - inward[..., 0, :], whole), (returned, whole + TRIANGLE)):
        places = np.zeros((STREAMS - 1, STREAMS - 1), int)
        places[np.triu_indices(STREAMS - 1)] = first + np.arange(TRIANGLE)
        places = np.maximum(places, places.T)
        rest = jnp.concatenate([row[..., 1:, None], entries[..., places]], axis=-1)
        reflections.append(jnp.concatenate([row[..., None, :], rest], axis=-2))
    outer, inner = reflections
    return inward, outer, inner


def polynomial_coefficients(arrival: Array) -> Array:
    """Matrix from streams to polynomials."""
    return matvec(jnp.asarray(AT_NODES.T, arrival.dtype), arrival)


def matmul(a: Array, b: Array) -> Array:
    """Product of small matrices, term by term.

    XLA calls a library for every product that it is given, and in single precision for every sum along an axis, which
    takes several times as long; and it would work out the factors anew for each of the sums that they are in.
    """
    a, b = jax.lax.optimization_barrier(a), jax.lax.optimization_barrier(b)
    return dot(a[..., :, None, :], jnp.swapaxes(b, -1, -2)[..., None, :, :])


def matvec(matrix: Array, vector: Array) -> Array:
    """Product of a small matrix and a vector."""
    return dot(matrix, vector[..., None, :])


def dot(a: Array, b: Array) -> Array:
    """Sum of the products of so many streams, or polynomials."""
    return sum((a[..., k] * b[..., k] for k in range(1, STREAMS)), a[..., 0] * b[..., 0])
