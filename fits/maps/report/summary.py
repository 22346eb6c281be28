"""A fitted map in a few numbers, the verdict on it in sentences, and tables for the terminal and the report.

The thresholds of the verdict are those of the map's `MapOptions`.
"""

import html
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from fits.maps.store import FLAGS, FittedMap
from fits.problem.noise import DEFAULT_RELATIVE
from fits.reports.pages import Table, html_table
from fits.reports.tables import with_error
from fits.reports.verdicts import listed

WORST = 12
"""Texels that are shown of those with the largest chi-square."""

WORDS = {
    "fitted": "fitted",
    "converged": "converged",
    "at_bound": "at a bound",
    "poor": "poor: chi-square above what noise and the pilot explain",
    "restarted": "fitted again from other starts",
    "masked": "masked",
    "too_few_measurements": "too few measurements",
    "failed": "failed: no finite value",
    "unidentified": "a parameter is unidentified",
}
"""The meaning of each flag."""


@dataclass(frozen=True)
class Summary:
    """Counts of texels, and quartiles over those that are fitted.

    Attributes:
        texels, done: texels of the map, and of them those that are fitted or excluded.
        counts: texels with each flag.
        at_bound: texels at which each parameter is at a bound.
        quartiles: of each array of the store, such as "values/base.albedo", where it is finite; NaN if it nowhere is.
    """

    texels: int
    done: int
    counts: dict[str, int]
    at_bound: dict[str, int]
    quartiles: dict[str, tuple[float, ...]]

    @property
    def fitted(self) -> int:
        """Texels with values."""
        return self.counts["fitted"]

    @property
    def converged(self) -> float:
        """The share of the fitted texels that converged; NaN if none is fitted."""
        return self.counts["converged"] / self.fitted if self.fitted else np.nan


def summarise(map: FittedMap) -> Summary:
    """The numbers of a map, finished or not; arrays are read one after the other."""
    flags = map.flags  # first: a texel that has them has everything
    fitted = (flags & FLAGS["fitted"]) != 0
    at_bound, quartiles = map.at_bound[fitted], {}
    for path in map.arrays.keys() - {"flags", "start", "at_bound"}:
        values = map.read(path)[fitted].astype(float)
        finite = values[np.isfinite(values)]
        quartiles[path] = tuple(np.quantile(finite, (0.25, 0.5, 0.75)).tolist()) if finite.size else (np.nan,) * 3
    return Summary(
        texels=flags.size,
        done=int(np.count_nonzero(flags)),
        counts={name: int(np.count_nonzero(flags & bit)) for name, bit in FLAGS.items()},
        at_bound={name: int(np.count_nonzero(at_bound & (1 << place))) for place, name in enumerate(map.names)},
        quartiles=quartiles,
    )


# ---- the verdict ----


def noise_words(map: FittedMap) -> list[str]:
    """That a noise was assumed, where nothing says how large it is."""
    if not map.attributes.get("noise_assumed"):
        return []
    level = f"{100.0 * DEFAULT_RELATIVE:g} %"
    return [f"No noise is stated: {level} of the model's value is assumed. State it as `relative`, or by `--noise`."]


