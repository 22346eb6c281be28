"""A model with polynomials in the place of its residuals, fitted to exact evaluations all over its posterior.

The log-posterior of a fit is half a sum of squares, whatever the noise and its tails (`problem.likelihood`), so that
polynomials of the residuals give it; prior, bounds and log-determinant stay exact. As only the sum of squares counts,
residuals are rotated to the few directions in which they change.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy.special import expit

from fits.problem.compilation import cores, in_shares
from fits.problem.joint import JointModel
from fits.problem.model import Model
from fits.problem.parameters import Box
from fits.problem.problem import Problem

DEGREES = (2, 3, 4)
MOST_TERMS = 500
MOST_NUMBERS = 100_000_000  # of residuals at all the points that a polynomial is fitted to
NEGLIGIBLE = 1e-3  # of the noise: directions in which residuals are smaller all over the posterior are left out
HALF_WEIGHT = 4.0  # so far below its height in the log-posterior, and half a unit more a parameter, a point counts half
COUNTS = 0.05  # weight from which the radius takes a point in
BEYOND = 1.2  # of the farthest such point: the radius
NARROWEST = 1e-12  # boxes
RANK = 1e-10
TINY = 1e-300  # under a root, which has no derivative at 0
WIDTH = 16  # K is a multiple: programs are compiled for few widths, and run as fast

Floats = NDArray[np.float64]


class Evaluated(NamedTuple):
    """Exact evaluations at n points (n, P) in unconstrained coordinates: residuals (n, R) and log-posterior (n,)."""

    positions: Floats
    residuals: Floats
    log_posterior: Floats

    def finite(self) -> "Evaluated":
        """The evaluations whose residuals and log-posterior are finite."""
        whole = np.isfinite(self.log_posterior) & np.all(np.isfinite(self.residuals), axis=1)
        return Evaluated(*(part[whole] for part in self))

    def joined(self, more: "Evaluated") -> "Evaluated":
        """These evaluations followed by more of them."""
        return Evaluated(*(np.concatenate(parts) for parts in zip(self, more, strict=True)))


def evaluate(model: Model, positions: Array) -> tuple[Array, Array]:
    """Residuals (n, R) of the data, without those of the prior, and log-posterior (n,), at positions (n, P)."""

    def one(u: Array) -> tuple[Array, Array]:
        data, _, *sigma = model.residuals(model.box.constrain(u))
        rows = jnp.concatenate([part.reshape(-1) for part in (data, *sigma)])
        prior = model.box.log_prior(model.box.constrain(u)) + model.box.log_determinant(u)
        total = prior - 0.5 * jnp.sum(rows**2)
        return rows, jnp.where(jnp.isfinite(total), total, -jnp.inf)

    return jax.lax.map(one, positions)


def evaluate_many(problem: Problem, positions: Floats, walkers: int) -> tuple[Floats, Floats]:
    """`evaluate` at positions (n, P) on all cores: half of the walkers, which move together, are a share for each."""
    at_once = max(1, walkers // (2 * min(cores(), walkers // 2)))
    residuals, log_posterior = in_shares(lambda part: problem.call(evaluate, part), positions, at_once)
    return residuals, log_posterior


class Surrogate(eqx.Module):
    """The posterior of a model whose likelihood comes from polynomials in P whitened coordinates: K, of T terms.

    Attributes:
        box: bounds and priors of the P parameters.
        centre, whiten: (P,) and (P, P), of the coordinates.
        radius: as far as they were fitted; beyond, their values there are taken, and the posterior falls off.
        weights: (T, K), of the terms.
        degree: of the polynomials.
    """

    box: Box
    centre: Array
    whiten: Array
    radius: Array
    weights: Array
    degree: int = eqx.field(static=True)

    def log_posterior_unconstrained(self, u: Array) -> Array:
        """Log-posterior, not normalised, over the unconstrained vector."""
        residuals, distance = self.rotated_residuals(u, self.weights.shape[1])
        beyond = jnp.maximum(distance - self.radius, 0.0)
        prior = self.box.log_prior(self.box.constrain(u)) + self.box.log_determinant(u)
        total = prior - 0.5 * jnp.sum(residuals**2) - 0.5 * beyond**2
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def rotated_residuals(self, u: Array, count: int) -> tuple[Array, Array]:
        """The first `count` of them, which change most, and how far from the centre that is."""
        z = self.whiten @ (jax.nn.sigmoid(u) - self.centre)
        distance = jnp.sqrt(jnp.sum(z**2) + TINY)
        inside = z * (self.radius / jnp.maximum(distance, self.radius))
        return monomials(inside, self.degree) @ self.weights[:, :count], distance

    def arrays(self) -> dict[str, Any]:
        """What `with_polynomials` makes it of."""
        return {name: np.asarray(getattr(self, name)) for name in (*POLYNOMIALS, "degree")}


POLYNOMIALS = ("centre", "whiten", "radius", "weights")


def with_polynomials(model: Model | JointModel, arrays: dict[str, Any]) -> Surrogate:
    """The surrogate of a model with these `Surrogate.arrays`."""
    own = {name: jnp.asarray(arrays[name]) for name in POLYNOMIALS}
    return Surrogate(box=model.box, **own, degree=int(arrays["degree"]))


def affordable_degrees(dimension: int, residuals: int, points_a_term: float) -> list[int]:
    """Degrees of polynomials for so many parameters and residuals, lowest first; none where there are too many."""
    return [
        degree
        for degree in DEGREES
        for terms in (term_count(dimension, degree),)
        if terms <= MOST_TERMS and points_a_term * terms * residuals <= MOST_NUMBERS
    ]


def term_count(dimension: int, degree: int) -> int:
    """Terms of a polynomial of this degree."""
    return math.comb(dimension + degree, degree)


def monomials(z: Any, degree: int) -> Any:
    """All products of up to `degree` of the coordinates `z` (..., P), as (..., T); of numpy's arrays or JAX's."""
    xp = np if isinstance(z, np.ndarray) else jnp
    blocks, before = [xp.ones_like(z[..., :1]), z], z
    first = list(range(z.shape[-1]))  # among `before`, the first without any coordinate before this one
    for _ in range(2, degree + 1):
        parts = [before[..., place:] * z[..., index : index + 1] for index, place in enumerate(first)]
        first = [sum(part.shape[-1] for part in parts[:index]) for index in range(len(parts))]
        before = xp.concatenate(parts, axis=-1)
        blocks.append(before)
    return xp.concatenate(blocks, axis=-1)


def fitted(model: Model | JointModel, degree: int, points: Evaluated) -> Surrogate:
    """The surrogate by least squares through evaluations, which count the less the lower the posterior is there."""
    unit = expit(points.positions)
    below = np.max(points.log_posterior) - points.log_posterior
    count = 1.0 / (1.0 + (below / (HALF_WEIGHT + 0.5 * unit.shape[1])) ** 2)
    centre = np.average(unit, axis=0, weights=count)
    spread, directions = np.linalg.eigh(np.atleast_2d(np.cov(unit.T, aweights=count)))
    whiten = directions.T / np.sqrt(np.maximum(spread, NARROWEST**2))[:, None]
    z = (unit - centre) @ whiten.T
    distance = np.linalg.norm(z, axis=1)
    radius = BEYOND * np.max(distance[count > COUNTS])
    inside = distance <= radius
    root = np.sqrt(count[inside])[:, None]
    left, values, right = np.linalg.svd(root * monomials(z[inside], degree), full_matrices=False)
    kept = values > RANK * values[0]
    # of the residuals, only what changes together, and how far: the sum of squares is left as it is
    shapes, sizes, _ = np.linalg.svd(left[:, kept].T @ (root * points.residuals[inside]), full_matrices=False)
    large = sizes > NEGLIGIBLE * np.linalg.norm(root)
    weights = (right[kept].T / values[kept]) @ (shapes[:, large] * sizes[large])
    weights = np.pad(weights, ((0, 0), (0, -weights.shape[1] % WIDTH)))
    return with_polynomials(
        model, {"centre": centre, "whiten": whiten, "radius": radius, "weights": weights, "degree": degree}
    )
