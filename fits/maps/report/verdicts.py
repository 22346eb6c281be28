"""How far a fitted map can be relied on, in plain sentences; thresholds are those of its `MapOptions`."""

import html
import math
from typing import Any

from fits.maps.report.tables import Summary, quartile_table, share, summarise
from fits.maps.store import FittedMap
from fits.reports.tables import html_table
from fits.reports.verdicts import listed


def verdict(summary: Summary, map: FittedMap) -> tuple[list[str], bool]:
    """A few sentences, and whether they are without reservation."""
    counts, some = summary.counts, map.option("flagged_share") * summary.fitted

    # how much of the map there is, and why the rest is not
    reasons = {"masked": "masked", "too_few_measurements": "with too few measurements", "failed": "failed"}
    rest = [f"{counts[flag]:,} {said}" for flag, said in reasons.items() if counts[flag]]
    fitted, fine = ", ".join([f"{summary.fitted:,} are fitted", *rest]), summary.there == summary.texels
    if fine:
        words = [f"A map of {summary.texels:,} texels: {fitted}."]
    else:
        there = f"{summary.there:,} of {summary.texels:,} texels ({share(summary.there, summary.texels)}) are there"
        words = [f"The map is not finished: {there}, and the same command resumes it.", f"Of what is there, {fitted}."]
    if not summary.fitted:
        return [*words, "No texel is fitted."], False
    fine &= counts["converged"] >= map.option("converged_share") * (summary.fitted + counts["failed"])
    words.append(f"{share(counts['converged'], summary.fitted)} of the fitted texels converged.")

    said, explains = _chi_square(summary, map)
    words += said

    # flags
    if counts["at_bound"]:
        most = sorted(((count, name) for name, count in summary.at_bound.items() if count), reverse=True)[:3]
        which = f" ({', '.join(f'{name} in {share(count, summary.fitted)}' for count, name in most)})" if most else ""
        words.append(f"At a bound: {share(counts['at_bound'], summary.fitted)} of the fitted texels{which}.")
    else:
        words.append("No texel is at a bound.")
    above = (map.attributes.get("pilot") or {}).get("poor_above")
    limit = "" if above is None else f"above {float(above):.3g}, "
    if counts["poor"]:
        poor = share(counts["poor"], summary.fitted)
        words.append(f"Poor: {poor} of the fitted texels: chi-square is {limit}more than noise and the pilot explain.")
    elif (
        not explains and summary.reduced_chi_square[1] > 1.0
    ):  # nor then does the model explain the pilot, by which the flag is set
        words.append(f"No texel stands out: chi-square is nowhere {limit}more than in the pilot.")
    else:
        words.append("No texel is poor: chi-square is nowhere above what noise and the pilot explain.")
    if counts["unidentified"]:
        unidentified = share(counts["unidentified"], summary.fitted)
        words.append(f"In {unidentified} of the fitted texels the data leave a parameter unidentified.")
    fine &= explains and all(counts[flag] <= some for flag in ("at_bound", "poor", "unidentified"))

    # what the pilot says
    common = map.attributes.get("common", {})
    if not all(one["converged"] for one in common.values()):
        words.append("The joint fit of common parameters has not converged: all else is fitted with wrong values.")
        fine = False
    if unknown := [name for name, one in common.items() if math.isinf(float(one["error"]))]:
        words.append(f"The pilot leaves {listed(unknown)}, common to all texels, unidentified.")
        fine = False
    if (error := map.numerical_error) is not None:
        small = error <= map.option("numerical_error")
        but = "" if small else ": a finer resolution may give other values"
        words.append(f"The numerical error of the model is at most {error:.2g} standard deviations in the pilot{but}.")
        fine &= small
    return words, fine


def _chi_square(summary: Summary, map: FittedMap) -> tuple[list[str], bool]:
    """Whether chi-square is what noise makes of it."""
    low, middle, high = summary.reduced_chi_square
    freedom = degrees_of_freedom(summary.measurements[1], map)
    spread = math.sqrt(2.0 / freedom) if freedom > 0 else math.inf
    far = map.option("chi_square_sigmas") * spread
    if not math.isfinite(middle):
        return ["No texel has a chi-square: there are no more measurements than parameters."], False
    words = [
        f"Chi-square per degree of freedom is {middle:.3g} in the median texel, and between {low:.3g} and {high:.3g} "
        f"in half of them; the right model with the right noise gives 1 ± {spread:.2g}."
    ]
    if middle > 1.0 + far:
        words.append("The model does not explain the data to within their noise: the errors are too small.")
    if middle < 1.0 - far:
        words.append("The data scatter less than the stated noise: the errors are too large.")
    return words, abs(middle - 1.0) <= far


def fragment(map: FittedMap) -> str:
    """What a notebook shows, as HTML: the verdict, and the median of every parameter."""
    summary = summarise(map)
    table = html_table(quartile_table(summary, map)) if summary.fitted else ""
    return f"<p>{html.escape(' '.join(verdict(summary, map)[0]))}</p>{table}"


def degrees_of_freedom(measurements: Any, map: FittedMap) -> Any:
    """Measurements of a texel less the parameters that are its own."""
    return measurements - len(own_parameters(map))


def own_parameters(map: FittedMap) -> list[str]:
    """Those that differ from texel to texel."""
    return [name for name in map.names if name not in map.attributes.get("common", {})]
