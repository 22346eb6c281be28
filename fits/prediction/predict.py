"""Prediction: the BSDF of a fit and a new measurement of it, along other directions, with intervals and scores.

For each of D draws of the posterior the stack has a value along every direction, the model discrepancy a mean and a
standard deviation conditional on the fitted data, and a measurement independent noise. The posterior predictive is the
mixture of these D distributions: Gaussian, or Student's t, of the BSDF or of its `logarithm`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy import stats
from scipy.special import logsumexp

from fits.data.geometry import Floats, Geometry
from fits.data.measurements import TO_HAVE_THEM, Measurements
from fits.data.totals import Totals
from fits.optimise.result import Fit
from fits.problem.discrepancy import logarithm, places, size
from fits.problem.discrepancy import softness as softness_of
from fits.problem.instrument import gain_unknown
from fits.problem.model import Model
from fits.problem.problem import polar_angles
from fits.problem.simulate import require_visible
from fits.sampling.importance import ImportanceDraws, importance_draws
from fits.sampling.initial import normal_draws
from fits.sampling.mixture import Mixture
from fits.sampling.options import MAX_PARETO_K
from fits.sampling.posterior import Posterior
from layerjax._checks import abbreviate, require_count, require_kind, require_number, require_seed
from layerjax.compiling import program_cache

# quantiles of a `Summary`: the ends of the central 50 % and 95 % intervals, and the median
LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)
COVERAGES = (0.5, 0.95)  # central intervals whose coverage is scored
DRAWS = 256  # draws of the posterior that a prediction is made with
MIN_PROPOSALS = 400  # the fewest weighted draws that those of a fit's posterior are resampled from
DRAWS_PER_VECTOR = 8  # values that are drawn of the distribution of each draw of the posterior, for means and quantiles
BISECTIONS = 50  # halvings of the interval that a quantile of the mixture lies in
SMALLEST_SD = 1e-12  # of the discrepancy, where the data determine it: its distribution keeps a density


@dataclass(frozen=True, eq=False)
class Summary:
    """Mean and standard deviation of M values in C channels, (M, C), and quantiles at `LEVELS`, (5, M, C), in 1/sr."""

    mean: Floats
    sd: Floats
    quantiles: Floats


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted BSDF at M pairs of directions in C channels.

    Attributes:
        wi: directions of the light, (M, 3).
        wo: directions of the viewer, (M, 3).
        channels: C names.
        values: the value of the stack for each of D draws of the posterior, (D, M, C), in 1/sr.
        means: location of a measurement for each draw, (D, M, C), in 1/sr; with a discrepancy, of its `logarithm`.
        scales: its scale.
        softness: of that logarithm, (M, C) or (D, M, C), in 1/sr; None where values themselves are meant.
        discrepancy_sd: standard deviation of the discrepancy about `means`, (D, M, C), of the logarithm; None without.
        degrees_of_freedom: of Student's t; infinite for a Gaussian.
        seed: random seed of the draws that `bsdf` and `predictive` summarise.
        pareto_k: Pareto k of the importance weights that the draws of a fit's posterior are resampled by (see
            `fits.evidence`); NaN for draws of a chain.
        effective_draws: effective sample size of the D draws of the posterior.
        measurements: the measurements that were predicted; None for a `Geometry`.
    """

    wi: Floats
    wo: Floats
    channels: tuple[str, ...]
    values: Floats
    means: Floats
    scales: Floats
    softness: Floats | None
    discrepancy_sd: Floats | None
    degrees_of_freedom: float
    seed: int = 0
    pareto_k: float = math.nan
    effective_draws: float = math.nan
    measurements: Measurements | None = None

    @property
    def mean(self) -> Floats:
        """Mean of the BSDF, (M, C), in 1/sr."""
        return self.bsdf.mean

    @property
    def sd(self) -> Floats:
        """Standard deviation of the BSDF, (M, C), in 1/sr."""
        return self.bsdf.sd

    @cached_property
    def latent(self) -> Summary:
        """Summary of the stack without model discrepancy."""
        return self._summary(self.values)

    @property
    def bsdf(self) -> Summary:
        """Summary of the BSDF, which is the stack with its model discrepancy (the best estimate)."""
        return self._summaries[0]

    @property
    def predictive(self) -> Summary:
        """Summary of a new measurement, the BSDF with noise (posterior predictive)."""
        return self._summaries[1]

    @cached_property
    def _summaries(self) -> tuple[Summary, Summary]:
        generator, shape = np.random.default_rng(self.seed), (DRAWS_PER_VECTOR, *self.means.shape)
        gaussian = math.isinf(self.degrees_of_freedom)
        noise = generator.standard_normal(shape) if gaussian else generator.standard_t(self.degrees_of_freedom, shape)
        predictive = self._summary(self._inverse(self.means + self.scales * noise))
        if self.discrepancy_sd is None:
            return self.latent, predictive
        bsdf = self.means + self.discrepancy_sd * generator.standard_normal(shape)
        return self._summary(self._inverse(bsdf)), predictive

    def _summary(self, values: Floats) -> Summary:
        values = values.reshape(-1, *values.shape[-2:])
        return Summary(values.mean(axis=0), values.std(axis=0), np.quantile(values, LEVELS, axis=0))

    def quantile(self, level: float) -> Floats:
        """Quantile of the BSDF, (M, C), in 1/sr; level in (0, 1)."""
        require_number("level", level, 0.0, 1.0, open_ends=True)
        if self.discrepancy_sd is None:
            return np.quantile(self.values, level, axis=0)
        return self._mixture_quantile(level, np.maximum(self.discrepancy_sd, SMALLEST_SD), stats.norm())

    def predictive_quantile(self, level: float) -> Floats:
        """Quantile of a new measurement, (M, C), in 1/sr; level in (0, 1)."""
        require_number("level", level, 0.0, 1.0, open_ends=True)
        return self._mixture_quantile(level, self.scales, self._noise)

    def _mixture_quantile(self, level: float, scales: Floats, distribution: "stats.rv_frozen") -> Floats:
        quantiles = self._inverse(self.means + scales * distribution.ppf(level))
        low, high = quantiles.min(axis=0), quantiles.max(axis=0)  # a mixture's lies between those of its components
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            is_low = distribution.cdf(self._standardised(middle, scales)).mean(axis=0) < level
            low, high = np.where(is_low, middle, low), np.where(is_low, high, middle)
        return 0.5 * (low + high)

    @property
    def scores(self) -> "Scores":
        """Scores of the predicted measurements. ValueError if a `Geometry` was predicted."""
        if self.measurements is None:
            raise ValueError("scores: a Geometry was predicted; predict Measurements to score them")
        return scores(self, self.measurements)

    def _select(self, rows: NDArray[np.bool_]) -> "Prediction":
        """The prediction at some of its pairs of directions, (M,)."""
        names = ("values", "means", "scales", "softness", "discrepancy_sd")
        by_pair = {name: one[..., rows, :] for name in names if (one := getattr(self, name)) is not None}
        return replace(self, wi=self.wi[rows], wo=self.wo[rows], measurements=None, **by_pair)

    @property
    def reliable(self) -> bool:
        """Whether the draws represent the whole posterior; otherwise sample it by a chain."""
        return not self.pareto_k >= MAX_PARETO_K

    def log_density(self, values: Floats) -> Floats:
        """Log predictive density of each of the measured `values`, (M, C)."""
        return logsumexp(self.log_densities(values), axis=0) - math.log(len(self.means))

    def log_densities(self, values: Floats) -> Floats:
        """Log-density of each of the measured `values` for each draw of the posterior, (D, M, C)."""
        density = self._noise.logpdf(self._standardised(values, self.scales)) - np.log(self.scales)
        return density if self.softness is None else density - np.log(np.asarray(size(values, self.softness)))

    def cdf(self, values: Floats) -> Floats:
        """Predictive probability of a measurement below each of `values`, (M, C)."""
        return self._noise.cdf(self._standardised(values, self.scales)).mean(axis=0)

    @property
    def median(self) -> Floats:
        """Median prediction of a measurement over the draws, (M, C), in 1/sr."""
        return np.median(self._inverse(self.means), axis=0)

    def _standardised(self, values: Floats, scales: Floats) -> Floats:
        transformed = values if self.softness is None else np.asarray(logarithm(values, self.softness))
        return (transformed - self.means) / scales

    def _inverse(self, transformed: Floats) -> Floats:
        return transformed if self.softness is None else self.softness * np.sinh(transformed)

    @property
    def _noise(self) -> "stats.rv_frozen":
        return stats.norm() if math.isinf(self.degrees_of_freedom) else stats.t(self.degrees_of_freedom)


