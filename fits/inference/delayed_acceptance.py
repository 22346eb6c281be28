"""Delayed acceptance (Christen and Fox 2005): many steps of a surrogate's posterior, then one exact evaluation.

The steps are reversible for the surrogate's posterior s, which is fixed before sampling begins; taking where they end
with the chance p(y) s(x) / (p(x) s(y)) is therefore Metropolis' rule for the exact posterior p, however good s is.

A step has the covariance of the posterior, or, where that is thin, mostly the surrogate's own where the step begins (as
Girolami & Calderhead 2011, without drift). Where data know a product of parameters a hundred times better than each of
them, the posterior is a thin curved sheet, and of steps as long as it is wide none is taken.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular
from numpy.typing import NDArray
from scipy import special

from fits.inference.surrogate import Surrogate
from fits.problem.compiled import Static, run

STEPS_A_PARAMETER, FEWEST_STEPS, MOST_STEPS = 80, 100, 1000
FEWER = 0.375  # times as many, of those that follow the surrogate's covariance
THIN = 5.0  # times narrower at its centre than as a whole: a thin posterior
WIDE = 0.15  # share of steps with the covariance of the whole posterior: they leap from one part of it to another
RESIDUALS = 8  # that the covariance is made of: those that change most
EDGE = 1e-12  # boxes: the centre of a posterior on a bound may be rounded to it
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
        centre = special.logit(np.clip(surrogate.centre, EDGE, 1.0 - EDGE))
        precision = np.asarray(run(_precision, self._split, jnp.asarray(centre), self._root))
        self._walk = _walk_along if np.linalg.eigvalsh(precision)[-1] > THIN**2 else _walk

    def propose(self, positions: Floats, generator: np.random.RandomState) -> tuple[Floats, Floats]:
        """Where walks from positions (n, P) end, and the log-ratio of densities that `emcee` asks for."""
        ends, before, after = self.walk(positions, generator)
        return ends, before - after

    def walk(
        self, positions: Floats, generator: np.random.RandomState, temperature: float = 1.0
    ) -> tuple[Floats, Floats, Floats]:
        """Ends of walks for the surrogate's posterior at a temperature, and its log there before and after."""
        seed = jnp.asarray(generator.randint(2**31))
        ends, before, after = run(self._walk, self._split, jnp.asarray(positions), seed, self._root, temperature)
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
    """Ends of walks whose steps have one covariance, and heights before and after."""
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


def _precision(model: Surrogate, position: Array, root: Array) -> Array:
    """Inverse covariance of the surrogate about a position (P,), and of one unit more, in units of the root."""
    slopes = jax.jacfwd(lambda u: model.rotated_residuals(u, RESIDUALS)[0])(position) @ root
    return jnp.eye(len(position), dtype=position.dtype) + slopes.T @ slopes


class _At(NamedTuple):
    """A walker: where it is in units of the root, the log-posterior there, and the root of the inverse covariance."""

    place: Array
    height: Array
    inverse_root: Array


def _log_density(step: Array, inverse_root: Array) -> Array:
    """Of a draw of the Gaussian with this root of the inverse covariance."""
    white = inverse_root.T @ step
    return jnp.sum(jnp.log(jnp.diagonal(inverse_root))) - 0.5 * jnp.sum(white**2)


def _walk_along(
    model: Surrogate, positions: Array, seed: Array, root: Array, temperature: Array
) -> tuple[Array, Array, Array]:
    """Ends of walks whose steps have the surrogate's covariance where they begin, and heights before and after."""
    count, dimension = positions.shape
    steps = max(FEWEST_STEPS, int(FEWER * walk_length(dimension)))
    of_moves, of_lengths, of_levels, of_kinds = jax.random.split(jax.random.key(seed), 4)
    lengths = jnp.exp(SPREAD * jax.random.normal(of_lengths, (steps, count), positions.dtype))
    moves = jax.random.normal(of_moves, (steps, count, dimension), positions.dtype)
    levels = jnp.log(jax.random.uniform(of_levels, (steps, count), positions.dtype))
    wide = jax.random.uniform(of_kinds, (steps, count), positions.dtype) < WIDE

    def at(place: Array) -> _At:
        precision = _precision(model, root @ place, root)
        return _At(place, model.log_posterior_unconstrained(root @ place), jnp.linalg.cholesky(precision))

    def moved(here: _At, move: Array, length: Array, level: Array, wide: Array) -> _At:
        def root_at(end: _At) -> Array:
            return jnp.where(wide, jnp.eye(dimension, dtype=end.place.dtype), end.inverse_root)

        step = solve_triangular(root_at(here), move, lower=True, trans=1)
        there = at(here.place + length * step)
        back, forth = (_log_density(step, root_at(end)) for end in (there, here))
        gain = (there.height - here.height) / temperature + back - forth
        return jax.tree.map(partial(jnp.where, level < gain), there, here)

    def together(state: _At, given: tuple[Array, ...]) -> tuple[_At, None]:
        return jax.vmap(moved)(state, *given), None

    first = jax.vmap(at)(jnp.linalg.solve(root, positions.T).T)
    scale = STEP * jnp.sqrt(temperature / dimension)
    last, _ = jax.lax.scan(together, first, (moves, scale * lengths, levels, wide))
    return last.place @ root.T, first.height, last.height
