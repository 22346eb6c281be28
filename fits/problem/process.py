"""What a model lacks, as a Gaussian process: errors of its logarithm that are alike where directions are alike.

With model value f, datum d and noise n, g(d) = g(f) + e + n, where g is the logarithm and, below four standard
deviations of the noise, a straight line (`logarithm`). e has Matern kernels of the angles of half vector and difference
(Rusinkiewicz 1998), folded so that light and viewer may change places: errors follow a lobe from one incidence to the
next, and a reading at 10 and 70 degrees tells of that at 70 and 10. Their standard deviation grows towards grazing, by
a power of the mean cosine of light and viewer, cos half cos difference. Channels have one correlation. The process
lives on nodes that are the product of two grids, a cubic between them, and costs a matrix of as many rows. Noise is
that of the datum, so that the covariance does not depend on the model, and most of its derivatives vanish.

The negative log-density of all readings is half a sum of squares again, up to a constant: with A from white numbers c
to errors in standard deviations of the noise, z the residuals, and B = 1 + A'A = C C',

    (z'(1 + A A')^-1 z + log det (1 + A A')) / 2 = min_c (|z - A c|^2 + |c|^2) / 2 + sum log diag C.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from numpy.typing import ArrayLike

from fits.problem.nodes import grid

Trio = tuple[Array, Array, Array]

JITTER = 1e-8
"""On the diagonal of a kernel's matrix: what rounding leaves of its smallest eigenvalues."""

LEAST = 1e-6
"""Of the information about a number of the process: what is kept of its smallest eigenvalue."""


GRAZING = 85.0
"""Degrees from which errors grow no more."""


class Correlation(NamedTuple):
    """The numbers of a process, as `fits.problem.correlated.Correlated` says of them."""

    amplitude: Any
    half: Any
    difference: Any
    growth: Any
    channels: Any


class Roots(NamedTuple):
    """Of the covariance of channels, (C, C), of nodes in the half vector's angle, (H, H), and in the difference,
    (D, D); that of all is their product."""

    channels: Array
    half: Array
    difference: Array


class Whitened(NamedTuple):
    """Residuals that are independent, of N readings in C channels, with R = C H D white numbers.

    residuals: z - A c, (N, C). latent: c, (R,). levels: the logarithms of the diagonal of B's root, (R,), none below 0.
    """

    residuals: Array
    latent: Array
    levels: Array


