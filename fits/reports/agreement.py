"""How well a fitted model agrees with the data, in plain sentences: the misfit, the noise, and the discrepancy term."""

import math
from typing import TYPE_CHECKING

import numpy as np

from fits.data.checks import repeats
from fits.data.totals import Totals
from fits.problem.model import Density
from fits.problem.noise import DEFAULT_RELATIVE
from fits.problem.parameters import is_free
from fits.reports.diagnostics import ResidualStructure

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.problem.problem import Problem

MISFIT_SIGMAS = 3.0
"""Chi-square so many of its own standard deviations away from its expectation is not chance."""

LARGE_FACTOR = 1.5
"""From which a misfit is said as a factor: as a share of the model it saturates at 100 %."""

UNDESCRIBED = 1.5
"""Median misfit, in standard deviations of the stated noise, above which a stack does not describe the sample; that of
the right one is 0.67."""


def describes(fit: "Fit") -> bool:
    """Whether the stack alone comes as near to the data as the stated noise lets expect, but for a moderate misfit."""
    if not fit.is_posterior:
        return True  # nothing is stated
    offsets = np.abs(np.asarray(fit.problem.call(Density.offsets_at, fit.vector, fit.predicted), float))
    significant = excess(float(np.sum(offsets**2)), fit.degrees_of_freedom) > MISFIT_SIGMAS
    return not (significant and float(np.median(offsets)) > UNDESCRIBED)


def misdescribed(fit: "Fit") -> list[str]:
    """That the stack does not describe the sample, if so: the first thing to know."""
    if describes(fit):
        return []
    values = fit.problem.data.used().values
    sigma = np.asarray(fit.problem.call(Density.sigma_at, fit.vector, values))  # of what was measured: a share of that
    lit = values > 0.0
    if not lit.any():
        return ["This stack does not describe the sample."]
    noise = float(np.median(sigma[lit] / values[lit]))
    return [
        f"This stack does not describe the sample: median misfit {apart(factors(fit, 0.5)[0])}, stated noise "
        f"{100.0 * noise:.2g} %."
    ]


def agreement(fit: "Fit") -> list[str]:
    """How near the stack alone comes to the readings, whatever their noise; nothing, where none is above zero."""
    values = fit.problem.data.used().values
    if not (values > 0.0).any():
        return []
    half, most = map(apart, factors(fit, 0.5, 0.95))
    which = "stack alone" if fit.problem.noise.discrepancy else "model"
    return [f"Half of the {values.size:,} readings are within {half} of the {which}, 95 % of them within {most}."]


def factors(fit: "Fit", *shares: float) -> tuple[float, ...]:
    """Within which factor of the stack alone these shares of the positive readings are; infinite where it is 0."""
    values = fit.problem.data.used().values
    lit = values > 0.0
    with np.errstate(divide="ignore", over="ignore"):
        ratio = np.where(fit.predicted[lit] > 0.0, fit.predicted[lit] / values[lit], 0.0)
        factor = np.maximum(ratio, 1.0 / ratio)
    ordered = np.sort(factor)  # no interpolation: it would make NaN of two infinite ones
    return tuple(float(ordered[min(int(share * len(ordered)), len(ordered) - 1)]) for share in shares)


def apart(factor: float) -> str:
    """A factor in words: in percent while it is near 1."""
    if factor < LARGE_FACTOR:
        return f"{100.0 * (factor - 1.0):.2g} %"
    return f"a factor of {factor:.2g}" if math.isfinite(factor) else "an infinite factor (it is 0 there)"


def discrepancy(fit: "Fit") -> list[str]:
    """How large the model-discrepancy term is and how far it is correlated; nothing, where there is none."""
    at = fit.problem.build(fit.vector).correlation
    if at is None:
        return []
    left, whole = (
        float(np.sum(np.square(fit.problem.call(offsets, fit.vector, fit.predicted))))
        for offsets in (Density.offsets_after_discrepancy_at, Density.offsets_at)
    )
    share = 1.0 - left / whole if whole > 0.0 else 0.0
    size = 100.0 * float(at.amplitude)
    grazing = (
        f" at normal incidence and {size * 2.0 ** float(at.grazing_exponent):.2g} % at 60°"
        if at.grazing_exponent > 0.0
        else ""
    )
    return [
        f"The model-discrepancy term (a Gaussian process) has a standard deviation of {size:.2g} % of the BRDF{grazing}"
        f" and length scales of {float(at.length_half):.2g}° (half angle) and {float(at.length_difference):.2g}° "
        f"(difference angle). It absorbs {100.0 * share:.3g} % of the residual sum of squares. Parameter uncertainties "
        "and prediction intervals include this term.",
        *_added_automatically(fit),
    ]


def _added_automatically(fit: "Fit") -> list[str]:
    found = fit.without_discrepancy
    if found is None:
        return []
    return [
        "It was added automatically because, with independent noise, neighbouring residuals correlate by "
        f"{found.residual_autocorrelation:+.2f} ({found.pairs} pairs; chi-square per degree of freedom "
        f"{without_discrepancy(fit):.3g}). Set `discrepancy = false` to disable it."
    ]


