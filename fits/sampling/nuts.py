"""A few chains of the No-U-Turn sampler (Hoffman and Gelman 2014) by blackjax: for many parameters.

Each begins with a draw of Laplace's approximation, whose covariance is the first metric, and finds its own metric and
step size by blackjax's window adaptation. A step is a trajectory after a jump to a draw of the mixture, which is
taken by the rule of Metropolis and Hastings: trajectories alone never find another mode. blackjax is an extra.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import emcee
import jax
import numpy as np
from jax import Array

from fits.data.geometry import Floats
from fits.optimise.result import Fit
from fits.problem.compilation import cores, in_shares
from fits.problem.model import Model
from fits.progress import Progress
from fits.sampling.chain import Chain
from fits.sampling.ensemble import first_mixture, propose
from fits.sampling.initial import first_positions, log_posteriors, share_of
from fits.sampling.mixture import Mixture
from fits.sampling.options import SamplerOptions

CHAINS = 4
DRAWS = 4096  # of the approximation, for its covariance


def require_blackjax() -> None:
    """ValueError if the extra is not installed."""
    try:
        import blackjax  # noqa: F401
    except ImportError:
        raise ValueError('sampler="nuts" needs blackjax: pip install "layerjax[nuts]"') from None


class Nuts:
    """Moves the chains about the optimum of a fit. A step depends on the seed, its number, and where the chains are."""

    def __init__(self, fit: Fit, chain: Chain, seed: int, options: SamplerOptions, progress: Progress):
        self.problem, self.chain, self.seed = fit.problem, chain, seed
        self._compiled: set[Callable[..., Any]] = set()
        if not chain.moves:
            self._warm_up(first_mixture(fit, seed, options, progress, share_of(chain.shape[0])), options, progress)

    def _warm_up(self, mixture: Mixture, options: SamplerOptions, progress: Progress) -> None:
        """Before the first step, and for all: where each chain begins, its metric, and the length of its steps."""
        generator = np.random.RandomState(self.seed)
        metric = np.atleast_2d(np.cov(mixture.best.draw(generator, DRAWS).T))
        positions = first_positions(mixture, self._log_posteriors, self.chain.shape[0], generator)
        progress("warm-up", 0, None, f"{options.warm_up} steps of each of {len(positions)} chains")
        adapt = _adaptation(options.warm_up, options.target_acceptance)
        positions, step_sizes, metrics = self._on_all_cores(adapt, positions, metric=metric)
        progress("warm-up", options.warm_up, options.warm_up)
        moves = {"mixture": mixture.record(), "positions": positions, "step_sizes": step_sizes, "metrics": metrics}
        self.chain.decide(moves)

    def advance(self, step: int, show: Callable[[], None]) -> None:
        """Append steps to the chain until it has `step` of them, and `show` each."""
        chain, moves = self.chain, self.chain.moves
        mixture = Mixture(**moves["mixture"])
        positions = chain.get_last_sample().coords if chain.iteration else moves["positions"]
        chain.grow(step - chain.iteration, None)
        while chain.iteration < step:
            generator = np.random.RandomState([self.seed, chain.iteration])
            drawn, log_ratio = propose(mixture, positions, generator)
            gain = log_ratio + self._log_posteriors(drawn) - self._log_posteriors(positions)
            positions = np.where((np.log(generator.random_sample(len(drawn))) < gain)[:, None], drawn, positions)
            positions, log_posterior, divergent = self._on_all_cores(
                _step, positions, number=chain.iteration + 1, step_sizes=moves["step_sizes"], metrics=moves["metrics"]
            )
            state = emcee.State(positions, log_prob=log_posterior, random_state=generator.get_state())
            chain.save_step(state, ~divergent)
            show()

    def _on_all_cores(self, function: Callable[..., Any], positions: Floats, **settings: Any) -> list[Any]:
        """What a function of the model gives of each chain: they take as many gradients as each trajectory needs."""

        def call(rows: Floats) -> tuple[Array, ...]:
            return self.problem.call(function, self.seed, rows[:, 0].astype(int), rows[:, 1:], settings)

        rows = np.column_stack([np.arange(len(positions)), positions])
        found = in_shares(call, rows, -(-len(rows) // cores()), function in self._compiled)
        self._compiled.add(function)
        return found

    def _log_posteriors(self, positions: Floats) -> Floats:
        return log_posteriors(self.problem, positions, share_of(len(positions)))


@cache
def _adaptation(steps: int, target: float) -> Callable[..., Any]:
    """The warm-up of so many steps, for `Nuts._on_all_cores`: positions, step sizes and metrics."""
    import blackjax
    from blackjax.adaptation.base import get_filter_adapt_info_fn

    def adapt(
        model: Model, seed: Array, chains: Array, positions: Array, settings: dict[str, Array]
    ) -> tuple[Array, ...]:
        def one(place: tuple[Array, Array]) -> tuple[Array, Array, Array]:
            chain, position = place
            adaptation = blackjax.window_adaptation(
                blackjax.nuts,
                model.log_posterior_unconstrained,
                is_mass_matrix_diagonal=False,
                initial_inverse_mass_matrix=settings["metric"],
                initial_step_size=0.5,
                target_acceptance_rate=target,
                adaptation_info_fn=get_filter_adapt_info_fn(),
            )
            key = jax.random.fold_in(jax.random.key(seed), chain)
            (state, found), _ = adaptation.run(key, position, steps)
            return state.position, found["step_size"], found["inverse_mass_matrix"]

        return jax.lax.map(one, (chains, positions))

    return adapt


def _step(model: Model, seed: Array, chains: Array, positions: Array, settings: dict[str, Array]) -> tuple[Array, ...]:
    """Where a step takes chains (n, P) of these numbers, the log-posteriors there, and whether they diverged."""
    from blackjax.mcmc import nuts

    kernel, height = nuts.build_kernel(), model.log_posterior_unconstrained
    key = jax.random.fold_in(jax.random.key(seed), settings["number"])

    def one(place: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        chain, position = place
        # the state made anew: a chain that is resumed from its file is the same to the last bit
        state, info = kernel(
            jax.random.fold_in(key, chain),
            nuts.init(position, height),
            height,
            settings["step_sizes"][chain],
            settings["metrics"][chain],
        )
        return state.position, state.logdensity, info.is_divergent

    return jax.lax.map(one, (chains, positions))
