"""What a vector of parameters predicts, and how far that is from the data: pure functions that compile once.

`Model` holds a problem as arrays and static choices, so that one compiled program serves every problem of the same
structure and shape: new data, bounds or fixed numbers do not recompile.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

import layerjax as lj
from fits.problem.likelihood import (
    Objective,
    Tails,
    information_weights,
    log_density,
    named_residual,
    sigma_residual,
    tail_residual,
    total_sigma,
)
from fits.problem.parameters import Box, Template

Transport = lj.Transport | Literal["auto"] | Callable[[Any, Array, Array], Array]
"""How the values are computed: a layerjax transport, `"auto"`, or any callable in the place of one.

A callable takes the stack with numbers in place of its free parameters, and unit directions wi and wo, (N, 3) each,
and returns the BSDF in 1/sr, (N, C). JAX traces and differentiates it, and it must be hashable: functions, `jax.jit` of
them, `functools.partial`, equinox modules and most objects with `__call__` are.
"""

Side = Literal["all", "reflection"]


class Parts(NamedTuple):
    """What a vector of parameters stands for: the stack, the common scale, and the levels of the noise model."""

    stack: Any
    scale: Array
    relative: Array
    floor: Array


class Model(eqx.Module):
    """Pure functions of the physical vector (P,): predictions, residuals and log-densities over the used samples.

    Arrays are traced by `jax.jit`, the rest is static.

    Attributes:
        template: the stack, scale and noise levels without their free parameters.
        box: bounds and priors of the P parameters.
        wi, wo: directions of the N samples, (N, 3).
        values: BSDF in C channels, (N, C), in 1/sr.
        variance: the measurement's own, (N, C), in 1/sr^2.
        lowest: what sigma cannot fall below, (N, C), in 1/sr.
        degrees_of_freedom: of Student-t tails.
        transport: how the values are computed.
        side: "reflection" if all directions lie above.
        known: what is known of the directions beforehand.
        objective, tails: see `Problem` and `Noise`.
        varying: whether sigma depends on the parameters.
    """

    template: Template
    box: Box
    wi: Array
    wo: Array
    values: Array
    variance: Array
    lowest: Array
    degrees_of_freedom: Array
    transport: Transport
    known: lj.KnownDirections | None
    side: Side = eqx.field(static=True)
    objective: Objective = eqx.field(static=True)
    tails: Tails = eqx.field(static=True)
    varying: bool = eqx.field(static=True)

    def build(self, vector: Array) -> Parts:
        """Stack, scale and noise levels with these parameters."""
        return Parts(*self.template.fill(vector))

    def predict(self, vector: Array) -> Array:
        """Scaled BSDF, (N, C), in 1/sr."""
        return self._predict(self.build(vector))

    def sigma(self, vector: Array) -> Array:
        """Scale of the noise, (N, C), in 1/sr."""
        parts = self.build(vector)
        return total_sigma(self._predict(parts), self.variance, parts.relative, parts.floor)

    def standardised(self, vector: Array) -> Array:
        """(datum - model) / sigma, (N, C)."""
        predicted, sigma = self._predicted_and_sigma(vector)
        return (self.values - predicted) / sigma

    def residuals(self, vector: Array, fixed_sigma: Array | None = None) -> tuple[Array, ...]:
        """Arrays whose half sum of squares is minus the log-posterior up to a constant, or the named objective.

        The third of them, where sigma varies with the parameters, is that of log sigma. `fixed_sigma` (N, C), where it
        is finite, replaces sigma: the first step towards a fit of noise levels.
        """
        predicted, sigma = self._predicted_and_sigma(vector)
        if fixed_sigma is not None:
            sigma = jnp.where(jnp.isfinite(fixed_sigma), fixed_sigma, sigma)
        return self._residuals(vector, predicted, sigma)

    def information_rows(self, vector: Array) -> tuple[Array, Array, Array]:
        """Of the data (rows,) and of the prior (P,): their Jacobian A has the Fisher information A'A; and the cost.

        The expected information needs first derivatives only and is never indefinite; for Gaussian noise that is known
        it is J'J. For a named objective: its residuals. The cost is half the sum of squared residuals.
        """
        predicted, sigma = self._predicted_and_sigma(vector)
        residuals = self._residuals(vector, predicted, sigma)
        cost = half_squares(residuals)
        if self.objective != "likelihood":
            return residuals[0].reshape(-1), jnp.zeros_like(vector), cost
        of_mean, of_level = information_weights(self.tails, self.degrees_of_freedom)
        rows = jnp.sqrt(of_mean) * (predicted / jax.lax.stop_gradient(sigma)).reshape(-1)
        if self.varying:
            rows = jnp.concatenate([rows, jnp.sqrt(of_level) * jnp.log(sigma).reshape(-1)])
        return rows, self.box.prior_residuals(vector), cost

    def log_likelihood_per_datum(self, vector: Array) -> Array:
        """Normalised log-density of each datum, (N, C)."""
        predicted, sigma = self._predicted_and_sigma(vector)
        return log_density((self.values - predicted) / sigma, sigma, self.tails, self.degrees_of_freedom)

    def log_likelihood(self, vector: Array) -> Array:
        """Normalised log-likelihood: the sum of the log-densities of all data."""
        return jnp.sum(self.log_likelihood_per_datum(vector))

    def log_prior(self, vector: Array) -> Array:
        """Log-density of the physical vector, -inf outside the bounds."""
        return self.box.log_prior(vector)

    def log_posterior_unconstrained(self, u: Array) -> Array:
        """Log-posterior (not normalised) as a density over the unconstrained vector; -inf where undefined."""
        vector = self.box.constrain(u)
        total = self.log_likelihood(vector) + self.box.log_prior(vector) + self.box.log_determinant(u)
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)

    def _residuals(self, vector: Array, predicted: Array, sigma: Array) -> tuple[Array, ...]:
        if self.objective != "likelihood":
            return (named_residual(self.objective, predicted, self.values, jnp.abs(self.wi[:, 2:])),)
        z = (predicted - self.values) / sigma
        parts = [tail_residual(z, self.tails, self.degrees_of_freedom), self.box.prior_residuals(vector)]
        if self.varying:
            parts.append(sigma_residual(sigma, self.lowest))
        return tuple(parts)

    def _predicted_and_sigma(self, vector: Array) -> tuple[Array, Array]:
        parts = self.build(vector)
        predicted = self._predict(parts)
        return predicted, total_sigma(predicted, self.variance, parts.relative, parts.floor)

    def _predict(self, parts: Parts) -> Array:
        return parts.scale * forward(parts.stack, self.wi, self.wo, self.transport, self.side, self.known)


def half_squares(residuals: tuple[Array, ...]) -> Array:
    """Half the sum of the squares of all residuals: the cost that a fit minimises."""
    return 0.5 * jnp.sum(jnp.stack([jnp.sum(part**2) for part in residuals]))


def forward(
    stack: Any,
    wi: Array | NDArray[np.float64],
    wo: Array | NDArray[np.float64],
    transport: Transport,
    side: Side = "all",
    known: lj.KnownDirections | None = None,
) -> Array:
    """BSDF (N, C) in 1/sr along unit directions (N, 3): the one place where inference meets the forward models.

    Raises:
        ValueError: the transport is random, cannot carry the stack, or is nothing that could.
    """
    if isinstance(transport, lj.Transport) and transport.random:
        raise ValueError(f"transport: {type(transport).__name__} is random; use a deterministic one: AddingDoubling()")
    # a class is callable too, but only a transport that lacks its brackets: layerjax says so
    if callable(transport) and not isinstance(transport, lj.Transport | type):
        return transport(stack, jnp.asarray(wi), jnp.asarray(wo))
    return lj.evaluate(stack, wi, wo, cast(lj.Transport | Literal["auto"], transport), side=side, known=known)
