"""How probable the data are under a stack, whatever its parameters: the evidence, by importance sampling.

The posterior is compared with the approximation of it that a fit has: the mean of posterior / approximation over draws
of the approximation is the evidence, however good it is; how good is told by the Pareto shape of the largest weights
(Vehtari, Simpson, Gelman, Yao & Gabry 2024, JMLR 25, 72).
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from fits.inference.fit_result import Fit
from fits.inference.laplace import Approximation

DRAWS = 1000
UNRELIABLE = 0.7


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

    Of a posterior with several minima that of the best one alone.

    Raises:
        ValueError: a fit of a named objective.
    """
    if not fit.is_posterior:
        raise ValueError(f"evidence: a fit of {fit.problem.objective!r} has none, it minimised no likelihood")
    import arviz

    from fits.inference.ensemble import log_posteriors

    approximation = Approximation.of(fit)
    positions = approximation.draw(np.random.RandomState(seed), draws)
    heights = np.asarray(fit.problem.call(log_posteriors, positions), float)
    weights = heights - approximation.log_density(positions)
    weights = np.where(np.isfinite(weights), weights, -np.inf)
    total = float(logsumexp(weights))
    if not np.isfinite(total):
        return Evidence(-np.inf, np.inf, np.inf)
    relative = np.exp(weights - total) * draws
    finite = np.maximum(weights - weights.max(), -700.0)
    _, shape = arviz.psislw(finite)
    return Evidence(total - float(np.log(draws)), float(np.std(relative) / np.sqrt(draws)), float(shape))
