"""What readings elsewhere will be: the model with its uncertainty, what it lacks, and the noise of a reading."""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import stats
from scipy.special import logsumexp

from fits.data.geometry import Geometry
from fits.data.measurements import Measurements, Source
from fits.inference.fit_result import Fit
from fits.inference.importance import UNRELIABLE, weighted
from fits.inference.posterior import Posterior
from fits.problem.logarithm import logarithm, size
from fits.problem.logarithm import softness as soft
from fits.problem.model import Model
from fits.problem.nodes import places

LEAST_DRAWS = 400
"""Of the approximation that draws of a posterior are chosen from."""

DRAWS = 256
"""Vectors of parameters that a prediction is made with."""

BESIDE = 8
"""Readings that are drawn for each of them."""

LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)

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
        model: of the stack's own value.
        reading: of a new reading: that with what the model lacks, and with noise.
        means, scales: of a reading with each of D vectors of parameters, (D, M, C), in 1/sr; given these it is
            Gaussian, or has Student-t tails. Where readings share errors, of its `logarithm`.
        softness: of that, (M, C) or (D, M, C), in 1/sr; else None.
        values: of the stack itself, with each vector, (D, M, C), in 1/sr.
        degrees_of_freedom: of these tails; infinite if it is Gaussian.
        shape: Pareto shape of the weights by which draws stand for the posterior of a fit (see `evidence`); NaN where
            they are those of a chain.
    """

    wi: Floats
    wo: Floats
    channels: tuple[str, ...]
    levels: tuple[float, ...]
    model: Band
    reading: Band
    means: Floats
    scales: Floats
    softness: Floats | None
    degrees_of_freedom: float
    values: Floats
    shape: float = math.nan

    @property
    def reliable(self) -> bool:
        """Whether the vectors stand for the whole posterior; else a chain is better asked."""
        return not self.shape >= UNRELIABLE

    def log_density(self, values: Floats) -> Floats:
        """Log-density of readings (M, C), each by itself."""
        density = self._tails.logpdf(self._offsets(values)) - np.log(self.scales)
        if self.softness is not None:
            density = density - np.log(np.asarray(size(values, self.softness)))
        return logsumexp(density, axis=0) - math.log(len(density))

    def rank(self, values: Floats) -> Floats:
        """Probability of a reading below each of these, (M, C)."""
        return self._tails.cdf(self._offsets(values)).mean(axis=0)

    def _offsets(self, values: Floats) -> Floats:
        measured = values if self.softness is None else np.asarray(logarithm(values, self.softness))
        return (measured - self.means) / self.scales

    @property
    def median(self) -> Floats:
        """Of a reading, (M, C), in 1/sr."""
        middle = self.means if self.softness is None else self.softness * np.sinh(self.means)
        return np.median(middle, axis=0)

    @property
    def _tails(self) -> "stats.rv_frozen":
        return stats.norm() if math.isinf(self.degrees_of_freedom) else stats.t(self.degrees_of_freedom)


def predict(
    of: Fit | Posterior,
    at: Geometry | Measurements,
    *,
    levels: tuple[float, ...] = LEVELS,
    draws: int = DRAWS,
    seed: int = 0,
) -> Prediction:
    """What the fitted stack is expected to reflect, and what would be read.

    Args:
        of: a posterior, or a fit, of whose posterior draws are made by weights (see `fits.inference.importance`).
        at: pairs of directions, above or below; of `Measurements` their used samples, with their own sigma.
        levels: of the quantiles, in (0, 1).
        draws: vectors of parameters, at least 2.
        seed: of these, and of the noise.

    Readings whose sigma is not known have the median sigma of those that were fitted, relative to the model.

    Raises:
        ValueError: a level or number of draws out of range, a fit of a named objective, readings in other channels, or
            directions that the transport cannot answer.
    """
    fit = of.fit if isinstance(of, Posterior) else of
    if not fit.is_posterior:
        raise ValueError(f"predict: a fit of {fit.problem.objective!r} has no noise model, it says nothing of readings")
    if not all(0.0 < level < 1.0 for level in levels):
        raise ValueError(f"levels is {levels}; they must be in (0, 1)")
    if draws < 2:
        raise ValueError(f"draws is {draws}; it must be at least 2")
    generator = np.random.default_rng(seed)
    data = _measurements(fit, at)
    vectors, shape = _vectors(of, draws, generator)
    values = np.asarray(fit.problem.predict_at(vectors, data.wi, data.wo), float)
    values = np.broadcast_to(values, (*values.shape[:2], len(fit.problem.data.channels)))
    sigma = _own_sigma(fit, values, data.sigma)
    means, scales, softness = _readings(fit, vectors, values, data, sigma)
    noise = fit.problem.noise
    freedom = noise.degrees_of_freedom if noise.tails == "student" else math.inf
    found = banded(data.wi, data.wo, fit.problem.data.channels, levels, values, means, scales, softness, freedom, seed)
    return replace(found, shape=shape)


def banded(
    wi: Floats,
    wo: Floats,
    channels: tuple[str, ...],
    levels: tuple[float, ...],
    values: Floats,
    means: Floats,
    scales: Floats,
    softness: Floats | None,
    degrees_of_freedom: float,
    seed: int,
) -> Prediction:
    """The prediction with these parts, and the bands that follow from them: `BESIDE` readings are drawn of each."""
    generator, shape = np.random.default_rng(seed), (BESIDE, *means.shape)
    gaussian = math.isinf(degrees_of_freedom)
    drawn = generator.standard_normal(shape) if gaussian else generator.standard_t(degrees_of_freedom, shape)
    readings = means + scales * drawn
    if softness is not None:
        readings = softness * np.sinh(readings)
    return Prediction(
        wi=wi,
        wo=wo,
        channels=channels,
        levels=levels,
        model=_band(values, levels),
        reading=_band(readings.reshape(-1, *means.shape[1:]), levels),
        means=means,
        scales=scales,
        softness=softness,
        degrees_of_freedom=degrees_of_freedom,
        values=values,
    )


@dataclass(frozen=True)
class Scores:
    """How well readings were predicted.

    count: readings times channels. median_error, large_error: median and 95th percentile of |prediction / reading - 1|,
    the prediction being the median; model_error: the median of that for the model's own value. within_half, within_95:
    shares of readings in the central 50 and 95 % intervals. log_score: mean log-density of a reading.
    """

    count: int
    median_error: float
    large_error: float
    model_error: float
    within_half: float
    within_95: float
    log_score: float


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
    error, of_model = (np.abs(part - values) / size for part in (median, prediction.model.mean[keep]))
    return Scores(
        count=values.size,
        median_error=float(np.median(error)),
        large_error=float(np.quantile(error, 0.95)),
        model_error=float(np.median(of_model)),
        within_half=float(np.mean((rank > 0.25) & (rank < 0.75))),
        within_95=float(np.mean((rank > 0.025) & (rank < 0.975))),
        log_score=float(np.mean(prediction.log_density(used.values)[keep])),
    )


def _band(values: Floats, levels: tuple[float, ...]) -> Band:
    return Band(values.mean(axis=0), values.std(axis=0), np.quantile(values, levels, axis=0))


def _measurements(fit: Fit, at: Geometry | Measurements) -> Measurements:
    if isinstance(at, Measurements):
        if len(at.channels) != len(fit.problem.data.channels):
            raise ValueError(
                f"predict: the readings have the channels {', '.join(at.channels)}, "
                f"the fit {', '.join(fit.problem.data.channels)}"
            )
        return at.used()
    count, channels = len(at), fit.problem.data.channels
    nothing = np.zeros((count, len(channels)))
    return Measurements(at.wi, at.wo, nothing, None, np.ones(count, bool), channels, Source("", "memory"))


def _vectors(of: Fit | Posterior, draws: int, generator: np.random.Generator) -> tuple[Floats, float]:
    """Draws (D, P) of the posterior, and the shape of their weights."""
    if isinstance(of, Posterior):
        return generator.choice(of.samples, draws, axis=0, replace=len(of.samples) < draws), math.nan
    random = np.random.RandomState(generator.integers(2**31))
    found = weighted(of, max(LEAST_DRAWS, 2 * draws), random, good=UNRELIABLE)
    positions = jnp.asarray(found.resampled(random, draws))
    return np.asarray(jax.vmap(of.problem.model.box.constrain)(positions), float), found.shape


def _own_sigma(fit: Fit, values: Floats, sigma: Floats | None) -> Floats:
    """The measurement's own, (M, C), where it has one; that of what was fitted, relative to the model, elsewhere."""
    used = fit.problem.data.used()
    if used.sigma is None or not fit.problem.noise.use_sigma:
        return np.zeros(values.shape[1:])
    if sigma is not None:
        return sigma
    relative = np.median(used.sigma / np.maximum(np.abs(fit.predicted), np.finfo(float).tiny), axis=0)
    return relative * np.median(np.abs(values), axis=0)


