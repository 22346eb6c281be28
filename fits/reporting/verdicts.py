"""What a fit is worth, in plain sentences: how well the model explains the data, what the data cannot tell, how sure
the minimum is. The report prints them; the thresholds are stated in the sentences or here."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fits.inference.fit_result import ENDED
from fits.inference.identifiability import UNRESOLVED_BEYOND, Combination
from fits.inference.length import MIXED
from fits.inference.limits import instrument_limits, limited_with
from fits.inference.resolution import ENOUGH
from fits.reporting.diagnostics import ResidualStructure
from fits.reporting.modes import errors_of_one, modes

if TYPE_CHECKING:
    from fits.inference.fit_result import Fit
    from fits.inference.posterior import Posterior
    from fits.problem.problem import Problem

STRONG = 0.95  # correlation from which two parameters are said to trade against each other
MISFIT_SIGMAS = 3.0  # chi-square this many of its own standard deviations away from its expectation is not chance


def identifiability(fit: "Fit") -> dict[str, str]:
    """For each parameter, in a few words, whether the data determines it; combinations count from 1, worst first."""
    names, correlation = list(fit.values), np.array(fit.correlation, dtype=float)
    np.fill_diagonal(correlation, 0.0)
    limits, limited = instrument_limits(fit), limited_with(fit)
    worst = {name: place for place in range(len(fit.unresolved), 0, -1) for name in fit.unresolved[place - 1].weights}
    words = {}
    for index, name in enumerate(names):
        width = float(fit.problem.high[index] - fit.problem.low[index])
        error = fit.standard_errors[name]
        partner = int(np.nanargmax(np.abs(correlation[index]))) if np.isfinite(correlation[index]).any() else index
        if name in fit.without_influence:
            words[name] = "NO INFLUENCE on the data"
        elif name in limits:
            words[name] = f"LIMITED by the instrument: alpha below {limits[name]:.2g}"
        elif name in fit.at_bound:
            words[name] = "AT BOUND"
        elif name in limited:
            words[name] = f"LIMITED by the instrument: moves with {limited[name][0]}"
        elif name in worst:
            combination = fit.unresolved[worst[name] - 1]
            kind = "OPEN" if combination.open else "LOOSE"
            others = len(combination.weights) > 1
            words[name] = f"{kind}: combination {worst[name]}" if others else f"{kind}: hardly seen"
        elif not math.isfinite(error):
            words[name] = "not determined"
        elif error > 0.3 * width:
            words[name] = "barely: error near the width of the bounds"
        elif abs(correlation[index, partner]) >= STRONG:
            words[name] = f"trades with {names[partner]} {correlation[index, partner]:+.2f}"
        else:
            words[name] = "yes"
    return words


def explains(fit: "Fit", structure: ResidualStructure) -> list[str]:
    """Whether the residuals are what the noise model says they should be, and what follows for the quoted errors."""
    if not fit.is_posterior:
        return [
            "This fit minimised a named residual, not a likelihood: its cost has no absolute scale, so that chi-square "
            "says nothing about the noise. Errors are scaled by the scatter that is left, and are no posterior; "
            "in what follows, sigma stands for that scatter.",
            *_structure(structure),
        ]
    ratio, freedom = fit.reduced_chi_square, fit.degrees_of_freedom
    sentences = [
        *shared_errors(fit),
        f"Chi-square per degree of freedom is {ratio:.3g} ({fit.chi_square:.5g} over {freedom}); the right model with "
        f"the right noise gives 1 ± {math.sqrt(2.0 / max(freedom, 1)):.2g}.",
    ]
    if _excess(fit) > MISFIT_SIGMAS:
        sentences.append(
            "The model does not explain the data to within the stated noise. The quoted errors assume that it does, so "
            f"they are too small: scaling them to the scatter that is there multiplies them by {math.sqrt(ratio):.2g}, "
            "and even that does not account for what a wrong model does to the values themselves."
        )
    elif _excess(fit) < -MISFIT_SIGMAS:
        sentences.append(
            "The data scatters less than the stated noise: sigma is too large, or holds an error that all readings "
            f"share. For what is random, the quoted errors are too large by {1.0 / math.sqrt(ratio):.2g}."
        )
    else:
        sentences.append("The overall size of the residuals is what the stated noise predicts.")
    return sentences + _structure(structure)


def in_short(fit: "Fit", structure: ResidualStructure) -> tuple[list[str], bool]:
    """The verdict in a few sentences, and whether it is without reservation."""
    sentences = [] if fit.converged else ["The fit did not converge: these are the best values seen, not a minimum."]
    close = agreement(fit)
    if not fit.is_posterior:
        sentences.append("Fitted with a named residual, not a likelihood: the errors are only indicative.")
    elif _excess(fit) > MISFIT_SIGMAS:
        sentences.append(
            f"The model does not explain the data to within its noise (chi-square per degree of freedom "
            f"{fit.reduced_chi_square:.3g}): the quoted errors are too small."
        )
    elif structure.lag_one_sigma > MISFIT_SIGMAS and not fit.problem.noise.correlated:
        sentences.append(
            "The residuals are of the expected size, but neighbours are correlated: the quoted errors are too small."
        )
    sentences += shared_errors(fit)
    if fit.numerical_error is not None and not fit.numerical_error <= ENOUGH:
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
    if fit.without_influence:
        sentences.append(f"Without influence on the data: {', '.join(fit.without_influence)}.")
    for combination in fit.unresolved[:1]:
        sentences.append(f"{_not_separated(combination)}{' (and more)' if len(fit.unresolved) > 1 else ''}.")
    sentences += errors_of_one(fit)
    if sentences:
        return [*close, *sentences], False
    return [*close, "The model explains the data to within its noise, and the data resolve every parameter."], True


def agreement(fit: "Fit") -> list[str]:
    """How close the model comes to the readings, whatever their noise; nothing, where none is above zero."""
    values = fit.problem.data.used().values
    lit = values > 0.0
    if not lit.any():
        return []
    half, most = np.quantile(100.0 * np.abs(fit.predicted[lit] / values[lit] - 1.0), [0.5, 0.95])
    count = f"{values.size:,} readings"
    return [f"Half of the {count} are within {half:.2g} % of the model, 95 % of them within {most:.2g} %."]


def shared_errors(fit: "Fit") -> list[str]:
    """How large the errors of the model are that neighbouring readings share, and how far they reach; none, nothing."""
    at = fit.problem.build(fit.vector).correlation
    if at is None:
        return []
    scatter = float(np.sum(np.square(fit.problem.call("offsets_at", fit.vector, fit.predicted))))
    share = 1.0 - float(np.sum(fit.residuals**2)) / scatter if scatter > 0.0 else 0.0
    reach = f"{float(at.half):.2g} degrees of the half vector and {float(at.difference):.2g} of the difference"
    along = 100.0 * float(at.amplitude)
    grazing = f" along the normal and {along * 2.0 ** float(at.growth):.2g} % at 60 degrees" if at.growth > 0.0 else ""
    return [
        f"Neighbouring readings share errors of the model of {along:.2g} % of its value{grazing}, alike "
        f"over {reach}: {100.0 * share:.3g} % of the scatter about it. The errors of the parameters, and the "
        "bands of predictions, count them.",
        *_without_them(fit),
    ]


def _without_them(fit: "Fit") -> list[str]:
    """Why the fit counts what readings share, where it was left to the residuals."""
    if fit.alone is None:
        return []
    ratio = fit.alone.chi_square / fit.alone.degrees_of_freedom if fit.alone.degrees_of_freedom > 0 else math.nan
    return [
        "They are counted since without them residuals of neighbours in angle are correlated by "
        f"{fit.alone.alike:+.2f} ({fit.alone.pairs} pairs; chi-square per degree of freedom {ratio:.3g}); "
        "correlated = false leaves them out."
    ]


def outcome(fit: "Fit", structure: ResidualStructure) -> list[str]:
    """A few lines for the terminal: the verdict, how good, how sure, and what the data leave open."""
    lines, _ = in_short(fit, structure)
    good = f"chi2/dof {fit.reduced_chi_square:.4g} ({fit.chi_square:.6g} / {fit.degrees_of_freedom})"
    starts = f"{fit.minima[0].count} of {sum(fit.ended.values())} starts ended here"
    accurate = f"; numerical error of the model: {numerical_error(fit)}" if fit.resolution else ""
    return [*lines, f"{good}; {starts}, others as good: {len(fit.alternatives)}{accurate}"]


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
            parts.append(f"{value:.3g} {unit}")
    if noise.correlated:
        parts.append("errors that neighbouring readings share")
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


def _not_separated(combination: Combination) -> str:
    names = list(combination.weights)
    return f"The data do not {'separate' if len(names) > 1 else 'determine'} {listed(names)}"


def _excess(fit: "Fit") -> float:
    """Chi-square above its expectation, in its own standard deviations."""
    freedom = fit.degrees_of_freedom
    return (fit.reduced_chi_square - 1.0) / math.sqrt(2.0 / freedom) if freedom > 0 else math.nan


def _structure(structure: ResidualStructure) -> list[str]:
    sentences = []
    if math.isfinite(structure.lag_one):
        sentences.append(
            f"Neighbours in angle have residuals correlated by {structure.lag_one:+.2f}, which is "
            f"{structure.lag_one_sigma:+.1f} standard errors from the 0 of independent noise ({structure.pairs} pairs)."
        )
        if structure.lag_one_sigma > MISFIT_SIGMAS:
            independent = max(1.0, structure.count * structure.independent_share)
            sentences.append(
                f"So the {structure.count} residuals are worth about {independent:.0f} independent ones, which alone "
                f"makes the quoted errors too small by about {structure.independent_share**-0.5:.2g}. Such runs come "
                "from structure that the model lacks, or from a calibration error that is smooth in angle."
            )
    if len(structure.by_incidence) > 1:
        worst = structure.worst
        sentences.append(
            f"The worst incidence is {worst.theta:g}°: root mean square {worst.rms:.2f} sigma, mean "
            f"{worst.mean:+.2f} sigma."
        )
    sentences.append(
        f"{structure.beyond_three:.1%} of the residuals are beyond 3 sigma (a normal law has 0.3 %); their "
        f"distribution is at most {structure.normal_distance:.2f} away from the unit normal one "
        "(Kolmogorov-Smirnov distance)."
    )
    return sentences


def determines(fit: "Fit") -> list[str]:
    """What the data leave open: condition number, combinations they do not separate, parameters at a bound."""
    sentences = [f"The condition number of the scaled problem is {fit.condition_number:.3g}."]
    if fit.without_influence:
        sentences.append(
            f"Without influence on the data: {', '.join(fit.without_influence)}. Any value explains them as well."
        )
    if fit.unresolved:
        sentences.append(
            f"The data alone know {len(fit.unresolved)} of {len(fit.vector)} combinations of parameters to no better "
            f"than {UNRESOLVED_BEYOND:.0%} of their bounds: only bounds and priors hold them."
        )
    else:
        sentences.append(
            f"The data alone know every combination of parameters to better than {UNRESOLVED_BEYOND:.0%} of its bounds."
        )
    if fit.at_bound:
        sentences.append(
            f"At a bound: {', '.join(fit.at_bound)}. The best value may lie beyond it; it has no symmetric error, and "
            "the errors of the others hold with it kept there."
        )
    return sentences


def starts_in_words(fit: "Fit") -> str:
    """How many starts there were, and where they ended, in one line."""
    if not fit.ended:
        return "not recorded"
    run = ", ".join(f"{name} {value}" for name, value in fit.settings.items() if name != "starts")
    where = ", ".join(f"{fit.ended[key]} {word}" for key, word in ENDED.items() if fit.ended[key])
    return f"{sum(fit.ended.values())} ({run}): {where}"


def minima(fit: "Fit") -> list[str]:
    """How many starts agree on the minimum, and whether another stack explains the data as well."""
    best, total = fit.minima[0], sum(fit.ended.values()) or sum(minimum.count for minimum in fit.minima)
    found = "no other was found" if len(fit.minima) == 1 else f"{len(fit.minima)} minima were found"
    sentences = [f"{best.count} of {total} starts reached the best minimum; {found}."]
    if best.count == 1 and total > 1:
        sentences.append("Only one start found it: more starts may find a better one.")
    return [*sentences, *errors_of_one(fit)]


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
    return posterior.converged or posterior.allow_short
