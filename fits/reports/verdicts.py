"""What a report says of a fit: every statement with the condition under which it is made, in one list.

`assess` collects the facts of a fit, and statements depend on these alone. Each says what it claims of the errors,
the residuals, the noise or the parameters, so that a test can go through all combinations of facts and find that no two
statements of a report contradict each other. With a model discrepancy, statements on residuals are about those whitened
by the fitted covariance.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fits.data.checks import repeats
from fits.data.totals import Totals
from fits.optimise.limits import instrument_limits, limited_with
from fits.optimise.options import FitOptions
from fits.optimise.uncertainty import UNCONSTRAINED_BEYOND, UNIDENTIFIED_BEYOND, Direction
from fits.problem.model import Model
from fits.problem.noise import DEFAULT_RELATIVE
from fits.problem.parameters import is_free
from fits.reports.diagnostics import ResidualStructure, residual_structure, standardised

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.problem.problem import Problem
    from fits.sampling.posterior import Posterior


@dataclass(frozen=True)
class ReportOptions:
    """Thresholds that decide what a report says."""

    significance: float = 3.0
    """Standard errors from which a chi-square, or a correlation of residuals, is not chance."""

    misfit: float = 1.5
    """Median misfit, in standard deviations of the stated noise, above which a significant misfit means that the stack
    does not describe the sample; that of the true stack is 0.67."""

    factor: float = 1.5
    """Ratio of model and data from which a misfit is quoted as a factor instead of in percent."""

    correlated: float = 0.95
    """Absolute correlation from which the table of parameters names the partner of a parameter."""

    prior_dominated: float = 0.3
    """Standard error, as a share of the bounds, above which a parameter is called prior-dominated."""

    r_hat: float = 1.01
    """R-hat above which the shares of the modes of a posterior are called uncertain."""

    peak_points: int = 3
    """Measurements above half the height of a peak from which its width is called sampled."""


DEFAULT = ReportOptions()


# ---- facts ----


@dataclass(frozen=True)
class Assessment:
    """The facts of a fit that decide what is said of it.

    Attributes:
        structure: of the residuals in units of the noise, whitened by the covariance with a model discrepancy.
        ratio, freedom: chi-square per degree of freedom, and their number.
        excess: chi-square above its expectation, in its own standard deviations.
        likelihood: whether the objective is one.
        noise_assumed: whether no noise was stated.
        described: whether the stack without discrepancy is as near to the data as noise and options allow.
        misfit: factors within which half and 95 % of the data are of that stack; None if no value is above zero.
        noise: median of the stated noise as a share of the value; NaN if none is above zero.
        discrepancy: fitted parameters of the model discrepancy, and the share of the residual sum of squares that it
            absorbs; None without one.
        limits: roughnesses that the instrument limits, and the least that it resolves.
        limited: other parameters that these limit, with the roughness and the shift in standard errors.
        words: of each parameter, what the data say of it.
        numerical_error: of the model, in standard deviations of the data; None where there is no resolution.
        numerical_limit: of it, see `FitOptions`.
    """

    options: ReportOptions
    structure: ResidualStructure
    count: int
    objective: str
    ratio: float
    freedom: int
    excess: float
    converged: bool
    likelihood: bool
    noise_assumed: bool
    described: bool
    misfit: tuple[float, float] | None
    noise: float
    discrepancy: tuple[Any, float] | None
    unidentified: tuple[Direction, ...]
    insensitive: tuple[str, ...]
    at_bound: tuple[str, ...]
    limits: Mapping[str, float]
    limited: Mapping[str, tuple[str, float]]
    words: Mapping[str, str]
    alternatives: int
    numerical_error: float | None
    numerical_limit: float

    @property
    def large(self) -> bool:
        """Whether the residuals are significantly larger than expected."""
        return self.excess > self.options.significance

    @property
    def small(self) -> bool:
        """Whether the residuals are significantly smaller than expected."""
        return self.excess < -self.options.significance

    @property
    def correlated(self) -> bool:
        """Whether neighbouring residuals are significantly correlated."""
        return self.structure.lag_one_sigma > self.options.significance and self.structure.independent_share < 1.0

    @property
    def error_factors(self) -> tuple[float, float]:
        """Factors by which the standard errors are too small, for the size and the correlation of the residuals."""
        share = self.structure.independent_share if self.correlated else 1.0
        return math.sqrt(self.ratio) if self.large or self.small else 1.0, share**-0.5

    @property
    def error_factor(self) -> float:
        """Both together."""
        return math.prod(self.error_factors)

    @property
    def which(self) -> str:
        """The residuals that statements are about, in words."""
        return "whitened residuals" if self.discrepancy else "residuals"

    @property
    def expectation(self) -> str:
        """What says how large they should be, in words."""
        return "the fitted covariance" if self.discrepancy else "the stated noise"

    @property
    def physical(self) -> dict[str, str]:
        """What the data say of the parameters of stack and scale; those of the noise are nuisance parameters."""
        return {name: word for name, word in self.words.items() if not name.startswith("noise.")}

    @property
    def identified(self) -> bool:
        """Whether the data identify every one of these."""
        return all(word == IDENTIFIED or word.startswith(CORRELATED) for word in self.physical.values())

    @property
    def resolved(self) -> bool:
        """Whether the numerical error of the model is small beside that of the data."""
        return self.numerical_error is None or self.numerical_error <= self.numerical_limit


def assess(fit: "Fit", options: ReportOptions = DEFAULT) -> Assessment:
    """The facts of a fit."""
    used, likelihood = fit.problem.data.used(), fit.is_posterior
    positive = used.values > 0.0
    described, noise, discrepancy = True, math.nan, None
    if likelihood:
        offsets = np.abs(np.asarray(fit.problem.call(Model.offsets_at, fit.vector, fit.predicted), float))
        significant = excess(float(np.sum(offsets**2)), fit.degrees_of_freedom) > options.significance
        described = not (significant and float(np.median(offsets)) > options.misfit)
        if positive.any():
            sigma = np.asarray(fit.problem.call(Model.sigma_at, fit.vector, used.values))
            noise = float(np.median(sigma[positive] / used.values[positive]))
    fitted = fit.problem.build(fit.vector).correlation
    if likelihood and fitted is not None:
        remaining = np.asarray(fit.problem.call(Model.offsets_after_discrepancy_at, fit.vector, fit.predicted), float)
        whole = float(np.sum(offsets**2))
        discrepancy = fitted, 1.0 - float(np.sum(remaining**2)) / whole if whole > 0.0 else 0.0
    return Assessment(
        options=options,
        structure=residual_structure(fit.problem.data, standardised(fit)),
        count=used.values.size,
        objective=fit.problem.objective,
        ratio=fit.reduced_chi_square,
        freedom=fit.degrees_of_freedom,
        excess=excess(fit.chi_square, fit.degrees_of_freedom),
        converged=fit.converged,
        likelihood=likelihood,
        noise_assumed=likelihood and fit.problem.noise_is_assumed,
        described=described,
        misfit=_misfit(fit.predicted[positive], used.values[positive]) if positive.any() else None,
        noise=noise,
        discrepancy=discrepancy,
        unidentified=fit.unidentified,
        insensitive=fit.insensitive,
        at_bound=fit.at_bound,
        limits=instrument_limits(fit),
        limited=limited_with(fit),
        words=identifiability(fit, options),
        alternatives=len(fit.alternatives),
        numerical_error=fit.numerical_error,
        numerical_limit=float(fit.settings.get("numerical_error", FitOptions().numerical_error)),
    )


def excess(square: float, freedom: int) -> float:
    """Chi-square above its expectation, in its own standard deviations."""
    return (square / freedom - 1.0) / math.sqrt(2.0 / freedom) if freedom > 0 else math.nan


def _misfit(predicted: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Within which factor of the model half, and 95 %, of positive values are; infinite where the model is 0."""
    with np.errstate(divide="ignore", over="ignore"):
        ratio = np.where(predicted > 0.0, predicted / values, 0.0)
        ordered = np.sort(np.maximum(ratio, 1.0 / ratio))  # no interpolation: it would make NaN of two infinite ones
    half, most = (float(ordered[min(int(share * len(ordered)), len(ordered) - 1)]) for share in (0.5, 0.95))
    return half, most


