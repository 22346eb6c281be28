"""Delayed acceptance (Christen and Fox 2005): many steps of a surrogate's posterior, then one exact evaluation.

The steps are reversible for the surrogate's posterior s, which is fixed before sampling begins; taking where they end
with the chance p(y) s(x) / (p(x) s(y)) is therefore Metropolis' rule for the exact posterior p, however good s is.

A step has the covariance of the posterior, or, where that is thin, mostly the surrogate's own where the step begins (as
Girolami & Calderhead 2011, without drift). Where data know a product of parameters a hundred times better than each of
them, the posterior is a thin curved sheet, and of steps as long as it is wide none is taken. Among the steps are leaps:
draws of a mixture that was fitted to the surrogate's posterior. A walk that takes one has forgotten where it began.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular
from numpy.typing import NDArray
from scipy import special

from fits.problem.compilation import Static, run
from fits.sampling.mixture import Leaps, Mixture
from fits.sampling.surrogate import Surrogate

STEPS_A_PARAMETER, FEWEST_STEPS, MOST_STEPS = 17, 100, 1000
THIN = 5.0  # times narrower at its centre than as a whole: a thin posterior
WIDE = 0.15  # share of steps with the covariance of the whole posterior: they leap from one part of it to another
RESIDUALS = 8  # that the covariance is made of: those that change most
EDGE = 1e-12  # boxes: the centre of a posterior on a bound may be rounded to it
STEP = 2.4  # standard deviations over the square root of their number: a random walk's best, for a Gaussian
SPREAD = 0.7  # of the logarithm of the length of its steps
LEAPS = 0.3  # share of steps that are leaps

Floats = NDArray[np.float64]
State = tuple[Array, Array, Array]
"""A walker: where it is, the surrogate's log-posterior, and the leaps' log-density there."""


class DelayedAcceptance:
    """Proposals for `emcee.moves.MHMove`: ends of walks of the surrogate's posterior.

    root: (P, P), whose product with its transpose is about the covariance of the posterior. mixture: that is leapt
    to, fixed before sampling begins.
    """

    def __init__(self, surrogate: Surrogate, root: Floats, mixture: Mixture):
        arrays, static = eqx.partition(surrogate, eqx.is_array)
        self._split = arrays, Static(static)
        self._root, self._leaps = jnp.asarray(root), mixture.leaps()
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
        ends, before, after = run(
            self._walk, self._split, jnp.asarray(positions), seed, self._root, temperature, self._leaps
        )
        return np.asarray(ends), np.asarray(before), np.asarray(after)

    def heights(self, positions: Floats) -> Floats:
        """Log-posterior of the surrogate at positions (n, P)."""
        return np.asarray(run(_heights, self._split, jnp.asarray(positions)))


def walk_length(dimension: int) -> int:
    """Steps after which a walk has about forgotten where it began, where one leap in a hundred is taken."""
    return min(max(STEPS_A_PARAMETER * dimension, FEWEST_STEPS), MOST_STEPS)


def _heights(model: Surrogate, positions: Array) -> Array:
    return jax.vmap(model.log_posterior_unconstrained)(positions)


def _walk(
    model: Surrogate, positions: Array, seed: Array, root: Array, temperature: Array, leaps: Leaps
) -> tuple[Array, Array, Array]:
    """Ends of walks whose steps have one covariance, and heights before and after."""
    count, dimension = positions.shape
    steps = walk_length(dimension)
    of_moves, of_lengths, of_levels, of_leaps = jax.random.split(jax.random.key(seed), 4)
    lengths = jnp.exp(SPREAD * jax.random.normal(of_lengths, (steps, count, 1), positions.dtype))
    moves = jax.random.normal(of_moves, (steps, count, dimension), positions.dtype) @ root.T
    levels = jnp.log(jax.random.uniform(of_levels, (steps, count), positions.dtype))

    def at(place: Array) -> State:
        return place, model.log_posterior_unconstrained(place), leaps.log_density(place)

    def moved(here: State, move: Array, level: Array, leap: _Leap) -> State:
        there = at(jnp.where(leap.tried, leap.to, here[0] + move))
        gain = (there[1] - here[1]) / temperature + jnp.where(leap.tried, here[2] - there[2], 0.0)
        taken: State = jax.tree.map(partial(jnp.where, level < gain), there, here)
        return taken

    def together(state: State, given: tuple[Array, Array, _Leap]) -> tuple[State, None]:
        return jax.vmap(moved)(state, *given), None

    first = jax.vmap(at)(positions)
    moves *= STEP / jnp.sqrt(dimension) * lengths
    last, _ = jax.lax.scan(together, first, (moves, levels, _drawn(leaps, of_leaps, (steps, count))))
    return last[0], first[1], last[1]


class _Leap(NamedTuple):
    """Whether a step is a leap, and where to."""

    tried: Array
    to: Array


def _drawn(leaps: Leaps, key: Array, shape: tuple[int, int]) -> _Leap:
    """Of every step of every walker; none where the draw is outside the box, which depends on no walker."""
    of_kinds, of_draws = jax.random.split(key)
    to, inside = leaps.draw(of_draws, shape)
    return _Leap(inside & (jax.random.uniform(of_kinds, shape, to.dtype) < LEAPS), to)


def _precision(model: Surrogate, position: Array, root: Array) -> Array:
    """Inverse covariance of the surrogate about a position (P,), and of one unit more, in units of the root."""
    slopes = jax.jacfwd(lambda u: model.rotated_residuals(u, RESIDUALS)[0])(position) @ root
    return jnp.eye(len(position), dtype=position.dtype) + slopes.T @ slopes


class _At(NamedTuple):
    """A walker: where it is in units of the root, the log-posterior, the root of the inverse covariance, and leaps'
    log-density there."""

    place: Array
    height: Array
    inverse_root: Array
    density: Array


def _log_density(step: Array, inverse_root: Array) -> Array:
    """Of a draw of the Gaussian with this root of the inverse covariance."""
    white = inverse_root.T @ step
    return jnp.sum(jnp.log(jnp.diagonal(inverse_root))) - 0.5 * jnp.sum(white**2)


def _walk_along(
    model: Surrogate, positions: Array, seed: Array, root: Array, temperature: Array, leaps: Leaps
) -> tuple[Array, Array, Array]:
    """Ends of walks whose steps have the surrogate's covariance where they begin, and heights before and after."""
    count, dimension = positions.shape
    steps = walk_length(dimension)
    of_moves, of_lengths, of_levels, of_kinds, of_leaps = jax.random.split(jax.random.key(seed), 5)
    lengths = jnp.exp(SPREAD * jax.random.normal(of_lengths, (steps, count), positions.dtype))
    moves = jax.random.normal(of_moves, (steps, count, dimension), positions.dtype)
    levels = jnp.log(jax.random.uniform(of_levels, (steps, count), positions.dtype))
    wide = jax.random.uniform(of_kinds, (steps, count), positions.dtype) < WIDE

    def at(place: Array) -> _At:
        position = root @ place
        inverse_root = jnp.linalg.cholesky(_precision(model, position, root))
        return _At(place, model.log_posterior_unconstrained(position), inverse_root, leaps.log_density(position))

    def moved(here: _At, move: Array, length: Array, level: Array, wide: Array, leap: _Leap) -> _At:
        def root_at(end: _At) -> Array:
            return jnp.where(wide, jnp.eye(dimension, dtype=end.place.dtype), end.inverse_root)

        step = solve_triangular(root_at(here), move, lower=True, trans=1)
        there = at(jnp.where(leap.tried, leap.to, here.place + length * step))
        back, forth = (_log_density(step, root_at(end)) for end in (there, here))
        gain = (there.height - here.height) / temperature
        gain += jnp.where(leap.tried, here.density - there.density, back - forth)
        return jax.tree.map(partial(jnp.where, level < gain), there, here)

    def together(state: _At, given: tuple[Any, ...]) -> tuple[_At, None]:
        return jax.vmap(moved)(state, *given), None

    first = jax.vmap(at)(jnp.linalg.solve(root, positions.T).T)
    scale = STEP * jnp.sqrt(temperature / dimension)
    drawn = _drawn(leaps, of_leaps, (steps, count))
    drawn = drawn._replace(to=drawn.to @ jnp.linalg.inv(root).T)
    last, _ = jax.lax.scan(together, first, (moves, scale * lengths, levels, wide, drawn))
    return last.place @ root.T, first.height, last.height
