"""Draws that are weighted so that they stand for the posterior of a fit, without a chain.

They come from an approximation of the posterior: that of the fit, and where it will not do one along the fit's ridge,
or about all of its minima that hold a share of the posterior.
How well they stand for it is told by the Pareto shape of the largest weights (Vehtari, Simpson, Gelman, Yao & Gabry
2024, JMLR 25, 72). While weights are too uneven, a mixture is fitted to the draws as they are weighted, and drawn from
too (Cappe, Guillin, Marin & Robert 2004, J. Comput. Graph. Stat. 13, 907); the draws of all approximations are weighted
as those of one (Cornuet, Marin, Mira & Robert 2012, Scand. J. Stat. 39, 798).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from fits.optimise.result import Fit
from fits.problem.compilation import in_shares
from fits.sampling.laplace import Approximation
from fits.sampling.modes import other_minima

if TYPE_CHECKING:
    from fits.sampling.mixture import Mixture

FINITE, ROUNDS = 0.5, 3
"""The Pareto shape below which the variance of weights is finite, and how many mixtures are fitted for it."""

UNRELIABLE = 0.7
"""The Pareto shape above which a part of the posterior may be missing. Below it draws by weight are good enough."""

FEWEST = 50
"""Weighted draws are worth at least so many of the posterior, or another approximation is tried; those that a mixture
is fitted to have weights that are made more even until they are."""

SHARE = 50
"""Draws that a core evaluates at a time: however many there are, one program serves."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Weighted:
    """Draws of approximations, unconstrained, (D, P), and the logarithms of posterior / approximation there, (D,);
    shape: of the Pareto tail of the weights: above `UNRELIABLE` a part of the posterior may be missing."""

    positions: Floats
    log_weights: Floats
    shape: float

    @property
    def worth(self) -> float:
        """How many draws of the posterior they are worth."""
        total = logsumexp(self.log_weights)
        return float(np.exp(-logsumexp(2.0 * (self.log_weights - total)))) if np.isfinite(total) else 0.0

    def is_good(self, shape: float) -> bool:
        """Whether there are enough of them, and their shape is below this."""
        return self.shape < shape and self.worth >= FEWEST

    def resampled(self, generator: np.random.RandomState, count: int) -> Floats:
        """(count, P) draws of the posterior, unconstrained: the more even the weights, the fewer occur twice.

        Unreliable weights are made more even: draws then spread more widely than the posterior, rather than all be one.
        """
        weights = self.log_weights if self.shape < UNRELIABLE else _evened(self.log_weights)
        return self.positions[_chosen(weights, generator, count)]

    def mixture(self, generator: np.random.RandomState, count: int) -> "Mixture | None":
        """A mixture fitted to so many draws of the posterior; None where it has no value at any."""
        from fits.sampling.mixture import Mixture

        if not np.isfinite(self.log_weights).any():
            return None
        return Mixture.through(self.resampled(generator, count), generator)


def weighted(
    fit: Fit,
    draws: int,
    generator: np.random.RandomState,
    *,
    good: float = FINITE,
    along_ridge: bool = False,
    like: "Mixture | None" = None,
) -> Weighted:
    """Draws for a fit of a likelihood: as many of each of several approximations, until they will do.

    good: the shape that is enough.
    along_ridge: begin with a mixture along the fit's ridge, where it has one; that takes some hundred Jacobians. Else
        it is asked for where the fit has minima that may be other modes, or its own approximation will not do, nor
        what is like it.
    like: an approximation of a posterior that is like the fit's.
    """
    from fits.sampling.mixture import Mixture

    along_ridge = along_ridge or bool(other_minima(fit))  # one mode alone would be found good by itself
    ridge = Mixture.of(fit) if along_ridge else None
    pool = _Pool(fit, draws, generator)
    found = pool.add(ridge or Approximation.of(fit))
    if not along_ridge and not found.is_good(UNRELIABLE):
        if like is not None:
            found = pool.refined(pool.add(like), good)
        if not found.is_good(UNRELIABLE) and (ridge := Mixture.of(fit)) is not None:
            found = pool.add(ridge)
    return pool.refined(found, good)


class _Pool:
    """Draws of several approximations, weighted as those of the mixture of all."""

    def __init__(self, fit: Fit, draws: int, generator: np.random.RandomState):
        self.fit, self.draws, self.generator = fit, draws, generator
        self.approximations: list[Approximation | Mixture] = []
        self.positions = np.empty((0, len(fit.vector)))
        self.inside = np.empty(0, bool)
        self.heights = np.empty(0)

    def add(self, approximation: "Approximation | Mixture") -> Weighted:
        """All draws so far, those of this approximation among them."""
        import arviz

        from fits.sampling.ensemble import log_posteriors

        if isinstance(approximation, Approximation):
            positions, inside = approximation.draw(self.generator, self.draws), np.ones(self.draws, bool)
        else:
            positions, inside = approximation.draw_all(self.generator, self.draws)
        (heights,) = in_shares(lambda part: [self.fit.problem.call(log_posteriors, part)], positions, SHARE)
        self.approximations.append(approximation)
        self.positions = np.concatenate([self.positions, positions])
        self.inside = np.append(self.inside, inside)
        self.heights = np.append(self.heights, heights)
        densities = [one.log_density(self.positions) for one in self.approximations]
        weights = self.heights - (logsumexp(densities, axis=0) - np.log(len(densities)))
        weights = np.where(self.inside & np.isfinite(weights), weights, -np.inf)
        if not np.isfinite(weights).any():
            return Weighted(self.positions, weights, np.inf)
        with np.errstate(over="ignore"):  # in the tail that it fits where all weights but a few are next to nothing
            _, shape = arviz.psislw(np.maximum(weights - weights.max(), -700.0))
        return Weighted(self.positions, weights, float(shape))

    def refined(self, found: Weighted, good: float) -> Weighted:
        """What was found, with draws of mixtures fitted to it while it will not do."""
        from fits.sampling.mixture import Mixture

        for _ in range(ROUNDS):
            if found.is_good(good) or not np.isfinite(found.log_weights).any():
                break
            chosen = _chosen(_evened(found.log_weights), self.generator, self.draws)
            found = self.add(Mixture.through(found.positions[chosen], self.generator))
        return found


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