IDENTIFIED, CORRELATED = "identified", "correlated with"


def identifiability(fit: "Fit", options: ReportOptions = DEFAULT) -> dict[str, str]:
    """What the data say of each parameter, in a few words; directions count from 1, worst first.

    What counts is a parameter's own error along the unidentified directions, in units of its prior range: a parameter
    with a small share in an unidentified direction may be well known itself.
    """
    names, correlation = list(fit.values), np.array(fit.correlation, dtype=float)
    np.fill_diagonal(correlation, 0.0)
    limits, limited = instrument_limits(fit), limited_with(fit)
    words = {}
    for index, name in enumerate(names):
        width, error = float(fit.problem.high[index] - fit.problem.low[index]), fit.standard_errors[name]
        partner = int(np.nanargmax(np.abs(correlation[index]))) if np.isfinite(correlation[index]).any() else index
        along = [direction.error_of(name) for direction in fit.unidentified]
        if name in fit.insensitive:
            words[name] = "insensitive: no effect on the data"
        elif name in limits:
            words[name] = f"limited by the instrument: alpha below {limits[name]:.2g}"
        elif name in fit.at_bound:
            words[name] = "at a bound"
        elif name in limited:
            words[name] = f"limited by the instrument: correlated with {limited[name][0]}"
        elif math.hypot(*along) > UNIDENTIFIED_BEYOND:
            kind = "unidentified" if math.hypot(*along) > UNCONSTRAINED_BEYOND else "weakly identified"
            words[name] = f"{kind}: see direction {int(np.argmax(along)) + 1}"
        elif not math.isfinite(error):
            words[name] = "unidentified"
        elif error > options.prior_dominated * width:
            words[name] = "prior-dominated: error near the width of the bounds"
        elif abs(correlation[index, partner]) >= options.correlated:
            words[name] = f"{CORRELATED} {names[partner]} {correlation[index, partner]:+.2f}"
        else:
            words[name] = IDENTIFIED
    return words