def without_discrepancy(fit: "Fit") -> float:
    """Chi-square per degree of freedom with independent noise: as fitted so, else with these parameters."""
    if fit.without_discrepancy is not None:
        square, freedom = fit.without_discrepancy.chi_square, fit.without_discrepancy.degrees_of_freedom
    else:
        square = float(np.sum(np.square(fit.problem.call(Density.offsets_at, fit.vector, fit.predicted))))
        freedom = fit.degrees_of_freedom
    return square / freedom if freedom > 0 else math.nan


def excess(square: float, freedom: int) -> float:
    """Chi-square above its expectation, in its own standard deviations."""
    return (square / freedom - 1.0) / math.sqrt(2.0 / freedom) if freedom > 0 else math.nan


def noise_notes(problem: "Problem") -> list[str]:
    """What of the noise was assumed without being told, or counts beside the file's own."""
    noise, used = problem.noise, problem.data.used()
    if problem.objective != "likelihood":
        return []
    if problem.noise_is_assumed:
        found = None if isinstance(used, Totals) else repeats(used)
        words = f"Nothing is stated of the noise: {100.0 * DEFAULT_RELATIVE:g} % of the model's value is assumed."
        if found is not None and found.noise > 0.0:
            return [
                f"{words} {found.count:,} repeated readings scatter by about {100.0 * found.noise:.2g} %: "
                f"`relative = {found.noise:.2g}` under [noise], or `--noise` of a search, states that."
            ]
        return [
            f"{words} State it as `relative` under [noise], or `--noise` of a search; given start, low and high there, "
            "it is fitted."
        ]
    if used.sigma is None or not noise.use_sigma or noise.relative in (None, 0):
        return []
    lit = used.values > 0.0
    own = f", {100.0 * float(np.median(used.sigma[lit] / used.values[lit])):.2g} % in the median" if lit.any() else ""
    more = "a fitted relative part" if is_free(noise.relative) else f"relative = {noise.relative:g}"
    return [
        f"Noise: the data's own sigma{own}, and {more} beside it, added in quadrature. Leave `relative` out if sigma "
        "holds it already; `use_sigma = false` leaves sigma out."
    ]


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
    correlated = bool(fit.problem.noise.discrepancy)
    term = " with the discrepancy term" if correlated else ""
    sentences = [
        *misdescribed(fit),
        *discrepancy(fit),
        f"Chi-square per degree of freedom{term} is {ratio:.3g} ({fit.chi_square:.5g} over {freedom}); the right model "
        f"with the right noise gives 1 ± {math.sqrt(2.0 / max(freedom, 1)):.2g}.",
    ]
    beyond, size = excess(fit.chi_square, freedom), 1.0
    if abs(beyond) > MISFIT_SIGMAS:
        size = math.sqrt(ratio)
    if beyond > MISFIT_SIGMAS:
        sentences.append("The model does not explain the data to within the stated noise, as the quoted errors assume.")
    elif beyond < -MISFIT_SIGMAS:
        sentences.append(
            "The data scatter less than the stated noise: sigma is too large, or holds an error common to all readings."
        )
    elif not correlated:
        sentences.append("The overall size of the residuals is what the stated noise predicts.")
    return sentences + _structure(structure, size, correlated)


def _structure(structure: ResidualStructure, size: float = 1.0, whitened: bool = False) -> list[str]:
    """Sentences on residuals; size: by what that of all of them makes the quoted errors too small."""
    sentences = []
    kind = "Residuals whitened by the fitted covariance have" if whitened else "Residuals have"
    if math.isfinite(structure.lag_one):
        sentences.append(
            f"{kind} a root mean square of {structure.rms:.2f}, and neighbours in angle are correlated by "
            f"{structure.lag_one:+.2f}; the assumed model gives 1 and 0, with standard errors of "
            f"{1.0 / math.sqrt(2.0 * structure.count):.2g} and {1.0 / math.sqrt(structure.pairs):.2g} "
            f"({structure.pairs} pairs)."
        )
    sentences += _net(structure, size)
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


def _net(structure: ResidualStructure, size: float) -> list[str]:
    """What size and correlation of the residuals together say of the quoted errors; nothing, if both are as assumed."""
    share = structure.independent_share if structure.lag_one_sigma > MISFIT_SIGMAS else 1.0
    net = size / math.sqrt(share)
    if net == 1.0:
        return []
    parts = []
    if size != 1.0:
        parts.append(f"{size:.2g} for the size of the residuals")
    if share != 1.0:
        independent = max(1.0, structure.count * share)
        parts.append(
            f"{share**-0.5:.2g} for their correlation, which makes {structure.count} of them worth about "
            f"{independent:.0f} independent ones"
        )
    small = (
        f"too small by a factor of about {net:.2g}" if net > 1.0 else f"too large by a factor of about {1.0 / net:.2g}"
    )
    words = [f"So the quoted errors are {small} ({' times '.join(parts)})."]
    if share != 1.0:
        words.append("Such runs come from structure that the model lacks, or from a calibration error smooth in angle.")
    if net > 1.0:
        words.append("Even that does not account for what a wrong model does to the values themselves.")
    return [" ".join(words)]
