"""Model discrepancy as a Gaussian process of the logarithm of the BSDF (Kennedy & O'Hagan 2001).

With model value f, datum d and noise n, g(d) = g(f) + e + n, where g is the logarithm and, below four standard
deviations of the noise, a straight line (`logarithm`). e has Matern kernels of the angles of half vector and difference
(Rusinkiewicz 1998), folded so that light and viewer may change places: errors follow a lobe from one incidence to the
next, and a measurement at 10 and 70 degrees says something of that at 70 and 10. Their standard deviation grows towards
grazing, by a power of the mean cosine of light and viewer, cos half cos difference. Channels have one correlation. The
process lives on inducing points, and costs a matrix of as many rows: the places of all measurements where these are
few, else of some, on which the others are regressed. Noise is that of the datum, so that the covariance does not depend
on the model, and most of its derivatives vanish.

The negative log-density of all measurements is half a sum of squares again, up to a constant: with A from white numbers
c to errors in standard deviations of the noise, z the residuals, and B = 1 + A'A = C C',

    (z'(1 + A A')^-1 z + log det (1 + A A')) / 2 = min_c (|z - A c|^2 + |c|^2) / 2 + sum log diag C.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from numpy.typing import ArrayLike

from fits.problem.discrepancy import whitening
from fits.problem.discrepancy.inducing_points import inducing_points
from fits.problem.discrepancy.kernel import correlation, log_scales
from fits.problem.discrepancy.whitening import Correlation, Roots, moved, roots_of, triangular_inverse, vector_of

LEAST = 1e-6
"""Of the information about a number of the process: what is kept of its smallest eigenvalue."""


class Whitened(NamedTuple):
    """Residuals that are independent, of N measurements in C channels, with C R white numbers.

    residuals: z - A c, (N, C). latent: c, (C R,). levels: the logarithms of the diagonal of B's root, (C R,), none
    below 0.
    """

    residuals: Array
    latent: Array
    levels: Array


class Process(eqx.Module):
    """A process on R `InducingPoints`. gram: `gram_of` measurements, (C, R, R), where their noise is known; else
    None."""

    where: Array
    weights: Array
    shortest: Array
    gram: Array | None = None

    def gram_of(self, relative: Array) -> Array:
        """What measurements say of inducing points, (C, R, R); relative: an error of 1 in units of the noise, (N,
        C)."""
        return whitening.gram_of(self.weights, relative)

    def whitened(self, z: Array, relative: Array, at: Correlation) -> Whitened:
        """What is left of residuals z (N, C) in units of the noise; relative: as for `gram_of`."""
        numbers = vector_of(at, z.shape[-1])
        return Whitened(*whitening.whitened(numbers, self.where, self.weights, self.gram, z, relative))

    def sample(self, white: Array, at: Correlation) -> Array:
        """Errors of the measurements, (N, C), from standard normal numbers (C, R)."""
        roots = roots_of(vector_of(at, len(white)), self.where, len(white))
        return at.amplitude * self.weights @ whitening.on_points(roots, white.reshape(-1)).T

    def whitened_residuals(self, z: Array, relative: Array, at: Correlation) -> Array:
        """Residuals z (N, C) by the symmetric root of their covariance, K^-1/2 z with K = 1 + A A'.

        Where the model holds they are independent standard normal, and their squares add up to z'K^-1 z. What is left
        of z beside what the process explains (`whitened`) is neither: the process follows each datum, so that it is
        smaller than 1, and negatively correlated between neighbours. Leave-one-out residuals (`leave_one_out`) have
        variance 1, but are correlated, too.
        """
        gram = self.gram_of(relative) if self.gram is None else self.gram
        roots = roots_of(vector_of(at, z.shape[-1]), self.where, z.shape[-1])
        spread, axes = jnp.linalg.eigh(at.amplitude**2 * whitening.unit_square(roots, gram))  # of A'A
        root = jnp.sqrt(1.0 + jnp.maximum(spread, 0.0))
        explained = at.amplitude * whitening.from_points(roots, (self.weights.T @ (relative * z)).T)
        white = -(axes @ ((axes.T @ explained) / (root * (1.0 + root))))  # ((1 + s)^-1/2 - 1) / s
        return z + relative * (self.weights @ (at.amplitude * whitening.on_points(roots, white)).T)

    def leave_one_out(self, whitened_data: Whitened, relative: Array, at: Correlation) -> tuple[Array, Array]:
        """Of each measurement its weighted residual and precision, (N, C): given all others it has mean residual /
        precision and variance 1 / precision, in units of the noise.
        """
        roots, root = self._factors(relative, at)
        rows = at.amplitude * jnp.einsum(
            "nc,cx,nr->ncxr", relative, roots.channels, self.weights @ roots.inducing_points
        )
        solved = solve_triangular(root, rows.reshape(relative.size, -1).T, lower=True)
        return whitened_data.residuals, 1.0 - jnp.sum(solved**2, axis=0).reshape(relative.shape)

    def predict(
        self, whitened_data: Whitened, relative: Array, at_places: Array, at: Correlation
    ) -> tuple[Array, Array]:
        """Errors of the model at other `places`, given residuals that were whitened: mean and sd, (M, C)."""
        roots, root = self._factors(relative, at)
        sizes, own = (jnp.exp(at.grazing_exponent * log_scales(where)) for where in (self.where, at_places))
        across = sizes[:, None] * own * correlation(self.where, at_places, at.length_half, at.length_difference)
        across = solve_triangular(roots.inducing_points, across, lower=True)
        rows = at.amplitude * jnp.einsum("cx,rm->mcxr", roots.channels, across)
        rows = rows.reshape(*rows.shape[:2], -1)
        solved = solve_triangular(root, rows.reshape(-1, rows.shape[-1]).T, lower=True)
        explained = jnp.sum(rows**2, axis=-1) - jnp.sum(solved**2, axis=0).reshape(rows.shape[:2])
        size = at.amplitude * own
        return -rows @ whitened_data.latent, jnp.sqrt(jnp.maximum(size[:, None] ** 2 - explained, 0.0))

    def information_rows(self, relative: Array, at: Correlation) -> Array:
        """Rows whose Jacobian A has in A'A the Fisher information of the measurements about the numbers of the process.

        With M = 1 - B^-1 and E = X + X' (see `whitening`), it is tr(M E M E) / 2.
        """
        numbers = vector_of(at, relative.shape[-1])
        held = jax.lax.stop_gradient(numbers)
        roots, root = self._factors(relative, Correlation(*held, *[0.0] * (5 - len(held))))
        inverse = triangular_inverse(root)
        seen = jnp.eye(len(root)) - inverse.T @ inverse
        parts = [2.0 / jnp.where(held[0] > 0.0, held[0], 1.0) * seen]
        for step in whitening.moves_of(held, self.where, roots):
            parts.append(moved(seen, step._replace(factor=step.factor + step.factor.T), roots))
        flat = jnp.stack(parts)
        information = 0.5 * jnp.einsum("kij,lji->kl", flat, flat)
        scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(information), LEAST))
        scaled = information * scale[:, None] * scale + LEAST * jnp.eye(len(scale))
        return jax.lax.stop_gradient(jnp.linalg.cholesky(scaled).T / scale) @ numbers

    def _factors(self, relative: Array, at: Correlation) -> tuple[Roots, Array]:
        """Roots of the covariances, and of B."""
        gram = self.gram_of(relative) if self.gram is None else self.gram
        numbers = vector_of(at, relative.shape[-1])
        roots = roots_of(numbers, self.where, relative.shape[-1])
        return roots, whitening.root_of(numbers[0], whitening.unit_square(roots, gram))


def make_process(wi: ArrayLike, wo: ArrayLike, channels: int = 1) -> Process:
    """The process of measurements along these directions, (N, 3) each, in so many channels."""
    return Process(*map(jnp.asarray, inducing_points(wi, wo, channels)))
