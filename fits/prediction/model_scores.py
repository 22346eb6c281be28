"""Which of several stacks predicts held-out data best: elpd differences, stacking weights, model probabilities."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_softmax, logsumexp, softmax

from fits.optimise.result import Fit
from fits.prediction.cross_validation import CrossValidation, HeldOut, cross_validate, require_groups
from fits.prediction.evidence import Evidence, evidence_of, posterior_draws
from fits.prediction.options import ComparisonOptions
from fits.progress import Progress, named, silent

LARGEST_LOG_RATIO = 30.0
"""Bound of the logarithms of ratios of stacking weights."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ModelScore:
    """How well one of several stacks predicts held-out data, and how probable it is.

    elpd: sum of log predictive densities of measurements, each by a fit without its incidence. elpd_diff: how far it is
    below the best; dse: standard error of the difference, by the incidences. least_diff: the difference a measurement,
    of the incidence where that is least. clear_diff: the difference less its error (see `ComparisonOptions`). weight:
    of stacking (Yao, Vehtari, Simpson & Gelman 2018, Bayesian Anal. 13, 917). evidence: see `evidence`.
    model_probability: of this stack among those compared, equally probable a priori.
    """

    elpd: float
    elpd_diff: float
    dse: float
    least_diff: float
    clear_diff: float
    weight: float
    evidence: Evidence
    model_probability: float

    @property
    def indistinguishable(self) -> bool:
        """Whether this stack and the best are statistically indistinguishable."""
        return self.clear_diff <= 0.0


def model_scores(
    candidates: Mapping[str, Fit], progress: Progress | None = None, options: ComparisonOptions | None = None
) -> dict[str, ModelScore]:
    """Score fits of the same data, by name; each is fitted again without each incidence (see `cross_validate`)."""
    results = {
        name: out_of_sample(fit, named(name, progress or silent), options=options) for name, fit in candidates.items()
    }
    return rank_models(
        {name: held_out for name, (held_out, _) in results.items()},
        {name: evidence for name, (_, evidence) in results.items()},
        options,
    )


def out_of_sample(
    fit: Fit,
    progress: Progress | None = None,
    done: HeldOut | None = None,
    options: ComparisonOptions | None = None,
) -> tuple[CrossValidation, Evidence]:
    """Cross-validation and evidence of a fit, both by draws of its posterior; done: see `cross_validate`."""
    require_groups(fit, options)
    draws = posterior_draws(fit)
    return cross_validate(fit, options=options, progress=progress, posterior=draws, done=done), evidence_of(draws)


def rank_models(
    held_out: Mapping[str, CrossValidation],
    evidences: Mapping[str, Evidence],
    options: ComparisonOptions | None = None,
) -> dict[str, ModelScore]:
    """Score fits of the same data by their cross-validation and evidence, side by side."""
    options = options or ComparisonOptions()
    best = max(held_out.values(), key=lambda one: one.elpd)
    weights = stacking(np.stack([one.log_density.ravel() for one in held_out.values()]))
    probabilities = softmax(np.array([evidences[name].log_evidence for name in held_out]))
    scores = {}
    for (name, one), weight, probability in zip(held_out.items(), weights, probabilities, strict=True):
        gaps = best.elpd_by_group - one.elpd_by_group
        elpd_diff, dse = float(gaps.sum()), float(np.sqrt(gaps.size) * gaps.std(ddof=1))
        least_diff = float(np.min(gaps / best.group_sizes))
        decisive = least_diff > options.decisive_per_measurement
        scores[name] = ModelScore(
            elpd=one.elpd,
            elpd_diff=elpd_diff,
            dse=dse,
            least_diff=least_diff,
            clear_diff=elpd_diff if decisive else elpd_diff - options.standard_errors * dse,
            weight=float(weight),
            evidence=evidences[name],
            model_probability=float(probability),
        )
    return scores


def stacking(log_density: Floats) -> Floats:
    """Weights (K,) of K predictions whose mixture has the highest log-density over N measurements, from (K, N)."""
    count = len(log_density)
    if count == 1:
        return np.ones(1)

    def cost(free: Floats) -> float:
        logs = log_softmax(np.append(free, 0.0))
        return -float(np.mean(logsumexp(log_density + logs[:, None], axis=0)))

    def gradient(free: Floats) -> Floats:
        weights = softmax(np.append(free, 0.0))
        responsibility = softmax(log_density + np.log(weights)[:, None], axis=0).mean(axis=1)
        return (weights - responsibility)[:-1]

    optimum = minimize(
        cost,
        np.zeros(count - 1),
        jac=gradient,
        method="L-BFGS-B",
        bounds=[(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO)] * (count - 1),
        options={"ftol": 1e-14, "gtol": 1e-9},
    )
    return softmax(np.append(optimum.x, 0.0))
