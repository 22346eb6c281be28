"""Input files of inverse adding-doubling, ``.rxt`` (Prahl, iad): a slab between slides, measured with spheres.

After ``IAD1`` stand numbers, whatever the lines; ``#`` begins a comment. In this order: index of the sample, of the
slides; thickness of the sample, of a slide, diameter of the beam in mm; reflectance of the standard; how many spheres
at a time; five numbers of the reflection sphere and five of the transmission sphere (diameter, ports of sample, light
and detector in mm, reflectance of the wall). Then either how many columns a row has (1: M_R, 2: and M_T, 3: and M_U, 4:
and the wall's reflectance, 5: and that of the other sphere, 6, 7: and of the standards), or letters that name them, as
`COLUMNS` says. Then the rows; with a count, a number above 1 at the head of a row is its wavelength. As `iad_io.w` of
iad 4 reads it.

The header does not say how sample and standard were compared. By two beams the sphere has the same gain for both, and
iad makes no correction (`iad -X`); where a comment of the file says so, neither does this reader, and a note tells.
"""

import re
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fits._files import given_path, require_file, require_switch
from fits.data.formats._text import Line, plural, read_lines
from fits.data.geometry import Floats
from fits.data.measurements import Source
from fits.data.spheres import Sphere, Spheres
from fits.data.totals import KINDS, Kind, Totals

if TYPE_CHECKING:
    import layerjax as lj

Indices = NDArray[np.int_]

FIRST = "IAD1"
HEADER = 17
"""Numbers before the measurements: seven of the sample and how it was read, and five of each sphere."""

LETTERS: dict[str, Kind] = {"r": "reflectance", "t": "transmittance", "u": "unscattered"}
COUNTED = "rtuwWRT"
"""Columns that a count stands for."""

COLUMNS = {
    **LETTERS,
    "L": "wavelength in nm",
    "i": "incidence in degrees",
    "n": "index of the sample",
    "N": "index of the slides",
    "d": "thickness of the sample in mm",
    "D": "thickness of a slide in mm",
    "g": "asymmetry",
    "R": "reflectance of the standard",
    "w": "reflectance of the wall, of both spheres where there is no W",
    "W": "reflectance of the wall of the transmission sphere",
    "S": "number of spheres",
    "M": "number of spheres",
    "c": "share of what is mirrored that M_R holds",
    "C": "share of what passes unscattered that M_T holds",
    "E": "optical depth of a slide",
}
UNUSED = {
    "T": "standard of the transmission sphere",
    "B": "beam",
    "a": "albedo",
    "A": "mu_a",
    "b": "optical depth",
    "F": "mu_s",
    "e": "tolerance",
    "q": "quadrature",
}
"""Columns of settings of iad's inversion, which do not concern the measurements."""

MUST_BE = {"c": 1.0, "C": 1.0, "E": 0.0}
"""Columns whose other values the model does not support."""

SAME_VALUE = 0.01
"""Relative variation from row to row below which numbers of the slab and of the standard count as one."""

SAME_WALLS = 0.002
"""The same, absolute, for reflectances of walls, as their absorptance matters."""

_TWO_BEAMS = re.compile(r"(?i:dual[ -]?beam)|\biad\s(.*\s)?-X\b")


@dataclass(frozen=True, eq=False)
class Slab:
    """A slab and its measurements, from a file of iad.

    Attributes:
        totals: a channel for each row of the file, or each wavelength where there are several incidences.
        wavelengths: of the channels, in nm; None where the file has none.
        ior: refractive index of the sample.
        ior_slides: that of the slides; 1 without slides.
        thickness_mm: thickness of the sample.
        asymmetry: g of the channels; None where the file has none.
    """

    totals: Totals
    wavelengths: Floats | None
    ior: float
    ior_slides: float
    thickness_mm: float
    asymmetry: Floats | None

    def stack(self, mu_s: Any, mu_a: Any, phase: "lj.PhaseFunction") -> "lj.Stack":
        """The slab of these coefficients in 1/mm (numbers or `Free`), one or one a row, between polished faces."""
        import layerjax as lj

        medium = lj.TurbidMedium(thickness_mm=self.thickness_mm, mu_s=mu_s, mu_a=mu_a, phase=phase)
        indices = [1.0, self.ior_slides, self.ior]
        above = [after for before, after in pairwise(indices) if after != before]
        below = [after for before, after in pairwise(indices[::-1]) if after != before]
        return lj.Stack([*map(lj.Interface, above), medium, *map(lj.Interface, below)])


