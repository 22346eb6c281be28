"""An ensemble of walkers moved by emcee: half stretch moves, half independent proposals from an approximation.

The approximation is the fit's own or one learned from the chain (`laplace`). The ensemble moves in unconstrained
coordinates, where the box has no walls.
"""

import emcee
import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.inference.chain import MemoryChain
from fits.inference.fit_result import Fit
from fits.inference.laplace import Approximation, first_positions
from fits.inference.length import last_checks
from fits.inference.mixture import Mixture
from fits.problem.model import Model

INDEPENDENT = 0.5

Floats = NDArray[np.float64]
Proposals = Approximation | Mixture


class Ensemble:
    """Moves the walkers of a chain about the optimum of a fit."""

    def __init__(self, fit: Fit, chain: MemoryChain, seed: int):
        self.problem, self.chain, self.seed = fit.problem, chain, seed
        self.initial: Proposals = Mixture.of(fit) or Approximation.of(fit)

    def advance(self, step: int) -> None:
        """Append steps to the chain until it has `step` of them."""
        chain = self.chain
        state = chain.get_last_sample() if chain.iteration else self._first_state()
        # walkers are drawn from a density of full rank: emcee need not look whether they are
        self.sampler().run_mcmc(state, step - chain.iteration, skip_initial_state_check=True)

    def sampler(self) -> emcee.EnsembleSampler:
        """emcee with the moves of the steps up to the next check."""
        approximation = adapted(self.chain, self.initial)
        moves = [
            (emcee.moves.MHMove(approximation.propose), INDEPENDENT),
            (emcee.moves.StretchMove(), 1.0 - INDEPENDENT),
        ]
        walkers, count = self.chain.shape
        return emcee.EnsembleSampler(
            walkers, count, self._log_posteriors, moves=moves, vectorize=True, backend=self.chain
        )

    def _log_posteriors(self, positions: Floats) -> Floats:
        return np.asarray(self.problem.call(log_posteriors, positions), float)

    def _first_state(self) -> emcee.State:
        def finite(positions: Floats) -> bool:
            return bool(np.all(np.isfinite(self._log_posteriors(positions))))

        generator = np.random.RandomState(self.seed)
        positions = first_positions(self.initial.draw, finite, self.chain.shape[0], generator)
        return emcee.State(positions, random_state=generator.get_state())  # else emcee copies numpy's global state


def adapted(chain: MemoryChain, initial: Proposals) -> Proposals:
    """The fit's approximation, or one learned from the second half of the chain up to its last check if that is closer.

    As checks grow apart, so the adaptation fades; and it depends on whole checks only, so that a resumed chain is the
    same.
    """
    _, check = last_checks(chain.iteration)
    if not check:
        return initial
    positions = chain.chain[check // 2 : check]
    positions = positions.reshape(-1, positions.shape[-1])
    candidates: list[Proposals] = [initial, Approximation.learned(positions)]
    if isinstance(initial, Mixture):
        candidates.append(initial.refined(positions))
    return max(candidates, key=lambda candidate: candidate.mean_log_density(positions))


def log_posteriors(model: Model, positions: Array) -> Array:
    """Log-posterior at each of `positions` (count, P) in unconstrained coordinates."""
    return jax.lax.map(model.log_posterior_unconstrained, positions)  # one walker fits the cache: twice as fast as vmap
