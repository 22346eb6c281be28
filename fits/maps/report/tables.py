"""Tables of a fitted map, for the terminal and the report."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fits.maps.fitted_map import FittedMap
from fits.maps.store import FLAGS
from fits.maps.summary import Quartiles, Summary
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
    "too_few_readings": "too few readings",
    "failed": "failed: no finite value",
    "unidentified": "a parameter is not resolved",
}
"""What is said of each flag."""


def count_table(found: Summary) -> Table:
    """How many texels have each flag, and which share of the map."""
    rows = [("of the map", found.texels, "")]
    if found.there < found.texels:
        rows.append(("there so far", found.there, share(found.there, found.texels)))
    for flag, count in found.counts.items():
        if count or flag == "fitted" or (flag == "converged" and found.fitted):
            whole = found.texels if flag in ("fitted", "masked", "too_few_readings", "failed") else found.fitted
            of = "" if whole == found.texels else " of the fitted"
            rows.append((WORDS[flag], count, f"{share(count, whole)}{of}"))
    for name, count in found.at_bound.items():
        if count:
            rows.append((f"at a bound: {name}", count, f"{share(count, found.fitted)} of the fitted"))
    return Table("Texels", ("", "texels", "share"), tuple((words, f"{count:,}", part) for words, count, part in rows))


def quartile_table(found: Summary, map: FittedMap) -> Table:
    """Quartiles over the fitted texels: of each parameter, of its standard error, and of how well texels are fitted."""
    rows, notes = [], []
    for name in map.names:
        rows.append((name, *_words(found.values[name]), *_words(found.errors[name]), map.units[name]))
        if missing := found.no_error[name]:
            notes.append(f"{name} has no error in {share(missing, found.fitted)} of them.")
    none = ("", "", "")
    rows.append(("chi2/dof", *_words(found.reduced_chi_square), *none, "1"))
    rows.append(("readings", *_words(found.readings), *none, "1"))
    if found.numerical_error is not None:
        low, middle, high, most = found.numerical_error
        rows.append(("numerical error", *_words((low, middle, high)), *none, "sigma"))
        notes.append(f"The numerical error is below {most:.2g} sigma in 95 % of them.")
    columns = ("", "25 %", "median", "75 %", "error: 25 %", "error: median", "error: 75 %", "unit")
    return Table("Quartiles over the fitted texels", columns, tuple(rows), " ".join(notes))


def worst_table(map: FittedMap) -> Table:
    """The fitted texels with the largest chi-square, worst first."""
    flags = map.flags
    places = worst(map.reduced_chi_square, (flags & FLAGS["fitted"]) != 0)
    numbers = {name: (map.values[name][places], map.errors[name][places]) for name in map.names}
    ratio, seen = map.reduced_chi_square[places], flags[places]
    rows = []
    for row, place in enumerate(np.transpose(places)):
        pairs = (with_error(float(values[row]), float(errors[row])) for values, errors in numbers.values())
        words = (value if error == "unknown" else f"{value} ± {error}" for value, error in pairs)
        index = ", ".join(str(int(axis)) for axis in place)
        told = ", ".join(_told(int(seen[row])))
        rows.append((f"[{index}]", f"{ratio[row]:.4g}", *words, told))
    columns = ("texel", "chi2/dof", *map.names, "flags")
    note = f"Counted from 0, by {'row and column' if len(map.shape) == 2 else 'index'}; value ± standard error."
    return Table("", columns, tuple(rows), note if rows else "")


def worst(ratio: np.ndarray, fitted: np.ndarray) -> tuple[np.ndarray, ...]:
    """Index arrays of at most `WORST` fitted texels with the largest values, largest first."""
    ranked = np.where(fitted & np.isfinite(ratio), ratio, -np.inf).ravel()
    count = min(WORST, int(np.count_nonzero(ranked > -np.inf)))
    top = np.argpartition(-ranked, max(count - 1, 0))[:count]
    return np.unravel_index(top[np.argsort(-ranked[top], kind="stable")], ratio.shape)


def _told(bits: int) -> list[str]:
    """What is worth telling of a texel that is fitted."""
    usual = ("fitted", "converged")
    found = [WORDS[flag].partition(":")[0] for flag, bit in FLAGS.items() if bits & bit and flag not in usual]
    return found if bits & FLAGS["converged"] else ["not converged", *found]


def shared_table(map: FittedMap) -> Table:
    """The parameters that all texels have in common."""
    rows = []
    for name, one in dict(map.attributes.get("shared") or {}).items():
        value, error = with_error(float(one["value"]), float(one.get("error", math.nan)))
        rows.append((name, value, error, str(one.get("unit", ""))))
    return Table("", ("parameter", "value", "error", "unit"), tuple(rows))


def posterior_table(map: FittedMap) -> Table | None:
    """How posteriors of a few texels compare with the fitted values and their errors; None where there are none."""
    sampled = map.posterior
    if sampled is None:
        return None
    rows = []
    for place, name in enumerate(sampled.names):
        ratios, shifts = (of[:, place][np.isfinite(of[:, place])] for of in (sampled.ratio, sampled.shift))
        if not ratios.size:
            rows.append((name, "", "", "", ""))
            continue
        range_, largest = f"{ratios.min():.3g} to {ratios.max():.3g}", f"{np.max(np.abs(shifts)):.2g}"
        rows.append((name, f"{np.median(ratios):.3g}", range_, f"{np.median(shifts):.2g}", largest))
    columns = ("parameter", "sd / error", "from ... to", "mean - value, errors", "at most")
    note = (
        f"{len(sampled.places)} texels from all over the map; {sampled.converged.sum()} of their chains converged. "
        "Where sd / error is 1 and the means are the values, a standard error says all; where it is not, the posterior "
        "is skewed, curved or cut off by a bound."
    )
    return Table("", columns, tuple(rows), note)


def smoothing_words(map: FittedMap) -> str:
    """How a map was smoothed, and how far that has come, in a few sentences; nothing if it was not."""
    said = map.smoothing
    if said is None:
        return ""
    asked, (start, *_, end) = said["smoothness"], said["objective"]
    scales = {f"{one:g}" for one in asked["scale"].values()}
    alike = len(scales) == 1 and asked["scale"].keys() == set(map.names)
    each = scales.pop() if alike else ", ".join(f"{name} {one:g}" for name, one in asked["scale"].items())
    kind = asked["kind"].replace("_", " ")
    words = f"Smoothed beside the plain fit by block alternation ({kind}, of the bounds: {each}): {said['rounds']} "
    words += f"rounds took {start - end:.4g} off minus the log-posterior. In the last one texels moved by at most "
    words += f"{said['largest_moves'][-1]:.2g} standard errors"
    if said["settled"]:
        return f"{words}. Errors of the smoothed map hold with the neighbours where they are."
    left = float(said["left"])
    far = f", by the last two about {left:.2g} more are left to go" if math.isfinite(left) else ""
    return f"{words}{far}: it has not settled. Errors of the smoothed map hold with the neighbours where they are."


_ELSEWHERE = {"kind", "format", "names", "units", "shape", "chunk", "numerical_error", "shared", "stack"}


def made_table(map: FittedMap) -> Table:
    """What the store says of how it was made, a row for each of its attributes."""
    rows = [
        ("store", str(map.path)),
        ("texels", f"{_by(map.shape)}, in chunks of {_by(map.chunk)}"),
        ("parameters", ", ".join(map.names)),
    ]
    for name, value in map.attributes.items():
        if name not in _ELSEWHERE and value not in (None, "", {}, []):
            rows.append((name.replace("_", " "), _in_words(value)))
    return Table("", ("", ""), tuple(rows))


def _by(sizes: Sequence[int]) -> str:
    return " x ".join(str(size) for size in sizes)


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


def _words(quartiles: Quartiles) -> tuple[str, str, str]:
    low, middle, high = (f"{value:.4g}" if math.isfinite(value) else "" for value in quartiles)
    return low, middle, high
