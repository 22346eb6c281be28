"""A mixture of heavy-tailed densities: about the minima of a fit (`initial`), or fitted to draws (`proposals`)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.cluster.vq import ClusterError, kmeans2
from scipy.special import expit, gammaln, logit, logsumexp

from fits.data.geometry import Floats

DEGREES_OF_FREEDOM = 6.0
COMPONENTS = 4  # of mixtures that are fitted to draws: more follow what is there by chance
ITERATIONS = 10
MOST_SAMPLES = 8000
SMALLEST_VARIANCE = 1e-12  # of a unit, that a combination of parameters keeps
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

    @classmethod
    def fitted(cls, positions: Floats, generator: np.random.RandomState) -> "Mixture":
        """Fitted to samples (count, P), two at least, by expectation and maximisation; each component counts as a few
        samples of its own, so that it keeps its full rank."""
        samples = positions[generator.permutation(len(positions))[:MOST_SAMPLES]]  # of all walkers
        dimension = samples.shape[1]
        values, directions = np.linalg.eigh(np.atleast_2d(np.cov(samples.T)))
        whole = directions * np.sqrt(np.maximum(values, NARROWEST**2))
        white = np.linalg.solve(whole, samples.T).T
        centres, nearest = _clusters(white, generator)
        prior = whole @ np.atleast_2d(np.cov((white - centres[nearest]).T)) @ whole.T
        count, own = len(centres), 2.0 + dimension
        now = cls.students(centres @ whole.T, np.tile(_root(prior), (count, 1, 1)), np.full(count, -np.log(count)))
        for _ in range(ITERATIONS):
            parts = now.log_parts(samples)
            share = np.exp(parts - logsumexp(parts, axis=0))
            near = share * (DEGREES_OF_FREEDOM + dimension) / (DEGREES_OF_FREEDOM + now.squared_distance(samples))
            centre = (near @ samples + own * now.centre) / (near.sum(axis=1) + own)[:, None]
            away = samples - centre[:, None]
            scatter = np.swapaxes(away * near[..., None], 1, 2) @ away
            scale = (scatter + own * prior) / (share.sum(axis=1) + own)[:, None, None]
            weight = share.sum(axis=1) + 1.0
            now = cls.students(centre, _root(scale), np.log(weight / weight.sum()))
        return now

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


def _clusters(points: Floats, generator: np.random.RandomState) -> tuple[Floats, NDArray[np.int_]]:
    """Centres of up to `COMPONENTS` clusters, none of them empty, and which one each point belongs to."""
    for count in range(min(COMPONENTS, len(np.unique(points.round(6), axis=0))), 1, -1):
        try:
            return kmeans2(points, count, minit="++", missing="raise", rng=generator)
        except ClusterError:
            continue
    return points.mean(axis=0, keepdims=True), np.zeros(len(points), int)


def _root(covariance: Floats) -> Floats:
    """Roots (..., P, P) of covariances, of full rank however little rounding has left of them."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    scale = np.sqrt(np.maximum(variance, NARROWEST**2))
    scaled = covariance / (scale[..., None] * scale[..., None, :])
    short = 1.0 - variance / scale**2  # of a unit, where there is next to no variance
    return scale[..., None] * np.linalg.cholesky(
        scaled + (short + SMALLEST_VARIANCE)[..., None] * np.eye(scaled.shape[-1])
    )