class Process(eqx.Module):
    """A process on a `Grid` of H x D nodes. gram: `gram_of` readings, (C, H D, H D), where their noise is known; else
    None.
    """

    half: Array
    difference: Array
    half_weights: Array
    difference_weights: Array
    steps: Array
    gram: Array | None = None

    def rows_beside(self, channels: int) -> int:
        """Residuals beside those of the readings: of white numbers, and of levels."""
        return 2 * channels * self.half.size * len(self.difference)

    def gram_of(self, relative: Array) -> Array:
        """What readings tell of nodes, (C, H D, H D); relative: an error of 1 in units of the noise, (N, C)."""
        weights = self.half_weights[:, :, None] * self.difference_weights[:, None, :]
        weights = weights.reshape(len(weights), -1)
        return jnp.stack([weights.T @ (column[:, None] ** 2 * weights) for column in relative.T])

    def whitened(self, z: Array, relative: Array, at: Correlation) -> Whitened:
        """What is left of residuals z (N, C) in units of the noise; relative: as for `gram_of`."""
        wanted = jnp.stack([self.half_weights.T @ (x[:, None] * self.difference_weights) for x in (relative * z).T])
        numbers, nodes = _numbers(at, z.shape[-1]), (self.half, self.difference)
        if self.gram is None:
            found = _whitened(numbers, nodes, self.gram_of(relative), wanted)
        else:
            found = _whitened_by_known(numbers, nodes, self.gram, wanted)
        errors, latent, levels = found
        return Whitened(z - relative * self._at_readings(errors), latent, levels)

    def drawn(self, white: Array, at: Correlation) -> Array:
        """Errors of the readings, (N, C), from standard normal numbers (C, H, D)."""
        roots = _roots(_numbers(at, len(white)), (self.half, self.difference), len(white))
        return at.amplitude * self._at_readings(_mixed(roots, white))

    def given_others(self, found: Whitened, relative: Array, at: Correlation) -> tuple[Array, Array]:
        """Of each reading its weighted residual and precision, (N, C): given all others it has mean residual /
        precision and variance 1 / precision, in units of the noise.
        """
        roots, root = self._factors(relative, at)
        parts = roots.channels, self.half_weights @ roots.half, self.difference_weights @ roots.difference
        rows = at.amplitude * jnp.einsum("nc,cx,ni,nj->ncxij", relative, *parts)
        solved = solve_triangular(root, rows.reshape(relative.size, -1).T, lower=True)
        return found.residuals, 1.0 - jnp.sum(solved**2, axis=0).reshape(relative.shape)

    def elsewhere(self, found: Whitened, relative: Array, at_places: Array, at: Correlation) -> tuple[Array, Array]:
        """Errors of the model at other `places`, given residuals that were whitened: mean and sd, (M, C)."""
        roots, root = self._factors(relative, at)
        half = _half_kernel(self.half, at_places[:, 0], at)
        difference = _difference_kernel(self.difference, at_places[:, 1:], at)
        parts = (solve_triangular(a, b, lower=True) for a, b in ((roots.half, half), (roots.difference, difference)))
        rows = at.amplitude * jnp.einsum("cx,im,jm->mcxij", roots.channels, *parts)
        rows = rows.reshape(*rows.shape[:2], -1)
        solved = solve_triangular(root, rows.reshape(-1, rows.shape[-1]).T, lower=True)
        told = jnp.sum(rows**2, axis=-1) - jnp.sum(solved**2, axis=0).reshape(rows.shape[:2])
        size = at.amplitude * _sizes(at_places[:, 0], at.growth) * _sizes(_apart(at_places[:, 1:]), at.growth)
        return -rows @ found.latent, jnp.sqrt(jnp.maximum(size[:, None] ** 2 - told, 0.0))

    def information_rows(self, relative: Array, at: Correlation) -> Array:
        """Rows whose Jacobian A has in A'A the Fisher information of the readings about the numbers of the process.

        With M = 1 - B^-1 and E = R^-1 dK R'^-1, K = R R' the covariance of the nodes, it is tr(M E M E) / 2.
        """
        count, nodes = relative.shape[-1], (self.half, self.difference)
        numbers = _numbers(at, count)
        held = jax.lax.stop_gradient(numbers)
        roots, root = self._factors(relative, _as_correlation(held))
        inverse = _inverse(root)
        sizes = tuple(len(one) for one in roots)
        seen = (jnp.eye(len(root)) - inverse.T @ inverse).reshape(len(root), *sizes)
        moved = jax.jacfwd(lambda x: _kernels(x, nodes, count))(held)
        tops = [_inverse(one) for one in roots]
        inner = [jnp.einsum("ij,jkn,lk->nil", top, one, top) for top, one in zip(tops, moved, strict=True)]
        parts = [2.0 / jnp.where(held[0] > 0.0, held[0], 1.0) * seen]
        for by_channel, by_half, by_difference in zip(*(one[1:] for one in inner), strict=True):
            along = jnp.einsum("rchd,hg->rcgd", seen, by_half) + jnp.einsum("rchd,df->rchf", seen, by_difference)
            parts.append(along + jnp.einsum("rchd,cx->rxhd", seen, by_channel))
        flat = jnp.stack([part.reshape(root.shape) for part in parts])
        information = 0.5 * jnp.einsum("kij,lji->kl", flat, flat)
        scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(information), LEAST))
        scaled = information * scale[:, None] * scale + LEAST * jnp.eye(len(scale))
        return jax.lax.stop_gradient(jnp.linalg.cholesky(scaled).T / scale) @ numbers

    def _at_readings(self, errors: Array) -> Array:
        """(N, C), of those on the nodes, (C, H, D)."""
        each = [jnp.sum((self.half_weights @ one) * self.difference_weights, axis=-1) for one in errors]
        return jnp.stack(each, axis=-1)

    def _factors(self, relative: Array, at: Correlation) -> tuple[Roots, Array]:
        """Roots of the covariances, and of B."""
        count = relative.shape[-1]
        gram = self.gram_of(relative) if self.gram is None else self.gram
        numbers = _numbers(at, count)
        roots = _roots(numbers, (self.half, self.difference), count)
        return roots, jnp.linalg.cholesky(_matrix(numbers[0], roots, gram))


