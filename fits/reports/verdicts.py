"""What a fit is worth, in plain sentences: how well the model explains the data, what the data cannot tell, how sure
the minimum is. The report prints them; the thresholds are stated in the sentences or here."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fits.optimise.identifiability import UNCONSTRAINED_BEYOND, UNIDENTIFIED_BEYOND, Direction
from fits.optimise.limits import instrument_limits, limited_with
from fits.optimise.options import DEFAULT
from fits.optimise.result import OUTCOMES
from fits.reports.agreement import (
    MISFIT_SIGMAS,
    agreement,
    describes,
    discrepancy,
    excess,
    misdescribed,
    noise_notes,
    without_discrepancy,
)
from fits.reports.diagnostics import ResidualStructure
from fits.reports.modes import errors_of_one, modes
from fits.sampling.convergence import MIXED

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.problem.problem import Problem
    from fits.sampling.posterior import Posterior

STRONG = 0.95  # correlation from which two parameters are said to trade against each other


def identifiability(fit: "Fit") -> dict[str, str]:
    """For each parameter, in a few words, whether the data determines it; directions count from 1, worst first.

    What counts is a parameter's own error along the directions that the data leave open, in units of its prior range: a
    parameter with a small share in a badly known direction may be well known itself.
    """
    names, correlation = list(fit.values), np.array(fit.correlation, dtype=float)
    np.fill_diagonal(correlation, 0.0)
    limits, limited = instrument_limits(fit), limited_with(fit)
    words = {}
    for index, name in enumerate(names):
        width = float(fit.problem.high[index] - fit.problem.low[index])
        error = fit.standard_errors[name]
        partner = int(np.nanargmax(np.abs(correlation[index]))) if np.isfinite(correlation[index]).any() else index
        if name in fit.insensitive:
            words[name] = "NO INFLUENCE on the data"
        elif name in limits:
            words[name] = f"LIMITED by the instrument: alpha below {limits[name]:.2g}"
        elif name in fit.at_bound:
            words[name] = "AT BOUND"
        elif name in limited:
            words[name] = f"LIMITED by the instrument: moves with {limited[name][0]}"
        elif math.hypot(*(own := [one.error_of(name) for one in fit.unidentified])) > UNIDENTIFIED_BEYOND:
            kind = "unconstrained by the data" if math.hypot(*own) > UNCONSTRAINED_BEYOND else "weakly constrained"
            words[name] = f"{kind}: see direction {int(np.argmax(own)) + 1}"
        elif not math.isfinite(error):
            words[name] = "not determined"
        elif error > 0.3 * width:
            words[name] = "weakly constrained: error near the width of the bounds"
        elif abs(correlation[index, partner]) >= STRONG:
            words[name] = f"trades with {names[partner]} {correlation[index, partner]:+.2f}"
        else:
            words[name] = "yes"
    return words


def in_short(fit: "Fit", structure: ResidualStructure) -> tuple[list[str], bool]:
    """The verdict in a few sentences, and whether it is without reservation."""
    sentences = [] if fit.converged else ["The fit did not converge: these are the best values seen, not a minimum."]
    close, undescribed, notes = agreement(fit), misdescribed(fit), noise_notes(fit.problem)
    if not fit.is_posterior:
        sentences.append("Fitted with a named residual, not a likelihood: the errors are only indicative.")
    elif excess(fit.chi_square, fit.degrees_of_freedom) > MISFIT_SIGMAS:
        sentences.append(
            f"The model does not explain the data to within its noise (chi-square per degree of freedom "
            f"{fit.reduced_chi_square:.3g}): the quoted errors are too small."
        )
    elif structure.lag_one_sigma > MISFIT_SIGMAS and not fit.problem.noise.discrepancy:
        sentences.append(
            "The residuals are of the expected size, but neighbours are correlated: the quoted errors are too small."
        )
    sentences += discrepancy(fit)
    if fit.numerical_error is not None and not fit.numerical_error <= DEFAULT.numerical_error:
        sentences.append(f"The numerical error of the model is {numerical_error(fit)}: a finer resolution may differ.")
    for name, least in instrument_limits(fit).items():
        sentences.append(f"{name} is limited by the instrument: lobes below {least:.2g} are not resolved.")
    for name, (roughness, errors) in limited_with(fit).items():
        sentences.append(
            f"{name} is limited by the instrument with {roughness}: up to that width it moves by {errors:.2g} of its "
            "standard errors."
        )
    if fit.at_bound:
        sentences.append(f"At a bound: {', '.join(fit.at_bound)}.")
    if fit.insensitive:
        sentences.append(f"Without influence on the data: {', '.join(fit.insensitive)}.")
    for combination in fit.unidentified[:1]:
        sentences.append(f"{_not_separated(combination)}{' (and more)' if len(fit.unidentified) > 1 else ''}.")
    if not undescribed:
        sentences += errors_of_one(fit)
    if undescribed or sentences:
        return [*undescribed, *close, *notes, *sentences], False
    return [
        *close,
        *notes,
        "The model explains the data to within its noise, and the data resolve every parameter.",
    ], True


def outcome(fit: "Fit", structure: ResidualStructure) -> list[str]:
    """A few lines for the terminal: the verdict, how good, how sure, and what the data leave open."""
    lines, _ = in_short(fit, structure)
    good = f"chi2/dof {fit.reduced_chi_square:.4g} ({fit.chi_square:.6g} / {fit.degrees_of_freedom})"
    if fit.problem.noise.discrepancy:
        good = f"{good} with the discrepancy term, {without_discrepancy(fit):.4g} without"
    starts = f"{fit.minima[0].count} of {_started(fit)} ended here"
    others = f", other local minima that fit equally well: {len(fit.alternatives)}" if describes(fit) else ""
    accurate = f"; numerical error of the model: {numerical_error(fit)}" if fit.resolution else ""
    return [*lines, f"{good}; {starts}{others}{accurate}"]


def noise_in_words(problem: "Problem") -> str:
    """The noise model of a problem in one line."""
    noise, parts = problem.noise, []
    if noise.use_sigma and problem.data.sigma is not None:
        parts.append("the file's own sigma")
    for level, unit in (("relative", "of the model's value"), ("floor", "1/sr")):
        value = float(np.asarray(getattr(problem.build(problem.start), level)))
        if f"noise.{level}" in problem.names:
            parts.append(f"a fitted {level} part")
        elif value > 0.0:
            assumed = " (assumed)" if level == "relative" and problem.noise_is_assumed else ""
            parts.append(f"{value:.3g} {unit}{assumed}")
    if noise.discrepancy:
        parts.append("a model discrepancy (Gaussian process)")
    tails = (
        "Gaussian" if noise.tails == "gaussian" else f"Student-t with {noise.degrees_of_freedom:g} degrees of freedom"
    )
    return f"{', '.join(parts)}, added in quadrature; {tails}" if len(parts) > 1 else f"{''.join(parts)}; {tails}"


def scale_in_words(problem: "Problem") -> str:
    """What the common calibration factor of a problem is, in a few words."""
    if problem.scale is None:
        return "fixed at 1"
    return (
        f"fixed at {problem.scale:g}" if isinstance(problem.scale, int | float) else "fitted, see the table of values"
    )


def transport_in_words(fit: "Fit") -> str:
    """The transport of a fit, and its resolution."""
    transport = fit.problem.transport
    name = transport if isinstance(transport, str) else type(transport).__name__
    return name if fit.resolution is None else f"{name}, {fit.resolution}"


def numerical_error(fit: "Fit") -> str:
    """How far the resolution keeps the model from what it should be, in a few words."""
    error = fit.numerical_error
    return "not known" if error is None or not math.isfinite(error) else f"{error:.2g} sigma at most"


def listed(names: Sequence[str]) -> str:
    """Names as words: "a, b and c"."""
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def _not_separated(combination: Direction) -> str:
    error = {name: combination.error_of(name) for name in combination.weights}
    names = [name for name in error if error[name] > UNIDENTIFIED_BEYOND] or [max(error, key=lambda name: error[name])]
    if len(names) > 1:
        return f"The data do not separate {listed(names)}"
    return f"The data {'do not determine' if combination.unconstrained else 'weakly constrain'} {names[0]}"


def determines(fit: "Fit") -> list[str]:
    """What the data leave open: condition number, combinations they do not separate, parameters at a bound."""
    sentences = [f"The condition number of the scaled problem is {fit.condition_number:.3g}."]
    if fit.insensitive:
        sentences.append(
            f"Without influence on the data: {', '.join(fit.insensitive)}. Any value explains them as well."
        )
    if fit.unidentified:
        sentences.append(
            f"{len(fit.unidentified)} of {len(fit.vector)} principal directions of parameter space are constrained by "
            f"the data to no better than {100.0 * UNIDENTIFIED_BEYOND:g} % of the prior range; there, priors dominate."
        )
    else:
        sentences.append(
            "The data constrain every principal direction of parameter space to better than "
            f"{100.0 * UNIDENTIFIED_BEYOND:g} % of the prior range."
        )
    if fit.at_bound:
        sentences.append(
            f"At a bound: {', '.join(fit.at_bound)}. The best value may lie beyond it. Parameters at a bound have no "
            "standard error; the other errors are conditional on them being fixed there."
        )
    return sentences


def starts_in_words(fit: "Fit") -> str:
    """How many starts there were, and where they ended, in one line."""
    if not fit.start_outcomes:
        return "not recorded"
    run = ", ".join(f"{name} {fit.settings[name]}" for name in ("seed", "solver") if name in fit.settings)
    where = ", ".join(f"{fit.start_outcomes[key]} {word}" for key, word in OUTCOMES.items() if fit.start_outcomes[key])
    ran = sum(fit.start_outcomes.values())
    if not _refitted(fit):
        return f"{ran} ({run}): {where}"
    given = fit.settings.get("starts", "?")
    return f"{given} with independent noise ({run}), then {ran} with the discrepancy term: {where}"


def _refitted(fit: "Fit") -> bool:
    """Whether it was fitted once more, with a model discrepancy, from starts of its own: see `shared_errors.points`."""
    return fit.without_discrepancy is not None


def _started(fit: "Fit") -> str:
    """How many starts led to the fit, in words."""
    return f"{sum(fit.start_outcomes.values())} starts{' with the discrepancy term' if _refitted(fit) else ''}"


def minima(fit: "Fit") -> list[str]:
    """How many starts agree on the minimum, and whether another local minimum fits equally well."""
    best, total = fit.minima[0], sum(fit.start_outcomes.values()) or sum(minimum.count for minimum in fit.minima)
    starts = _started(fit) if fit.start_outcomes else f"{total} starts"
    found = "no other was found" if len(fit.minima) == 1 else f"{len(fit.minima)} minima were found"
    sentences = [f"{best.count} of {starts} reached the best minimum; {found}."]
    if best.count == 1 and total > 1:
        sentences.append("Only one start found it: more starts may find a better one.")
    return [*sentences, *errors_of_one(fit)] if describes(fit) else sentences


def sampled(posterior: "Posterior") -> list[str]:
    """How long the chain is, and whether that is long enough for its estimates to mean anything."""
    steps, walkers = posterior.chain.shape[:2]
    longest, worst = float(np.max(posterior.autocorrelation_time)), float(np.max(posterior.r_hat))
    sentences = [
        f"{walkers} walkers made {steps} steps; the first {posterior.burn_in} are left out, and the rest is "
        f"{(steps - posterior.burn_in) / longest:.0f} times the longest autocorrelation time of {longest:.0f} steps.",
        f"The effective sample size is at least {float(np.min(posterior.effective_samples)):.0f}; "
        f"{posterior.acceptance:.0%} of the proposals were accepted; R-hat is at most {worst:.3f}.",
        *modes(posterior),
    ]
    if posterior.status:
        sentences.append(f"The sampler: {posterior.status}.")
    if not posterior.converged:
        sentences.append(
            "The chain is too short (under 50 autocorrelation times, or these still change), or walkers do not tell "
            f"the same (R-hat above {MIXED:g}): "
            + ("do not quote these estimates." if reportable(posterior) else "it gives no estimates yet.")
        )
    return sentences


def reportable(posterior: "Posterior") -> bool:
    """Whether estimates may be had from the chain."""
    return posterior.converged or posterior.allow_unconverged
