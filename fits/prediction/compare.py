"""Fits of the same measurements side by side: which of them the data prefer, and their predictions averaged."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fits._files import require_switch
from fits._lazy import shown_by
from fits.data.geometry import Geometry
from fits.data.measurements import Measurements
from fits.optimise.result import Fit
from fits.prediction.cross_validation import ModelScore, model_scores
from fits.prediction.options import DEFAULT, ComparisonOptions
from fits.prediction.predict import DRAWS, Prediction, predict
from fits.progress import Progress
from fits.sampling.posterior import Posterior
from layerjax._checks import require_kind
from layerjax.compiling import program_cache

LINEAR = 1e6  # softness that makes the logarithm linear, in units of the largest value: asinh(x / s) is x / s there


@dataclass(frozen=True)
class ComparedFit:
    """One fit in a comparison; model_score: elpd of held-out incidences, stacking weight and evidence, with `refit`."""

    name: str
    fit: Fit
    model_score: ModelScore | None = None

    @property
    def aic(self) -> float:
        """Akaike's information criterion; NaN for a named objective."""
        return 2.0 * len(self.fit.vector) - 2.0 * self.fit.log_likelihood

    @property
    def bic(self) -> float:
        """The Bayesian information criterion; NaN for a named objective."""
        return len(self.fit.vector) * math.log(self.fit.problem.count) - 2.0 * self.fit.log_likelihood


@dataclass(frozen=True)
class Comparison:
    """Fits of the same data, side by side.

    Attributes:
        rows: best first.
        sorted_by: "elpd" (of held-out incidences), "aic" or "chi_square".
        verdict: a sentence on a line for each fit other than the best, whether the data prefer the best to it.
        notes: cautions for reading the rows.
        options: the thresholds of verdict and notes.
    """

    rows: tuple[ComparedFit, ...]
    sorted_by: str
    verdict: str
    notes: tuple[str, ...]
    options: ComparisonOptions

    def _repr_html_(self) -> str:
        return str(shown_by("fits.reports.html:comparison_fragment", self))


def fits_of(candidates: Mapping[str, Fit | Posterior]) -> dict[str, Fit]:
    """The fits among the candidates, and those of posteriors. ValueError for anything else."""
    require_kind("candidates", candidates, Mapping)
    for name, one in candidates.items():
        require_kind(f"candidates[{name!r}]", one, Fit, Posterior)
    return {name: one.fit if isinstance(one, Posterior) else one for name, one in candidates.items()}