def make_process(wi: ArrayLike, wo: ArrayLike) -> Process:
    """The process of readings along these directions, (N, 3) each."""
    return Process(*map(jnp.asarray, grid(wi, wo)))


def matern(distance: Any, length: Any) -> Array:
    """Matern kernel of smoothness 5/2."""
    x = jnp.sqrt(5.0) * distance / length
    return (1.0 + x + x**2 / 3.0) * jnp.exp(-x)


def _half_kernel(one: Array, other: Array, at: Correlation) -> Array:
    sizes = _sizes(one, at.growth)[:, None] * _sizes(other, at.growth)
    return sizes * matern(jnp.abs(one[:, None] - other), at.half)


def _difference_kernel(one: Array, other: Array, at: Correlation) -> Array:
    """Between (D, 3) and (M, 3): angles, and sides that have nothing in common."""
    gaps = [one[:, None, k] - other[None, :, k] for k in range(3)]
    sizes = _sizes(_apart(one), at.growth)[:, None] * _sizes(_apart(other), at.growth)
    return jnp.where(gaps[2] == 0.0, sizes * matern(jnp.hypot(gaps[0], gaps[1]), at.difference), 0.0)


def _sizes(angle: Array, growth: Any) -> Array:
    """By what errors are larger at this angle, in degrees, than at 0."""
    return jnp.cos(jnp.radians(jnp.minimum(jnp.abs(angle), GRAZING))) ** -growth


def _apart(difference: Array) -> Array:
    """The angle (D,) of a difference (D, 3)."""
    return jnp.hypot(difference[:, 0], difference[:, 1])


def _numbers(at: Correlation, channels: int) -> Array:
    """Those of a process that matter, (4,) or (5,)."""
    return jnp.stack([jnp.asarray(number, float) for number in (at if channels > 1 else at[:4])])


def _as_correlation(numbers: Array) -> Correlation:
    return Correlation(*numbers, *[0.0] * (5 - len(numbers)))


def _kernels(numbers: Array, nodes: tuple[Array, Array], channels: int) -> tuple[Array, Array, Array]:
    """Covariances, but for the amplitude: see `Roots`."""
    at, (half, difference) = _as_correlation(numbers), nodes
    between = at.channels + (1.0 - at.channels) * jnp.eye(channels) if channels > 1 else jnp.ones((1, 1))
    plain = (between, _half_kernel(half, half, at), _difference_kernel(difference, difference, at))
    first, second, third = (one + JITTER * jnp.diag(jnp.diagonal(one)) for one in plain)
    return first, second, third


def _roots(numbers: Array, nodes: tuple[Array, Array], channels: int) -> Roots:
    return Roots(*map(_root, _kernels(numbers, nodes, channels)))


def _mixed(roots: Roots, x: Array) -> Array:
    """R x, for x (C, H, D)."""
    return jnp.einsum("cx,xhd->chd", roots.channels, roots.half @ x @ roots.difference.T)


def _matrix(amplitude: Array, roots: Roots, gram: Array) -> Array:
    """B, (R, R)."""
    square = _square(roots, gram)
    return amplitude**2 * square + jnp.eye(len(square))


