"""emcee's ensemble: walkers that move together, in unconstrained coordinates, where the box has no walls.

Most steps are independent proposals from a mixture that approximates the posterior (`importance`), the others stretch
moves and differential evolution, neither of which is the better one everywhere. Walkers stay where the mixture has too
little: components are added there, ever more seldom. Metropolis' rule keeps every step exact, however poor it is.
"""

from collections.abc import Callable
from functools import partial

import emcee
import numpy as np

from fits.data.geometry import Floats
from fits.optimise.result import Fit
from fits.problem.compilation import one_thread
from fits.progress import Progress
from fits.sampling.chain import Chain
from fits.sampling.importance import COMPONENTS, components_at, importance_draws
from fits.sampling.initial import first_positions, log_posteriors, share_of
from fits.sampling.mixture import Mixture
from fits.sampling.options import SamplerOptions

# steps after which components are added: often while the chain is short, seldom once it is long
ADDED_AFTER = (25 * 1.5 ** np.arange(40.0)).astype(int)
# length of differential evolution; 2.38 is best for a normal posterior, but curved ones are narrower than they are long
DIFFERENCE = 1.2
LOOKED_AT = 64  # steps among those since the last addition: where walkers stay they are seen all the same
FIRST_DRAWS = 512  # of the approximation that a chain begins with
EFFICIENCY = 0.4  # effective draws of it to draws, at which it needs no more components


class Ensemble:
    """Moves the walkers of a chain about the optimum of a fit."""

    def __init__(self, fit: Fit, chain: Chain, seed: int, options: SamplerOptions, progress: Progress):
        self.problem, self.chain, self.seed, self.options = fit.problem, chain, seed, options
        self.share, self._compiled = share_of(chain.shape[0]), False
        if not chain.moves:
            chain.decide({"mixture": first_mixture(fit, seed, options, progress, self.share).record(), "steps": 0})

    def advance(self, step: int, show: Callable[[], None]) -> None:
        """Append steps to the chain until it has `step` of them, and `show` each."""
        while (begin := self.chain.iteration) < step:
            mixture = self._mixture()
            state = self.chain.get_last_sample() if begin else self._first_state(mixture)
            share = self.options.independent
            moves = [
                (emcee.moves.MHMove(partial(propose, mixture)), share),
                (emcee.moves.StretchMove(), 0.5 * (1.0 - share)),
                (emcee.moves.DEMove(gamma0=DIFFERENCE / np.sqrt(2.0 * self.chain.shape[1])), 0.5 * (1.0 - share)),
            ]
            sampler = emcee.EnsembleSampler(
                *self.chain.shape, self.log_posteriors, moves=moves, vectorize=True, backend=self.chain
            )
            count = min(step, int(ADDED_AFTER[begin < ADDED_AFTER].min())) - begin
            # walkers are drawn from a density of full rank: emcee need not look whether they are
            for _ in sampler.sample(state, iterations=count, skip_initial_state_check=True):
                show()

    def _mixture(self) -> Mixture:
        """What proposals are drawn from, after some steps with more components: where the posterior exceeds it most
        among all places that walkers have been to since the last ones were added. So adaptation fades."""
        chain, mixture, since = self.chain, Mixture(**self.chain.moves["mixture"]), self.chain.moves["steps"]
        if since == chain.iteration or chain.iteration not in ADDED_AFTER:
            return mixture
        chain.write()  # before the moves that follow from it
        count, every = chain.shape[1], slice(since, chain.iteration, -(-(chain.iteration - since) // LOOKED_AT))
        seen, first = np.unique(chain.chain[every].reshape(-1, count), axis=0, return_index=True)
        with one_thread():  # the same to the last bit, whatever else runs
            top = np.argsort(mixture.log_density(seen) - chain.log_prob[every].ravel()[first])[: 2 * COMPONENTS]
            spread = np.atleast_2d(np.cov(chain.steps()[chain.iteration // 2 :].reshape(-1, count).T))
        added = components_at(self.problem, seen[top], spread)
        mixture = mixture.extended(added, len(top) / (len(mixture.centre) + len(top)))
        chain.decide({"mixture": mixture.record(), "steps": chain.iteration})
        return mixture

    def log_posteriors(self, positions: Floats) -> Floats:
        found = log_posteriors(self.problem, positions, self.share, self._compiled)
        self._compiled = True
        return found

    def _first_state(self, mixture: Mixture) -> emcee.State:
        generator = np.random.RandomState(self.seed)
        positions = first_positions(mixture, self.log_posteriors, self.chain.shape[0], generator)
        return emcee.State(positions, random_state=generator.get_state())  # else emcee copies numpy's global state


def first_mixture(fit: Fit, seed: int, options: SamplerOptions, progress: Progress, share: int) -> Mixture:
    """What a chain begins with: an approximation of the posterior that is efficient, or as good as it gets."""
    draws = importance_draws(
        fit,
        FIRST_DRAWS,
        np.random.RandomState(seed),
        efficiency=EFFICIENCY,
        share=share,
        smallest_mode=options.smallest_mode,
        progress=progress,
    )
    return draws.mixture


def propose(mixture: Mixture, positions: Floats, generator: np.random.RandomState) -> tuple[Floats, Floats]:
    """Draws in place of `positions` (count, P), and the log-ratio of densities that `emcee.moves.MHMove` asks for."""
    drawn = mixture.draw(generator, len(positions))
    before, after = np.split(mixture.log_density(np.concatenate([positions, drawn])), 2)
    return drawn, before - after