# ---- statements ----


class Statement(NamedTuple):
    """A sentence, and what it claims of which topic, in a word each."""

    sentence: str
    claims: Mapping[str, str] = {}


def opening(f: Assessment) -> list[Statement]:
    """The verdict: how well the model describes the data, what the errors mean, and what the data identify."""
    return [_description(f), _errors(f), _parameters(f)]


def _description(f: Assessment) -> Statement:
    near, chi_square = "None of the measurements is above zero", f"(reduced chi-square {f.ratio:.3g})"
    if f.misfit is not None:
        half, most = (in_words(factor, f.options) for factor in f.misfit)
        which = "stack without model discrepancy" if f.discrepancy else "model"
        near = f"Half of the {f.count:,} measurements are within {half} of the {which}, 95 % within {most}"
    if not f.likelihood:
        return Statement(f"{near}; the objective is {f.objective}, which has no noise model to judge this by.")
    if not f.described:
        return Statement(not_described(f), {"description": "no"})
    if f.large:
        words = f"{near}, which {f.expectation} does not explain {chi_square}."
        return Statement(words, {"description": "no", "size": "large"})
    if f.small:
        words = f"{near}, closer than {f.expectation} predicts {chi_square}."
        return Statement(words, {"description": "yes", "size": "small"})
    words = f"{near}, as {f.expectation} predicts {chi_square}."
    return Statement(words, {"description": "yes", "size": "expected"})