def _square(roots: Roots, gram: Array) -> Array:
    """A'A at an amplitude of 1, (R, R)."""
    channels, half, difference = roots
    shape = (len(half), len(difference))
    square = gram.reshape(-1, *shape, *shape)
    square = jnp.einsum("chdgf,hi->cidgf", square, half)
    square = jnp.einsum("cidgf,dj->cijgf", square, difference)
    square = jnp.einsum("cijgf,gk->cijkf", square, half)
    square = jnp.einsum("cijkf,fl->cijkl", square, difference)
    if len(channels) > 1:
        square = jnp.einsum("cx,cy,cijkl->xijykl", channels, channels, square)
    size = len(channels) * shape[0] * shape[1]
    return square.reshape(size, size)


def _whitened(numbers: Array, nodes: tuple[Array, Array], gram: Array, wanted: Array) -> Trio:
    """Errors on the nodes, (C, H, D), white numbers and levels, from what readings tell and want, (C, H, D)."""
    roots = _roots(numbers, nodes, len(wanted))
    latent, levels = _solved(_matrix(numbers[0], roots, gram), numbers[0] * _mixed_back(roots, wanted))
    return numbers[0] * _mixed(roots, latent.reshape(wanted.shape)), latent, levels


def _mixed_back(roots: Roots, x: Array) -> Array:
    """R'x, (R,), for x (C, H, D)."""
    return jnp.einsum("xc,xhd->chd", roots.channels, roots.half.T @ x @ roots.difference).reshape(-1)


@jax.custom_jvp
def _whitened_by_known(numbers: Array, nodes: tuple[Array, Array], gram: Array, wanted: Array) -> Trio:
    """`_whitened` with nodes and gram that do not depend on parameters.

    Of a Jacobian by many parameters, matrices of derivatives are made for the few numbers of the process alone.
    """
    return _whitened(numbers, nodes, gram, wanted)


@_whitened_by_known.defjvp
def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Trio, Trio]:
    numbers, nodes, gram, wanted = primals
    moved, _, _, change = tangents
    amplitude = numbers[0]

    def parts(lengths: Array) -> tuple[Array, Array]:
        roots = _roots(jnp.concatenate([numbers[:1], lengths]), nodes, len(wanted))
        return _square(roots, gram), _mixed_back(roots, wanted)

    def on_nodes(numbers: Array, latent: Array) -> Array:
        roots = _roots(numbers, nodes, len(wanted))
        return numbers[0] * _mixed(roots, latent.reshape(wanted.shape))

    square, target = parts(numbers[1:])
    squares, targets = jax.jacfwd(parts)(numbers[1:])
    squares, targets = jnp.moveaxis(squares, -1, 0), targets.T
    root = jnp.linalg.cholesky(amplitude**2 * square + jnp.eye(len(square)))
    inverse = _inverse(root)
    latent = amplitude * (inverse.T @ (inverse @ target))
    pulled = [target - 2.0 * amplitude * (square @ latent)]
    pulled += [amplitude * (one - amplitude * (by @ latent)) for one, by in zip(targets, squares, strict=True)]
    latents = (inverse.T @ (inverse @ jnp.stack(pulled, axis=-1))).T
    safe = jnp.where(amplitude > 0.0, amplitude, 1.0)
    levels = [jnp.where(amplitude > 0.0, (1.0 - jnp.sum(inverse**2, axis=-1)) / safe, 0.0)]
    levels += [0.5 * amplitude**2 * jnp.sum((inverse @ by) * inverse, axis=-1) for by in squares]
    errors, by_numbers = jax.vmap(lambda *step: jax.jvp(on_nodes, (numbers, latent), step), out_axes=(None, 0))(
        jnp.eye(len(numbers)), latents
    )
    roots = _roots(numbers, nodes, len(wanted))
    own = amplitude * (inverse.T @ (inverse @ _mixed_back(roots, change)))
    found = errors, latent, jnp.log(jnp.diagonal(root))
    by_errors = jnp.tensordot(moved, by_numbers, 1) + on_nodes(numbers, own)
    return found, (by_errors, moved @ latents + own, moved @ jnp.stack(levels))


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