@dataclass(frozen=True)
class Scores:
    """Scores of predicted measurements.

    Attributes:
        count: measurements times channels.
        median_error: median of |prediction / measurement - 1|, for the median prediction.
        p95_error: its 95th percentile.
        model_error: its median for the stack without model discrepancy.
        coverage: share of measurements in the central 50 % and 95 % intervals.
        elpd: mean log predictive density of a measurement.
    """

    count: int
    median_error: float
    p95_error: float
    model_error: float
    coverage: Mapping[float, float]
    elpd: float


def scores(prediction: Prediction, measurements: Measurements, rows: NDArray[np.bool_] | None = None) -> Scores:
    """Score the used measurements, at the predicted directions; only those in `rows`, (M,), if given.

    Raises:
        ValueError: no measurement to score, or other directions than those that were predicted.
    """
    require_kind("prediction", prediction, Prediction)
    require_kind("measurements", measurements, Measurements, fix=TO_HAVE_THEM)
    used = measurements.used()
    if len(used) != len(prediction.wi) or not np.allclose([used.wi, used.wo], [prediction.wi, prediction.wo]):
        raise ValueError("scores: the measurements have other directions than the prediction")
    chosen = np.ones(len(used), bool) if rows is None else rows
    if not chosen.any():
        raise ValueError("scores: there is no measurement to score")
    values, prediction = used.values[chosen], prediction._select(chosen)
    rank, magnitude = prediction.cdf(values), np.maximum(np.abs(values), np.finfo(float).tiny)
    predicted = (prediction.median, prediction.latent.mean)
    error, model_error = (np.abs(one - values) / magnitude for one in predicted)
    return Scores(
        count=values.size,
        median_error=float(np.median(error)),
        p95_error=float(np.quantile(error, 0.95)),
        model_error=float(np.median(model_error)),
        coverage={level: float(np.mean(np.abs(2.0 * rank - 1.0) < level)) for level in COVERAGES},
        elpd=float(np.mean(prediction.log_density(values))),
    )