def not_described(f: Assessment) -> str:
    """That the stack does not describe the sample."""
    if f.misfit is None:
        return "This stack does not describe the sample."
    median = in_words(f.misfit[0], f.options)
    return f"This stack does not describe the sample: median misfit {median}, stated noise {100.0 * f.noise:.2g} %."


def _errors(f: Assessment) -> Statement:
    if not f.converged:
        words = "The fit did not converge: values are the best found, not a minimum, and have no valid errors."
        return Statement(words, {"errors": "invalid"})
    if not f.likelihood:
        words = "The errors are scaled by the remaining scatter and are only indicative."
        return Statement(words, {"errors": "indicative"})
    if not f.described:
        words = "Values and standard errors hold only within this model, which does not describe the data."
        if f.discrepancy:
            words = "The standard errors include the model discrepancy, and hold only if it accounts for the misfit."
        return Statement(words, {"errors": "conditional", "description": "no"})
    if f.alternatives:
        others = "Another local minimum of the same model fits"
        if f.alternatives > 1:
            others = f"{f.alternatives} other local minima of the same model fit"
        words = f"{others} equally well: the standard errors are those of the best one only, sampling covers all."
        return Statement(words, {"errors": "one minimum"})
    size, correlation = f.error_factors
    if size * correlation != 1.0:
        parts = [f"{size:.2g} for the size of the {f.which}"] if size != 1.0 else []
        if f.correlated:
            count = f.structure.count
            words = f"{count} of them are equivalent to {max(1.0, count / correlation**2):.0f} independent ones"
            parts.append(f"{correlation:.2g} for their correlation: {words}")
        wrong, factor = ("small", f.error_factor) if f.error_factor > 1.0 else ("large", 1.0 / f.error_factor)
        words = f"The standard errors are too {wrong} by a factor of about {factor:.2g} ({' times '.join(parts)})."
        return Statement(words, {"errors": f"too {wrong}", "residuals": "misfit"})
    words = "The standard errors follow from the stated noise."
    if f.discrepancy:
        words = "The standard errors include the model discrepancy."
    elif f.noise_assumed:
        words = f"The standard errors are proportional to the noise, assumed to be {100.0 * DEFAULT_RELATIVE:g} %."
    return Statement(words, {"errors": "valid", "residuals": "as assumed"})


def _parameters(f: Assessment) -> Statement:
    words = f.physical
    if f.identified:
        every = "every parameter" if len(words) == len(f.words) else "every parameter of the stack"
        return Statement(f"The data identify {every}.", {"parameters": "all"})
    directions = [one for one in f.unidentified if any(_weak(one, name) for name in words)]
    parts = [f"{not_identified(one)}{' (and more)' if directions[1:] else ''}" for one in directions[:1]]
    for begins, what in (
        ("insensitive", "without effect on the data"),
        ("at a bound", "at a bound"),
        ("limited", "limited by the instrument"),
        ("prior-dominated", "prior-dominated"),
        *(() if directions else (("unidentified", "unidentified"), ("weakly", "weakly identified"))),
    ):
        names = [name for name, word in words.items() if word.startswith(begins)]
        if names:
            parts.append(f"{listed(names)} {'is' if len(names) == 1 else 'are'} {what}")
    return Statement(f"{'; '.join(parts)}.", {"parameters": "not all"})


def not_identified(direction: Direction) -> str:
    """What is not identified along a direction: the parameters with a large error along it."""
    names = [name for name in direction.weights if _weak(direction, name)] or [next(iter(direction.weights))]
    if len(names) > 1:
        return f"{listed(names)} are not identified separately"
    return f"{names[0]} is {'unidentified' if direction.unconstrained else 'weakly identified'}"


def _weak(direction: Direction, name: str) -> bool:
    return direction.error_of(name) > UNIDENTIFIED_BEYOND


