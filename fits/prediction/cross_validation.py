"""Cross-validation, and which of several stacks predicts held-out data best: elpd differences, stacking weights.

A fit is repeated without one group of measurements after the other, and predicts them. A single measurement would be
predicted well by its neighbours, whatever the stack. Groups are whole incidences; of fewer than three, parts of scans.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp, softmax

from fits.data.geometry import Floats
from fits.data.scans import incidences, scans
from fits.optimise.fit import refit
from fits.optimise.result import Fit
from fits.prediction.evidence import Evidence, evidence_of, posterior_draws
from fits.prediction.options import DEFAULT, ComparisonOptions
from fits.prediction.predict import draws_to_resample, posterior_predictive
from fits.problem.discrepancy import size
from fits.problem.problem import Problem
from fits.progress import Progress, given_progress, named
from fits.sampling.initial import other_minima
from fits.sampling.mixture import Mixture
from layerjax._checks import require_count, require_kind, require_seed
from layerjax.compiling import program_cache

DRAWS = 128  # draws of the posterior that held-out data are predicted with at a time, see `ComparisonOptions`
INFINITE_NOISE = 1e8  # noise with which a measurement does not influence a fit, in units of the largest measurement
INFINITE_ERROR = 1e3  # the same of its logarithm, beside model discrepancy
STACKING_STEPS = 20_000  # steps of the expectation maximisation of stacking weights, at most


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Predictive densities of held-out measurements.

    groups: names of what was held out together. rows: of each group among the used samples. log_density: log predictive
    density of each measurement, (N, C), by the fit without its group; 0 for those in no group, whose plane has too few
    to hold some out. converged: whether all fits did. errors: of each group's elpd, (G,), by the number of draws.
    """

    groups: tuple[str, ...]
    rows: tuple[NDArray[np.int64], ...]
    log_density: Floats
    converged: bool
    errors: Floats

    @property
    def elpd(self) -> float:
        """Expected log pointwise predictive density: the sum over measurements; higher is better."""
        return float(np.sum(self.log_density))

    @property
    def elpd_by_group(self) -> Floats:
        """The elpd of each group, (G,)."""
        return np.array([np.sum(self.log_density[rows]) for rows in self.rows])

    @property
    def error(self) -> float:
        """Standard error of the elpd by the number of draws of the posterior."""
        return float(np.linalg.norm(self.errors))


@program_cache()
def cross_validate(
    fit: Fit,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    options: ComparisonOptions | None = None,
    progress: Progress | None = None,
) -> CrossValidation:
    """Fit again without each incidence, starting from the best values, and predict its measurements.

    With fewer than three incidences a fifth of every scan is held out at a time.

    Args:
        fit: a fit of a likelihood.
        draws: of the posterior at a time, see `predict`; as many again until the elpd is as exact as `options` ask for.
        seed: see `predict`.
        options: `min_incidences` and `scan_parts` decide what is held out together.
        progress: called with ("cross-validation", groups done, groups, name).

    Raises:
        ValueError: a fit of a named objective, data of a single group, or a joint fit or a part of one.
    """
    require_count("draws", draws, 2)
    require_seed(seed)
    return _cross_validate(fit, draws, seed, options or DEFAULT, given_progress(progress))


def _cross_validate(
    fit: Fit, draws: int, seed: int, options: ComparisonOptions, progress: Progress, initial: Mixture | None = None
) -> CrossValidation:
    """initial: approximation of the fit's posterior, from which those without a group are sought."""
    groups, data = require_groups(fit, options), fit.problem.data.used()
    density, errors, converged = np.zeros(data.values.shape), np.zeros(len(groups)), True
    for number, (name, rows) in enumerate(groups.items()):
        progress("cross-validation", number, len(groups), name)
        rest = refit(without(fit.problem, np.isin(np.arange(len(data)), rows)), fit.vector, *other_minima(fit))
        each, effective, error, approximation = np.empty((0, *data.values[rows].shape)), 0.0, math.inf, initial
        while not len(each) or (error > options.monte_carlo_error and len(each) < options.most_draws):
            pool = draws_to_resample(rest, draws, np.random.RandomState(seed + len(each)), approximation)
            approximation = pool.mixture
            prediction = posterior_predictive(rest, data, draws=draws, seed=seed + len(each), pool=pool)
            each = np.concatenate([each, prediction.log_densities(data.values)[:, rows]])
            effective += prediction.effective_draws
            density[rows] = logsumexp(each, axis=0) - math.log(len(each))
            # how much each draw adds to the elpd, to first order
            error = float(np.std(np.sum(np.exp(each - density[rows]), axis=(1, 2))) / math.sqrt(effective))
        errors[number], converged = error, converged and rest.converged
    progress("cross-validation", len(groups), len(groups), "")
    return CrossValidation(tuple(groups), tuple(groups.values()), density, converged, errors)


