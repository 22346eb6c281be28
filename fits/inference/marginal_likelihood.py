"""How probable the data are under a stack, whatever its parameters: the evidence, by importance sampling.

The posterior is compared with an approximation of it: the mean of posterior / approximation over draws of the
approximation is the evidence, however good it is; how good is told by the Pareto shape of the largest weights (Vehtari,
Simpson, Gelman, Yao & Gabry 2024, JMLR 25, 72). The first is that of the fit, along its ridge where there is one. While
weights are too uneven, a mixture is fitted to the draws as they are weighted, and drawn from in its place (Cappe,
Guillin, Marin & Robert 2004, J. Comput. Graph. Stat. 13, 907).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from fits.inference.fit_result import Fit
from fits.inference.laplace import Approximation

if TYPE_CHECKING:
    from fits.inference.mixture import Mixture

DRAWS = 1000
UNRELIABLE = 0.7

GOOD, ROUNDS = 0.5, 4
"""The Pareto shape below which the variance of weights is finite, and how many approximations are tried for it."""

FEWEST = 50
"""Draws that a mixture is fitted to are worth at least so many of the posterior; else weights are made more even."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Evidence:
    """log: natural logarithm of the evidence, with data in 1/sr. error: its standard error. shape: Pareto shape of the
    largest weights: above 0.7 the approximation misses a part of the posterior, and the error tells too little."""

    log: float
    error: float
    shape: float

    @property
    def reliable(self) -> bool:
        """Whether the error may be believed."""
        return self.shape < UNRELIABLE


def evidence(fit: Fit, *, draws: int = DRAWS, seed: int = 0) -> Evidence:
    """The evidence of a fitted stack, with the priors that its parameters have within their bounds.

    Of a posterior with several minima that of the best one, and of what lies near it.

    Args:
        fit: of a likelihood.
        draws: of each approximation, of which there are up to four.
        seed: of the draws.

    Raises:
        ValueError: a fit of a named objective.
    """
    if not fit.is_posterior:
        raise ValueError(f"evidence: a fit of {fit.problem.objective!r} has none, it minimised no likelihood")
    from fits.inference.mixture import Mixture

    generator = np.random.RandomState(seed)
    approximation: Approximation | Mixture = Mixture.of(fit) or Approximation.of(fit)
    best = Evidence(-np.inf, np.inf, np.inf)
    for _ in range(ROUNDS):
        positions, weights = _weighted(fit, approximation, generator, draws)
        found = _evidence(weights)
        if found.shape < best.shape:
            best = found
        if best.shape < GOOD or not np.isfinite(found.log):
            break
        chances = np.exp(_evened(weights))
        chosen = generator.choice(draws, draws, p=chances / chances.sum())
        approximation = Mixture.through(positions[chosen], generator)
    return best


def _weighted(
    fit: Fit, approximation: "Approximation | Mixture", generator: np.random.RandomState, draws: int
) -> tuple[Floats, Floats]:
    """Draws (draws, P) of an approximation, and the logarithms of posterior / approximation there, (draws,)."""
    from fits.inference.ensemble import log_posteriors

    if isinstance(approximation, Approximation):
        positions, inside = approximation.draw(generator, draws), np.ones(draws, bool)
    else:
        positions, inside = approximation.draw_all(generator, draws)
    heights = np.asarray(fit.problem.call(log_posteriors, positions), float)
    weights = heights - approximation.log_density(positions)
    return positions, np.where(inside & np.isfinite(weights), weights, -np.inf)


def _evidence(weights: Floats) -> Evidence:
    """By the logarithms of weights, (draws,)."""
    import arviz

    total, draws = float(logsumexp(weights)), len(weights)
    if not np.isfinite(total):
        return Evidence(-np.inf, np.inf, np.inf)
    relative = np.exp(weights - total) * draws
    _, shape = arviz.psislw(np.maximum(weights - weights.max(), -700.0))
    return Evidence(total - float(np.log(draws)), float(np.std(relative) / np.sqrt(draws)), float(shape))


def _evened(weights: Floats) -> Floats:
    """Logarithms of weights raised to the highest power up to 1 with which they are worth `FEWEST` draws."""
    weights = weights - weights.max()
    for power in 0.8 ** np.arange(40):
        scaled = np.where(np.isfinite(weights), power * weights, -np.inf)
        share = np.exp(scaled - logsumexp(scaled))
        if 1.0 / np.sum(share**2) >= min(FEWEST, 0.5 * np.isfinite(weights).sum()):
            break
    return scaled