def verdict(summary: Summary, map: FittedMap) -> tuple[list[str], bool]:
    """How far the map can be relied on, in a few sentences, and whether they are without reservation."""
    counts, fitted, option = summary.counts, summary.fitted, map.option

    # how much of the map there is, and why the rest is not
    reasons = {"masked": "masked", "too_few_measurements": "with too few measurements", "failed": "failed"}
    rest = [f"{counts[flag]:,} {words}" for flag, words in reasons.items() if counts[flag]]
    parts, sound = ", ".join([f"{fitted:,} are fitted", *rest]), summary.done == summary.texels
    words = [f"A map of {summary.texels:,} texels: {parts}."]
    if not sound:
        done = f"{summary.done:,} of {summary.texels:,} texels ({share(summary.done, summary.texels)}) are done"
        words = [f"The map is not finished: {done}, and the same command resumes it.", f"Of these, {parts}."]
    if not fitted:
        return [*words, "No texel is fitted."], False
    sound &= counts["converged"] >= option("converged_share") * (fitted + counts["failed"])
    words.append(f"{share(counts['converged'], fitted)} of the fitted texels converged.")

    # chi-square beside what noise makes of it
    words += (assumed := noise_words(map))
    stated = "assumed" if assumed else "stated"
    low, median, high = summary.quartiles["reduced_chi_square"]
    freedom = degrees_of_freedom(summary.quartiles["measurements"][1], map)
    spread = math.sqrt(2.0 / freedom) if freedom > 0 else math.inf
    far = option("chi_square_sigmas") * spread
    if math.isfinite(median):
        words.append(
            f"Chi-square per degree of freedom is {median:.3g} in the median texel, and between {low:.3g} and "
            f"{high:.3g} in half of them; the right model with the right noise gives 1 ± {spread:.2g}."
        )
        if median > 1.0 + far:
            words.append("The model does not explain the data to within their noise: the errors are too small.")
        if median < 1.0 - far:
            words.append(f"The data scatter less than the {stated} noise: the errors are too large.")
    else:
        words.append("No texel has a chi-square: there are no more measurements than parameters.")
    explained = abs(median - 1.0) <= far  # not so for NaN

    # flags
    most = sorted(((count, name) for name, count in summary.at_bound.items() if count), reverse=True)[:3]
    which = f" ({', '.join(f'{name} in {share(count, fitted)}' for count, name in most)})" if most else ""
    bounded = f"At a bound: {share(counts['at_bound'], fitted)} of the fitted texels{which}."
    words.append(bounded if counts["at_bound"] else "No texel is at a bound.")
    most_of_noise = float(chi2.isf(option("poor_probability"), max(freedom, 1.0))) / max(freedom, 1.0)
    pilot_is_explained = map.attributes["pilot"]["poor_above"] <= option("pilot_factor") * most_of_noise
    words += _of_poor_texels(summary, map, pilot_is_explained and not median > 1.0 + far)
    if counts["unidentified"]:
        unidentified = share(counts["unidentified"], fitted)
        words.append(f"In {unidentified} of the fitted texels the data leave a parameter unidentified.")
    flagged = max(counts[flag] for flag in ("at_bound", "poor", "unidentified"))
    sound &= explained and pilot_is_explained and flagged <= option("flagged_share") * fitted

    # the pilot
    common = map.attributes["common"]
    if not all(one["converged"] for one in common.values()):
        words.append("The joint fit of common parameters has not converged: all else is fitted with wrong values.")
        sound = False
    if unknown := [name for name, one in common.items() if math.isinf(float(one["error"]))]:
        words.append(f"The pilot leaves {listed(unknown)}, common to all texels, unidentified.")
        sound = False
    if (error := map.numerical_error) is not None:
        small = error <= option("numerical_error")
        but = "" if small else ": a finer resolution may give other values"
        words.append(f"The numerical error of the model is at most {error:.2g} standard deviations in the pilot{but}.")
        sound &= small
    return words, sound


def _of_poor_texels(summary: Summary, map: FittedMap, explained: bool) -> list[str]:
    """A sentence on the texels with a large chi-square; explained: whether noise explains the others and the pilot."""
    counts, limit = summary.counts, f"above {map.attributes['pilot']['poor_above']:.3g}, "
    if counts["poor"]:
        poor = share(counts["poor"], summary.fitted)
        return [f"Poor: {poor} of the fitted texels: chi-square is {limit}more than noise and the pilot explain."]
    if math.isnan(summary.quartiles["reduced_chi_square"][1]):
        return []
    who = "texel" if counts["converged"] == summary.fitted else "converged texel"  # of others nothing is flagged
    if not explained:  # nor then does the model explain the pilot, by which the flag is set
        return [f"No {who} stands out: chi-square is nowhere {limit}more than in the pilot."]
    return [f"No {who} is poor: chi-square is nowhere above what noise and the pilot explain."]


def fragment(map: FittedMap) -> str:
    """The map in a notebook, as HTML: the verdict, and the median of every parameter."""
    summary = summarise(map)
    table = html_table(quartile_table(summary, map)) if summary.fitted else ""
    return f"<p>{html.escape(' '.join(verdict(summary, map)[0]))}</p>{table}"


def own_parameters(map: FittedMap) -> list[str]:
    """The parameters that differ from texel to texel."""
    return [name for name in map.names if name not in map.attributes["common"]]


def degrees_of_freedom(measurements: Any, map: FittedMap) -> Any:
    """Measurements of a texel less the parameters that are its own."""
    return measurements - len(own_parameters(map))


# ---- tables ----


