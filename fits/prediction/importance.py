"""Importance sampling of the posterior of a fit: weighted draws without a chain, and the evidence.

Proposals are Laplace's approximations about the minima of the fit, and where these do not suffice, mixtures along its
ridges. The Pareto k of the largest weights says how well the draws represent the posterior (Vehtari, Simpson, Gelman,
Yao & Gabry 2024, JMLR 25, 72). While weights are too uneven, a mixture is fitted to the weighted draws, and drawn from
as well (Cappe, Guillin, Marin & Robert 2004, J. Comput. Graph. Stat. 13, 907); the draws of all proposals are weighted
as those of their mixture (Cornuet, Marin, Mira & Robert 2012, Scand. J. Stat. 39, 798). Their mean is the evidence.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from fits.data.geometry import Floats
from fits.optimise.result import Fit
from fits.prediction.options import DEFAULT
from fits.sampling.initial import initial_mixture, log_posteriors
from fits.sampling.proposals import Density, FittedProposal
from layerjax._checks import require_count, require_kind, require_seed
from layerjax._numerics import broadcasting

MAX_PARETO_K = DEFAULT.max_pareto_k  # above it a part of the posterior may be missing
FINITE_VARIANCE = 0.5  # Pareto k below which the variance of weights is finite
ROUNDS = 3  # how many mixtures are fitted to reach it
MIN_EFFECTIVE_DRAWS = 50  # below it another proposal is tried; weights are tempered to it before a mixture is fitted
DRAWS = 1000  # draws of each proposal for an evidence
BATCH = 50  # draws that a core evaluates at a time: however many there are, one program serves


@dataclass(frozen=True)
class Evidence:
    """log_evidence: natural logarithm, with data in 1/sr. error: its standard error. pareto_k: of the importance
    weights: above 0.7 the approximation misses a part of the posterior, and the error is too small."""

    log_evidence: float
    error: float
    pareto_k: float

    @property
    def reliable(self) -> bool:
        """Whether the error can be trusted."""
        return self.pareto_k < MAX_PARETO_K


@dataclass(frozen=True, eq=False)
class ImportanceDraws:
    """Unconstrained draws, (D, P), log weights posterior / proposal, (D,), and the Pareto k of the weights."""

    positions: Floats
    log_weights: Floats
    pareto_k: float

    @property
    def effective_sample_size(self) -> float:
        """Effective sample size of the weighted draws."""
        total = logsumexp(self.log_weights)
        return float(np.exp(-logsumexp(2.0 * (self.log_weights - total)))) if np.isfinite(total) else 0.0

    @property
    def evidence(self) -> Evidence:
        """The mean weight, if these are draws of the whole posterior."""
        total, count = float(logsumexp(self.log_weights)), len(self.log_weights)
        if not np.isfinite(total):
            return Evidence(-np.inf, np.inf, np.inf)
        relative = np.exp(self.log_weights - total) * count
        return Evidence(total - float(np.log(count)), float(np.std(relative) / np.sqrt(count)), self.pareto_k)

    def suffices(self, max_pareto_k: float) -> bool:
        """Whether there are enough effective draws, with a Pareto k below this."""
        return self.pareto_k < max_pareto_k and self.effective_sample_size >= MIN_EFFECTIVE_DRAWS

    def resample(self, generator: np.random.RandomState, count: int) -> Floats:
        """(count, P) draws of the posterior, unconstrained. Unreliable weights are tempered: draws then spread more
        widely than the posterior, rather than repeat a few."""
        weights = self.log_weights if self.pareto_k < MAX_PARETO_K else _tempered(self.log_weights)
        return self.positions[_resample(weights, generator, count)]

    def proposal(self, generator: np.random.RandomState, count: int) -> FittedProposal | None:
        """A proposal fitted to so many draws of the posterior; None if all weights are 0."""
        if not np.isfinite(self.log_weights).any():
            return None
        return FittedProposal.to(self.resample(generator, count), generator)


def importance_draws(
    fit: Fit,
    draws: int,
    generator: np.random.RandomState,
    *,
    max_pareto_k: float = FINITE_VARIANCE,
    along_ridge: bool = False,
    proposal: Density | None = None,
) -> ImportanceDraws:
    """Draw as many of each of several proposals, until their weights suffice; the fit is of a likelihood.

    max_pareto_k: that suffices. along_ridge: begin with mixtures along the ridges of the fit's minima, which takes some
    hundred Jacobians; otherwise they are used if neither approximations about the minima nor `proposal` suffice.
    proposal: an approximation of a posterior similar to the fit's.
    """
    import arviz

    proposals: list[Density] = []
    positions, log_posterior = np.empty((0, len(fit.vector))), np.empty(0)

    def add(proposal: Density) -> ImportanceDraws:
        """Draws of all proposals with this one, weighted as those of their mixture."""
        nonlocal positions, log_posterior
        new = proposal.draw(generator, draws)
        proposals.append(proposal)
        positions = np.concatenate([positions, new])
        log_posterior = np.append(log_posterior, log_posteriors(fit.problem, new, BATCH))
        densities = [one.log_density(positions) for one in proposals]
        weights = log_posterior - (logsumexp(densities, axis=0) - np.log(len(densities)))
        weights = np.where(np.isfinite(weights), weights, -np.inf)
        pareto_k = np.inf
        if np.isfinite(weights).any():
            with np.errstate(over="ignore"):  # in the tail that it fits where all weights but a few are next to nothing
                pareto_k = float(arviz.psislw(np.maximum(weights - weights.max(), -700.0))[1])
        return ImportanceDraws(positions, weights, pareto_k)

    def adapt(weighted: ImportanceDraws) -> ImportanceDraws:
        """The draws, with those of mixtures that are fitted to them until all suffice."""
        for _ in range(ROUNDS):
            if weighted.suffices(max_pareto_k) or not np.isfinite(weighted.log_weights).any():
                break
            rows = _resample(_tempered(weighted.log_weights), generator, draws)
            weighted = add(FittedProposal.to(weighted.positions[rows], generator))
        return weighted

    weighted = add(initial_mixture(fit, BATCH, along_ridges=along_ridge))
    if not along_ridge and not weighted.suffices(MAX_PARETO_K):
        if proposal is not None:
            weighted = adapt(add(proposal))
        if not weighted.suffices(MAX_PARETO_K):
            weighted = add(initial_mixture(fit, BATCH))
    return adapt(weighted)


def _resample(log_weights: Floats, generator: np.random.RandomState, count: int) -> NDArray[np.int64]:
    """So many rows, each as often as its weight says to within one (systematic resampling, Kitagawa 1996)."""
    if not np.isfinite(log_weights).any():
        return generator.randint(len(log_weights), size=count)
    cumulative = np.cumsum(np.exp(log_weights - np.max(log_weights)))
    places = (generator.random_sample() + np.arange(count)) / count
    return np.minimum(np.searchsorted(cumulative, places * cumulative[-1]), len(log_weights) - 1)


def _tempered(log_weights: Floats) -> Floats:
    """Log weights times the highest power up to 1 with which `MIN_EFFECTIVE_DRAWS` are reached."""
    finite = np.isfinite(log_weights)
    least = min(MIN_EFFECTIVE_DRAWS, 0.5 * finite.sum())
    scaled = log_weights
    for power in 0.8 ** np.arange(40):
        scaled = np.where(finite, power * np.where(finite, log_weights, 0.0), -np.inf)
        normalised = np.exp(scaled - logsumexp(scaled))
        if 1.0 / np.sum(normalised**2) >= least:
            break
    return scaled


@broadcasting
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
    require_count("draws", draws, 2)
    require_seed(seed)
    fit.require_posterior("evidence")
    return posterior_draws(fit, draws, seed).evidence


def posterior_draws(fit: Fit, draws: int = DRAWS, seed: int = 0) -> ImportanceDraws:
    """Weighted draws of a fit's posterior, of which the evidence is the mean weight."""
    return importance_draws(fit, draws, np.random.RandomState(seed), along_ridge=True)