def remarks(f: Assessment) -> list[Statement]:
    """Statements that qualify the verdict."""
    found = []
    if f.discrepancy is not None:
        term, absorbed = f.discrepancy
        amplitude, exponent = 100.0 * float(term.amplitude), float(term.grazing_exponent)
        grazing = f" at normal incidence, {amplitude * 2.0**exponent:.2g} % at 60°" if exponent > 0.0 else ""
        lengths = (
            f"{float(term.length_half):.2g}° (half angle), {float(term.length_difference):.2g}° (difference angle)"
        )
        words = f"Model discrepancy: {amplitude:.2g} % of the BSDF{grazing}; length scales {lengths}."
        found.append(Statement(f"{words} It absorbs {100.0 * absorbed:.3g} % of the residual sum of squares."))
    if not f.resolved:
        error = numerical_error(f.numerical_error)
        words = f"The numerical error of the model is {error}: a finer resolution may give other values."
        found.append(Statement(words))
    for name, least in f.limits.items():
        words = f"{name} is limited by the instrument: lobes below {least:.2g} are not resolved."
        found.append(Statement(words, {"parameters": "not all"}))
    for name, (roughness, shift) in f.limited.items():
        words = (
            f"{name} is limited by the instrument with {roughness}: up to that width it shifts by {shift:.2g} of its"
        )
        found.append(Statement(f"{words} its standard errors.", {"parameters": "not all"}))
    return found


def residuals(f: Assessment) -> list[Statement]:
    """Whether the residuals are what the noise model predicts; with a discrepancy, all is about the whitened ones."""
    which, structure = f.which, f.structure
    if f.likelihood:
        of = " of the whitened residuals" if f.discrepancy else ""
        words = f"The reduced chi-square{of} is {f.ratio:.3g} with {f.freedom} degrees of freedom; the true model and"
        found = [Statement(f"{words} noise give 1 ± {math.sqrt(2.0 / max(f.freedom, 1)):.2g}.")]
        if f.large:
            words = f"The {which} are larger than {f.expectation} predicts."
            found.append(Statement(words, {"size": "large", "residuals": "misfit"}))
        elif f.small and f.correlated:
            words = f"The {which} are smaller than {f.expectation} predicts, but correlated."
            found.append(Statement(words, {"size": "small", "residuals": "misfit"}))
        elif f.small:
            words = (
                f"The {which} are smaller than {f.expectation} predicts: sigma is too large, or holds a common error."
            )
            found.append(Statement(words, {"size": "small", "residuals": "misfit", "noise": "too large"}))
        else:
            found.append(Statement(f"The size of the {which} is what {f.expectation} predicts.", {"size": "expected"}))
    else:
        found = [Statement("Residuals are in units of their own scatter: a named residual has no noise model.")]
    if math.isfinite(structure.lag_one):
        words = f"correlated by {structure.lag_one:+.2f} ± {structure.pairs**-0.5:.2g} ({structure.pairs} pairs)"
        words = f"Neighbouring {which} are {words}; their root mean square is {structure.rms:.2f}."
        found.append(Statement(f"{words} Independent ones of unit variance have 0 and 1."))
    if f.correlated:
        words = "Correlated residuals come from structure that is not in the model, or from a smooth calibration error."
        found.append(Statement(words, {"residuals": "misfit"}))
    words = f"{structure.beyond_three:.1%} of the {which} are beyond 3 sigma (normal distribution: 0.3 %)."
    return [*found, Statement(words)]


def identification(f: Assessment) -> list[Statement]:
    """What the data identify: directions of parameter space, and parameters at a bound."""
    limit = f"{100.0 * UNIDENTIFIED_BEYOND:g} % of the prior range"
    words = f"The standard error along every principal direction of parameter space is at most {limit}."
    found = [Statement(words, {"directions": "all"})]
    if f.unidentified:
        words = f"{len(f.unidentified)} of {len(f.words)} principal directions of parameter space have a standard error"
        found = [Statement(f"{words} above {limit}; there, priors dominate.", {"directions": "not all"})]
    if f.at_bound:
        words = f"At a bound: {', '.join(f.at_bound)}. The best value may lie beyond it. Parameters at a bound have no"
        found.append(Statement(f"{words} standard error; the other errors are conditional on them."))
    return found