def count_table(summary: Summary) -> Table:
    """How many texels have each flag, and which share of the map."""
    rows = [("of the map", summary.texels, "")]
    if summary.done < summary.texels:
        rows.append(("done so far", summary.done, share(summary.done, summary.texels)))
    for flag, count in summary.counts.items():
        if count or flag == "fitted":
            of_map = flag in ("fitted", "masked", "too_few_measurements", "failed")
            percent = share(count, summary.texels) if of_map else f"{share(count, summary.fitted)} of the fitted"
            rows.append((WORDS[flag], count, percent))
    for name, count in summary.at_bound.items():
        if count:
            rows.append((f"at a bound: {name}", count, f"{share(count, summary.fitted)} of the fitted"))
    return Table("Texels", ("", "texels", "share"), tuple((words, f"{count:,}", part) for words, count, part in rows))


def quartile_table(summary: Summary, map: FittedMap) -> Table:
    """Quartiles over the fitted texels: of each parameter, of its standard error, and of how well texels are fitted."""

    def words(path: str) -> tuple[str, ...]:
        return tuple(f"{value:.4g}" if math.isfinite(value) else "" for value in summary.quartiles[path])

    rows = [(name, *words(f"values/{name}"), *words(f"errors/{name}"), map.units[name]) for name in map.names]
    rows.append(("chi2/dof", *words("reduced_chi_square"), "", "", "", "1"))
    rows.append(("measurements", *words("measurements"), "", "", "", "1"))
    columns = ("", "25 %", "median", "75 %", "error: 25 %", "error: median", "error: 75 %", "unit")
    return Table("Quartiles over the fitted texels", columns, tuple(rows), "Of errors, those that are finite.")


def worst_table(map: FittedMap) -> Table:
    """The fitted texels with the largest chi-square, worst first."""
    flags, ratio = map.flags, map.reduced_chi_square
    ranked = np.where((flags & FLAGS["fitted"] != 0) & np.isfinite(ratio), ratio, -np.inf).ravel()
    order = np.argsort(-ranked, kind="stable")[:WORST]
    places = np.unravel_index(order[ranked[order] > -np.inf], ratio.shape)
    columns = [(map.values[name][places], map.errors[name][places]) for name in map.names]
    rows = []
    for row, (place, bits) in enumerate(zip(np.transpose(places), flags[places], strict=True)):
        pairs = (with_error(float(values[row]), float(errors[row])) for values, errors in columns)
        cells = (value if error == "unknown" else f"{value} ± {error}" for value, error in pairs)
        words = [WORDS[flag].partition(":")[0] for flag, bit in FLAGS.items() if bits & bit and flag != "fitted"]
        words = words[1:] if "converged" in words else ["not converged", *words]
        rows.append((str(place.tolist()), f"{ratio[tuple(place)]:.4g}", *cells, ", ".join(words)))
    note = f"Counted from 0, by {'row and column' if len(map.shape) == 2 else 'index'}; value ± standard error."
    return Table("", ("texel", "chi2/dof", *map.names, "flags"), tuple(rows), note if rows else "")


def common_table(map: FittedMap) -> Table:
    """The parameters that all texels have in common."""
    common = map.attributes["common"].items()
    rows = [(name, *with_error(float(one["value"]), float(one["error"])), one["unit"]) for name, one in common]
    return Table("", ("parameter", "value", "error", "unit"), tuple(rows))


def smoothing_words(map: FittedMap) -> str:
    """How a map was smoothed, and whether that has settled, in a few sentences; nothing if it was not."""
    about = map.smoothing
    if about is None:
        return ""
    scales = about["prior"]["scale"]
    one_scale = len(set(scales.values())) == 1 and scales.keys() == set(map.names)
    each = f"{scales[map.names[0]]:g}" if one_scale else ", ".join(f"{name} {one:g}" for name, one in scales.items())
    kind, settled = about["prior"]["kind"].replace("_", " "), "" if about["settled"] else ": it has not settled"
    return (
        f"Smoothed beside the plain fit by block alternation ({kind}, of the bounds: {each}), in {about['rounds']} "
        f"rounds; in the last one texels moved by at most {about['largest_moves'][-1]:.2g} standard errors{settled}. "
        "Errors of the smoothed map are conditional on the values of the neighbours."
    )


def share(part: float, whole: float) -> str:
    """A share in per cent, rounded down to 0.01 %: nearly all is not all."""
    percent = math.floor(1e4 * part / whole + 1e-6) / 100.0
    return "< 0.01 %" if part and not percent else f"{percent:.4g} %"
