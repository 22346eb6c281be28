"""Model comparison: fits of the same measurements side by side, and which of them the data prefer."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fits._files import require_switch
from fits._lazy import shown_by
from fits.optimise.result import Fit
from fits.prediction.cross_validation import ModelScore, model_scores
from fits.prediction.options import DEFAULT, ComparisonOptions
from fits.progress import Progress
from fits.sampling.posterior import Posterior
from layerjax._checks import require_kind
from layerjax.compiling import programs_kept


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


@programs_kept()
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
        refit: fit each again without each incidence and rank by the elpd of the held-out measurements; this takes as
            many short fits, and gives stacking weights and evidence as well.
        options: the thresholds of verdict and notes.
        progress: called with (name and stage, done, total, note) meanwhile.

    Raises:
        ValueError: fewer than two candidates, different data, different objectives, or joint fits; a part of one may be
            compared, but not with `refit`.
    """
    fits = fits_of(candidates)
    require_kind("options", options, ComparisonOptions, None)
    require_switch("refit", refit)
    if len(candidates) < 2:
        raise ValueError(f"compare: {len(candidates)} candidate(s) given; at least 2 are needed")
    options = options or DEFAULT
    _require_comparable(fits)
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


def _require_comparable(fits: Mapping[str, Fit]) -> None:
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
            notes.append(f"of the fits only {', '.join(with_it)} with a discrepancy term")
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
