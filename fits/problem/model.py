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
from layerjax._shapes import require_single

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
        parts = self.build(vector)
        return parts.scale * forward(parts.stack, self.wi, self.wo, self.transport, self.side, self.known)

    def sigma(self, vector: Array) -> Array:
        """Scale of the noise, (N, C), in 1/sr."""
        return self.sigma_at(vector, self.predict(vector))

    def sigma_at(self, vector: Array, predicted: Array) -> Array:
        """Scale of the noise, (N, C), in 1/sr, with these parameters and what they predict, (N, C)."""
        parts = self.build(vector)
        return total_sigma(predicted, self.variance, parts.relative, parts.floor)

    def standardised_at(self, vector: Array, predicted: Array) -> Array:
        """(datum - model) / sigma, (N, C), with these parameters and what they predict; or, for a named objective,
        datum minus model in its own measure."""
        if self.objective != "likelihood":
            return -self._named(predicted)
        return (self.values - predicted) / self.sigma_at(vector, predicted)

    def cost_at(self, vector: Array, predicted: Array) -> Array:
        """Half the sum of squared residuals with these parameters and what they predict, (N, C)."""
        return half_squares(self._residuals(vector, predicted, self.sigma_at(vector, predicted)))

    def residuals(self, vector: Array, fixed_sigma: Array | None = None) -> tuple[Array, ...]:
        """Arrays whose half sum of squares is minus the log-posterior up to a constant, or the named objective.

        The third of them, where sigma varies with the parameters, is that of log sigma. `fixed_sigma` (N, C), where it
        is finite, replaces sigma: the first step towards a fit of noise levels.
        """
        return self.linear_parts(vector, fixed_sigma)[0]

    def linear_parts(
        self, vector: Array, fixed_sigma: Array | None = None
    ) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
        """See `residuals`; and what is predicted, (N, C), with the rows (rows,) of the data's Fisher information.

        The Jacobian A of these rows has the Fisher information A'A. The expected information needs first derivatives
        only and is never indefinite; for Gaussian noise that is known it is J'J. For a named objective: its residuals.
        """
        predicted = self.predict(vector)
        sigma = self.sigma_at(vector, predicted)
        rows = self._information_rows(predicted, sigma)
        if fixed_sigma is not None:
            sigma = jnp.where(jnp.isfinite(fixed_sigma), fixed_sigma, sigma)
        return self._residuals(vector, predicted, sigma), (predicted, rows)

    def log_likelihood_per_datum(self, vector: Array) -> Array:
        """Normalised log-density of each datum, (N, C)."""
        return self.log_likelihood_per_datum_at(vector, self.predict(vector))

    def log_likelihood_per_datum_at(self, vector: Array, predicted: Array) -> Array:
        """Normalised log-density of each datum, (N, C), from the values (N, C) that the parameters predict."""
        sigma = self.sigma_at(vector, predicted)
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

    def _named(self, predicted: Array) -> Array:
        assert self.objective != "likelihood"
        return named_residual(self.objective, predicted, self.values, jnp.abs(self.wi[:, 2:]))

    def _residuals(self, vector: Array, predicted: Array, sigma: Array) -> tuple[Array, ...]:
        if self.objective != "likelihood":
            return (self._named(predicted),)
        z = (predicted - self.values) / sigma
        parts = [tail_residual(z, self.tails, self.degrees_of_freedom), self.box.prior_residuals(vector)]
        if self.varying:
            parts.append(sigma_residual(sigma, self.lowest))
        return tuple(parts)

    def _information_rows(self, predicted: Array, sigma: Array) -> Array:
        if self.objective != "likelihood":
            return self._named(predicted).reshape(-1)
        of_mean, of_level = information_weights(self.tails, self.degrees_of_freedom)
        rows = jnp.sqrt(of_mean) * (predicted / jax.lax.stop_gradient(sigma)).reshape(-1)
        if self.varying:
            rows = jnp.concatenate([rows, jnp.sqrt(of_level) * jnp.log(sigma).reshape(-1)])
        return rows


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
    if isinstance(stack, lj.Stack):
        require_single(stack, "inference")
    return lj.evaluate(stack, wi, wo, cast(lj.Transport | Literal["auto"], transport), side=side, known=known)
