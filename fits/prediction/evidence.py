"""The evidence of a fit, by importance sampling of its posterior."""

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from fits.optimise.result import Fit
from fits.prediction.options import DEFAULT
from fits.sampling.importance import ImportanceDraws, importance_draws
from layerjax._checks import require_count, require_kind, require_seed
from layerjax._numerics import allow_broadcasting

DRAWS = 1000  # before more are added where weights are uneven


@dataclass(frozen=True)
class Evidence:
    """Marginal likelihood of a stack.

    Attributes:
        log_evidence: its natural logarithm, with data in 1/sr.
        error: standard error of the logarithm.
        pareto_k: Pareto k of the importance weights; above 0.7 the error is unreliable.
    """

    log_evidence: float
    error: float
    pareto_k: float

    @property
    def reliable(self) -> bool:
        """Whether the error can be trusted."""
        return self.pareto_k < DEFAULT.max_pareto_k


@allow_broadcasting
def evidence(fit: Fit, *, draws: int = DRAWS, seed: int = 0) -> Evidence:
    """The marginal likelihood of a fitted stack, under the priors of its parameters within their bounds.

    For a posterior with several modes it is that of all modes which the starts of the fit found.

    Args:
        fit: a fit of a likelihood.
        draws: draws of the posterior; more are added where their weights are uneven.
        seed: random seed of the draws.

    Raises:
        ValueError: a fit of a named objective, or a part of a joint fit.
    """
    require_kind("fit", fit, Fit)
    require_count("draws", draws, 2)
    require_seed(seed)
    fit.require_posterior("evidence")
    return evidence_of(posterior_draws(fit, draws, seed))


def posterior_draws(fit: Fit, draws: int = DRAWS, seed: int = 0) -> ImportanceDraws:
    """Weighted draws of a fit's posterior, of which the evidence is the mean weight."""
    return importance_draws(fit, draws, np.random.RandomState(seed))


def evidence_of(draws: ImportanceDraws) -> Evidence:
    """The mean weight of draws of the whole posterior."""
    total, count = float(logsumexp(draws.log_weights)), len(draws.log_weights)
    if not np.isfinite(total):
        return Evidence(-np.inf, np.inf, np.inf)
    relative = np.exp(draws.log_weights - total) * count
    return Evidence(total - float(np.log(count)), float(np.std(relative) / np.sqrt(count)), draws.pareto_k)
