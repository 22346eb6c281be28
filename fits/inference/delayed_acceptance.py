"""Delayed acceptance (Christen and Fox 2005): many steps of a surrogate's posterior, then one exact evaluation.

The steps are reversible for the surrogate's posterior s, which is fixed before sampling begins; taking where they end
with the chance p(y) s(x) / (p(x) s(y)) is therefore Metropolis' rule for the exact posterior p, however good s is.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.inference.surrogate import Surrogate
from fits.problem.compiled import Static, run

STEPS_A_PARAMETER, FEWEST_STEPS, MOST_STEPS = 80, 100, 1000
STEP = 2.4  # standard deviations over the square root of their number: a random walk's best, for a Gaussian
SPREAD = 0.7  # of the logarithm of the length of its steps

Floats = NDArray[np.float64]


class DelayedAcceptance:
    """Proposals for `emcee.moves.MHMove`: ends of walks of the surrogate's posterior.

    root: (P, P), whose product with its transpose is about the covariance of the posterior.
    """

    def __init__(self, surrogate: Surrogate, root: Floats):
        arrays, static = eqx.partition(surrogate, eqx.is_array)
        self._split = arrays, Static(static)
        self._root = jnp.asarray(root)

    def propose(self, positions: Floats, generator: np.random.RandomState) -> tuple[Floats, Floats]:
        """Where walks from positions (n, P) end, and the log-ratio of densities that `emcee` asks for."""
        ends, before, after = self.walk(positions, generator)
        return ends, before - after

    def walk(
        self, positions: Floats, generator: np.random.RandomState, temperature: float = 1.0
    ) -> tuple[Floats, Floats, Floats]:
        """Ends of walks for the surrogate's posterior at a temperature, and its log there before and after."""
        seed = jnp.asarray(generator.randint(2**31))
        ends, before, after = run(_walk, self._split, jnp.asarray(positions), seed, self._root, temperature)
        return np.asarray(ends), np.asarray(before), np.asarray(after)

    def heights(self, positions: Floats) -> Floats:
        """Log-posterior of the surrogate at positions (n, P)."""
        return np.asarray(run(_heights, self._split, jnp.asarray(positions)))


def walk_length(dimension: int) -> int:
    """Steps after which a random walk has about forgotten where it began."""
    return min(max(STEPS_A_PARAMETER * dimension, FEWEST_STEPS), MOST_STEPS)


def _heights(model: Surrogate, positions: Array) -> Array:
    return jax.vmap(model.log_posterior_unconstrained)(positions)


def _walk(
    model: Surrogate, positions: Array, seed: Array, root: Array, temperature: Array
) -> tuple[Array, Array, Array]:
    count, dimension = positions.shape
    steps = walk_length(dimension)
    of_moves, of_lengths, of_levels = jax.random.split(jax.random.key(seed), 3)
    lengths = jnp.exp(SPREAD * jax.random.normal(of_lengths, (steps, count, 1), positions.dtype))
    moves = jax.random.normal(of_moves, (steps, count, dimension), positions.dtype) @ root.T
    levels = jnp.log(jax.random.uniform(of_levels, (steps, count), positions.dtype))

    def step(state: tuple[Array, Array], given: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        (here, height), (move, level) = state, given
        there = here + move
        other = _heights(model, there)
        taken = level < (other - height) / temperature
        return (jnp.where(taken[:, None], there, here), jnp.where(taken, other, height)), None

    first = _heights(model, positions)
    (ends, last), _ = jax.lax.scan(step, (positions, first), (STEP / jnp.sqrt(dimension) * lengths * moves, levels))
    return ends, first, last
