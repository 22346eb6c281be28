"""What is predicted elsewhere: the BSDF, a new measurement and the stack alone, with intervals and scores."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import logsumexp

from fits.data.measurements import Measurements
from fits.prediction.importance import UNRELIABLE
from fits.problem.discrepancy.logarithm import logarithm, size

BESIDE = 8
"""Readings that are drawn for each of them."""

HELD = (0.5, 0.95)
"""Central intervals whose shares of readings are told."""

HALVINGS = 50
"""Of an interval that a quantile lies in."""

NARROWEST = 1e-12
"""Of the discrepancy's standard deviation: where the data leave nothing of it unknown, its law is still a function."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Band:
    """What is expected of M values in C channels, in 1/sr: mean and sd, (M, C), and quantiles, (levels, M, C)."""

    mean: Floats
    sd: Floats
    quantiles: Floats


@dataclass(frozen=True, eq=False)
class Prediction:
    """Of M pairs of directions in C channels.

    Attributes:
        wi, wo: directions, (M, 3).
        channels: their names.
        levels: of the quantiles.
        bsdf: of the BSDF: the stack's value with the model discrepancy. This is the best estimate.
        predictive: of a new measurement: the BSDF with noise.
        latent: of the stack alone, without the discrepancy.
        means, scales: of a reading with each of D vectors of parameters, (D, M, C), in 1/sr; given these it is
            Gaussian, or has Student-t tails. Where readings share errors, of its `logarithm`.
        softness: of that, (M, C) or (D, M, C), in 1/sr; else None.
        unknown: standard deviation of the discrepancy with each vector, (D, M, C), about `means`, of the `logarithm`;
            None where no discrepancy is modelled.
        values: of the stack itself, with each vector, (D, M, C), in 1/sr.
        degrees_of_freedom: of these tails; infinite if it is Gaussian.
        pareto_k: of the importance weights by which draws stand for the posterior of a fit (see `evidence`); NaN where
            they are those of a chain.
        readings: those that were to be predicted, None where directions alone were asked for.
    """

    wi: Floats
    wo: Floats
    channels: tuple[str, ...]
    levels: tuple[float, ...]
    bsdf: Band
    predictive: Band
    latent: Band
    means: Floats
    scales: Floats
    softness: Floats | None
    unknown: Floats | None
    degrees_of_freedom: float
    values: Floats
    pareto_k: float = math.nan
    readings: Measurements | None = None

    @property
    def mean(self) -> Floats:
        """Of the BSDF, (M, C), in 1/sr."""
        return self.bsdf.mean

    @property
    def sd(self) -> Floats:
        """Standard deviation of the BSDF, (M, C), in 1/sr."""
        return self.bsdf.sd

    def quantile(self, level: float) -> Floats:
        """Of the BSDF, (M, C), in 1/sr; level in (0, 1)."""
        require_level(level)
        if self.unknown is None:
            return np.quantile(self.values, level, axis=0)
        return self._mixture_quantile(level, np.maximum(self.unknown, NARROWEST), stats.norm())

    def predictive_quantile(self, level: float) -> Floats:
        """Of a new reading, (M, C), in 1/sr; level in (0, 1)."""
        require_level(level)
        return self._mixture_quantile(level, self.scales, self._tails)

    def _mixture_quantile(self, level: float, scales: Floats, law: "stats.rv_frozen") -> Floats:
        ends = self.means + scales * law.ppf(level)
        if self.softness is not None:
            ends = self.softness * np.sinh(ends)
        low, high = ends.min(axis=0), ends.max(axis=0)  # a mixture's lies between those of its parts
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            below = law.cdf(self._offsets(middle, scales)).mean(axis=0) < level
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return 0.5 * (low + high)

    @property
    def scores(self) -> "Scores":
        """How well the readings were predicted. ValueError where directions alone were asked for."""
        if self.readings is None:
            raise ValueError("scores: directions alone were predicted; predict readings (Measurements) to score them")
        return scores(self, self.readings)

    @property
    def reliable(self) -> bool:
        """Whether the vectors stand for the whole posterior; else a chain is better asked."""
        return not self.pareto_k >= UNRELIABLE

    def log_density(self, values: Floats) -> Floats:
        """Log-density of readings (M, C), each by itself."""
        density = self._tails.logpdf(self._offsets(values, self.scales)) - np.log(self.scales)
        if self.softness is not None:
            density = density - np.log(np.asarray(size(values, self.softness)))
        return logsumexp(density, axis=0) - math.log(len(density))

    def rank(self, values: Floats) -> Floats:
        """Probability of a reading below each of these, (M, C)."""
        return self._tails.cdf(self._offsets(values, self.scales)).mean(axis=0)

    def _offsets(self, values: Floats, scales: Floats) -> Floats:
        measured = values if self.softness is None else np.asarray(logarithm(values, self.softness))
        return (measured - self.means) / scales

    @property
    def median(self) -> Floats:
        """Of a reading, (M, C), in 1/sr."""
        middle = self.means if self.softness is None else self.softness * np.sinh(self.means)
        return np.median(middle, axis=0)

    @property
    def _tails(self) -> "stats.rv_frozen":
        return stats.norm() if math.isinf(self.degrees_of_freedom) else stats.t(self.degrees_of_freedom)


