"""Input files of inverse adding-doubling, ``.rxt`` (Prahl, iad): a slab between slides, measured with spheres.

After ``IAD1`` stand numbers, whatever the lines; ``#`` begins a comment. In this order: index of the sample, of the
slides; thickness of the sample, of a slide, diameter of the beam in mm; reflectance of the standard; how many spheres
at a time; five numbers of the reflection sphere and five of the transmission sphere (diameter, ports of sample, light
and detector in mm, reflectance of the wall). Then either how many kinds of readings a row has (1: M_R, 2: and M_T, 3:
and M_U), or letters that name its columns: L wavelength, r M_R, t M_T, u M_U, n index of the sample, N of the slides,
d thickness, g asymmetry. Then the rows; with a count, a number above 1 at the head of a row is its wavelength.
"""

import re
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fits._files import require_file
from fits.data.formats._text import Line, read_lines
from fits.data.geometry import Floats
from fits.data.measurements import Source
from fits.data.spheres import Sphere, Spheres
from fits.data.totals import KINDS, Kind, Totals

if TYPE_CHECKING:
    import layerjax as lj

FIRST = "IAD1"
HEADER = 17
"""Numbers before the readings: seven of the sample and how it was read, and five of each sphere."""

LETTERS: dict[str, Kind] = {"r": "reflectance", "t": "transmittance", "u": "unscattered"}
BESIDE = ("L", "n", "N", "d", "g")
SMOOTH = 1e-4
"""Roughness of a polished face."""

ALIKE = 0.01
"""Indices and thicknesses that vary by less from row to row are taken for one."""


