"""Which stack explains the data: fits of the same measurements side by side."""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fits._lazy import shown_by
from fits.optimise.result import Fit
from fits.prediction.model_scores import ModelScore, model_scores
from fits.progress import Progress
from fits.sampling.posterior import Posterior, require_fits

LEANING, CLEAR = 2.0, 10.0
"""Differences in AIC and BIC below the first say nothing, above the second leave hardly any doubt (Burnham & Anderson
2002, Sec. 2.6; Kass & Raftery 1995)."""


@dataclass(frozen=True)
class Row:
    """One fit in a comparison.

    parameters: number of fitted ones. aic, bic: Akaike's and the Bayesian information criterion, NaN for a named
    objective.
    loo: expected log-density of a new datum summed over the data, by Pareto-smoothed leave-one-out, with its standard
    error; loo_diff: how far that falls behind the best, with the error of the difference; unreliable: number of data
    whose leave-one-out weight has a Pareto shape above 0.7. All five are NaN where posteriors were not given.
    model_score: what it foretells of incidences that are left out, its weight and its evidence; None without `refit`.
    """

    name: str
    parameters: int
    chi_square: float
    degrees_of_freedom: int
    reduced_chi_square: float
    log_likelihood: float
    aic: float
    bic: float
    loo: float
    loo_error: float
    loo_diff: float
    loo_dse: float
    unreliable: float
    converged: bool
    at_bound: tuple[str, ...]
    model_score: ModelScore | None = None


@dataclass(frozen=True)
class Comparison:
    """Fits of the same data, side by side.

    Attributes:
        rows: best first.
        sorted_by: "left_out", "loo", "aic" or "chi_square".
        verdict: a sentence for each fit behind the best, that says whether the data prefer the best to it.
        notes: what to mind in reading the rows.
    """

    rows: tuple[Row, ...]
    sorted_by: str
    verdict: tuple[str, ...]
    notes: tuple[str, ...]

    def _repr_html_(self) -> str:
        return str(shown_by("fits.reports.html:comparison_fragment", self))


def compare(
    candidates: Mapping[str, Fit | Posterior], *, refit: bool = False, progress: Progress | None = None
) -> Comparison:
    """Compare fits of the same data under the same objective; leave-one-out enters if every candidate is a `Posterior`.

    Args:
        candidates: at least two fits or their posteriors, by name.
        refit: fit each again without each incidence, and rank by what they foretell of it; this takes as many short
            fits. Their stacking weights and their evidence come with it.
        progress: called with (name and stage, done, total, note) meanwhile.

    Raises:
        ValueError: fewer than two candidates, different data, different objectives, or fits of several measurements,
            of which one may be compared, but not with `refit`.
    """
    require_fits(candidates)
    if len(candidates) < 2:
        raise ValueError(f"compare: {len(candidates)} candidate(s) given; at least 2 are needed")
    fits = {name: entry.fit if isinstance(entry, Posterior) else entry for name, entry in candidates.items()}
    for fit in fits.values():
        fit.require_one("compare")
    first_name, first = next(iter(fits.items()))
    for name, fit in fits.items():
        if not _same_data(first, fit):
            raise ValueError(f"compare: {first_name!r} and {name!r} were fitted to different data")
        if fit.problem.objective != first.problem.objective:
            raise ValueError(
                f"compare: {first_name!r} minimised {first.problem.objective!r}, {name!r} {fit.problem.objective!r}; "
                "only fits of one objective can be compared"
            )
    posteriors = {name: entry for name, entry in candidates.items() if isinstance(entry, Posterior)}
    loo = _leave_one_out(posteriors) if len(posteriors) == len(candidates) else {}
    rows = [_row(name, fit, loo.get(name, {})) for name, fit in fits.items()]
    if refit:
        foreseen = model_scores(fits, progress)
        rows = [replace(row, model_score=foreseen[row.name]) for row in rows]
        rows.sort(key=lambda row: -foreseen[row.name].elpd)
    elif loo:
        rows.sort(key=lambda row: -row.loo)
    elif first.is_posterior:
        rows.sort(key=lambda row: row.aic)
    else:
        rows.sort(key=lambda row: row.chi_square)
    sorted_by = "left_out" if refit else "loo" if loo else "aic" if first.is_posterior else "chi_square"
    verdict = tuple(_preference(rows[0], row, sorted_by) for row in rows[1:])
    return Comparison(tuple(rows), sorted_by, verdict, tuple(_notes(fits, rows, len(posteriors))))


def _row(name: str, fit: Fit, loo: dict[str, float]) -> Row:
    count, likelihood = len(fit.vector), fit.log_likelihood
    return Row(
        name=name,
        parameters=count,
        chi_square=fit.chi_square,
        degrees_of_freedom=fit.degrees_of_freedom,
        reduced_chi_square=fit.reduced_chi_square,
        log_likelihood=likelihood,
        aic=2.0 * count - 2.0 * likelihood,
        bic=count * math.log(fit.problem.count) - 2.0 * likelihood,
        loo=loo.get("loo", math.nan),
        loo_error=loo.get("error", math.nan),
        loo_diff=loo.get("behind", math.nan),
        loo_dse=loo.get("dse", math.nan),
        unreliable=loo.get("unreliable", math.nan),
        converged=fit.converged,
        at_bound=fit.at_bound,
    )