class Predictor(Protocol):
    """Several fits that predict as one: see `fits.average`."""

    def predict(self, at: Geometry | Measurements, *, draws: int, seed: int) -> Prediction: ...


@program_cache()
def predict(
    fitted: Fit | Posterior | Predictor, at: Geometry | Measurements, *, draws: int = DRAWS, seed: int = 0
) -> Prediction:
    """Predict the BSDF along other directions, and new measurements of it.

    Args:
        fitted: a posterior or an average; or a fit, whose posterior is sampled by importance (see `fits.evidence`), of
            a part of a joint fit by its normal approximation.
        at: pairs of directions, all in the upper hemisphere if the stack has a base; of `Measurements` their used
            samples, with their own sigma.
        draws: draws of the posterior, at least 2.
        seed: random seed of draws and noise.

    Measurements whose sigma is not known have the median sigma of the fitted ones, relative to the model.

    Raises:
        ValueError: a number of draws out of range, a fit of a named objective, measurements in other channels,
            directions below an opaque stack, or directions that the transport does not support.
    """
    require_count("draws", draws, 2)
    require_seed(seed)
    require_kind("at", at, Geometry, Measurements, fix=TO_HAVE_THEM)
    if not isinstance(fitted, Fit | Posterior):
        if isinstance(fitted, type) or not hasattr(fitted, "predict"):
            raise ValueError(f"fitted: {abbreviate(fitted)} is not a Fit, a Posterior or an Average")
        return fitted.predict(at, draws=draws, seed=seed)
    return posterior_predictive(fitted, at, draws=draws, seed=seed)


