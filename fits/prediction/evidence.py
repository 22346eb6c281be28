"""How probable the data are under a stack, whatever its parameters: the evidence, by importance sampling.

The mean of posterior / approximation over draws of the approximation is the evidence, however good the approximation
is; how good it is, is told by the Pareto shape of the largest weights (see `importance`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from fits.optimise.result import Fit
from fits.prediction.importance import UNRELIABLE, Weighted, weighted
from layerjax._checks import require_kind

DRAWS = 1000


@dataclass(frozen=True)
class Evidence:
    """log_evidence: natural logarithm, with data in 1/sr. error: its standard error. pareto_k: of the largest
    importance weights: above 0.7 the approximation misses a part of the posterior, and the error tells too little."""

    log_evidence: float
    error: float
    pareto_k: float

    @property
    def reliable(self) -> bool:
        """Whether the error may be believed."""
        return self.pareto_k < UNRELIABLE


def evidence(fit: Fit, *, draws: int = DRAWS, seed: int = 0) -> Evidence:
    """The evidence of a fitted stack, with the priors that its parameters have within their bounds.

    Of a posterior with several modes that of all which the starts of the fit found.

    Args:
        fit: of a likelihood.
        draws: of each approximation, of which there are up to four (see `weighted`).
        seed: of the draws.

    Raises:
        ValueError: a fit of a named objective, or a part of one of several measurements.
    """
    require_kind("fit", fit, Fit)
    if not fit.is_posterior:
        raise ValueError(f"evidence: a fit of {fit.problem.objective!r} has none, it minimised no likelihood")
    fit.require_alone("evidence")
    return evidence_of(posterior_draws(fit, draws, seed))


def posterior_draws(fit: Fit, draws: int = DRAWS, seed: int = 0) -> Weighted:
    """What the evidence of a fit is the mean of."""
    return weighted(fit, draws, np.random.RandomState(seed), along_ridge=True)


def evidence_of(found: Weighted) -> Evidence:
    """The evidence by draws of all of a posterior."""
    total = float(logsumexp(found.log_weights))
    if not np.isfinite(total):
        return Evidence(-np.inf, np.inf, np.inf)
    count = len(found.log_weights)
    relative = np.exp(found.log_weights - total) * count
    return Evidence(total - float(np.log(count)), float(np.std(relative) / np.sqrt(count)), found.shape)
