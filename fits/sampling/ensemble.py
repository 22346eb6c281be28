"""emcee's ensemble: walkers that move together, in unconstrained coordinates, where the box has no walls.

Half of the steps are stretch moves and differential evolution, neither of which is the better one everywhere, half
independent proposals from a density that is fitted to the chain as it grows (`proposals`).
"""

from collections.abc import Callable
from functools import partial

import emcee
import numpy as np

from fits.data.geometry import Floats
from fits.optimise.result import Fit
from fits.problem.compilation import one_thread
from fits.sampling.chain import Chain
from fits.sampling.initial import first_positions, initial_mixture, log_posteriors, share_of
from fits.sampling.mixture import Mixture
from fits.sampling.options import SamplerOptions
from fits.sampling.proposals import Density, FittedProposal, propose

# steps after which proposals are fitted again: often while the chain is short, seldom once it is long
FITS = (25 * 1.5 ** np.arange(40.0)).astype(int)
# length of differential evolution; 2.38 is best for a normal posterior, but curved ones are narrower than they are long
DIFFERENCE = 1.2


class Ensemble:
    """Moves the walkers of a chain about the optimum of a fit."""

    def __init__(self, fit: Fit, chain: Chain, seed: int, options: SamplerOptions):
        self.problem, self.chain, self.seed, self.options = fit.problem, chain, seed, options
        self.share, self._compiled = share_of(chain.shape[0]), False
        if not chain.moves:
            chain.decide({"initial": initial_mixture(fit, self.share, options.smallest_mode).record()})

    def advance(self, step: int, show: Callable[[], None]) -> None:
        """Append steps to the chain until it has `step` of them, and `show` each."""
        while (begin := self.chain.iteration) < step:
            proposals = proposals_of(self.chain)
            state = self.chain.get_last_sample() if begin else self._first_state()
            share = self.options.independent
            moves = [
                (emcee.moves.MHMove(partial(propose, proposals)), share),
                (emcee.moves.StretchMove(), 0.5 * (1.0 - share)),
                (emcee.moves.DEMove(gamma0=DIFFERENCE / np.sqrt(2.0 * self.chain.shape[1])), 0.5 * (1.0 - share)),
            ]
            sampler = emcee.EnsembleSampler(
                *self.chain.shape, self.log_posteriors, moves=moves, vectorize=True, backend=self.chain
            )
            count = min(step, int(FITS[begin < FITS].min())) - begin  # until proposals are fitted again
            # walkers are drawn from a density of full rank: emcee need not look whether they are
            for _ in sampler.sample(state, iterations=count, skip_initial_state_check=True):
                show()

    def log_posteriors(self, positions: Floats) -> Floats:
        found = log_posteriors(self.problem, positions, self.share, self._compiled)
        self._compiled = True
        return found

    def _first_state(self) -> emcee.State:
        generator = np.random.RandomState(self.seed)
        initial = Mixture(**self.chain.moves["initial"])
        positions = first_positions(initial, self.log_posteriors, self.chain.shape[0], generator)
        return emcee.State(positions, random_state=generator.get_state())  # else emcee copies numpy's global state


def proposals_of(chain: Chain, fewest: int = 1) -> Density:
    """What proposals are drawn from until the next fit: fitted to the second half of the chain up to the last one, of
    so many draws at least. As fits grow apart, adaptation fades; a chain that resumes depends on whole fits only."""
    initial, last = Mixture(**chain.moves["initial"]), FITS[chain.iteration >= FITS].max(initial=0)
    if (last - last // 2) * chain.shape[0] < fewest:
        return initial
    positions = chain.chain[last // 2 : last].reshape(-1, chain.shape[-1])
    with one_thread():  # the same to the last bit, whatever else runs
        return FittedProposal.to(positions.copy(), np.random.RandomState(last), initial)