@dataclass(frozen=True, eq=False)
class Slab:
    """A slab as iad describes it, and what was read of it.

    Attributes:
        totals: a channel for each row of the file.
        wavelengths: of the rows, in nm; None where the file has none.
        ior, ior_slides: refractive indices; of the slides 1 where there are none.
        thickness_mm: of the sample.
        asymmetry: g of the rows, None where the file has none.
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
        return lj.Stack([*(lj.Interface(n, SMOOTH) for n in above), medium, *(lj.Interface(n, SMOOTH) for n in below)])


def read_slab(
    path: str | Path,
    *,
    incidence: float = 0.0,
    sigma: float = 0.01,
    corrected: bool = False,
    wavelengths: tuple[float, float] | None = None,
) -> Slab:
    """Read an ``.rxt`` file.

    Args:
        path: the file.
        incidence: polar angle of the light, in [0, 90) degrees; the format does not say it.
        sigma: standard deviation of every reading, above 0; nor this.
        corrected: the readings are of the slab itself, whatever the spheres: two beams were compared, say. Else what
            spheres add is part of the model (`Spheres`): of one at a time, each for its reading, or of two together.
        wavelengths: the lowest and the highest that are read, in nm; None for all rows.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: on one line: another format, or numbers that are missing or out of range.
    """
    path = Path(path)
    require_file(path)
    lines = read_lines(path)
    words = [word for line in lines for word in _words(line)]
    if not words or words[0][1] != FIRST:
        raise ValueError(f"{path}: not an .rxt file, which begins with {FIRST}")
    words = words[1:]
    if len(words) < HEADER:
        raise ValueError(f"{path}: {len(words)} numbers, must be {HEADER} before the readings")
    header = [line.parse(text, place) for place, (line, text) in enumerate(words[:HEADER], start=1)]
    ior, slides, thickness, slide = header[:4]
    by = None if corrected else _spheres(path, header)
    columns = _columns(path, words[HEADER:])
    if wavelengths is not None:
        columns = _within(path, columns, *wavelengths)
    given = {kind: columns[letter] for letter, kind in LETTERS.items() if letter in columns}
    if not given:
        raise ValueError(f"{path}: no column of r, t or u")
    count = len(next(iter(given.values())))
    waves = columns.get("L")
    names = [f"row {place + 1}" for place in range(count)]
    if waves is not None and len(set(waves)) == count:
        names = [f"{wave:g} nm" for wave in waves]
    shares: dict[str, Any] = {kind: given[kind][None] for kind in KINDS if kind in given}
    totals = Totals.of(incidence, **shares, sigma=sigma, channels=names, spheres=by)
    totals = replace(totals, source=Source(str(path), "rxt"))
    slides = _one(path, "N", columns, slides) if slide > 0 and slides > 0 else 1.0
    return Slab(
        totals=totals,
        wavelengths=waves,
        ior=_one(path, "n", columns, ior),
        ior_slides=slides,
        thickness_mm=_one(path, "d", columns, thickness),
        asymmetry=columns.get("g"),
    )


def _spheres(path: Path, header: list[float]) -> Spheres | None:
    """What the header says of spheres; a sphere of no diameter is none."""
    standard, count = header[5], header[6]
    if count not in (0, 1, 2):
        raise ValueError(f"{path}: number of spheres is {count:g}, must be 0, 1 or 2")
    if count == 0:
        return None
    try:
        front, behind = (Sphere(*numbers) if numbers[0] else None for numbers in (header[7:12], header[12:17]))
        return Spheres(front, behind, standard, together=count == 2)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _words(line: Line) -> list[tuple[Line, str]]:
    """What stands on a line, without its comment; ``IAD1`` is a word of its own."""
    text = line.text.partition("#")[0].replace(",", " ")
    return [(line, word) for word in re.sub(rf"^\s*{FIRST}", f"{FIRST} ", text).split()]


def _columns(path: Path, words: list[tuple[Line, str]]) -> dict[str, Floats]:
    """The readings by the letters of their columns, (rows,) each."""
    letters = []
    for _, text in words:
        if _is_number(text):
            break
        letters.append(text)
    if letters:
        return _lettered(path, letters, words[len(letters) :])
    if not words:
        raise ValueError(f"{path}: no readings behind the description of the spheres")
    line, text = words[0]
    kinds = line.parse(text, "number of measurements", (1.0, 3.0))
    if kinds != int(kinds):
        raise line.error(f"{text} is not allowed, must be 1, 2 or 3", "number of measurements")
    names = [*LETTERS][: int(kinds)]
    first = words[1:2] and words[1][0].parse(words[1][1], "L")
    return _lettered(path, ["L", *names] if first and first > 1.0 else names, words[1:])


def _lettered(path: Path, letters: list[str], words: list[tuple[Line, str]]) -> dict[str, Floats]:
    for letter in letters:
        if letter not in (*LETTERS, *BESIDE):
            raise ValueError(f"{path}: column {letter!r} is not one of {', '.join((*LETTERS, *BESIDE))}")
    numbers = [line.parse(text, letters[place % len(letters)]) for place, (line, text) in enumerate(words)]
    if not numbers or len(numbers) % len(letters):
        on_lines: dict[int, list[Line]] = {}
        for line, _ in words:
            on_lines.setdefault(line.number, []).append(line)
        for found in on_lines.values():
            if len(found) % len(letters):
                raise found[0].error(f"{len(found)} numbers, must be {len(letters)}: {' '.join(letters)}")
        raise ValueError(f"{path}: no readings behind the names of the columns")
    rows = np.array(numbers).reshape(-1, len(letters))
    return {letter: rows[:, place] for place, letter in enumerate(letters)}


def _within(path: Path, columns: dict[str, Floats], low: float, high: float) -> dict[str, Floats]:
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


def _one(path: Path, letter: str, columns: dict[str, Floats], default: float) -> float:
    """One number for all rows: their mean, where they are alike."""
    if letter not in columns:
        return default
    values = columns[letter]
    if np.ptp(values) > ALIKE * np.mean(values):
        raise ValueError(
            f"{path}: {letter} goes from {values.min():g} to {values.max():g}; one slab has one, within "
            f"{100 * ALIKE:g} %: choose rows that are alike by their wavelengths"
        )
    return float(np.mean(values))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