def read_slab(
    path: str | Path,
    *,
    incidence: float | None = None,
    sigma: float = 0.01,
    corrected: bool | None = None,
    wavelengths: tuple[float, float] | None = None,
) -> Slab:
    """Read an ``.rxt`` file.

    Args:
        path: the file.
        incidence: polar angle of the light, in [0, 90) degrees; None: that of column ``i``, or 0 without one.
        sigma: standard deviation of every measurement, above 0; the format does not say it.
        corrected: values are those of the slab itself, whatever the spheres: two beams were compared, say. Else what
            spheres add is part of the model (`Spheres`): of one at a time, each for its value, or of two together.
            None: corrected if a comment of the file says that two beams were compared, and a note says so.
        wavelengths: the lowest and the highest that are read, in nm; None for all rows.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: on one line: another format, or numbers that are missing or out of range.
    """
    path = given_path("path", path)
    require_file(path)
    require_switch("corrected", corrected, None)
    lines = read_lines(path)
    words = [word for line in lines for word in _words(line)]
    if not words or words[0][1] != FIRST:
        raise ValueError(f"{path}: not an .rxt file, which begins with {FIRST}")
    words = words[1:]
    if len(words) < HEADER:
        raise ValueError(f"{path}: {len(words)} numbers, must be {HEADER} before the measurements")
    header = [line.parse(text, place) for place, (line, text) in enumerate(words[:HEADER], start=1)]
    columns = _columns(path, words[HEADER:])
    if wavelengths is not None:
        columns = _select(path, columns, *_interval(wavelengths))
    if not any(letter in columns for letter in LETTERS):
        raise ValueError(f"{path}: no column of r, t or u")
    for letter, needed in MUST_BE.items():
        if letter in columns and (columns[letter] != needed).any():
            bad = columns[letter][columns[letter] != needed][0]
            raise ValueError(f"{path}: {letter}, the {COLUMNS[letter]}, is {bad:g}, must be {needed:g}")
    slides = _one(path, "N", columns, header[1])
    glass = columns.get("D", np.array(header[3:4]))
    if (glass > 0).any() != (glass > 0).all():
        raise ValueError(f"{path}: D is 0 in some rows only; restrict the wavelengths")
    totals, first = _totals(path, columns, incidence, sigma)
    by, notes = _compared(path, _described(path, header, columns), lines, corrected)
    unused = [f"{letter} ({UNUSED[letter]})" for letter in columns if letter in UNUSED]
    notes += [f"columns not used: {', '.join(unused)}"] if unused else []
    return Slab(
        totals=replace(totals, spheres=by, source=Source(str(path), "rxt", notes=tuple(notes))),
        wavelengths=columns["L"][first] if "L" in columns else None,
        ior=_one(path, "n", columns, header[0]),
        ior_slides=slides if (glass > 0).all() and slides > 0 else 1.0,
        thickness_mm=_one(path, "d", columns, header[2]),
        asymmetry=columns["g"][first] if "g" in columns else None,
    )


def _totals(path: Path, columns: dict[str, Floats], incidence: float | None, sigma: float) -> tuple[Totals, Indices]:
    """Measurements by incidence and channel, and the rows (C,) of the first incidence, which name the channels."""
    count = len(next(iter(columns.values())))
    if incidence is not None and "i" in columns:
        raise ValueError(f"{path}: incidence is {incidence:g}, and the file has a column i of its own: use that")
    at = columns.get("i", np.full(count, incidence or 0.0))
    angles = at[np.sort(np.unique(at, return_index=True)[1])]
    rows = [np.flatnonzero(at == angle) for angle in angles]
    waves = columns.get("L")
    for angle, own in zip(angles, rows, strict=True):
        equal = len(own) == len(rows[0]) and (waves is None or np.array_equal(waves[own], waves[rows[0]]))
        if not equal:
            raise ValueError(
                f"{path}: rows at {angle:g} degrees have other wavelengths than those at {angles[0]:g}, must have "
                "the same: restrict the wavelengths"
            )
    first = rows[0]
    names = [f"row {place + 1}" for place in range(len(first))]
    if waves is not None and len(set(waves[first])) == len(first):
        names = [f"{wave:g} nm" for wave in waves[first]]
    given_kinds = {kind: columns[letter] for letter, kind in LETTERS.items() if letter in columns}
    shares: dict[str, Any] = {kind: given_kinds[kind][np.array(rows)] for kind in KINDS if kind in given_kinds}
    try:
        return Totals.of(angles, **shares, sigma=sigma, channels=names), first
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _compared(
    path: Path, by: Spheres | None, lines: list[Line], corrected: bool | None
) -> tuple[Spheres | None, list[str]]:
    """The spheres that the model takes on itself, and what is to be noted."""
    if corrected is not None or by is None:
        return (None if corrected else by), []
    comments = (line.text.partition("#")[2] for line in lines)
    if not any(_TWO_BEAMS.search(comment) for comment in comments):
        return by, []
    if by.together:
        raise ValueError(
            f"{path}: a comment says that two beams were compared, and the header that two spheres stand together: "
            "say which holds by corrected=True or False (--read corrected=yes or no)"
        )
    return None, [
        "a comment says that two beams were compared: spheres are ignored, as by iad -X "
        "(--read corrected=no counts them)"
    ]


