"""Tables of a fitted map, for the terminal and the report."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fits.maps.fitted_map import FittedMap, Quartiles, Summary
from fits.maps.store import FLAGS
from fits.reports.tables import Table, with_error

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

ELSEWHERE = {"kind", "format", "names", "units", "shape", "chunk", "numerical_error", "common", "stack", "fingerprints"}
"""What the root of a store says that stands elsewhere in a report, or is of no use there."""


def count_table(found: Summary) -> Table:
    """How many texels have each flag, and which share of the map."""
    rows = [("of the map", found.texels, "")]
    if found.there < found.texels:
        rows.append(("there so far", found.there, share(found.there, found.texels)))
    for flag, count in found.counts.items():
        if count or flag == "fitted" or (flag == "converged" and found.fitted):
            whole = found.texels if flag in ("fitted", "masked", "too_few_measurements", "failed") else found.fitted
            of = "" if whole == found.texels else " of the fitted"
            rows.append((WORDS[flag], count, f"{share(count, whole)}{of}"))
    for name, count in found.at_bound.items():
        if count:
            rows.append((f"at a bound: {name}", count, f"{share(count, found.fitted)} of the fitted"))
    return Table("Texels", ("", "texels", "share"), tuple((words, f"{count:,}", part) for words, count, part in rows))


def quartile_table(found: Summary, map: FittedMap) -> Table:
    """Quartiles over the fitted texels: of each parameter, of its standard error, and of how well texels are fitted."""
    rows, notes, none = [], [], ("", "", "")
    for name in map.names:
        rows.append((name, *_words(found.values[name]), *_words(found.errors[name]), map.units[name]))
        if missing := found.no_error[name]:
            notes.append(f"{name} has no error in {share(missing, found.fitted)} of them.")
    rows.append(("chi2/dof", *_words(found.reduced_chi_square), *none, "1"))
    rows.append(("measurements", *_words(found.measurements), *none, "1"))
    if found.numerical_error is not None:
        *quartiles, most = found.numerical_error
        rows.append(("numerical error", *_words(quartiles), *none, "sigma"))
        notes.append(f"The numerical error is below {most:.2g} sigma in 95 % of them.")
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
        rows.append(
            (f"[{', '.join(_strings(place))}]", f"{ratio[tuple(place)]:.4g}", *cells, ", ".join(_flag_words(int(bits))))
        )
    note = f"Counted from 0, by {'row and column' if len(map.shape) == 2 else 'index'}; value ± standard error."
    return Table("", ("texel", "chi2/dof", *map.names, "flags"), tuple(rows), note if rows else "")


def _flag_words(bits: int) -> list[str]:
    """Words for the flags of a texel that is fitted."""
    usual = ("fitted", "converged")
    found = [WORDS[flag].partition(":")[0] for flag, bit in FLAGS.items() if bits & bit and flag not in usual]
    return found if bits & FLAGS["converged"] else ["not converged", *found]


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
    prior, (start, *_, end) = said["prior"], said["objective"]
    scales = {f"{one:g}" for one in prior["scale"].values()}
    one_scale = len(scales) == 1 and prior["scale"].keys() == set(map.names)
    each = scales.pop() if one_scale else ", ".join(f"{name} {one:g}" for name, one in prior["scale"].items())
    words = f"Smoothed beside the plain fit by block alternation ({prior['kind'].replace('_', ' ')}, of the bounds: "
    words += f"{each}): {said['rounds']} rounds took {start - end:.4g} off minus the log-posterior. In the last one "
    words += f"texels moved by at most {said['largest_moves'][-1]:.2g} standard errors"
    if not said["settled"]:
        left = float(said["left"])
        words += f", by the last two about {left:.2g} more are left to go" if math.isfinite(left) else ""
        words += ": it has not settled"
    return f"{words}. Errors of the smoothed map hold with the neighbours where they are."


def made_table(map: FittedMap) -> Table:
    """What the store says of how it was made, a row for each of its attributes."""
    shape, chunk = (" x ".join(_strings(sizes)) for sizes in (map.shape, map.chunk))
    rows = [("store", str(map.path)), ("texels", f"{shape}, in chunks of {chunk}")]
    rows += [("parameters", ", ".join(map.names))]
    for name, value in map.attributes.items():
        if name not in ELSEWHERE and value not in (None, "", {}, []):
            rows.append((name.replace("_", " "), _in_words(value)))
    return Table("", ("", ""), tuple(rows))


def _strings(numbers: Sequence[int]) -> list[str]:
    return [str(int(one)) for one in numbers]


def _in_words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name.replace('_', ' ')} {_in_words(one)}" for name, one in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_in_words(one) for one in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def share(part: float, whole: float) -> str:
    """A share in per cent; 0 and 100 are said only of none and all."""
    if not whole:
        return "none"
    percent = 100.0 * part / whole
    if part not in (0, whole) and not 0.01 <= percent <= 99.99:
        return "> 99.99 %" if percent > 50.0 else "< 0.01 %"
    return f"{percent:.4g} %" if percent > 99.9 else f"{percent:.3g} %" if percent >= 1.0 else f"{percent:.2g} %"


def _words(quartiles: Quartiles | list[float]) -> tuple[str, ...]:
    return tuple(f"{value:.4g}" if math.isfinite(value) else "" for value in quartiles)
