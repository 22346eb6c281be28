"""How far a fitted map can be relied on, in plain sentences; thresholds are those of its `MapOptions`."""

import html
import math
from typing import Any

from fits.maps.fitted_map import FittedMap, Summary, summarise
from fits.maps.report.tables import quartile_table, share
from fits.reports.tables import html_table
from fits.reports.verdicts import listed


def verdict(found: Summary, map: FittedMap) -> tuple[list[str], bool]:
    """A few sentences, and whether they are without reservation."""
    words, fine = _extent(found)
    if not found.fitted:
        return [*words, "No texel is fitted."], False
    counts = found.counts
    fine &= counts["converged"] >= map.option("converged_share") * (found.fitted + counts["failed"])
    words.append(f"{share(counts['converged'], found.fitted)} of the fitted texels converged.")
    explanation, explains = _chi_square(found, map)
    words += explanation
    if counts["at_bound"]:
        most = sorted(((count, name) for name, count in found.at_bound.items() if count), reverse=True)[:3]
        which = f" ({', '.join(f'{name} in {share(count, found.fitted)}' for count, name in most)})" if most else ""
        words.append(f"At a bound: {share(counts['at_bound'], found.fitted)} of the fitted texels{which}.")
    else:
        words.append("No texel is at a bound.")
    words.append(_poor(found, map, too_far=not explains and found.reduced_chi_square[1] > 1.0))
    if counts["unidentified"]:
        unidentified = share(counts["unidentified"], found.fitted)
        words.append(f"In {unidentified} of the fitted texels the data leave a parameter unidentified.")
    common, accurate = _common(map), _numerical(found, map)
    words += [*common, *accurate[0]]
    some = map.option("flagged_share") * found.fitted
    few = all(counts[flag] <= some for flag in ("at_bound", "poor", "unidentified"))
    return words, fine and explains and few and not common and accurate[1]


def fragment(map: FittedMap) -> str:
    """What a notebook shows, as HTML: the verdict, and the median of every parameter."""
    found = summarise(map)
    table = html_table(quartile_table(found, map)) if found.fitted else ""
    return f"<p>{html.escape(' '.join(verdict(found, map)[0]))}</p>{table}"


def degrees_of_freedom(measurements: Any, map: FittedMap) -> Any:
    """Measurements of a texel less the parameters that are its own."""
    return measurements - len(own_parameters(map))


def own_parameters(map: FittedMap) -> list[str]:
    """Those that differ from texel to texel."""
    return [name for name in map.names if name not in map.attributes.get("common", {})]


def _extent(found: Summary) -> tuple[list[str], bool]:
    """How much of the map there is, and why the rest is not."""
    reasons = {"masked": "masked", "too_few_measurements": "with too few measurements", "failed": "failed"}
    rest = [f"{found.counts[flag]:,} {words_of_flag}" for flag, words_of_flag in reasons.items() if found.counts[flag]]
    fitted = ", ".join([f"{found.fitted:,} are fitted", *rest])
    if found.there == found.texels:
        return [f"A map of {found.texels:,} texels: {fitted}."], True
    there = f"{found.there:,} of {found.texels:,} texels ({share(found.there, found.texels)}) are there"
    return [
        f"The map is not finished: {there}, and the same command resumes it.", f"Of what is there, {fitted}."
    ], False  # fmt: skip


def _chi_square(found: Summary, map: FittedMap) -> tuple[list[str], bool]:
    """Whether chi-square is what noise makes of it."""
    low, middle, high = found.reduced_chi_square
    if not math.isfinite(middle):
        return ["No texel has a chi-square: there are no more measurements than parameters."], False
    freedom = degrees_of_freedom(found.measurements[1], map)
    spread = math.sqrt(2.0 / freedom) if freedom > 0 else math.inf
    words = [
        f"Chi-square per degree of freedom is {middle:.3g} in the median texel, and between {low:.3g} and {high:.3g} "
        f"in half of them; the right model with the right noise gives 1 ± {spread:.2g}."
    ]
    far = map.option("chi_square_sigmas") * spread
    if middle > 1.0 + far:
        words.append("The model does not explain the data to within their noise: the errors are too small.")
    if middle < 1.0 - far:
        words.append("The data scatter less than the stated noise: the errors are too large.")
    return words, abs(middle - 1.0) <= far


def _poor(found: Summary, map: FittedMap, too_far: bool) -> str:
    """too_far: chi-square is not explained in the median texel, nor then in the pilot by which the flag is set."""
    poor, above = found.counts["poor"], (map.attributes.get("pilot") or {}).get("poor_above")
    limit = "" if above is None else f"above {float(above):.3g}, "
    if poor:
        return (
            f"Poor: {share(poor, found.fitted)} of the fitted texels, whose chi-square is {limit}more than noise and "
            "the pilot explain."
        )
    if too_far:
        return (
            f"No texel stands out: chi-square is nowhere {limit}more than the pilot leads to expect, whose texels the "
            "model does not explain either."
        )
    return "No texel is poor: chi-square is nowhere above what noise and the pilot explain."


def _common(map: FittedMap) -> list[str]:
    """What is wrong with the parameters that all texels have in common."""
    common, words = map.attributes.get("common", {}), []
    if not all(one["converged"] for one in common.values()):
        words.append("The joint fit of common parameters has not converged: all else is fitted with wrong values.")
    unknown = [name for name, one in common.items() if math.isinf(float(one["error"]))]
    if unknown:
        words.append(f"The pilot leaves {listed(unknown)}, common to all texels, unidentified.")
    return words


def _numerical(found: Summary, map: FittedMap) -> tuple[list[str], bool]:
    if found.numerical_error is None or not math.isfinite(found.numerical_error[1]):
        return [], True
    _, middle, _, most = found.numerical_error
    words = f"The numerical error of the model is {middle:.2g} standard deviations in the median texel, and in 95 % of"
    words += f" them below {most:.2g}"
    fine = most <= map.option("numerical_error")
    return [f"{words}." if fine else f"{words}: a finer resolution may give other values."], fine
