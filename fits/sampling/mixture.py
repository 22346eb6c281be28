"""A mixture of heavy-tailed densities, which approximates a posterior: see `initial` and `importance`."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit, gammaln, logit, logsumexp

from fits.data.geometry import Floats

DEGREES_OF_FREEDOM = 3.0  # tails heavier than those of a posterior: where they are lighter, walkers stay
ROWS = 1024  # positions at a time: less memory
NARROWEST, INSIDE = 1e-9, 1e-9  # in log-odds; of the box


@dataclass(frozen=True, eq=False)
class Mixture:
    """A density over the unconstrained vectors of a problem with P parameters: M multivariate Student-t densities.

    centre: (M, P). root: (M, P, P), of the scale matrix. at_bound: (M, P) bool: such a parameter follows none of them,
    its distance from the bound is exponentially distributed. distance: (M, P), the mean of that in boxes. log_weight:
    (M,). mode: (M,), which mode of the posterior a component belongs to; 0 is that of the best minimum.
    """

    centre: Floats
    root: Floats
    at_bound: NDArray[np.bool_]
    distance: Floats
    log_weight: Floats
    mode: NDArray[np.int64]

    @classmethod
    def students(cls, centre: Floats, root: Floats, log_weight: Floats) -> "Mixture":
        """Without parameters at a bound, and of one mode."""
        nowhere = np.zeros(centre.shape, bool)
        return cls(centre, root, nowhere, np.ones(centre.shape), log_weight, np.zeros(len(centre), int))

    @classmethod
    def of_modes(cls, parts: Sequence["Mixture"]) -> "Mixture":
        """Mixtures about the modes of a posterior, by the masses that they have as weights."""
        joined = cls(*(np.concatenate([vars(part)[name] for part in parts]) for name in cls.__dataclass_fields__))
        mode = np.repeat(np.arange(len(parts)), [len(part.centre) for part in parts])
        return replace(joined, mode=mode, log_weight=joined.log_weight - logsumexp(joined.log_weight))

    def extended(self, added: "Mixture", share: float) -> "Mixture":
        """This mixture and another, which has a share of it; components added belong to the modes that they lie in."""
        added = replace(added, log_weight=added.log_weight + np.log(share), mode=self.mode_of(added.centre))
        own = replace(self, log_weight=self.log_weight + np.log1p(-share))
        return Mixture(*(np.concatenate([vars(own)[name], vars(added)[name]]) for name in self.__dataclass_fields__))

    @property
    def best(self) -> "Mixture":
        """The component about the best minimum."""
        return Mixture(*(vars(self)[name][:1] for name in self.__dataclass_fields__))

    @property
    def mode_count(self) -> int:
        """How many modes the fit knows of."""
        return int(self.mode.max()) + 1

    def mode_of(self, positions: Floats) -> NDArray[np.int64]:
        """Which mode each of `positions` (count, P) belongs to, (count,)."""
        return self.mode[np.argmax(self.log_parts(positions), axis=0)]

    def log_density(self, positions: Floats) -> Floats:
        """Log-density, (count,), at unconstrained `positions` (count, P)."""
        return np.asarray(logsumexp(self.log_parts(positions), axis=0))

    def draw(self, generator: np.random.RandomState, count: int, shrink: float = 1.0) -> Floats:
        """(count, P) independent draws, `shrink` times closer to the centre of their component."""
        chances = np.exp(self.log_weight - logsumexp(self.log_weight))
        which = generator.choice(len(chances), count, p=chances)
        normal = generator.standard_normal((count, self.centre.shape[1]))
        heavy = normal * np.sqrt(DEGREES_OF_FREEDOM / generator.chisquare(DEGREES_OF_FREEDOM, (count, 1)))
        drawn = self.centre[which] + shrink * np.einsum("nij,nj->ni", self.root[which], heavy)
        mean = self.distance[which]
        distance = -mean * np.log1p(generator.random_sample(mean.shape) * np.expm1(-1.0 / mean))
        log_odds = logit(np.clip(shrink * distance, INSIDE, 1.0 - INSIDE))
        return np.where(self.at_bound[which], np.where(self.centre[which] < 0.0, log_odds, -log_odds), drawn)

    def log_parts(self, positions: Floats) -> Floats:
        """What every component adds to the density, as logarithms, (M, count)."""
        blocks = np.array_split(positions, 1 + len(positions) // ROWS)
        return np.concatenate([self._log_parts(block) for block in blocks], axis=1)

    def _log_parts(self, positions: Floats) -> Floats:
        power, level = self._of_components
        found = level[:, None] - power[:, None] * np.log1p(self.squared_distance(positions) / DEGREES_OF_FREEDOM)
        if self.at_bound.any():
            mean = self.distance[:, None]
            log_odds = np.where(self.centre[:, None] < 0.0, positions, -positions)
            exponential = -expit(log_odds) / mean - np.log(-mean * np.expm1(-1.0 / mean))
            held = exponential + stats.logistic.logpdf(log_odds)  # d distance / d log-odds
            found = found + np.sum(np.where(self.at_bound[:, None], held, 0.0), axis=-1)
        return found

    def squared_distance(self, positions: Floats) -> Floats:
        """Squared distance from every centre by its scale matrix, (M, count), without parameters at a bound."""
        away = np.where(self.at_bound[:, None], 0.0, positions - self.centre[:, None])
        return np.sum((away @ np.swapaxes(self._inverse, 1, 2)) ** 2, axis=-1)

    @cached_property
    def _inverse(self) -> Floats:
        return np.asarray(np.linalg.inv(self._full_root), float)

    @property
    def _full_root(self) -> Floats:
        return self.root + self.at_bound[:, None] * np.eye(self.centre.shape[1])

    @cached_property
    def _of_components(self) -> tuple[Floats, Floats]:
        """The power of every Student-t, and the logarithm of its height, (M,) each."""
        dimension = np.sum(~self.at_bound, axis=1)
        power = 0.5 * (DEGREES_OF_FREEDOM + dimension)
        peak = gammaln(power) - gammaln(0.5 * DEGREES_OF_FREEDOM) - 0.5 * dimension * np.log(DEGREES_OF_FREEDOM * np.pi)
        return power, self.log_weight + peak - np.linalg.slogdet(self._full_root)[1]

    def record(self) -> dict[str, Any]:
        """Its arrays by name, as a store keeps them."""
        return {name: np.ascontiguousarray(array) for name, array in asdict(self).items()}