def _preference(best: Row, other: Row, sorted_by: str) -> str:
    """Whether the data prefer one fit to another, in one sentence.

    A best fit that misses the data by more than their noise says that the noise is larger than stated: differences in
    log-likelihood are then divided by its reduced chi-square (Burnham & Anderson 2002, Sec. 2.5, QAIC).
    """
    if sorted_by == "chi_square":
        return f"{best.name} comes closer than {other.name}; without a likelihood it cannot be said whether by chance."
    if sorted_by == "left_out":
        assert other.model_score is not None
        ahead, error = other.model_score.elpd_diff, other.model_score.dse
        differ = f"it foretells incidences that are left out with a log-density higher by {ahead:.1f} ± {error:.1f}"
        return _in_words(best.name, other.name, 2.0 * other.model_score.clear_diff, differ)
    excess = max(1.0, best.reduced_chi_square) if best.degrees_of_freedom > 0 else 1.0
    counted = f" (the scatter that {best.name} leaves counted as noise)" if excess > 1.0 else ""
    if sorted_by == "loo":
        ahead, error = other.loo_diff / excess, other.loo_dse / excess
        lead = 2.0 * (ahead - 2.0 * error)
        differ = f"it expects new data with a log-density higher by {ahead:.1f} ± {error:.1f}{counted}"
    else:
        gain = 2.0 * (best.log_likelihood - other.log_likelihood)
        spared = gain / excess - gain
        aic, bic = other.aic - best.aic + spared, other.bic - best.bic + spared
        lead = min(aic, bic)
        differ = f"AIC lower by {aic:.1f}, BIC by {bic:.1f}{counted}"
    return _in_words(best.name, other.name, lead, differ)


def _in_words(best: str, other: str, lead: float, differ: str) -> str:
    if lead < LEANING:
        return f"The data do not tell {best} from {other}: {differ}."
    return f"The data {'prefer' if lead > CLEAR else 'slightly prefer'} {best} to {other}: {differ}."


def _leave_one_out(posteriors: Mapping[str, Posterior]) -> dict[str, dict[str, float]]:
    import arviz

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Estimated shape parameter of Pareto", category=UserWarning)
        estimates = {name: arviz.loo(entry.inference_data, pointwise=True) for name, entry in posteriors.items()}
    pointwise = {name: np.ravel(estimate.loo_i) for name, estimate in estimates.items()}
    best = pointwise[max(estimates, key=lambda name: float(estimates[name].elpd_loo))]
    result = {}
    for name, estimate in estimates.items():
        difference = best - pointwise[name]
        result[name] = {
            "loo": float(estimate.elpd_loo),
            "error": float(estimate.se),
            "behind": float(difference.sum()),
            "dse": float(math.sqrt(difference.size) * difference.std()),
            "unreliable": float(np.sum(np.asarray(estimate.pareto_k) > 0.7)),
        }
    return result


def _same_data(one: Fit, other: Fit) -> bool:
    first, second = one.problem.model, other.problem.model
    pairs = ((first.wi, second.wi), (first.wo, second.wo), (first.values, second.values))
    return all(a.shape == b.shape and np.allclose(a, b, rtol=1e-9, atol=1e-12) for a, b in pairs)


def _notes(fits: Mapping[str, Fit], rows: list[Row], posteriors: int) -> list[str]:
    notes = []
    for what in ("noise", "transport", "scale"):
        settings = {name: getattr(fit.problem, what) for name, fit in fits.items()}
        if not _all_equal(list(settings.values())):
            notes.append(
                f"the fits differ in {what}: " + "; ".join(f"{name}: {value}" for name, value in settings.items())
            )
    failed = [row.name for row in rows if not row.converged]
    if failed:
        notes.append(f"not converged: {', '.join(failed)}")
    doubtful = [f"{row.name} ({row.unreliable:.0f})" for row in rows if row.unreliable > 0]
    if doubtful:
        notes.append(f"leave-one-out is unreliable for single data of {', '.join(doubtful)}")
    if 0 < posteriors < len(fits):
        notes.append("leave-one-out is left out: not every candidate is a posterior")
    unsure = [row.name for row in rows if row.model_score is not None and not row.model_score.evidence.reliable]
    if unsure:
        notes.append(f"the evidence is unreliable, its sampling misses a part of the posterior: {', '.join(unsure)}")
    if min(row.reduced_chi_square for row in rows) > 2.0:
        notes.append("no candidate explains the data within its noise: the criteria overstate differences")
    return notes


def _all_equal(values: list[Any]) -> bool:
    return all(repr(value) == repr(values[0]) for value in values)