def _readings(
    fit: Fit, vectors: Floats, values: Floats, data: Measurements, sigma: Floats
) -> tuple[Floats, Floats, Floats | None]:
    """Means, scales and softness of readings (see `Prediction`), where the model has these values, (D, M, C)."""
    relative, floor = (np.asarray(part, float)[:, None, None] for part in fit.problem.call(_levels, vectors))
    if fit.problem.model.process is None:
        return values, np.sqrt(sigma**2 + (relative * values) ** 2 + floor**2), None
    lack, unknown = (np.asarray(part) for part in fit.problem.call(_lack_at, vectors, places(data.wi, data.wo)))
    softness = soft(np.median(values, axis=0), np.hypot(sigma, np.median(floor)))
    means = np.asarray(logarithm(values, softness)) + lack
    corrected = softness * np.sinh(means)
    noise = np.sqrt(sigma**2 + (relative * corrected) ** 2 + floor**2) / np.asarray(size(corrected, softness))
    return means, np.hypot(unknown, noise), softness


def _levels(model: Model, vectors: Array) -> tuple[Array, Array]:
    def one(vector: Array) -> tuple[Array, Array]:
        parts = model.build(vector)
        return parts.relative, parts.floor

    return jax.vmap(one)(vectors)


def _lack_at(model: Model, vectors: Array, where: Array) -> tuple[Array, Array]:
    return jax.lax.map(lambda vector: model.lack_at(vector, where), vectors)
