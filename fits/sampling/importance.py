"""Importance sampling of the posterior of a fit: weighted draws without a chain, and the mixture they are drawn from.

Incremental mixture importance sampling (Raftery & Bao 2010, Biometrics 66, 1162): the first draws are those of
Laplace's approximations about the minima of the fit. Where their weights, posterior / mixture, are largest the mixture
has too little: components are added there, by the information at each place (as of Fasiolo, de Melo & Maskell 2018,
Stat. Comput. 28, 549), and drawn from. All draws are weighted as those of the whole mixture. So it grows along ridges,
however they bend. The Pareto k of the largest weights says how well the draws represent the posterior (Vehtari,
Simpson, Gelman, Yao & Gabry 2024, JMLR 25, 72).
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logsumexp

from fits.data.geometry import Floats
from fits.optimise.result import Fit
from fits.optimise.uncertainty import local_information
from fits.problem.compilation import on_all_cores, one_thread
from fits.problem.problem import Problem
from fits.progress import Progress, silent
from fits.sampling.initial import initial_mixture, log_posteriors
from fits.sampling.mixture import NARROWEST, Mixture
from fits.sampling.options import MAX_PARETO_K, SamplerOptions

FINITE_VARIANCE = 0.5  # Pareto k below which the variance of weights is finite
MIN_EFFECTIVE_DRAWS = 50
FEWEST = 200  # draws, of whose spread something can be said
MIN_EFFICIENCY = 0.2  # effective draws to draws: with less, a part of a ridge may not have been reached
SHARE = 8  # draws that a core evaluates at a time: however many there are, one program serves
ROUNDS = 24
ROUNDS_ALONG_RIDGES = 8  # at least, where a direction is unidentified: of a short piece of a ridge weights look well
COMPONENTS = 8  # that each round adds
DRAWS = 32  # of each of them
WIDEST = 2.0  # standard deviations of the posterior, as far as it is known: no component is wider
SMALLEST_VARIANCE = 1e-6  # of the largest, of a combination of parameters as far as it is known


@dataclass(frozen=True, eq=False)
class ImportanceDraws:
    """Unconstrained draws, (D, P), log weights posterior / proposal, (D,), the Pareto k of the weights, and the mixture
    that was drawn from."""

    positions: Floats
    log_weights: Floats
    pareto_k: float
    mixture: Mixture

    @property
    def effective_sample_size(self) -> float:
        """Effective sample size of the weighted draws."""
        total = logsumexp(self.log_weights)
        return float(np.exp(-logsumexp(2.0 * (self.log_weights - total)))) if np.isfinite(total) else 0.0

    def resample(self, generator: np.random.RandomState, count: int) -> Floats:
        """(count, P) draws of the posterior, unconstrained. Unreliable weights are tempered: draws then spread more
        widely than the posterior, rather than repeat a few."""
        weights = self.log_weights if self.pareto_k < MAX_PARETO_K else _tempered(self.log_weights)
        if not np.isfinite(weights).any():
            return self.positions[generator.randint(len(weights), size=count)]
        # systematic (Kitagawa 1996): each as often as its weight says to within one
        cumulative = np.cumsum(np.exp(weights - np.max(weights)))
        places = (generator.random_sample() + np.arange(count)) / count
        return self.positions[np.minimum(np.searchsorted(cumulative, places * cumulative[-1]), len(weights) - 1)]


def importance_draws(
    fit: Fit,
    draws: int,
    generator: np.random.RandomState,
    *,
    max_pareto_k: float = FINITE_VARIANCE,
    efficiency: float = MIN_EFFICIENCY,
    share: int = SHARE,
    smallest_mode: float = SamplerOptions.smallest_mode,
    initial: Mixture | None = None,
    progress: Progress = silent,
) -> ImportanceDraws:
    """So many draws, 200 at least, and more until they suffice: with a Pareto k below this, enough effective draws, and
    at least this share of all.

    The fit is of a likelihood. share: see `log_posteriors`. initial: mixture that is drawn from first, in place of
    approximations about the minima of the fit. progress: called with ("approximation", rounds, the most, note).
    """
    problem, least_rounds = fit.problem, ROUNDS_ALONG_RIDGES if fit.unidentified and initial is None else 0
    mixture = initial or initial_mixture(fit, share, smallest_mode)
    positions = mixture.draw(generator, max(draws, FEWEST))
    log_posterior, log_density = log_posteriors(problem, positions, share), mixture.log_density(positions)
    for number in range(ROUNDS + 1):
        weights = np.where(np.isfinite(log_posterior), log_posterior - log_density, -np.inf)
        found = ImportanceDraws(positions, weights, _pareto_k(weights), mixture)
        enough = max(MIN_EFFECTIVE_DRAWS, efficiency * len(positions))
        suffices = found.pareto_k < max_pareto_k and found.effective_sample_size >= enough
        if (suffices and number >= least_rounds) or number == ROUNDS or not np.isfinite(weights).any():
            break
        progress("approximation", number, ROUNDS, f"{found.effective_sample_size / len(positions):.0%} efficient")
        even = _tempered(weights)
        spread = np.atleast_2d(np.cov(positions.T, aweights=np.exp(even - even.max()), ddof=0))
        top = np.argsort(-weights)[:COMPONENTS]
        top = top[np.isfinite(weights[top])]
        added = components_at(problem, positions[top], spread)
        fresh = added.draw(generator, DRAWS * len(top))
        of_added = len(fresh) / (len(positions) + len(fresh))
        own, other = mixture.log_density(fresh), added.log_density(np.concatenate([positions, fresh]))
        log_density = np.concatenate([log_density, own]) + np.log1p(-of_added)
        log_density = np.logaddexp(log_density, other + np.log(of_added))
        mixture = mixture.extended(added, of_added)
        positions = np.concatenate([positions, fresh])
        log_posterior = np.append(log_posterior, log_posteriors(problem, fresh, share, compiled=True))
    return found


def components_at(problem: Problem, positions: Floats, spread: Floats) -> Mixture:
    """A component of equal weight for each of `positions` (M, P), by the information there, and a step of at most one
    standard deviation up the posterior; none is much wider than a posterior of covariance `spread`, (P, P)."""
    values, directions = np.linalg.eigh(spread)
    bound = np.maximum(values, max(SMALLEST_VARIANCE * values[-1], NARROWEST**2))
    limit = (directions / bound) @ directions.T / WIDEST**2

    def about(position: Floats) -> tuple[Floats, Floats]:
        unit = expit(position)
        stretch = unit * (1.0 - unit)
        rows, slope = (np.nan_to_num(part, posinf=0.0, neginf=0.0) for part in local_information(problem, unit)[:2])
        precision = (rows * stretch).T @ (rows * stretch) + np.diag(2.0 * stretch) + limit
        with one_thread():  # the same to the last bit, whatever else runs
            values, directions = np.linalg.eigh(precision)
            root = directions / np.sqrt(values)
            step = root.T @ (1.0 - 2.0 * unit - slope * stretch)  # in standard deviations
        return position + root @ (step / max(1.0, float(np.linalg.norm(step)))), root

    found = on_all_cores(about, positions)
    centres, roots = (np.stack([one[place] for one in found]) for place in (0, 1))
    return Mixture.students(centres, roots, np.full(len(found), -np.log(len(found))))


def _pareto_k(log_weights: Floats) -> float:
    import arviz

    if not np.isfinite(log_weights).any():
        return np.inf
    with np.errstate(over="ignore"):  # in the tail that it fits where all weights but a few are next to nothing
        return float(arviz.psislw(np.maximum(log_weights - log_weights.max(), -700.0))[1])


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
