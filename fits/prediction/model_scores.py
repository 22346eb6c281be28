"""Which of several stacks predicts held-out data best: elpd differences, stacking weights, model probabilities."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_softmax, logsumexp, softmax

from fits.optimise.result import Fit
from fits.prediction.cross_validation import CrossValidation, Done, cross_validate, require_groups
from fits.prediction.evidence import Evidence, evidence_of, posterior_draws
from fits.progress import Progress, named, silent

WIDEST = 30.0
"""Of the logarithms of ratios of weights."""

BY_CHANCE = 2.0
"""Standard errors by which a stack may be ahead of one that is as good."""

EVERYWHERE = 1.0
"""A stack that falls behind by more than this a reading, in every group of readings, does so not by chance: few groups
say little of the error of their sum where one of them differs much more than another."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ModelScore:
    """How well one of several stacks predicts held-out data, and how probable it is.

    elpd: sum of log-densities of measurements, each predicted by a fit without its incidence. elpd_diff: how far it is
    below the best; dse: standard error of the difference, by the incidences. least_diff: the difference a measurement,
    of the incidence where that is least. weight: of stacking (Yao, Vehtari, Simpson & Gelman 2018, Bayesian Anal. 13,
    917). evidence: see `evidence`. model_probability: of this stack among those compared, equally probable a priori.
    """

    elpd: float
    elpd_diff: float
    dse: float
    least_diff: float
    weight: float
    evidence: Evidence
    model_probability: float

    @property
    def clear_diff(self) -> float:
        """The difference less what may be chance; below 0 the two are statistically indistinguishable."""
        return self.elpd_diff if self.least_diff > EVERYWHERE else self.elpd_diff - BY_CHANCE * self.dse


def model_scores(candidates: Mapping[str, Fit], progress: Progress | None = None) -> dict[str, ModelScore]:
    """Of fits of the same data, by name; each is fitted again without each incidence (see `cross_validate`)."""
    seen = {name: out_of_sample(fit, named(name, progress or silent)) for name, fit in candidates.items()}
    return rank_models(
        {name: left for name, (left, _) in seen.items()}, {name: found for name, (_, found) in seen.items()}
    )


def out_of_sample(
    fit: Fit, progress: Progress | None = None, done: Done | None = None
) -> tuple[CrossValidation, Evidence]:
    """What a fit foretells of each incidence without it, and its evidence: by draws of its posterior both.

    done: see `cross_validate`.
    """
    require_groups(fit)
    known = posterior_draws(fit)
    return cross_validate(fit, progress=progress, known=known, done=done), evidence_of(known)


def rank_models(left: Mapping[str, CrossValidation], evidences: Mapping[str, Evidence]) -> dict[str, ModelScore]:
    """What was left out of fits of the same data, and their evidence, side by side."""
    names = list(left)
    scores = np.array([left[name].elpd for name in names])
    best = left[names[int(np.argmax(scores))]]
    weights = stacking(np.stack([left[name].log_density.ravel() for name in names]))
    probabilities = softmax(np.array([evidences[name].log_evidence for name in names]))
    found = {}
    for index, name in enumerate(names):
        gaps = best.by_group - left[name].by_group
        found[name] = ModelScore(
            elpd=float(scores[index]),
            elpd_diff=float(gaps.sum()),
            dse=float(np.sqrt(gaps.size) * gaps.std(ddof=1)),
            least_diff=float(np.min(gaps / best.sizes)),
            weight=float(weights[index]),
            evidence=evidences[name],
            model_probability=float(probabilities[index]),
        )
    return found


def stacking(log_density: Floats) -> Floats:
    """Weights (K,) of K predictions whose mixture has the highest log-density over N readings; log_density: (K, N)."""
    count = len(log_density)
    if count == 1:
        return np.ones(1)

    def cost(free: Floats) -> float:
        logs = log_softmax(np.append(free, 0.0))
        return -float(np.mean(logsumexp(log_density + logs[:, None], axis=0)))

    def slope(free: Floats) -> Floats:
        weights = softmax(np.append(free, 0.0))
        share = softmax(log_density + np.log(weights)[:, None], axis=0).mean(axis=1)
        return (weights - share)[:-1]

    found = minimize(
        cost,
        np.zeros(count - 1),
        jac=slope,
        method="L-BFGS-B",
        bounds=[(-WIDEST, WIDEST)] * (count - 1),
        options={"ftol": 1e-14, "gtol": 1e-9},
    )
    return softmax(np.append(found.x, 0.0))
