"""Model averaging: predictions of several stacks as one mixture, each with its weight."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fits.data.geometry import Geometry
from fits.data.measurements import Measurements
from fits.optimise.result import Fit
from fits.prediction.compare import fits_of
from fits.prediction.cross_validation import model_scores
from fits.prediction.options import ComparisonOptions
from fits.prediction.predict import DRAWS, Prediction, predict
from fits.progress import Progress
from fits.sampling.posterior import Posterior
from layerjax._checks import require_kind
from layerjax.compiling import programs_kept

LINEAR = 1e6  # softness that makes the logarithm linear, in units of the largest value: asinh(x / s) is x / s there


@dataclass(frozen=True, eq=False)
class Average:
    """Fits or posteriors of the same data, by name, and the weights of their predictions, which sum to 1."""

    candidates: Mapping[str, Fit | Posterior]
    weights: Mapping[str, float]

    def predict(self, at: Geometry | Measurements, *, draws: int = DRAWS, seed: int = 0) -> Prediction:
        """See `fits.predict`; the draws are divided between the candidates in proportion to the weights."""
        # differences of rounded cumulative weights, which sum to all draws however many candidates there are
        counts = np.diff(np.round(draws * np.cumsum([0.0, *self.weights.values()])))
        parts = [
            predict(self.candidates[name], at, draws=max(int(count), 2), seed=seed + number)
            for number, (name, count) in enumerate(zip(self.weights, counts, strict=True))
            if count > 0
        ]
        if len({part.degrees_of_freedom for part in parts}) > 1:
            raise ValueError("average: the fits differ in the tails of their noise")
        means, scales, softness, sds = (np.concatenate(same) for same in zip(*map(_logarithmic, parts), strict=True))
        return replace(
            parts[0],
            values=np.concatenate([part.values for part in parts]),
            means=means,
            scales=scales,
            softness=softness,
            discrepancy_sd=None if all(part.discrepancy_sd is None for part in parts) else sds,
            seed=seed,
            pareto_k=float(np.fmax.reduce([part.pareto_k for part in parts])),
            effective_draws=sum(part.effective_draws for part in parts),
        )


@programs_kept()
def average(
    candidates: Mapping[str, Fit | Posterior],
    weights: Mapping[str, float] | None = None,
    *,
    options: ComparisonOptions | None = None,
    progress: Progress | None = None,
) -> Average:
    """Average over fits of the same data: predictions of the result are a mixture of theirs, see `fits.predict`.

    Args:
        candidates: fits or posteriors, by name.
        weights: by the same names, none below 0: stacking weights (`ModelScore.weight`) predict best, model
            probabilities (`ModelScore.model_probability`) are Bayesian model averaging. None: stacking weights, for
            which each is fitted again without each incidence (see `cross_validate`).
        options: of that cross-validation.
        progress: progress of these fits, see `cross_validate`.

    Raises:
        ValueError: no candidate; weights that are missing, negative or all 0; or as `cross_validate`.
    """
    fits = fits_of(candidates)
    require_kind("weights", weights, Mapping, None)
    require_kind("options", options, ComparisonOptions, None)
    if not candidates:
        raise ValueError("average: there is no fit to average")
    if weights is None:
        weights = {name: score.weight for name, score in model_scores(fits, progress, options).items()}
    total = float(sum(weights.get(name, np.nan) for name in candidates))
    if set(weights) != set(candidates) or min(weights.values()) < 0.0 or not total > 0.0:
        words = f"it must give each of {', '.join(candidates)} a number of at least 0"
        raise ValueError(f"weights is {dict(weights)}; {words}")
    return Average(dict(candidates), {name: weights[name] / total for name in candidates})


def _logarithmic(part: Prediction) -> tuple[np.ndarray, ...]:
    """Means, scales, softness and standard deviations of the discrepancy, (D, M, C) each, of the `logarithm`."""
    sd = np.zeros_like(part.means) if part.discrepancy_sd is None else part.discrepancy_sd
    if part.softness is not None:
        return part.means, part.scales, np.broadcast_to(part.softness, part.means.shape), sd
    softness = np.full(part.means.shape, LINEAR * float(np.max(np.abs(part.means)) or 1.0))
    return part.means / softness, part.scales / softness, softness, sd
