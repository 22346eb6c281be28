"""What a report says of a fit: every statement with the condition under which it is made.

`assess` collects the facts of a fit, and `statements` depend on these alone. Each says what it claims of the errors,
the residuals, the noise or the parameters, so that a test can go through all combinations of facts and find that no two
statements of a report contradict each other. With a model discrepancy, residuals are those whitened by the covariance.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

import layerjax as lj
from fits.data.measurements import Measurements
from fits.data.scans import correlation, in_plane, neighbours, scans, signed_angle
from fits.optimise.options import FitOptions
from fits.optimise.result import Fit, numerical_error_in_words
from fits.optimise.uncertainty import UNCONSTRAINED_BEYOND, UNIDENTIFIED_BEYOND, Direction
from fits.problem.model import Model
from fits.problem.noise import DEFAULT_RELATIVE
from fits.sampling.posterior import Posterior
from layerjax._checks import require_number
from layerjax.mixture import stacks_by_name


@dataclass(frozen=True)
class ReportOptions:
    """Thresholds that decide what a report says.

    Attributes:
        significance: standard errors from which a chi-square, or a correlation of residuals, is not chance.
        misfit: median misfit, in standard deviations of the stated noise, above which a significant misfit means that
            the stack does not describe the sample; that of the true stack is 0.67.
        correlated: absolute correlation from which the table of parameters names the partner of a parameter.
        prior_dominated: standard error, as a share of the bounds, above which a parameter is called prior-dominated.
    """

    significance: float = 3.0
    misfit: float = 1.5
    correlated: float = 0.95
    prior_dominated: float = 0.3

    def __post_init__(self) -> None:
        for field in fields(self):
            require_number(f"ReportOptions.{field.name}", getattr(self, field.name), 0.0)


DEFAULT = ReportOptions()

NOISE_ASSUMED = (
    f"No noise is stated: {100.0 * DEFAULT_RELATIVE:g} % of the model's value is assumed. State it as `relative` under "
    "[noise], or by `--noise` of a search or a map."
)


# ---- residuals ----


def over_all_rows(fit: Fit, values: np.ndarray) -> np.ndarray:
    """Values (used samples, C) of a fit spread over every row of its data, (N, C); NaN in rows that were not used."""
    mask = fit.problem.data.mask
    spread = np.full((len(mask), np.shape(values)[1]), np.nan)
    spread[mask] = values
    return spread


def standardised(fit: Fit) -> np.ndarray:
    """Residuals of every row that are independent standard normal if the model holds, (N, C); NaN in unused rows.

    They are in units of the noise; with a model discrepancy, whitened by the covariance of both.
    """
    return over_all_rows(fit, fit.residuals / residual_unit(fit))


def residual_unit(fit: Fit) -> float:
    """Noise, or the scatter that is left where a named objective has no noise model."""
    return 1.0 if fit.is_posterior else math.sqrt(fit.chi_square / max(fit.degrees_of_freedom, 1))


# ---- what an instrument does not resolve ----

# tangent of the half vector, over alpha, at which facets are half as many as along the normal
HALF = {"ggx": math.sqrt(math.sqrt(2.0) - 1.0), "vmf": math.sqrt(math.log(2.0))}
STEPS = 2.0  # of a scan, that a lobe has to hold within its full width at half maximum
NEAR = 10.0  # degrees from the mirror direction within which steps of a scan count


def instrument_limits(fit: Fit) -> dict[str, float]:
    """Fitted roughnesses whose lobe is narrower than what can be seen of it, and the least alpha that could be.

    A mirror lobe is as wide as its full width at half maximum, in the angle of the viewer. That has to be wider than
    the aperture of the `Instrument`, and hold two steps of the scan that is finest about the mirror direction.
    """
    instrument, material = fit.problem.instrument, fit.problem.stack
    aperture = 0.0 if instrument is None else math.hypot(instrument.source_aperture, instrument.detector_aperture)
    resolved, found = max(aperture, STEPS * finest_step(fit.problem.data.used())), dict[str, float]()
    for prefix, stack in stacks_by_name(material).items() if isinstance(material, lj.Stack | lj.Mixture) else ():
        layers = {f"{prefix}layers[{place}]": layer for place, layer in enumerate(stack.layers)}
        parts = layers | {f"{prefix}base": stack.base}
        for name, part in ((f"{at}.{width}", part) for at, part in parts.items() for width in ("alpha", "alpha_y")):
            if isinstance(part, lj.Interface | lj.Conductor) and name in fit.values:
                least = math.tan(math.radians(resolved / 4.0)) / HALF[part.distribution]
                found |= {name: least} if fit.values[name] < least else {}
    return found


def finest_step(data: Measurements) -> float:
    """Degrees between neighbours about the mirror direction, of the scan that is finest there; 0 if none crosses it."""
    signed, plane = signed_angle(data), in_plane(data)
    steps = []
    for rows in scans(data):
        rows = rows[plane[rows]]
        angle, mirror = signed[rows], float(data.theta_i[rows[0]]) if rows.size else 0.0
        if rows.size < 2 or not angle.min() <= mirror <= angle.max():
            continue
        gaps = np.diff(angle)
        middle = 0.5 * (angle[1:] + angle[:-1])
        near = (np.abs(middle - mirror) <= NEAR) & (gaps > 0.0)
        if near.any():
            steps.append(float(np.min(gaps[near])))
    return min(steps, default=0.0)


# ---- facts ----


@dataclass(frozen=True)
class Assessment:
    """The facts of a fit that decide what is said of it; residuals are whitened where there is a model discrepancy."""

    fit: Fit
    options: ReportOptions
    count: int  # of residuals
    lag_one: float  # correlation of neighbours in angle; NaN without any
    pairs: int  # of neighbours
    ratio: float  # chi-square per degree of freedom
    excess: float  # chi-square above its expectation, in its own standard deviations
    noise_assumed: bool
    described: bool  # whether the stack without discrepancy is as near to the data as noise and options allow
    misfit: tuple[float, float] | None  # factors within which half and 95 % of the positive data are of that stack
    noise: float  # median of the stated noise as a share of the value; NaN if none is above zero
    discrepancy: tuple[Any, float] | None  # its parameters, and the reduced chi-square without it
    words: Mapping[str, str]  # of each parameter, see `identifiability`
    resolved: bool  # whether the numerical error is small enough

    @property
    def size(self) -> str:
        """Whether the residuals are larger or smaller than expected."""
        limit = self.options.significance
        return "large" if self.excess > limit else "small" if self.excess < -limit else "expected"

    @property
    def correlated(self) -> bool:
        return self.lag_one * math.sqrt(self.pairs) > self.options.significance

    @property
    def error_factors(self) -> tuple[float, float]:
        """Factors by which the standard errors are too small, for the size and the correlation of the residuals.

        The effective number of residuals over their number is (1 - r) / (1 + r) for a correlation r of neighbours.
        """
        inflation = (1.0 + self.lag_one) / max(1.0 - self.lag_one, 1e-9) if self.correlated else 1.0
        return 1.0 if self.size == "expected" else math.sqrt(self.ratio), math.sqrt(inflation)

    @property
    def which(self) -> str:
        return "whitened residuals" if self.discrepancy else "residuals"

    @property
    def expectation(self) -> str:
        return "the fitted covariance" if self.discrepancy else "the stated noise"

    @property
    def physical(self) -> dict[str, str]:
        """What the data say of the parameters of stack and scale; those of the noise are nuisance parameters."""
        return {name: word for name, word in self.words.items() if not name.startswith("noise.")}

    @property
    def identified(self) -> bool:
        return all(word == IDENTIFIED or word.startswith(CORRELATED) for word in self.physical.values())


def assess(fit: Fit, options: ReportOptions = DEFAULT) -> Assessment:
    """The facts of a fit."""
    used, likelihood, freedom = fit.problem.data.used(), fit.is_posterior, max(fit.degrees_of_freedom, 1)
    spread = math.sqrt(2.0 / freedom)  # of chi-square per degree of freedom about 1
    positive = used.values > 0.0
    described, noise, misfit, discrepancy = True, math.nan, None, None
    if positive.any():
        # factors between model and data, in order; no interpolation, which would make NaN of two infinite ones
        with np.errstate(divide="ignore", over="ignore"):
            ratio = np.where(fit.predicted > 0.0, fit.predicted / np.where(positive, used.values, 1.0), 0.0)[positive]
            ordered = np.sort(np.maximum(ratio, 1.0 / ratio))
        misfit = float(ordered[len(ordered) // 2]), float(ordered[int(0.95 * len(ordered))])
    if likelihood:
        offsets = np.abs(np.asarray(fit.problem.call(Model.standardised_at, fit.vector, fit.predicted), float))
        square = float(np.sum(offsets**2))  # by these parameters
        significant = fit.degrees_of_freedom > 0 and square / freedom - 1.0 > options.significance * spread
        described = not (significant and float(np.median(offsets)) > options.misfit)
        if positive.any():
            sigma = np.asarray(fit.problem.call(Model.sigma_at, fit.vector, used.values))
            noise = float(np.median(sigma[positive] / used.values[positive]))
        if (term := fit.problem.build(fit.vector).correlation) is not None:
            before = fit.without_discrepancy
            ratio_before = square / freedom if before is None else before.chi_square / max(before.degrees_of_freedom, 1)
            discrepancy = term, ratio_before
    limit = float(fit.settings.get("numerical_error", FitOptions().numerical_error))
    pairs = neighbours(fit.problem.data, standardised(fit))
    return Assessment(
        fit=fit,
        options=options,
        count=used.values.size,
        lag_one=correlation(*pairs),
        pairs=pairs[0].size,
        ratio=fit.reduced_chi_square,
        excess=(fit.reduced_chi_square - 1.0) / spread,
        noise_assumed=likelihood and fit.problem.noise_is_assumed,
        described=described,
        misfit=misfit,
        noise=noise,
        discrepancy=discrepancy,
        words=identifiability(fit, options),
        resolved=fit.numerical_error is None or fit.numerical_error <= limit,
    )


IDENTIFIED, CORRELATED = "identified", "correlated with"


def identifiability(fit: Fit, options: ReportOptions = DEFAULT) -> dict[str, str]:
    """What the data say of each parameter, in a few words; directions count from 1, worst first.

    What counts is a parameter's own error along the unidentified directions, in units of its prior range: a parameter
    with a small share in an unidentified direction may be well known itself.
    """
    names, correlation = list(fit.values), np.array(fit.correlation, dtype=float)
    np.fill_diagonal(correlation, 0.0)
    limits = instrument_limits(fit)
    words = {}
    for index, name in enumerate(names):
        width, error = float(fit.problem.high[index] - fit.problem.low[index]), fit.standard_errors[name]
        partner = int(np.argmax(np.abs(np.nan_to_num(correlation[index]))))
        along = [direction.error_of(name) for direction in fit.unidentified]
        if name in fit.insensitive:
            words[name] = "insensitive: no effect on the data"
        elif name in limits:
            words[name] = f"limited by the instrument: alpha below {limits[name]:.2g}"
        elif name in fit.at_bound:
            words[name] = "at a bound"
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


def statements(f: Assessment) -> dict[str, list[Statement]]:
    """All that is said of a fit: the three of the verdict, remarks that qualify it, and those on the residuals."""
    return {
        "verdict": [_description(f), _errors(f), _parameters(f)],
        "remarks": _remarks(f),
        "residuals": _residuals(f),
    }


def _description(f: Assessment) -> Statement:
    """How well the model describes the data."""
    near, chi_square = "None of the measurements is above zero", f"(reduced chi-square {f.ratio:.3g})"
    if f.misfit is not None:
        half, most = map(_deviation, f.misfit)
        which = "stack without model discrepancy" if f.discrepancy else "model"
        near = f"Half of the {f.count:,} measurements are within {half} of the {which}, 95 % within {most}"
    if not f.fit.is_posterior:
        return Statement(f"{near}; the objective is a named residual, which has no noise model to judge this by.")
    if not f.described:
        misfit = "" if f.misfit is None else f": median misfit {half}, stated noise {100.0 * f.noise:.2g} %"
        return Statement(f"This stack does not describe the sample{misfit}.", {"description": "no"})
    fitting = {
        "large": f"which {f.expectation} does not explain",
        "small": f"closer than {f.expectation} predicts",
        "expected": f"as {f.expectation} predicts",
    }
    described = "no" if f.size == "large" else "yes"
    return Statement(f"{near}, {fitting[f.size]} {chi_square}.", {"description": described, "size": f.size})


def _deviation(factor: float) -> str:
    """A factor between model and data in words: in percent while it is near 1."""
    if factor < 1.5:
        return f"{100.0 * (factor - 1.0):.2g} %"
    return f"a factor of {factor:.2g}" if math.isfinite(factor) else "an infinite factor (the model is 0 there)"


def _errors(f: Assessment) -> Statement:
    """What the standard errors mean."""
    if not f.fit.converged:
        words = "The fit did not converge: values are the best found, not a minimum, and have no valid errors."
        return Statement(words, {"errors": "invalid"})
    if not f.fit.is_posterior:
        words = "The errors are scaled by the remaining scatter and are only indicative."
        return Statement(words, {"errors": "indicative"})
    if not f.described:
        words = "Values and standard errors hold only within this model, which does not describe the data."
        if f.discrepancy:
            words = "The standard errors include the model discrepancy, and hold only if it accounts for the misfit."
        return Statement(words, {"errors": "conditional", "description": "no"})
    if count := len(f.fit.alternatives):
        others = "Another local minimum of the same model fits"
        if count > 1:
            others = f"{count} other local minima of the same model fit"
        words = f"{others} equally well: the standard errors are those of the best one only, sampling covers all."
        return Statement(words, {"errors": "one minimum"})
    size, correlation = f.error_factors
    if (factor := size * correlation) != 1.0:
        parts = [f"{size:.2g} for the size of the {f.which}"] if size != 1.0 else []
        if f.correlated:
            words = f"{f.count} of them are equivalent to {max(1.0, f.count / correlation**2):.0f} independent ones"
            parts.append(f"{correlation:.2g} for their correlation: {words}")
        wrong = "small" if factor > 1.0 else "large"
        words = f"too {wrong} by a factor of about {max(factor, 1.0 / factor):.2g} ({' times '.join(parts)})"
        return Statement(f"The standard errors are {words}.", {"errors": f"too {wrong}", "residuals": "misfit"})
    words = "The standard errors follow from the stated noise."
    if f.discrepancy:
        words = "The standard errors include the model discrepancy."
    elif f.noise_assumed:
        words = f"The standard errors are proportional to the noise, assumed to be {100.0 * DEFAULT_RELATIVE:g} %."
    return Statement(words, {"errors": "valid", "residuals": "as assumed"})


def _parameters(f: Assessment) -> Statement:
    """What the data identify."""
    words = f.physical
    if f.identified:
        every = "every parameter" if len(words) == len(f.words) else "every parameter of the stack"
        return Statement(f"The data identify {every}.", {"parameters": "all"})

    def weak(direction: Direction) -> list[str]:
        return [name for name in direction.weights if direction.error_of(name) > UNIDENTIFIED_BEYOND]

    directions, parts = [one for one in f.fit.unidentified if set(weak(one)) & set(words)], []
    if directions:
        names, more = weak(directions[0]), " (and more)" if directions[1:] else ""
        kind = "unidentified" if directions[0].unconstrained else "weakly identified"
        said = f"{listed(names)} are not identified separately" if names[1:] else f"{names[0]} is {kind}"
        parts = [f"{said}{more}"]
    for begins, what in (
        ("insensitive", "without effect on the data"),
        ("at a bound", "at a bound"),
        ("limited", "limited by the instrument"),
        ("prior-dominated", "prior-dominated"),
        *(() if directions else (("unidentified", "unidentified"), ("weakly", "weakly identified"))),
    ):
        names = [name for name, word in words.items() if word.startswith(begins)]
        parts += [f"{listed(names)} {'are' if names[1:] else 'is'} {what}"] if names else []
    return Statement(f"{'; '.join(parts)}.", {"parameters": "not all"})


def _remarks(f: Assessment) -> list[Statement]:
    """Statements that qualify the verdict."""
    remarks = []
    if f.discrepancy is not None:
        term, without = f.discrepancy
        amplitude, exponent = 100.0 * float(term.amplitude), float(term.grazing_exponent)
        grazing = f" at normal incidence, {amplitude * 2.0**exponent:.2g} % at 60°" if exponent > 0.0 else ""
        half, difference = float(term.length_half), float(term.length_difference)
        words = f"length scales {half:.2g}° (half angle), {difference:.2g}° (difference angle)"
        words = f"Model discrepancy: {amplitude:.2g} % of the BSDF{grazing}; {words}. The reduced chi-square is"
        remarks.append(Statement(f"{words} {f.ratio:.3g} with it and {without:.3g} without."))
    if not f.resolved:
        error = numerical_error_in_words(f.fit.numerical_error)
        remarks.append(Statement(f"The numerical error of the model is {error}: a finer resolution may change values."))
    if f.noise_assumed:
        remarks.append(Statement(NOISE_ASSUMED))
    return remarks


def _residuals(f: Assessment) -> list[Statement]:
    """Whether the residuals are what the noise model predicts; with a discrepancy, all is about the whitened ones."""
    residuals = [Statement("Residuals are in units of their own scatter: a named residual has no noise model.")]
    if f.fit.is_posterior:
        freedom, claims = f.fit.degrees_of_freedom, {"size": f.size}
        words = f"The reduced chi-square of the {f.which} is {f.ratio:.3g} with {freedom} degrees of freedom, for"
        words = f"{words} which {f.expectation} predicts 1 ± {math.sqrt(2.0 / max(freedom, 1)):.2g}"
        if f.size == "small" and not f.correlated:
            words, claims = f"{words}: sigma is too large, or holds a common error", claims | {"noise": "too large"}
        claims |= {} if f.size == "expected" else {"residuals": "misfit"}
        residuals = [Statement(f"{words}.", claims)]
    if math.isfinite(f.lag_one):
        words = f"Neighbouring {f.which} are correlated by {f.lag_one:+.2f}; of {f.pairs} independent pairs, by 0 ±"
        cause = ": structure that is not in the model, or a smooth calibration error" if f.correlated else ""
        claims = {"residuals": "misfit"} if f.correlated else {}
        residuals.append(Statement(f"{words} {f.pairs**-0.5:.2g}{cause}.", claims))
    return residuals


# ---- what is said of a fit ----


class Verdict(NamedTuple):
    """The three sentences that open a report, remarks that qualify them, and whether there is no reservation."""

    sentences: list[str]
    remarks: list[str]
    sound: bool


def verdict(fit: Fit, facts: Assessment | None = None) -> Verdict:
    """How well the model describes the data, what the errors mean, and what the data identify."""
    facts = facts or assess(fit)
    said = statements(facts)
    claims = {topic: claim for one in said["verdict"] for topic, claim in one.claims.items()}
    remarks = [one.sentence for one in said["remarks"]]
    if (independent := fit.without_discrepancy) is not None:
        remarks.append(
            "The discrepancy term was added automatically because, with independent noise, neighbouring residuals "
            f"correlate by {independent.residual_autocorrelation:+.2f} ({independent.pairs} pairs). Set `discrepancy = "
            "false` to disable it."
        )
    sound = claims.get("description") == "yes" and claims["errors"] == "valid" and facts.identified and facts.resolved
    return Verdict([one.sentence for one in said["verdict"]], remarks, sound)


def summary(fit: Fit) -> list[str]:
    """A few lines for the terminal: the verdict, chi-square, and how the fit ended."""
    opening = verdict(fit)
    good = f"chi2/dof {fit.reduced_chi_square:.4g} ({fit.chi_square:.6g} / {fit.degrees_of_freedom})"
    return [*opening.sentences, *opening.remarks, f"{good}; {fit.status}"]


def sampled(posterior: Posterior) -> list[str]:
    """How long the chain is, whether that is long enough for its estimates, and which modes it has."""
    steps, walkers = posterior.chain.shape[:2]
    longest, worst = float(np.max(posterior.autocorrelation_time)), float(np.max(posterior.r_hat))
    options = posterior.options
    words = [
        f"{walkers} walkers made {steps} steps; the first {posterior.burn_in} are burn-in, the others are "
        f"{(steps - posterior.burn_in) / longest:.0f} times the longest autocorrelation time of {longest:.0f} steps.",
        f"The effective sample size is at least {float(np.min(posterior.effective_samples)):.0f}; "
        f"{posterior.acceptance:.0%} of the proposals were accepted; R-hat is at most {worst:.3f}.",
    ]
    if posterior.modes:
        places = []
        for mode in posterior.modes:
            values = ", ".join(f"{name} {value:.4g}" for name, value in mode.values.items())
            places.append(f"{100.0 * mode.share:.2g} ± {100.0 * mode.error:.1g} % at {values}")
        words.append(f"The posterior has {len(places)} modes: {'; '.join(places)}. Estimates cover all of them.")
        if worst > options.r_hat:
            words.append(f"R-hat is above {options.r_hat:g}: the shares of the modes are uncertain.")
    if posterior.status:
        words.append(f"The sampler: {posterior.status}.")
    if not posterior.converged:
        needed = f"{options.autocorrelation_times:g} autocorrelation times and R-hat of at most {options.r_hat:g}"
        what = "do not quote these estimates" if reportable(posterior) else "it gives no estimates yet"
        words.append(f"The chain has not converged: {needed} are needed: {what}.")
    return words


def reportable(posterior: Posterior) -> bool:
    """Whether estimates may be had from the chain."""
    return posterior.converged or posterior.allow_unconverged


def listed(names: Sequence[str]) -> str:
    """Names as words: "a, b and c"."""
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