def require_groups(fit: Fit, options: ComparisonOptions | None = None) -> dict[str, NDArray[np.int64]]:
    """Rows of a fit's measurements that are held out together, by name. ValueError as of `cross_validate`."""
    require_kind("fit", fit, Fit)
    require_kind("options", options, ComparisonOptions, None)
    fit.require_posterior("cross_validate")
    if fit.problem.problems.get("") is not fit.problem:
        raise ValueError("cross_validate: it takes a fit of one measurement by itself, not a joint one")
    data, options = fit.problem.data.used(), options or DEFAULT
    by_incidence = incidences(data)
    groups = {one.label: one.rows for one in by_incidence}
    if len(by_incidence) < options.min_incidences:
        parts = [np.array_split(rows, options.scan_parts) for rows in scans(data)]
        together = [np.concatenate(same) for same in zip(*parts, strict=True)]
        groups = {f"part {number} of each scan": rows for number, rows in enumerate(together, 1) if rows.size}
    if len(groups) < 2:
        raise ValueError("cross_validate: there is one incidence, and too few measurements to hold some of them out")
    return groups


def without(problem: Problem, held_out: ArrayLike) -> Problem:
    """The problem whose used samples `held_out`, (N,) bool, have no influence, as their noise is infinite."""
    model, rows = problem.model, jnp.asarray(held_out)[:, None]
    infinite = INFINITE_NOISE * jnp.max(jnp.abs(model.values) + model.lowest)
    if model.process is not None:
        floor = model.build(model.box.high).floor  # where it is fitted, it must not matter either
        infinite = INFINITE_ERROR * jnp.hypot(size(model.values, model.softness), floor)
    model = replace(model, variance=jnp.where(rows, infinite**2, model.variance))
    return problem.with_model(model.with_projection())


# ---- of several stacks ----


@dataclass(frozen=True)
class ModelScore:
    """Predictive score of one of several stacks.

    Attributes:
        elpd: sum of log predictive densities of measurements, each by a fit without its incidence.
        elpd_diff: difference to the best stack.
        dse: standard error of the difference, from the incidences and from the draws of the posterior.
        clear_diff: the difference less its error, or all of it where every group of held-out data decides (see
            `ComparisonOptions`).
        weight: stacking weight (Yao, Vehtari, Simpson & Gelman 2018, Bayesian Anal. 13, 917).
        model_probability: posterior probability among the compared stacks, which are equally probable a priori.
    """

    elpd: float
    elpd_diff: float
    dse: float
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
    held_out, evidences = {}, {}
    for name, fit in candidates.items():
        held_out[name], evidences[name] = out_of_sample(fit, named(name, given_progress(progress)), options=options)
    return rank_models(held_out, evidences, options)


def out_of_sample(
    fit: Fit, progress: Progress | None = None, options: ComparisonOptions | None = None
) -> tuple[CrossValidation, Evidence]:
    """Cross-validation and evidence of a fit, both by draws of its posterior."""
    require_groups(fit, options)
    draws = posterior_draws(fit)
    held_out = _cross_validate(fit, DRAWS, 0, options or DEFAULT, given_progress(progress), draws.mixture)
    return held_out, evidence_of(draws)


def rank_models(
    held_out: Mapping[str, CrossValidation],
    evidences: Mapping[str, Evidence],
    options: ComparisonOptions | None = None,
) -> dict[str, ModelScore]:
    """Score fits of the same data by their cross-validation and evidence, side by side."""
    options = options or DEFAULT
    best = max(held_out.values(), key=lambda one: one.elpd)
    weights = stacking(np.stack([one.log_density.ravel() for one in held_out.values()]))
    probabilities = softmax(np.array([evidences[name].log_evidence for name in held_out]))
    scores = {}
    for (name, one), weight, probability in zip(held_out.items(), weights, probabilities, strict=True):
        gaps = best.elpd_by_group - one.elpd_by_group
        elpd_diff, dse = float(gaps.sum()), float(np.sqrt(gaps.size) * gaps.std(ddof=1))
        dse = math.hypot(dse, 0.0 if one is best else math.hypot(one.error, best.error))
        sizes = [best.log_density[rows].size for rows in best.rows]
        decisive = bool(np.all(gaps / sizes > options.decisive_per_measurement))
        scores[name] = ModelScore(
            elpd=one.elpd,
            elpd_diff=elpd_diff,
            dse=dse,
            clear_diff=elpd_diff if decisive else elpd_diff - options.standard_errors * dse,
            weight=float(weight),
            evidence=evidences[name],
            model_probability=float(probability),
        )
    return scores


def stacking(log_density: Floats) -> Floats:
    """Weights (K,) of K predictions whose mixture has the highest log-density over N measurements, from (K, N).

    By expectation maximisation: the mean share of each prediction in the density of a measurement is its next weight.
    """
    logs = np.full(len(log_density), -math.log(len(log_density)))
    for _ in range(STACKING_STEPS):
        before, logs = logs, np.log(softmax(log_density + logs[:, None], axis=0).mean(axis=1) + np.finfo(float).tiny)
        if np.max(np.abs(np.exp(logs) - np.exp(before))) < 1e-10:
            break
    return np.exp(logs)
