"""What a fitted map is worth, in plain sentences; thresholds are stated in the sentences or here."""

import math
from typing import Any

from fits.maps.fitted_map import FittedMap
from fits.maps.report.tables import share
from fits.maps.summary import Summary
from fits.reports.verdicts import listed

CONVERGED = 0.99
"""Share of the texels with enough readings that must converge."""

SOME = 0.05
"""Share of the fitted texels that may be at a bound, poor or not resolved in a map that is fine."""

ENOUGH = 0.1
"""Numerical error of the model, in standard deviations of the readings, that is small."""

SIGMAS = 3.0
"""Chi-square of the median texel this many of a texel's own standard deviations from 1 is no chance."""


def in_short(found: Summary, map: FittedMap) -> tuple[list[str], bool]:
    """The verdict in a few sentences, and whether it is without reservation."""
    words, fine = _extent(found)
    if not found.fitted:
        return [*words, "No texel is fitted."], False
    good = found.counts["converged"] >= CONVERGED * (found.fitted + found.counts["failed"])
    words.append(f"{share(found.counts['converged'], found.fitted)} of the fitted texels converged.")
    explained, explains = _explained(found, map)
    words += explained
    bounded = found.counts["at_bound"]
    if bounded:
        most = sorted(((count, name) for name, count in found.at_bound.items() if count), reverse=True)[:3]
        which = f" ({', '.join(f'{name} in {share(count, found.fitted)}' for count, name in most)})" if most else ""
        words.append(f"At a bound: {share(bounded, found.fitted)} of the fitted texels{which}.")
    else:
        words.append("No texel is at a bound.")
    words.append(_poor(found, map, too_far=not explains and found.reduced_chi_square[1] > 1.0))
    if found.counts["unidentified"]:
        unidentified = share(found.counts["unidentified"], found.fitted)
        words.append(f"In {unidentified} of the fitted texels the readings do not resolve every parameter.")
    shared, accurate = _shared(map), _numerical(found)
    words += [*shared, *accurate[0]]
    few = all(found.counts[flag] <= SOME * found.fitted for flag in ("at_bound", "poor", "unidentified"))
    return words, fine and good and explains and few and not shared and accurate[1]


def _extent(found: Summary) -> tuple[list[str], bool]:
    """How much of the map there is, and why the rest is not."""
    reasons = {"masked": "masked", "too_few_readings": "with too few readings", "failed": "failed"}
    rest = [f"{found.counts[flag]:,} {told}" for flag, told in reasons.items() if found.counts[flag]]
    fitted = ", ".join([f"{found.fitted:,} are fitted", *rest])
    if found.there == found.texels:
        return [f"A map of {found.texels:,} texels: {fitted}."], True
    there = f"{found.there:,} of {found.texels:,} texels ({share(found.there, found.texels)}) are there"
    return [
        f"The map is not finished: {there}, and the same command goes on with it.",
        f"Of what is there, {fitted}.",
    ], False


def _explained(found: Summary, map: FittedMap) -> tuple[list[str], bool]:
    """Whether chi-square is what noise makes of it."""
    low, middle, high = found.reduced_chi_square
    if not math.isfinite(middle):
        return ["No texel has a chi-square: there are no more readings than parameters."], False
    freedom = degrees_of_freedom(found.readings[1], map)
    spread = math.sqrt(2.0 / freedom) if freedom > 0 else math.inf
    words = (
        f"Chi-square per degree of freedom is {middle:.3g} in the median texel, and between {low:.3g} and {high:.3g} "
        f"in half of them; the right model with the right noise gives 1 ± {spread:.2g}."
    )
    if middle > 1.0 + SIGMAS * spread:
        return [
            words,
            "The model does not explain the readings to within their noise: the errors are too small.",
        ], False
    if middle < 1.0 - SIGMAS * spread:
        return [words, "The readings scatter less than the stated noise: the errors are too large."], False
    return [words], True


def degrees_of_freedom(readings: Any, map: FittedMap) -> Any:
    """Readings of a texel less the parameters that are its own."""
    shared = map.attributes.get("shared") or {}
    return readings - sum(name not in shared for name in map.names)


def _poor(found: Summary, map: FittedMap, too_far: bool) -> str:
    """too_far: chi-square is not explained in the median texel, nor then in the pilot by which the flag is set."""
    poor, above = found.counts["poor"], (map.attributes.get("pilot") or {}).get("poor_above")
    if not poor and not too_far:
        return "No texel is poor: chi-square is nowhere above what noise and the pilot explain."
    if not poor:
        limit = "" if above is None else f"above {float(above):.3g}, "
        return (
            f"No texel stands out: chi-square is nowhere {limit}more than the pilot leads to expect, whose texels the "
            "model does not explain either."
        )
    limit = "" if above is None else f"above {float(above):.3g}, "
    return (
        f"Poor: {share(poor, found.fitted)} of the fitted texels, whose chi-square is {limit}more than noise and the "
        "pilot explain."
    )


def _shared(map: FittedMap) -> list[str]:
    """What is wrong with the numbers that all texels have in common."""
    shared, words = map.attributes.get("shared") or {}, []
    if not all(one.get("converged", True) for one in shared.values()):
        words.append("The joint fit of what texels share has not converged: all else is fitted with wrong values.")
    unknown = [name for name, one in shared.items() if math.isinf(float(one["error"]))]
    if unknown:
        words.append(f"The sample does not know {listed(unknown)}, which texels share.")
    return words


def _numerical(found: Summary) -> tuple[list[str], bool]:
    if found.numerical_error is None or not math.isfinite(found.numerical_error[1]):
        return [], True
    middle, most = found.numerical_error[1], found.numerical_error[3]
    words = f"The numerical error of the model is {middle:.2g} standard deviations in the median texel, and in 95 % of"
    words += f" them below {most:.2g}"
    if most <= ENOUGH:
        return [f"{words}."], True
    return [f"{words}: a finer resolution may give other values."], False
