"""An ensemble of walkers moved by emcee, in unconstrained coordinates, where the box has no walls.

Half the steps are stretch moves, and half independent proposals from an approximation, the fit's own or one learned
from the chain (`laplace`).
"""

from collections.abc import Callable
from typing import Any

import emcee
import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.optimise.result import Fit
from fits.problem.compilation import cores, in_shares
from fits.problem.model import Model
from fits.sampling.chain import MemoryChain
from fits.sampling.convergence import last_checks
from fits.sampling.laplace import Approximation, first_positions
from fits.sampling.mixture import MODES, Mixture

INDEPENDENT = 0.5

Floats = NDArray[np.float64]
Proposals = Approximation | Mixture


class Ensemble:
    """Moves the walkers of a chain about the optimum of a fit."""

    def __init__(self, fit: Fit, chain: MemoryChain, seed: int):
        self.problem, self.chain, self.seed = fit.problem, chain, seed
        self._compiled: set[int] = set()  # sizes of batches
        self.initial: Proposals = Mixture.of(fit) or Approximation.of(fit)

    def decide(self) -> None:
        """Before the first step, and for all: between which modes walkers jump."""
        self.chain.decide(modes_of(self.initial))

    def advance(self, step: int, tell: Callable[[], None]) -> None:
        """Append steps to the chain until it has `step` of them, and `tell` of each."""
        chain = self.chain
        state = chain.get_last_sample() if chain.iteration else self._first_state()
        # walkers are drawn from a density of full rank: emcee need not look whether they are
        for _ in self.sampler().sample(state, iterations=step - chain.iteration, skip_initial_state_check=True):
            tell()

    def sampler(self) -> emcee.EnsembleSampler:
        """emcee with the moves of the steps up to the next check."""
        independent = emcee.moves.MHMove(adapted(self.chain, self.initial).propose)
        moves = [(independent, INDEPENDENT), (emcee.moves.StretchMove(), 1.0 - INDEPENDENT)]
        walkers, count = self.chain.shape
        return emcee.EnsembleSampler(
            walkers, count, self._log_posteriors, moves=moves, vectorize=True, backend=self.chain
        )

    def _log_posteriors(self, positions: Floats) -> Floats:
        share = max(1, len(positions) // cores())
        (heights,) = in_shares(
            lambda part: [self.problem.call(log_posteriors, part)], positions, share, share in self._compiled
        )
        self._compiled.add(share)
        return heights

    def _first_state(self) -> emcee.State:
        def finite(positions: Floats) -> bool:
            return bool(np.all(np.isfinite(self._log_posteriors(positions))))

        generator = np.random.RandomState(self.seed)
        positions = first_positions(self.initial.draw, finite, self.chain.shape[0], generator)
        return emcee.State(positions, random_state=generator.get_state())  # else emcee copies numpy's global state


def modes_of(proposals: Proposals | None) -> dict[str, Any]:
    """What a chain keeps of the modes of its posterior; nothing, where one is known."""
    several = isinstance(proposals, Mixture) and proposals.mode_count > 1
    return proposals.arrays(MODES) if isinstance(proposals, Mixture) and several else {}


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
