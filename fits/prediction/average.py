"""Predictions of several stacks as one, each with its weight."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fits.data.geometry import Geometry
from fits.data.measurements import Measurements
from fits.optimise.result import Fit
from fits.prediction.model_scores import model_scores
from fits.prediction.predict import DRAWS, LEVELS, predict
from fits.prediction.prediction import Prediction, banded
from fits.progress import Progress
from fits.sampling.posterior import Posterior, require_fits

STRAIGHT = 1e6
"""Softness of a prediction that is none of logarithms, in units of the largest value: asinh(x / s) is x / s there."""


@dataclass(frozen=True, eq=False)
class Average:
    """Fits or posteriors of the same data, by name, and the weights of their predictions, which sum to 1."""

    candidates: Mapping[str, Fit | Posterior]
    weights: Mapping[str, float]

    def predict(
        self,
        at: Geometry | Measurements,
        *,
        levels: tuple[float, ...] = LEVELS,
        draws: int = DRAWS,
        seed: int = 0,
    ) -> Prediction:
        """See `fits.predict`; draws: of all of them together, in proportion to the weights."""
        # by rounded ends of their shares, which are all of the draws however many share them
        counts = np.diff(np.round(draws * np.cumsum([0.0, *self.weights.values()])))
        parts = [
            predict(self.candidates[name], at, levels=levels, draws=max(int(count), 2), seed=seed + number)
            for number, (name, count) in enumerate(zip(self.weights, counts, strict=True))
            if count > 0
        ]
        first = parts[0]
        if any(part.degrees_of_freedom != first.degrees_of_freedom for part in parts):
            raise ValueError("average: the fits differ in the tails of their noise")
        means, scales, softness = (np.concatenate(same) for same in zip(*map(_logarithmic, parts), strict=True))
        values = np.concatenate([part.values for part in parts])
        freedom = first.degrees_of_freedom
        given = [np.zeros_like(part.means) if part.unknown is None else part.unknown for part in parts]
        unknown = None if all(part.unknown is None for part in parts) else np.concatenate(given)
        found = banded(
            first.wi, first.wo, first.channels, levels, values, means, scales, softness, unknown, freedom, seed
        )
        pareto_k = float(np.fmax.reduce([part.pareto_k for part in parts]))
        return replace(found, pareto_k=pareto_k, readings=first.readings)


def average(
    candidates: Mapping[str, Fit | Posterior],
    weights: Mapping[str, float] | None = None,
    *,
    progress: Progress | None = None,
) -> Average:
    """Fits of the same data as one, whose predictions are a mixture of theirs: see `fits.predict`.

    Args:
        candidates: fits or posteriors, by name.
        weights: by the same names, none below 0: those of stacking (`ModelScore.weight`) foretell best, probabilities
            of the stacks (`ModelScore.model_probability`) average over them as Bayes does. None: those of stacking, for
            which each is fitted again without each incidence (see `cross_validate`).
        progress: of these fits, see `cross_validate`.

    Raises:
        ValueError: no candidate; weights that are missing, negative or all 0; or as `cross_validate`.
    """
    require_fits(candidates)
    if not candidates:
        raise ValueError("average: there is no fit to average")
    if weights is None:
        plain = {name: one.fit if isinstance(one, Posterior) else one for name, one in candidates.items()}
        weights = {name: seen.weight for name, seen in model_scores(plain, progress).items()}
    total = float(sum(weights.get(name, np.nan) for name in candidates))
    if set(weights) != set(candidates) or min(weights.values()) < 0.0 or not total > 0.0:
        raise ValueError(
            f"weights is {dict(weights)}; it must give each of {', '.join(candidates)} a number of at least 0"
        )
    return Average(dict(candidates), {name: weights[name] / total for name in candidates})


def _logarithmic(part: Prediction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, scales and softness, (D, M, C) each, of the readings' `logarithm`."""
    if part.softness is not None:
        return part.means, part.scales, np.broadcast_to(part.softness, part.means.shape)
    softness = np.full(part.means.shape, STRAIGHT * float(np.max(np.abs(part.means)) or 1.0))
    return part.means / softness, part.scales / softness, softness
