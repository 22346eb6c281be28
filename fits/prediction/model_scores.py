"""Which of several stacks foretells what it has not seen, with what weights they foretell it best together, and how
probable each is."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_softmax, logsumexp, softmax

from fits.optimise.result import Fit
from fits.prediction.cross_validation import Done, LeftOut, leave_out, require_groups
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
class Foresight:
    """What one of several stacks is worth to who wants to know what was not measured.

    score: sum of log-densities of readings, each foretold by a fit without its incidence. behind: how far that falls
    behind the best, and its standard error by the incidences. least_behind: the same a reading, of the incidence where
    that is least. weight: of its predictions in the mixture that foretells best (stacking, Yao, Vehtari, Simpson &
    Gelman 2018, Bayesian Anal. 13, 917). evidence: see `evidence`. probability: of this stack among those that are
    compared, all as probable beforehand.
    """

    score: float
    behind: float
    behind_error: float
    least_behind: float
    weight: float
    evidence: Evidence
    probability: float

    @property
    def surely_behind(self) -> float:
        """How far the score falls behind the best beyond chance; below 0 the data do not tell the two apart."""
        return self.behind if self.least_behind > EVERYWHERE else self.behind - BY_CHANCE * self.behind_error


def foresights(candidates: Mapping[str, Fit], progress: Progress | None = None) -> dict[str, Foresight]:
    """Of fits of the same data, by name; each is fitted again without each incidence (see `leave_out`)."""
    seen = {name: look_closely(fit, named(name, progress or silent)) for name, fit in candidates.items()}
    return together(
        {name: left for name, (left, _) in seen.items()}, {name: found for name, (_, found) in seen.items()}
    )


def look_closely(fit: Fit, progress: Progress | None = None, done: Done | None = None) -> tuple[LeftOut, Evidence]:
    """What a fit foretells of each incidence without it, and its evidence: by draws of its posterior both.

    done: see `leave_out`.
    """
    require_groups(fit)
    known = posterior_draws(fit)
    return leave_out(fit, progress=progress, known=known, done=done), evidence_of(known)


def together(left: Mapping[str, LeftOut], evidences: Mapping[str, Evidence]) -> dict[str, Foresight]:
    """What was left out of fits of the same data, and their evidence, side by side."""
    names = list(left)
    scores = np.array([left[name].score for name in names])
    best = left[names[int(np.argmax(scores))]]
    weights = stacking(np.stack([left[name].log_density.ravel() for name in names]))
    probabilities = softmax(np.array([evidences[name].log for name in names]))
    found = {}
    for index, name in enumerate(names):
        gaps = best.by_group - left[name].by_group
        found[name] = Foresight(
            score=float(scores[index]),
            behind=float(gaps.sum()),
            behind_error=float(np.sqrt(gaps.size) * gaps.std(ddof=1)),
            least_behind=float(np.min(gaps / best.sizes)),
            weight=float(weights[index]),
            evidence=evidences[name],
            probability=float(probabilities[index]),
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
