"""The marginal likelihood (evidence) of a fitted stack, by importance sampling.

The mean of posterior / approximation over draws of the approximation is the evidence, for any approximation; the Pareto
k of the largest weights says how far its error is to be trusted (see `importance`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from fits.optimise.result import Fit
from fits.prediction.importance import MAX_PARETO_K, ImportanceDraws, importance_draws
from layerjax._checks import require_kind

DRAWS = 1000


@dataclass(frozen=True)
class Evidence:
    """log_evidence: natural logarithm, with data in 1/sr. error: its standard error. pareto_k: Pareto k of the largest
    importance weights: above 0.7 the approximation misses a part of the posterior, and the error is too small."""

    log_evidence: float
    error: float
    pareto_k: float

    @property
    def reliable(self) -> bool:
        """Whether the error can be trusted."""
        return self.pareto_k < MAX_PARETO_K


def evidence(fit: Fit, *, draws: int = DRAWS, seed: int = 0) -> Evidence:
    """The marginal likelihood of a fitted stack, under the priors of its parameters within their bounds.

    For a posterior with several modes it is that of all modes which the starts of the fit found.

    Args:
        fit: a fit of a likelihood.
        draws: draws of each approximation, of which there are up to four (see `importance_draws`).
        seed: random seed of the draws.

    Raises:
        ValueError: a fit of a named objective, or a part of a joint fit.
    """
    require_kind("fit", fit, Fit)
    if not fit.is_posterior:
        raise ValueError(f"evidence: a fit of {fit.problem.objective!r} has none, it minimised no likelihood")
    fit.require_alone("evidence")
    return evidence_of(posterior_draws(fit, draws, seed))


def posterior_draws(fit: Fit, draws: int = DRAWS, seed: int = 0) -> ImportanceDraws:
    """Weighted draws of a fit's posterior, of which the evidence is the mean weight."""
    return importance_draws(fit, draws, np.random.RandomState(seed), along_ridge=True)


def evidence_of(draws: ImportanceDraws) -> Evidence:
    """The evidence by weighted draws of the whole posterior."""
    total = float(logsumexp(draws.log_weights))
    if not np.isfinite(total):
        return Evidence(-np.inf, np.inf, np.inf)
    count = len(draws.log_weights)
    relative = np.exp(draws.log_weights - total) * count
    return Evidence(total - float(np.log(count)), float(np.std(relative) / np.sqrt(count)), draws.pareto_k)