def sentences(statements: Iterable[Statement]) -> list[str]:
    """The sentences of statements."""
    return [one.sentence for one in statements]


# ---- what is said of a fit ----


class Verdict(NamedTuple):
    """The three sentences that open a report, remarks that qualify them, and whether there is no reservation."""

    sentences: list[str]
    remarks: list[str]
    sound: bool


def verdict(fit: "Fit", facts: Assessment | None = None) -> Verdict:
    """How well the model describes the data, what the errors mean, and what the data identify."""
    facts = facts or assess(fit)
    three = opening(facts)
    claims = {topic: claim for one in three for topic, claim in one.claims.items()}
    notes = [*sentences(remarks(facts)), *automatic_discrepancy(fit), *noise_statements(fit.problem)]
    sound = claims.get("description") == "yes" and claims["errors"] == "valid" and facts.identified and facts.resolved
    return Verdict(sentences(three), notes, sound)


def summary(fit: "Fit") -> list[str]:
    """A few lines for the terminal: the verdict, chi-square, starts and numerical error."""
    found = verdict(fit)
    good = f"chi2/dof {fit.reduced_chi_square:.4g} ({fit.chi_square:.6g} / {fit.degrees_of_freedom})"
    if fit.problem.noise.discrepancy:
        good = f"{good} with the discrepancy term, {ratio_without_discrepancy(fit):.4g} without"
    starts = f"{fit.minima[0].count} of {started(fit)} reached the best minimum"
    accurate = f"; numerical error of the model: {numerical_error(fit.numerical_error)}" if fit.resolution else ""
    return [*found.sentences, *found.remarks, f"{good}; {starts}{accurate}"]


def automatic_discrepancy(fit: "Fit") -> list[str]:
    """Why a model discrepancy was added to a fit, if it was."""
    found = fit.without_discrepancy
    if found is None:
        return []
    correlation = f"{found.residual_autocorrelation:+.2f} ({found.pairs} pairs; reduced chi-square"
    return [
        "The discrepancy term was added automatically because, with independent noise, neighbouring residuals correlate"
        f" by {correlation} {ratio_without_discrepancy(fit):.3g}). Set `discrepancy = false` to disable it."
    ]


def ratio_without_discrepancy(fit: "Fit") -> float:
    """Chi-square per degree of freedom with independent noise: as fitted so, else with these parameters."""
    if fit.without_discrepancy is not None:
        square, freedom = fit.without_discrepancy.chi_square, fit.without_discrepancy.degrees_of_freedom
    else:
        square = float(np.sum(np.square(fit.problem.call(Model.offsets_at, fit.vector, fit.predicted))))
        freedom = fit.degrees_of_freedom
    return square / freedom if freedom > 0 else math.nan


def noise_statements(problem: "Problem") -> list[str]:
    """Which part of the noise was assumed, or adds to the file's own sigma."""
    noise, used = problem.noise, problem.data.used()
    if problem.objective != "likelihood":
        return []
    if problem.noise_is_assumed:
        words = f"No noise is stated: {100.0 * DEFAULT_RELATIVE:g} % of the model's value is assumed."
        found = None if isinstance(used, Totals) else repeats(used)
        if found is None or not found.noise > 0.0:
            where = "`relative` under [noise], or `--noise` of a search"
            return [f"{words} State it as {where}; with start, low and high it is fitted."]
        scatter = f"{found.count:,} repeated measurements scatter by about {100.0 * found.noise:.2g} %"
        where = f"`relative = {found.noise:.2g}` under [noise], or `--noise` of a search, states that."
        return [f"{words} {scatter}: {where}"]
    if used.sigma is None or not noise.use_sigma or noise.relative in (None, 0):
        return []
    share = used.sigma[used.values > 0.0] / used.values[used.values > 0.0]
    own = f", {100.0 * float(np.median(share)):.2g} % in the median" if share.size else ""
    more = "a fitted relative part" if is_free(noise.relative) else f"relative = {noise.relative:g}"
    return [
        f"Noise: the data's own sigma{own}, and {more}, added in quadrature. Leave `relative` out if sigma holds it "
        "already; `use_sigma = false` ignores sigma."
    ]


