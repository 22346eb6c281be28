"""The log-posterior of a model, of whatever data: its likelihood and the priors of its box."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from fits.problem.parameters import Box


class Density(eqx.Module):
    """A log-likelihood of the physical vector (P,), and bounds and priors of its parameters."""

    box: eqx.AbstractVar[Box]

    @abc.abstractmethod
    def log_likelihood(self, vector: Array) -> Array:
        """Normalised log-likelihood of all data."""

    def log_prior(self, vector: Array) -> Array:
        """Log-density of the physical vector, -inf outside the bounds."""
        return self.box.log_prior(vector)

    def log_posterior_unconstrained(self, u: Array) -> Array:
        """Log-posterior (not normalised) as a density over the unconstrained vector; -inf where undefined."""
        vector = self.box.constrain(u)
        total = self.log_likelihood(vector) + self.box.log_prior(vector) + self.box.log_determinant(u)
        return jnp.where(jnp.isfinite(total), total, -jnp.inf)