def banded(
    wi: Floats,
    wo: Floats,
    channels: tuple[str, ...],
    levels: tuple[float, ...],
    values: Floats,
    means: Floats,
    scales: Floats,
    softness: Floats | None,
    unknown: Floats | None,
    degrees_of_freedom: float,
    seed: int,
) -> Prediction:
    """The prediction with these parts, and the bands that follow from them: `BESIDE` readings are drawn of each."""
    generator, shape = np.random.default_rng(seed), (BESIDE, *means.shape)
    gaussian = math.isinf(degrees_of_freedom)
    drawn = generator.standard_normal(shape) if gaussian else generator.standard_t(degrees_of_freedom, shape)
    latent = _band(values, levels)
    predictive = _drawn_band(means + scales * drawn, softness, levels)
    bsdf = latent
    if unknown is not None:
        bsdf = _drawn_band(means + unknown * generator.standard_normal(shape), softness, levels)
    return Prediction(
        wi=wi,
        wo=wo,
        channels=channels,
        levels=levels,
        bsdf=bsdf,
        predictive=predictive,
        latent=latent,
        means=means,
        scales=scales,
        softness=softness,
        unknown=unknown,
        degrees_of_freedom=degrees_of_freedom,
        values=values,
    )


@dataclass(frozen=True)
class Scores:
    """How well readings were predicted.

    count: readings times channels. median_error, p95_error: median and 95th percentile of |prediction / reading - 1|,
    the prediction being the median; model_error: the median of that for the model's own value. coverage: share of the
    readings in the central interval, by what that should hold: 0.5 and 0.95. elpd: mean log-density of a reading.
    """

    count: int
    median_error: float
    p95_error: float
    model_error: float
    coverage: Mapping[float, float]
    elpd: float


def scores(prediction: Prediction, readings: Measurements, rows: NDArray[np.bool_] | None = None) -> Scores:
    """How well the used readings, at the predicted directions, were predicted; only those in `rows`, (M,), if given.

    Raises:
        ValueError: no reading is left, or they were taken elsewhere.
    """
    used = readings.used()
    if used.wi.shape != prediction.wi.shape or not np.allclose(used.wo, prediction.wo) & np.allclose(
        used.wi, prediction.wi
    ):
        raise ValueError("scores: the readings were taken elsewhere than where was predicted")
    keep = np.ones(len(used), bool) if rows is None else rows
    if not keep.any():
        raise ValueError("scores: no reading is left to score")
    values, rank = used.values[keep], prediction.rank(used.values)[keep]
    median = prediction.median[keep]
    size = np.maximum(np.abs(values), np.finfo(float).tiny)
    error, of_model = (np.abs(part - values) / size for part in (median, prediction.latent.mean[keep]))
    return Scores(
        count=values.size,
        median_error=float(np.median(error)),
        p95_error=float(np.quantile(error, 0.95)),
        model_error=float(np.median(of_model)),
        coverage={share: float(np.mean(np.abs(2.0 * rank - 1.0) < share)) for share in HELD},
        elpd=float(np.mean(prediction.log_density(used.values)[keep])),
    )


def require_level(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level}; it must be in (0, 1)")


def _drawn_band(draws: Floats, softness: Floats | None, levels: tuple[float, ...]) -> Band:
    """Of draws (..., D, M, C), of the `logarithm` where there is a softness."""
    values = draws if softness is None else softness * np.sinh(draws)
    return _band(values.reshape(-1, *values.shape[-2:]), levels)


def _band(values: Floats, levels: tuple[float, ...]) -> Band:
    return Band(values.mean(axis=0), values.std(axis=0), np.quantile(values, levels, axis=0))
