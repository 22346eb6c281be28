"""Proposals that do not depend on where a walker stands, fitted to draws of a posterior.

The marginal distribution of every parameter is mapped to a normal one, piecewise linearly between quantiles, and a
mixture of a few heavy-tailed densities is fitted to what the draws become: a copula, which follows skewness and bounds
with far fewer components than a mixture by itself. Where it is close to the posterior a chain forgets its past in a few
steps, and jumps between modes; Metropolis' rule keeps every step exact, however poor it is.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from fits.data.geometry import Floats
from fits.sampling.mixture import NARROWEST, Mixture

# normal scores of the quantiles between which marginal distributions are mapped; the last slopes go on beyond
SCORES = np.linspace(-2.0, 2.0, 17)
LINEAR_SHARE = 0.02  # of a map: the linear one, by mean and deviation, without which equal draws would have no slope
INITIAL_SHARE = 0.1  # of proposals: those from the approximations of the fit, which know of modes not visited


class Density(Protocol):
    """A density over the unconstrained vectors of a problem with P parameters that one can draw from."""

    def log_density(self, positions: Floats) -> Floats:
        """Its logarithm, (count,), at positions (count, P)."""

    def draw(self, generator: np.random.RandomState, count: int) -> Floats:
        """(count, P) independent draws."""


def propose(density: Density, positions: Floats, generator: np.random.RandomState) -> tuple[Floats, Floats]:
    """Draws in place of `positions` (count, P), and the log-ratio of densities that `emcee.moves.MHMove` asks for."""
    drawn = density.draw(generator, len(positions))
    return drawn, density.log_density(positions) - density.log_density(drawn)


@dataclass(frozen=True, eq=False)
class FittedProposal:
    """A density fitted to draws of a posterior, by quantiles (P, K) at `SCORES` and a mixture of normal scores, with a
    share of another, if there is one."""

    quantiles: Floats
    copula: Mixture
    initial: Mixture | None = None

    @classmethod
    def to(
        cls, positions: Floats, generator: np.random.RandomState, initial: Mixture | None = None
    ) -> "FittedProposal":
        """Fitted to draws (count, P), two at least, of which any may be there repeatedly."""
        sd = np.maximum(np.std(positions, axis=0), NARROWEST)
        linear = np.mean(positions, axis=0)[:, None] + sd[:, None] * SCORES
        quantiles = np.quantile(positions, stats.norm.cdf(SCORES), axis=0).T
        quantiles = (1.0 - LINEAR_SHARE) * quantiles + LINEAR_SHARE * linear
        return cls(quantiles, Mixture.fitted(_scores(quantiles, positions)[0], generator), initial)

    def log_density(self, positions: Floats) -> Floats:
        """Its logarithm, (count,), at positions (count, P)."""
        scores, log_slope = _scores(self.quantiles, positions)
        own = self.copula.log_density(scores) + log_slope
        if self.initial is None:
            return own
        other = np.log(INITIAL_SHARE) + self.initial.log_density(positions)
        return np.asarray(np.logaddexp(np.log1p(-INITIAL_SHARE) + own, other))

    def draw(self, generator: np.random.RandomState, count: int) -> Floats:
        """(count, P) independent draws."""
        scores = self.copula.draw(generator, count)
        drawn = np.stack(
            [_piecewise(SCORES, row, column) for row, column in zip(self.quantiles, scores.T, strict=True)], axis=1
        )
        if self.initial is None:
            return drawn
        others = generator.random_sample(count) < INITIAL_SHARE
        return np.where(others[:, None], self.initial.draw(generator, count), drawn)


def _scores(quantiles: Floats, positions: Floats) -> tuple[Floats, Floats]:
    """Normal scores of positions (count, P), and the logarithm of the product of their slopes, (count,)."""
    scores, log_slope = np.empty_like(positions), np.zeros(len(positions))
    for place, row in enumerate(quantiles):
        scores[:, place] = _piecewise(row, SCORES, positions[:, place])
        log_slope += np.log(np.diff(SCORES) / np.diff(row))[_pieces(row, positions[:, place])]
    return scores, log_slope


def _piecewise(knots: Floats, values: Floats, at: Floats) -> Floats:
    """The continuous function through values at knots, linear between them and on beyond."""
    left = _pieces(knots, at)
    slope = (np.diff(values) / np.diff(knots))[left]
    return np.asarray(values[left] + slope * (at - knots[left]))


def _pieces(knots: Floats, at: Floats) -> NDArray[np.int64]:
    return np.clip(np.searchsorted(knots, at) - 1, 0, len(knots) - 2)
