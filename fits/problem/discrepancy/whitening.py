"""Residuals less the model discrepancy, with derivatives in closed form.

With A from white numbers c to errors in standard deviations of the noise, z the residuals, and B = 1 + A'A = C C',
c = B^-1 A'z. A number of the process moves the root of its covariance by dA = A X, where X + X' is the change of that
covariance between white numbers; then

    dc = B^-1 (X + X') c - X c,    d(A c) = A B^-1 (X + X') c,    d log diag C = diag(C^-1 (B - 1) X C'^-1),

and C^-1 (B - 1) = C' - C^-1. So a Jacobian by many parameters makes matrices for the few numbers of the process alone.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular

from fits.problem.discrepancy.kernel import correlation, log_scales

Trio = tuple[Array, Array, Array]

JITTER = 1e-8
"""On the diagonal of a kernel's matrix: what rounding leaves of its smallest eigenvalues."""


class Correlation(NamedTuple):
    """The numbers of a process, as `fits.problem.discrepancy.parameters.Discrepancy` says of them."""

    amplitude: Any
    length_half: Any
    length_difference: Any
    grazing_exponent: Any
    channel_correlation: Any


class Roots(NamedTuple):
    """Roots of the covariance of channels, (C, C), and of inducing points, (R, R), but for the amplitude; that of all
    is their product."""

    channels: Array
    inducing_points: Array


class Move(NamedTuple):
    """X of a number of the process: a factor between channels, (C, C), or between inducing points, (R, R); the other is
    1."""

    between_channels: bool
    factor: Array


def vector_of(at: Correlation, channels: int) -> Array:
    """Those of a process that matter, (4,) or (5,)."""
    return jnp.stack([jnp.asarray(number, float) for number in (at if channels > 1 else at[:4])])


def roots_of(numbers: Array, where: Array, channels: int) -> Roots:
    """The roots of a process on inducing points `where`, (R, 4)."""
    _, half, difference, growth = numbers[:4]
    own = correlation(where, where, half, difference) + JITTER * jnp.eye(len(where))
    between = numbers[4] + (1.0 - numbers[4]) * jnp.eye(channels) if channels > 1 else jnp.ones((1, 1))
    sizes = jnp.exp(growth * log_scales(where))
    return Roots(jnp.linalg.cholesky(between + JITTER * jnp.eye(channels)), sizes[:, None] * jnp.linalg.cholesky(own))


def moves_of(numbers: Array, where: Array, roots: Roots) -> list[Move]:
    """The moves of all numbers but the amplitude."""
    inverse = triangular_inverse(roots.inducing_points)
    sizes = jnp.exp(numbers[3] * log_scales(where))
    by_lengths = jax.jacfwd(lambda lengths: correlation(where, where, *lengths))(numbers[1:3])
    scaled = inverse * sizes
    found = [Move(False, _halved(scaled @ by_lengths[..., k] @ scaled.T)) for k in range(2)]
    found.append(Move(False, inverse @ (log_scales(where)[:, None] * roots.inducing_points)))
    if len(numbers) > 4:
        inverse = triangular_inverse(roots.channels)
        found.append(Move(True, _halved(inverse @ (1.0 - jnp.eye(len(inverse))) @ inverse.T)))
    return found


def moved(rows: Array, move: Move, roots: Roots) -> Array:
    """Rows (M, C R) of white numbers times X."""
    split = rows.reshape(-1, len(roots.channels), len(roots.inducing_points))
    by = "mcr,cx->mxr" if move.between_channels else "mcr,rx->mcx"
    return jnp.einsum(by, split, move.factor).reshape(rows.shape)


def on_points(roots: Roots, white: Array) -> Array:
    """Errors (C, R), at an amplitude of 1, from white numbers (C R,)."""
    return roots.channels @ white.reshape(len(roots.channels), -1) @ roots.inducing_points.T


def from_points(roots: Roots, observed: Array) -> Array:
    """The transpose of `on_points`: (C R,) from (C, R)."""
    return (roots.channels.T @ observed @ roots.inducing_points).reshape(-1)


def gram_of(weights: Array, relative: Array) -> Array:
    """What measurements say of inducing points, (C, R, R), by weights (N, R); relative: an error of 1 in units of
    noise, (N, C)."""
    return jnp.stack([weights.T @ (column[:, None] ** 2 * weights) for column in relative.T])


