"""What there is to say of a fitted map in a few numbers, and tables of them for the terminal and the report."""

import math
from dataclasses import dataclass

import numpy as np

from fits.maps.store import FLAGS, FittedMap, Floats
from fits.reports.tables import Table, with_error

Quartiles = tuple[float, ...]

WORST = 12
"""Texels that are shown of those with the largest chi-square."""

WORDS = {
    "fitted": "fitted",
    "converged": "converged",
    "at_bound": "at a bound",
    "poor": "poor: chi-square above what noise and the pilot explain",
    "restarted": "started again",
    "masked": "masked",
    "too_few_measurements": "too few measurements",
    "failed": "failed: no finite value",
    "unidentified": "a parameter is unidentified",
}
"""What is said of each flag."""


@dataclass(frozen=True)
class Summary:
    """Counts of texels, and quartiles over those that are fitted.

    Attributes:
        texels: of the map.
        there: of them that have been dealt with.
        counts: of each flag.
        at_bound: of texels at which a parameter is at a bound, for each parameter.
        values, errors: quartiles of each parameter and of its standard error, where they are finite; NaN if nowhere.
        no_error: texels at which a parameter is fitted, and has no finite error.
        reduced_chi_square, measurements: quartiles.
    """

    texels: int
    there: int
    counts: dict[str, int]
    at_bound: dict[str, int]
    values: dict[str, Quartiles]
    errors: dict[str, Quartiles]
    no_error: dict[str, int]
    reduced_chi_square: Quartiles
    measurements: Quartiles

    @property
    def fitted(self) -> int:
        """Texels with values."""
        return self.counts["fitted"]

    @property
    def converged(self) -> float:
        """The share of the fitted texels that converged; NaN if none is fitted."""
        return self.counts["converged"] / self.fitted if self.fitted else np.nan


def summarise(map: FittedMap) -> Summary:
    """The numbers of a map as far as it has got; arrays are read one after the other."""
    flags = map.flags  # first: a texel that has them has everything
    fitted = (flags & FLAGS["fitted"]) != 0
    bounds, errors = map.at_bound[fitted], {name: map.errors[name][fitted] for name in map.names}
    return Summary(
        texels=flags.size,
        there=int(np.count_nonzero(flags)),
        counts={name: int(np.count_nonzero(flags & bit)) for name, bit in FLAGS.items()},
        at_bound={name: int(np.count_nonzero(bounds & (1 << place))) for place, name in enumerate(map.names)},
        values={name: _quartiles(map.values[name][fitted]) for name in map.names},
        errors={name: _quartiles(error) for name, error in errors.items()},
        no_error={name: int(np.count_nonzero(~np.isfinite(error))) for name, error in errors.items()},
        reduced_chi_square=_quartiles(map.reduced_chi_square[fitted]),
        measurements=_quartiles(map.measurements[fitted].astype(float)),
    )


def _quartiles(values: Floats) -> Quartiles:
    finite = values[np.isfinite(values)]
    return tuple(np.quantile(finite, (0.25, 0.5, 0.75)).tolist()) if finite.size else (np.nan,) * 3


def count_table(summary: Summary) -> Table:
    """How many texels have each flag, and which share of the map."""
    rows = [("of the map", summary.texels, "")]
    if summary.there < summary.texels:
        rows.append(("there so far", summary.there, share(summary.there, summary.texels)))
    for flag, count in summary.counts.items():
        if count or flag == "fitted" or (flag == "converged" and summary.fitted):
            whole = summary.texels if flag in ("fitted", "masked", "too_few_measurements", "failed") else summary.fitted
            of = "" if whole == summary.texels else " of the fitted"
            rows.append((WORDS[flag], count, f"{share(count, whole)}{of}"))
    for name, count in summary.at_bound.items():
        if count:
            rows.append((f"at a bound: {name}", count, f"{share(count, summary.fitted)} of the fitted"))
    return Table("Texels", ("", "texels", "share"), tuple((words, f"{count:,}", part) for words, count, part in rows))


def quartile_table(summary: Summary, map: FittedMap) -> Table:
    """Quartiles over the fitted texels: of each parameter, of its standard error, and of how well texels are fitted."""

    def words(quartiles: Quartiles) -> tuple[str, ...]:
        return tuple(f"{value:.4g}" if math.isfinite(value) else "" for value in quartiles)

    rows, notes = [], []
    for name in map.names:
        rows.append((name, *words(summary.values[name]), *words(summary.errors[name]), map.units[name]))
        if missing := summary.no_error[name]:
            notes.append(f"{name} has no error in {share(missing, summary.fitted)} of them.")
    rows.append(("chi2/dof", *words(summary.reduced_chi_square), "", "", "", "1"))
    rows.append(("measurements", *words(summary.measurements), "", "", "", "1"))
    columns = ("", "25 %", "median", "75 %", "error: 25 %", "error: median", "error: 75 %", "unit")
    return Table("Quartiles over the fitted texels", columns, tuple(rows), " ".join(notes))


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
        said = [WORDS[flag].partition(":")[0] for flag, bit in FLAGS.items() if bits & bit and flag != "fitted"]
        said = said[1:] if "converged" in said else ["not converged", *said]
        rows.append((str(place.tolist()), f"{ratio[tuple(place)]:.4g}", *cells, ", ".join(said)))
    note = f"Counted from 0, by {'row and column' if len(map.shape) == 2 else 'index'}; value ± standard error."
    return Table("", ("texel", "chi2/dof", *map.names, "flags"), tuple(rows), note if rows else "")


def common_table(map: FittedMap) -> Table:
    """The parameters that all texels have in common."""
    rows = []
    for name, one in map.attributes.get("common", {}).items():
        rows.append((name, *with_error(float(one["value"]), float(one["error"])), one["unit"]))
    return Table("", ("parameter", "value", "error", "unit"), tuple(rows))


def smoothing_words(map: FittedMap) -> str:
    """How a map was smoothed, and how far that has come, in a few sentences; nothing if it was not."""
    said = map.smoothing
    if said is None:
        return ""
    scales = said["prior"]["scale"]
    one_scale = len(set(scales.values())) == 1 and scales.keys() == set(map.names)
    each = f"{scales[map.names[0]]:g}" if one_scale else ", ".join(f"{name} {one:g}" for name, one in scales.items())
    kind, settled = said["prior"]["kind"].replace("_", " "), "" if said["settled"] else ": it has not settled"
    return (
        f"Smoothed beside the plain fit by block alternation ({kind}, of the bounds: {each}), in {said['rounds']} "
        f"rounds; in the last one texels moved by at most {said['largest_moves'][-1]:.2g} standard errors{settled}. "
        "Errors of the smoothed map hold with the neighbours where they are."
    )


def share(part: float, whole: float) -> str:
    """A share in per cent; 0 and 100 are said only of none and all."""
    if not whole:
        return "none"
    percent = 100.0 * part / whole
    if part not in (0, whole) and not 0.01 <= percent <= 99.99:
        return "> 99.99 %" if percent > 50.0 else "< 0.01 %"
    return f"{percent:.4g} %" if percent > 99.9 else f"{percent:.3g} %" if percent >= 1.0 else f"{percent:.2g} %"