def posterior_predictive(
    fitted: Fit | Posterior, at: Geometry | Measurements, *, draws: int, seed: int, pool: ImportanceDraws | None = None
) -> Prediction:
    """`predict` for one fit; pool: weighted draws of its posterior, if there are some."""
    fit = fitted.fit if isinstance(fitted, Posterior) else fitted
    fit.require_one("predict")
    if not fit.is_posterior:
        raise ValueError(f"predict: a fit of {fit.problem.objective!r} has no noise model and predicts no measurements")
    problem, channels, noise = fit.problem, fit.problem.data.channels, fit.problem.noise
    if isinstance(problem.data, Totals) or isinstance(at, Totals):
        raise ValueError("predict: Totals are not predicted; it takes a fit of BSDF values, and directions")
    if isinstance(at, Measurements):
        data = at.used()
        if len(at.channels) != len(channels):
            own, theirs = ", ".join(channels), ", ".join(at.channels)
            raise ValueError(f"predict: the measurements have the channels {theirs}, the fit {own}")
    else:
        require_visible("predict", problem.stack, light=at.wi, viewer=at.wo)
        values = np.zeros((len(at), len(channels)))  # of what refuses bad directions
        data = Measurements(at.wi, at.wo, values, None, np.ones(len(at), bool), channels)

    # draws of the posterior, (D, P), the Pareto k of their weights, and their effective sample size
    generator, pareto_k, effective = np.random.default_rng(seed), math.nan, float(draws)
    if isinstance(fitted, Posterior):
        vectors = generator.choice(fitted.samples, draws, axis=0, replace=len(fitted.samples) < draws)
        effective = _resampled_size(draws, float(np.min(fitted.effective_samples)))
    else:
        random = np.random.RandomState(generator.integers(2**31))
        if fit.dataset is not None:  # the other data sets of a joint fit constrain it as well: in its covariance
            positions = normal_draws(fit, draws, random)
        else:
            pool = pool or draws_to_resample(fit, draws, random)
            positions, pareto_k = pool.resample(random, draws), pool.pareto_k
            effective = _resampled_size(draws, pool.effective_sample_size)
        vectors = np.asarray(jax.vmap(problem.model.box.constrain)(jnp.asarray(positions)), float)

    # what the stack has there, the discrepancy, and noise
    values = np.asarray(problem.predict_at(vectors, data.wi, data.wo), float)
    means = values = np.broadcast_to(values, (*values.shape[:2], len(channels)))
    softness, discrepancy_sd, sigma = None, None, _stated_sigma(fit, values, data.sigma)
    relative, floor = (np.asarray(part, float)[:, None, None] for part in problem.call(_noise_levels, vectors))
    relative = np.hypot(relative, gain_unknown(problem.instrument, data.wi, polar_angles(problem.data)))
    if problem.model.process is None:
        scales = np.sqrt(sigma**2 + (relative * values) ** 2 + floor**2)
    else:
        conditional = problem.call(_discrepancy_at, vectors, places(data.wi, data.wo))
        discrepancy, discrepancy_sd = (np.asarray(part) for part in conditional)
        softness = _softness(fit, np.hypot(sigma, np.median(floor)))
        means = np.asarray(logarithm(values, softness)) + discrepancy
        bsdf = softness * np.sinh(means)
        spread = np.sqrt(sigma**2 + (relative * bsdf) ** 2 + floor**2) / np.asarray(size(bsdf, softness))
        scales = np.hypot(discrepancy_sd, spread)
    return Prediction(
        wi=data.wi,
        wo=data.wo,
        channels=channels,
        values=values,
        means=means,
        scales=scales,
        softness=softness,
        discrepancy_sd=discrepancy_sd,
        degrees_of_freedom=noise.degrees_of_freedom if noise.tails == "student" else math.inf,
        seed=seed,
        pareto_k=pareto_k,
        effective_draws=effective,
        measurements=data if isinstance(at, Measurements) else None,
    )


def draws_to_resample(
    fit: Fit, draws: int, random: np.random.RandomState, initial: Mixture | None = None
) -> ImportanceDraws:
    """Weighted draws of a posterior, enough to take so many of; initial: see `importance_draws`."""
    return importance_draws(fit, max(MIN_PROPOSALS, 2 * draws), random, max_pareto_k=MAX_PARETO_K, initial=initial)


def _resampled_size(draws: int, pool: float) -> float:
    """Effective sample size of so many draws that are taken of a pool of this one."""
    return 1.0 / (1.0 / draws + 1.0 / max(pool, 1.0))


def with_discrepancy(fit: Fit, wi: Floats, wo: Floats, values: Floats) -> Floats:
    """The BSDF of the best fit along other directions, (M, 3) each, given the stack's values there, (M, C)."""
    if fit.problem.model.process is None:
        return values
    _, floor = (np.asarray(part, float) for part in fit.problem.call(_noise_levels, fit.vector[None]))
    softness = _softness(fit, np.hypot(_stated_sigma(fit, values[None], None), floor))
    discrepancy = np.asarray(fit.problem.call(Model.discrepancy_at, fit.vector, fit.predicted, places(wi, wo))[0])
    return softness * np.sinh(np.asarray(logarithm(values, softness)) + discrepancy)


def _softness(fit: Fit, additive: Floats) -> Floats:
    typical = np.full(additive.shape, np.median(np.abs(fit.problem.data.used().values)))
    return softness_of(typical, additive)


def _stated_sigma(fit: Fit, values: Floats, sigma: Floats | None) -> Floats:
    """The measurements' stated sigma, (M, C), if there is one; else that of the fitted data, relative to the model."""
    used = fit.problem.data.used()
    if used.sigma is None or not fit.problem.noise.use_sigma:
        return np.zeros(values.shape[1:])
    if sigma is not None:
        return sigma
    relative = np.median(used.sigma / np.maximum(np.abs(fit.predicted), np.finfo(float).tiny), axis=0)
    return relative * np.median(np.abs(values), axis=0)


def _noise_levels(model: Model, vectors: Array) -> tuple[Array, Array]:
    def one(vector: Array) -> tuple[Array, Array]:
        parts = model.build(vector)
        return parts.relative, parts.floor

    return jax.vmap(one)(vectors)


def _discrepancy_at(model: Model, vectors: Array, where: Array) -> tuple[Array, Array]:
    return jax.lax.map(lambda vector: model.discrepancy_at(vector, model.predict(vector), where), vectors)