def unit_square(roots: Roots, gram: Array) -> Array:
    """A'A at an amplitude of 1, (C R, C R)."""
    square = jnp.einsum("ri,crs,sj->cij", roots.inducing_points, gram, roots.inducing_points)
    if len(square) == 1:
        return roots.channels[0, 0] ** 2 * square[0]
    size = square.shape[0] * square.shape[1]
    return jnp.einsum("cx,cy,cij->xiyj", roots.channels, roots.channels, square).reshape(size, size)


def root_of(amplitude: Array, square: Array) -> Array:
    """C, from A'A at an amplitude of 1."""
    return jnp.linalg.cholesky(amplitude**2 * square + jnp.eye(len(square)))


def triangular_inverse(root: Array) -> Array:
    """The inverse of a lower triangular matrix."""
    return solve_triangular(root, jnp.eye(len(root), dtype=root.dtype), lower=True)


@jax.custom_jvp
def whitened(numbers: Array, where: Array, weights: Array, gram: Array | None, z: Array, relative: Array) -> Trio:
    """z - A c (N, C), c (C R,) and log diag C (C R,), of residuals z (N, C) in units of the noise.

    Inducing points, weights (N, R) and a `gram` (C, R, R) that is given do not depend on parameters, nor does
    `relative` (N, C) with it.
    """
    roots = roots_of(numbers, where, z.shape[-1])
    square = unit_square(roots, gram_of(weights, relative) if gram is None else gram)
    root, amplitude = root_of(numbers[0], square), numbers[0]
    half = solve_triangular(root, amplitude * from_points(roots, (weights.T @ (relative * z)).T), lower=True)
    white = solve_triangular(root, half, lower=True, trans=1)
    errors = relative * (weights @ (amplitude * on_points(roots, white)).T)
    return z - errors, white, jnp.log(jnp.diagonal(root))


@whitened.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Trio, Trio]:
    numbers, where, weights, gram, z, relative = primals
    by_numbers, _, _, _, by_z, by_relative = tangents
    amplitude, roots = numbers[0], roots_of(numbers, where, z.shape[-1])
    square = unit_square(roots, gram_of(weights, relative) if gram is None else gram)
    root = root_of(amplitude, square)
    inverse = triangular_inverse(root)

    def back(x: Array) -> Array:
        """Towards white numbers, (C R,), from measurements, (N, C)."""
        return from_points(roots, (weights.T @ x).T)

    def solved(x: Array) -> Array:
        return inverse.T @ (inverse @ x)

    wanted = back(relative * z)
    white = amplitude * solved(wanted)
    discrepancy = weights @ (amplitude * on_points(roots, white)).T
    left = z - relative * discrepancy

    steps = moves_of(numbers, where, roots)
    pulled = [moved(white[None], step._replace(factor=step.factor.T), roots)[0] for step in steps]
    pushed = [moved(white[None], step, roots)[0] for step in steps]
    sums = [solved(one + other) for one, other in zip(pulled, pushed, strict=True)]
    by_amplitude = solved(wanted - 2.0 * amplitude * (square @ white))
    whites = [by_amplitude] + [total - one for total, one in zip(sums, pulled, strict=True)]
    errors = [white + amplitude * by_amplitude] + [amplitude * total for total in sums]

    safe = jnp.where(amplitude > 0.0, amplitude, 1.0)
    levels = [jnp.where(amplitude > 0.0, (1.0 - jnp.sum(inverse**2, axis=-1)) / safe, 0.0)]
    levels += [jnp.sum(moved(root.T - inverse, step, roots) * inverse, axis=-1) for step in steps]

    by_levels, observed, by_discrepancy = by_numbers @ jnp.stack(levels), relative * by_z, 0.0
    if gram is None:
        by_discrepancy = by_relative * discrepancy
        observed = observed + by_relative * left - relative * by_discrepancy
        parts = inverse.reshape(len(root), *map(len, roots)), roots.channels, weights @ roots.inducing_points
        seen = amplitude * jnp.einsum("mcr,dc,nr->mnd", *parts)
        by_levels = by_levels + jnp.tensordot(seen**2, relative * by_relative, 2)
    own = amplitude * solved(back(observed))
    moved_nodes = on_points(roots, by_numbers @ jnp.stack(errors) + amplitude * own)
    by_left = by_z - by_discrepancy - relative * (weights @ moved_nodes.T)
    found = left, white, jnp.log(jnp.diagonal(root))
    return found, (by_left, by_numbers @ jnp.stack(whites) + own, by_levels)


def _halved(matrix: Array) -> Array:
    """The lower triangle whose sum with its transpose is a symmetric matrix."""
    return jnp.tril(matrix) - 0.5 * jnp.diag(jnp.diagonal(matrix))
