"""Draws that are weighted so that they stand for the posterior of a fit, without a chain.

They come from an approximation of the posterior: that of the fit, and where it will not do one along the fit's ridge.
How well they stand for it is told by the Pareto shape of the largest weights (Vehtari, Simpson, Gelman, Yao & Gabry
2024, JMLR 25, 72). While weights are too uneven, a mixture is fitted to the draws as they are weighted, and drawn from
in its place (Cappe, Guillin, Marin & Robert 2004, J. Comput. Graph. Stat. 13, 907).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from fits.inference.fit_result import Fit
from fits.inference.laplace import Approximation
from fits.problem.compiled import in_shares

if TYPE_CHECKING:
    from fits.inference.mixture import Mixture

FINITE, ROUNDS = 0.5, 4
"""The Pareto shape below which the variance of weights is finite, and how many approximations are tried for it."""

UNRELIABLE = 0.7
"""The Pareto shape above which a part of the posterior may be missing. Below it draws by weight are good enough."""

FEWEST = 50
"""Draws that a mixture is fitted to are worth at least so many of the posterior; else weights are made more even."""

SHARE = 50
"""Draws that a core evaluates at a time: however many there are, one program serves."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Weighted:
    """Draws of an approximation, unconstrained, (D, P), and the logarithms of posterior / approximation there, (D,);
    shape: of the Pareto tail of the weights: above `UNRELIABLE` a part of the posterior may be missing."""

    positions: Floats
    log_weights: Floats
    shape: float

    def resampled(self, generator: np.random.RandomState, count: int) -> Floats:
        """(count, P) draws of the posterior, unconstrained: the more even the weights, the fewer occur twice.

        Unreliable weights are made more even: draws then spread more widely than the posterior, rather than all be one.
        """
        weights = self.log_weights if self.shape < UNRELIABLE else _evened(self.log_weights)
        return self.positions[_chosen(weights, generator, count)]


def weighted(
    fit: Fit, draws: int, generator: np.random.RandomState, *, good: float = FINITE, along_ridge: bool = False
) -> Weighted:
    """Draws for a fit of a likelihood: of the approximation with the lowest shape, of up to `ROUNDS` and the first two.

    good: the shape that is enough.
    along_ridge: begin with a mixture along the fit's ridge, where it has one; that takes some hundred Jacobians. Else
        it is tried where the fit's own approximation is unreliable.
    """
    from fits.inference.mixture import Mixture

    first = (Mixture.of(fit) if along_ridge else None) or Approximation.of(fit)
    best = found = _drawn(fit, first, draws, generator)
    ridge = None if along_ridge or best.shape < UNRELIABLE else Mixture.of(fit)
    if ridge is not None:
        found = _drawn(fit, ridge, draws, generator)
        best = min(found, best, key=_shape)
    for _ in range(ROUNDS - 1):
        if best.shape < good or not np.isfinite(found.log_weights).any():
            break
        chosen = _chosen(_evened(found.log_weights), generator, draws)
        found = _drawn(fit, Mixture.through(found.positions[chosen], generator), draws, generator)
        best = min(found, best, key=_shape)
    return best


def _shape(found: Weighted) -> float:
    return found.shape


def _drawn(
    fit: Fit, approximation: "Approximation | Mixture", draws: int, generator: np.random.RandomState
) -> Weighted:
    import arviz

    from fits.inference.ensemble import log_posteriors

    if isinstance(approximation, Approximation):
        positions, inside = approximation.draw(generator, draws), np.ones(draws, bool)
    else:
        positions, inside = approximation.draw_all(generator, draws)
    (heights,) = in_shares(lambda part: [fit.problem.call(log_posteriors, part)], positions, SHARE)
    weights = heights - approximation.log_density(positions)
    weights = np.where(inside & np.isfinite(weights), weights, -np.inf)
    if not np.isfinite(weights).any():
        return Weighted(positions, weights, np.inf)
    _, shape = arviz.psislw(np.maximum(weights - weights.max(), -700.0))
    return Weighted(positions, weights, float(shape))


def _chosen(log_weights: Floats, generator: np.random.RandomState, count: int) -> NDArray[np.int64]:
    if not np.isfinite(log_weights).any():
        return generator.randint(len(log_weights), size=count)
    chances = np.exp(log_weights - logsumexp(log_weights))
    return generator.choice(len(log_weights), count, p=chances / chances.sum())


def _evened(log_weights: Floats) -> Floats:
    """Logarithms of weights raised to the highest power up to 1 with which they are worth `FEWEST` draws."""
    finite = np.isfinite(log_weights)
    least = min(FEWEST, 0.5 * finite.sum())
    scaled = log_weights
    for power in 0.8 ** np.arange(40):
        scaled = np.where(finite, power * np.where(finite, log_weights, 0.0), -np.inf)
        share = np.exp(scaled - logsumexp(scaled))
        if 1.0 / np.sum(share**2) >= least:
            break
    return scaled
