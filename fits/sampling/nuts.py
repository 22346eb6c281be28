"""A few chains of the No-U-Turn sampler (Hoffman and Gelman 2014) by blackjax: for many parameters.

Its metric is the covariance of the fit's approximation, which whitens the posterior, refined once in the warm-up; the
length of its steps is found by dual averaging. Where the fit lies on a ridge, or has other minima that hold a share of
the posterior, every step begins with a draw of their mixture, which is taken by the rule of Metropolis and Hastings:
trajectories alone seldom find the way into a thin tail, and never to another mode. The metric is then made of the
higher half of the samples: one as wide as the tail makes steps short everywhere. blackjax is an extra, and imported on
first use.
"""

from collections.abc import Callable
from typing import Any

import emcee
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.optimise.result import Fit
from fits.problem.compilation import cores, in_shares
from fits.problem.model import Model
from fits.progress import Progress
from fits.sampling.chain import MemoryChain
from fits.sampling.ensemble import log_posteriors, modes_of
from fits.sampling.laplace import Approximation, first_positions
from fits.sampling.mixture import Leaps, Mixture

CHAINS = 4
FIRST_STEP = 0.5  # in a whitened posterior
TARGET = 0.95  # mean acceptance: with longer steps than that, chains diverge from narrow ridges that bend
WARM_UP = (75, 75)  # steps before the metric is refined, and after
SETTLING = 25  # of the former, which the metric is not learned from
DRAWS = 4096  # of the approximation, for its covariance
OWN_SAMPLES = 10  # that the approximation's covariance counts as, and one a parameter

Floats = NDArray[np.float64]


def require_blackjax() -> None:
    """ValueError if the extra is not installed."""
    try:
        import blackjax  # noqa: F401
    except ImportError:
        raise ValueError('sampler="nuts" needs blackjax: pip install "layerjax[nuts]"') from None