def _described(path: Path, header: list[float], columns: dict[str, Floats]) -> Spheres | None:
    """Spheres of header and columns; a diameter of 0 means no sphere."""
    counts = [columns[letter] for letter in "SM" if letter in columns] or [np.array(header[6:7])]
    if len(set(np.concatenate(counts))) > 1:
        raise ValueError(f"{path}: the number of spheres varies; restrict the wavelengths")
    count = float(counts[0][0])
    if count not in (0, 1, 2):
        raise ValueError(f"{path}: number of spheres is {count:g}, must be 0, 1 or 2")
    if count == 0:
        return None
    walls = [_one(path, "w", columns, header[11], SAME_WALLS)]
    walls.append(_one(path, "W" if "W" in columns else "w", columns, header[16], SAME_WALLS))
    standard = _one(path, "R", columns, header[5])
    ports = header[7:11], header[12:16]
    try:
        front, behind = (
            Sphere(port[0], port[1], port[2], port[3], wall) if port[0] else None
            for port, wall in zip(ports, walls, strict=True)
        )
        return Spheres(front, behind, standard, together=count == 2)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _interval(wavelengths: Any) -> tuple[float, float]:
    """The lowest and the highest; ValueError for what is no such pair."""
    try:
        low, high = (float(one) for one in wavelengths)
    except (TypeError, ValueError):
        low = high = np.nan
    if not 0.0 <= low <= high < np.inf:
        raise ValueError(f"wavelengths is {wavelengths!r}, must be two numbers in nm, the lowest and the highest")
    return low, high


def _words(line: Line) -> list[tuple[Line, str]]:
    """Words of a line, without its comment; ``IAD1`` is a word of its own."""
    text = line.text.partition("#")[0].replace(",", " ")
    return [(line, word) for word in re.sub(rf"^\s*{FIRST}", f"{FIRST} ", text).split()]


def _columns(path: Path, words: list[tuple[Line, str]]) -> dict[str, Floats]:
    """The measurements by the letters of their columns, (rows,) each."""
    letters: list[str] = []
    place = 0
    while place < len(words) and not _is_number(words[place][1]):
        letters += words[place][1].replace("-", "")  # iad takes them with or without blanks and dashes
        place += 1
    if letters:
        return _lettered(path, letters, words[place:])
    if not words:
        raise ValueError(f"{path}: no measurements after the description of the spheres")
    line, text = words[0]
    count = line.parse(text, "number of measurements", (1.0, len(COUNTED)))
    if count != int(count):
        raise line.error(f"{text} is not allowed, must be a whole number in [1, 7]", "number of measurements")
    names = [*COUNTED[: int(count)]]
    first = words[1:2] and words[1][0].parse(words[1][1], "L")
    return _lettered(path, ["L", *names] if first and first > 1.0 else names, words[1:])


def _lettered(path: Path, letters: list[str], words: list[tuple[Line, str]]) -> dict[str, Floats]:
    for place, letter in enumerate(letters):
        if letter not in COLUMNS | UNUSED:
            raise ValueError(f"{path}: column {letter!r} is not one of {', '.join(COLUMNS | UNUSED)}")
        if letter in letters[:place]:
            raise ValueError(f"{path}: column {letter!r} appears twice, each may appear once")
    numbers = [line.parse(text, letters[place % len(letters)]) for place, (line, text) in enumerate(words)]
    if not numbers or len(numbers) % len(letters):
        on_lines: dict[int, list[Line]] = {}
        for line, _ in words:
            on_lines.setdefault(line.number, []).append(line)
        for found in on_lines.values():
            if len(found) % len(letters):
                raise found[0].error(f"{plural(len(found), 'number')}, must be {len(letters)}: {' '.join(letters)}")
        raise ValueError(f"{path}: no measurements after the names of the columns")
    rows = np.array(numbers).reshape(-1, len(letters))
    return {letter: rows[:, place] for place, letter in enumerate(letters)}


def _select(path: Path, columns: dict[str, Floats], low: float, high: float) -> dict[str, Floats]:
    """The rows of these wavelengths."""
    if "L" not in columns:
        raise ValueError(f"{path}: the rows have no wavelengths to choose by")
    keep = (columns["L"] >= low) & (columns["L"] <= high)
    if not keep.any():
        raise ValueError(
            f"{path}: no row lies in [{low:g}, {high:g}] nm; they go from {columns['L'].min():g} to "
            f"{columns['L'].max():g}"
        )
    return {letter: column[keep] for letter, column in columns.items()}


def _one(path: Path, letter: str, columns: dict[str, Floats], default: float, tolerance: float | None = None) -> float:
    """One number for all rows: their mean, if they are equal within `tolerance`, or `SAME_VALUE` of it."""
    if letter not in columns:
        return default
    values = columns[letter]
    if np.ptp(values) > (SAME_VALUE * np.mean(values) if tolerance is None else tolerance):
        raise ValueError(
            f"{path}: {letter}, the {COLUMNS[letter]}, goes from {values.min():g} to {values.max():g}, "
            "and one slab has one: restrict the wavelengths, by wavelengths=(low, high) or --read wavelengths=LOW,HIGH"
        )
    return float(np.mean(values))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