@program_cache()
def compare(
    candidates: Mapping[str, Fit | Posterior],
    *,
    refit: bool = False,
    options: ComparisonOptions | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare fits of the same data under the same objective, by AIC or by cross-validation.

    Args:
        candidates: at least two fits, or posteriors of which the fits are compared, by name.
        refit: fit each again without each incidence, and rank by elpd; with stacking weights and evidence.
        options: the thresholds of verdict and notes.
        progress: called with (name and stage, done, total, note) meanwhile.

    Raises:
        ValueError: fewer than two candidates, different data or objectives, joint fits, or parts of one with `refit`.
    """
    fits = fits_of(candidates)
    require_kind("options", options, ComparisonOptions, None)
    require_switch("refit", refit)
    if len(candidates) < 2:
        raise ValueError(f"compare: {len(candidates)} candidate(s) given; at least 2 are needed")
    options = options or DEFAULT
    for fit in fits.values():
        fit.require_one("compare")
    first_name, first = next(iter(fits.items()))
    for name, fit in fits.items():
        pairs = [(getattr(first.problem.model, one), getattr(fit.problem.model, one)) for one in ("wi", "wo", "values")]
        if not all(a.shape == b.shape and np.allclose(a, b, rtol=1e-9, atol=1e-12) for a, b in pairs):
            raise ValueError(f"compare: {first_name!r} and {name!r} were fitted to different data")
        if fit.problem.objective != first.problem.objective:
            words = f"{first_name!r} minimised {first.problem.objective!r}, {name!r} {fit.problem.objective!r}"
            raise ValueError(f"compare: {words}; only fits of one objective can be compared")
    rows = [ComparedFit(name, fit) for name, fit in fits.items()]
    if refit:
        scores = model_scores(fits, progress, options)
        rows = [ComparedFit(name, fit, scores[name]) for name, fit in fits.items()]
        sorted_by, ranks = "elpd", {name: -score.elpd for name, score in scores.items()}
    elif rows[0].fit.is_posterior:
        sorted_by, ranks = "aic", {row.name: row.aic for row in rows}
    else:
        sorted_by, ranks = "chi_square", {row.name: row.fit.chi_square for row in rows}
    rows.sort(key=lambda row: ranks[row.name])
    verdict = "\n".join(_verdict(rows[0], row, sorted_by, options) for row in rows[1:])
    return Comparison(tuple(rows), sorted_by, verdict, tuple(_notes(rows, options)), options)


def _verdict(best: ComparedFit, other: ComparedFit, sorted_by: str, options: ComparisonOptions) -> str:
    """One sentence on whether the data prefer one fit to another.

    If the best fit misses the data by more than their noise, the noise is larger than stated: differences in
    log-likelihood are then divided by its reduced chi-square (Burnham & Anderson 2002, Sec. 2.5, QAIC).
    """
    if sorted_by == "chi_square":
        words = "without a likelihood the difference has no significance"
        return f"{best.name} has a lower chi-square than {other.name}; {words}."
    if (score := other.model_score) is not None:
        difference = 2.0 * score.clear_diff
        words = f"elpd difference {score.elpd_diff:.1f} ± {score.dse:.1f} by cross-validation"
    else:
        excess = max(1.0, best.fit.reduced_chi_square) if best.fit.degrees_of_freedom > 0 else 1.0
        gain = 2.0 * (best.fit.log_likelihood - other.fit.log_likelihood)
        correction = gain / excess - gain
        aic, bic = other.aic - best.aic + correction, other.bic - best.bic + correction
        difference = min(aic, bic)
        scaled = f" (noise scaled to the residuals of {best.name})" if excess > 1.0 else ""
        words = f"AIC difference {aic:.1f}, BIC difference {bic:.1f}{scaled}"
    if difference < options.slight_difference:
        return f"{best.name} and {other.name} are statistically indistinguishable: {words}."
    prefer = "prefer" if difference > options.clear_difference else "slightly prefer"
    return f"The data {prefer} {best.name} to {other.name}: {words}."


def _notes(rows: list[ComparedFit], options: ComparisonOptions) -> list[str]:
    notes = []
    for what in ("noise", "transport", "scale"):
        settings = {row.name: repr(getattr(row.fit.problem, what)) for row in rows}
        if len(set(settings.values())) == 1:
            continue
        with_it = [row.name for row in rows if row.fit.problem.noise.discrepancy]
        others = {repr(replace(row.fit.problem.noise, discrepancy=None)) for row in rows}
        if what == "noise" and len(others) == 1 and 0 < len(with_it) < len(rows):
            notes.append(f"a model discrepancy is included in {', '.join(with_it)} only")
        else:
            notes.append(f"the fits differ in {what}: " + "; ".join(f"{name}: {one}" for name, one in settings.items()))
    if failed := [row.name for row in rows if not row.fit.converged]:
        notes.append(f"not converged: {', '.join(failed)}")
    unsure = [row.name for row in rows if row.model_score and row.model_score.evidence.pareto_k >= options.max_pareto_k]
    if unsure:
        notes.append(f"the evidence is unreliable, its importance weights have a high Pareto k: {', '.join(unsure)}")
    if min(row.fit.reduced_chi_square for row in rows) > options.max_reduced_chi_square:
        notes.append("no candidate explains the data within its noise: the criteria overstate differences")
    return notes


# ---- averaging ----


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
        means, scales, softness, sds = [], [], [], []
        for part in parts:  # all of the logarithm, (D, M, C), which is linear where one predicts values themselves
            linear = LINEAR * float(np.max(np.abs(part.means)) or 1.0)
            size = 1.0 if part.softness is not None else linear
            means.append(part.means / size)
            scales.append(part.scales / size)
            softness.append(np.broadcast_to(linear if part.softness is None else part.softness, part.means.shape))
            sds.append(np.zeros_like(part.means) if part.discrepancy_sd is None else part.discrepancy_sd)
        return replace(
            parts[0],
            values=np.concatenate([part.values for part in parts]),
            means=np.concatenate(means),
            scales=np.concatenate(scales),
            softness=np.concatenate(softness),
            discrepancy_sd=None if all(part.discrepancy_sd is None for part in parts) else np.concatenate(sds),
            seed=seed,
            pareto_k=float(np.fmax.reduce([part.pareto_k for part in parts])),
            effective_draws=sum(part.effective_draws for part in parts),
        )


@program_cache()
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