class Nuts:
    """Moves the chains about the optimum of a fit. A step depends on the seed, its number, and where the chains are."""

    def __init__(self, fit: Fit, chain: MemoryChain, seed: int, progress: Progress | None):
        self.fit, self.problem, self.chain, self.seed = fit, fit.problem, chain, seed
        self.progress = progress
        self._compiled = False

    def decide(self) -> None:
        """Before the first step, and for all: starts, metric and length of steps, by a warm-up that is not kept."""
        generator = np.random.RandomState(self.seed)
        mixture, near = Mixture.of(self.fit), Approximation.of(self.fit)
        positions = first_positions((mixture or near).draw, self._finite, self.chain.shape[0], generator)
        if mixture is not None and mixture.held.any():  # its leaps know no bounds
            mixture = None
        leaps = None if mixture is None else mixture.leaps()
        modes = modes_of(mixture)
        metric, length, done = np.atleast_2d(np.cov(near.draw(generator, DRAWS).T)), FIRST_STEP, 0
        for steps in WARM_UP:
            begin, update, end = _dual_averaging(TARGET)
            state, visited, heights = begin(length), [], []
            for _ in range(steps):
                done += 1
                # before the chain's own steps, whose numbers are positive
                stride = float(np.exp(state.log_step_size))
                positions, height, _, acceptance = self._step(positions, -done, stride, metric, leaps)
                state = update(state, float(np.mean(acceptance)))
                visited.append(positions)
                heights.append(height)
                if self.progress is not None:
                    self.progress("warm-up", done, sum(WARM_UP))
            length = float(end(state))
            if done < sum(WARM_UP):
                settled, level = np.concatenate(visited[SETTLING:]), np.concatenate(heights[SETTLING:])
                settled = settled if leaps is None else settled[level >= np.median(level)]
                metric = _refined(metric, settled if not modes or mixture is None else _centred(mixture, settled))
            elif mixture is not None:
                mixture = mixture.refined(np.concatenate(visited))
        moves = {"sampler": "nuts", "positions": positions, "metric": metric, "length": length, "words": ""}
        self.chain.decide(moves | modes | ({} if mixture is None else mixture.arrays()))

    def advance(self, step: int, tell: Callable[[], None]) -> None:
        """Append steps to the chain until it has `step` of them, and `tell` of each."""
        chain, moves = self.chain, self.chain.moves
        positions = chain.get_last_sample().coords if chain.iteration else moves["positions"]
        leaps = Mixture.from_arrays(moves).leaps() if Mixture.within(moves) else None
        chain.grow(step - chain.iteration, None)
        random_state = np.random.RandomState(self.seed).get_state()  # part of a record, of no use here
        while chain.iteration < step:
            positions, heights, divergent, _ = self._step(
                positions, chain.iteration + 1, float(moves["length"]), np.asarray(moves["metric"]), leaps
            )
            state = emcee.State(positions, log_prob=heights, random_state=random_state)
            chain.save_step(state, ~divergent)
            tell()

    def _step(
        self, positions: Floats, number: int, length: float, metric: Floats, leaps: Leaps | None
    ) -> tuple[Any, ...]:
        """What `_step` gives, the chains on all cores: each follows as many gradients as its own trajectory takes."""

        def call(rows: Floats) -> tuple[Array, ...]:
            places, chains = rows[:, 1:], rows[:, 0].astype(int)
            return self.problem.call(_step, places, chains, self.seed, number, length, metric, leaps)

        rows = np.column_stack([np.arange(len(positions)), positions])
        found = in_shares(call, rows, -(-len(rows) // cores()), self._compiled)
        self._compiled = True
        return tuple(found)

    def _finite(self, positions: Floats) -> bool:
        return bool(np.all(np.isfinite(self.problem.call(log_posteriors, positions))))


def _dual_averaging(target: float) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    return dual_averaging_adaptation(target)


def _refined(metric: Floats, samples: Floats) -> Floats:
    """The covariance of samples (n, P), of which correlated ones are few, with what was known before."""
    own = OWN_SAMPLES + samples.shape[1]
    return (len(samples) * np.atleast_2d(np.cov(samples.T)) + own * metric) / (len(samples) + own)


def _centred(mixture: Mixture, samples: Floats) -> Floats:
    """Samples (n, P) about the mean of the mode that each belongs to: a metric as wide as modes lie apart fits none."""
    modes = mixture.mode_of(samples)
    means = np.stack([samples[modes == mode].mean(axis=0) for mode in np.unique(modes)])
    return samples - means[np.searchsorted(np.unique(modes), modes)]


def _step(
    model: Model,
    positions: Array,
    chains: Array,
    seed: Array,
    number: Array,
    length: Array,
    metric: Array,
    leaps: Leaps | None,
) -> tuple[Array, Array, Array, Array]:
    """Where a step takes chains (n, P) of these numbers, the log-posteriors there, whether they diverged, and their
    mean acceptance."""
    from blackjax.mcmc import nuts

    kernel, height = nuts.build_kernel(), model.log_posterior_unconstrained
    key = jax.random.fold_in(jax.random.key(seed), number)

    def one(given: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
        index, position = given
        of_path, of_leap = jax.random.split(jax.random.fold_in(key, index))
        if leaps is not None:
            position = _leapt(height, position, leaps, of_leap)
        # the state made anew: a chain that goes on from its file is the same to the last bit
        state = nuts.init(position, height)
        state, info = kernel(of_path, state, height, length, metric)
        return state.position, state.logdensity, info.is_divergent, info.acceptance_rate

    return jax.lax.map(one, (chains, positions))


def _leapt(height: Callable[[Array], Array], position: Array, leaps: Leaps, key: Array) -> Array:
    """A draw of the leaps instead of a position (P,), or the position: both of the posterior if that is."""
    of_draw, of_level = jax.random.split(key)
    drawn, inside = leaps.draw(of_draw, ())
    gain = height(drawn) - height(position) + leaps.log_density(position) - leaps.log_density(drawn)
    return jnp.where(inside & (jnp.log(jax.random.uniform(of_level, dtype=position.dtype)) < gain), drawn, position)