def minima(fit: "Fit") -> list[str]:
    """How many starts agree on the minimum."""
    best, total = fit.minima[0], sum(fit.start_outcomes.values()) or sum(minimum.count for minimum in fit.minima)
    starts = started(fit) if fit.start_outcomes else f"{total} starts"
    found = "no other was found" if len(fit.minima) == 1 else f"{len(fit.minima)} minima were found"
    only = ["Only one start found it: more starts may find a better one."] if best.count == 1 and total > 1 else []
    return [f"{best.count} of {starts} reached the best minimum; {found}.", *only]


def started(fit: "Fit") -> str:
    """How many starts led to the fit."""
    refitted = " with the discrepancy term" if fit.without_discrepancy is not None else ""
    return f"{sum(fit.start_outcomes.values())} starts{refitted}"


def sampled(posterior: "Posterior", options: ReportOptions = DEFAULT) -> list[str]:
    """How long the chain is, whether that is long enough for its estimates, and which modes it has."""
    steps, walkers = posterior.chain.shape[:2]
    longest, worst = float(np.max(posterior.autocorrelation_time)), float(np.max(posterior.r_hat))
    words = [
        f"{walkers} walkers made {steps} steps; the first {posterior.burn_in} are burn-in, the others are "
        f"{(steps - posterior.burn_in) / longest:.0f} times the longest autocorrelation time of {longest:.0f} steps.",
        f"The effective sample size is at least {float(np.min(posterior.effective_samples)):.0f}; "
        f"{posterior.acceptance:.0%} of the proposals were accepted; R-hat is at most {worst:.3f}.",
    ]
    if posterior.modes:
        places = [
            f"{100.0 * mode.share:.2g} ± {100.0 * mode.error:.1g} % at "
            + ", ".join(f"{name} {value:.4g}" for name, value in mode.values.items())
            for mode in posterior.modes
        ]
        words.append(f"The posterior has {len(places)} modes: {'; '.join(places)}. Estimates cover all of them.")
        if worst > options.r_hat:
            words.append(f"R-hat is above {options.r_hat:g}: the shares of the modes are uncertain.")
    if posterior.status:
        words.append(f"The sampler: {posterior.status}.")
    if not posterior.converged:
        words.append(
            f"The chain has not converged: {posterior.options.autocorrelation_times:g} autocorrelation times and R-hat "
            f"of at most {posterior.options.r_hat:g} are needed: "
            + ("do not quote these estimates." if reportable(posterior) else "it gives no estimates yet.")
        )
    return words


def reportable(posterior: "Posterior") -> bool:
    """Whether estimates may be had from the chain."""
    return posterior.converged or posterior.allow_unconverged


def in_words(factor: float, options: ReportOptions = DEFAULT) -> str:
    """A factor in words: in percent while it is near 1."""
    if factor < options.factor:
        return f"{100.0 * (factor - 1.0):.2g} %"
    return f"a factor of {factor:.2g}" if math.isfinite(factor) else "an infinite factor (the model is 0 there)"


def numerical_error(error: float | None) -> str:
    """How far the resolution keeps the model from its limit, in a few words."""
    return "not known" if error is None or not math.isfinite(error) else f"{error:.2g} sigma at most"


def listed(names: Sequence[str]) -> str:
    """Names as words: "a, b and c"."""
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
