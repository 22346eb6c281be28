"""Readers and writers of measured BSDFs, one file format a module.

`read` takes any of them, looks at the content first and at the name last, and gives `fits.Measurements`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from fits._files import require_file
from fits.data.formats import (
    alta,
    astm,
    csv,
    fred,
    lighttools,
    merl,
    pab,
    rgl,
    rxt,
    speos,
    ssdd,
    totals_csv,
    window_xml,
    zemax,
)
from fits.data.formats._text import without_mark
from fits.data.formats.csv import write_csv as write_csv
from fits.data.geometry import Geometry
from fits.data.measurements import Measurements, check_quantity
from fits.names import FORMATS, Quantity, Strata

_QUANTITY_GIVEN: dict[
    str, Callable[[Path, Quantity], Measurements]
] = {  # the caller says which quantity, BSDF by default
    "zemax": zemax.read,
    "lighttools": lighttools.read,
    "fred": fred.read,
    "astm": astm.read,
}
_QUANTITY_STATED: dict[str, Callable[[Path], Measurements]] = {  # the file says what it holds
    "klems": window_xml.read,
    "tensortree": window_xml.read,
    "pab": pab.read,
    "speos": speos.read,
    "ssdd": ssdd.read,
}

_KNOWN_ELSEWHERE = {  # first bytes of formats that share our file names but have no reader here
    b"\x89HDF": "an HDF5 file",
    b"PK\x03\x04": "a zip archive (a spreadsheet?)",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook",
}


def read(
    path: str | Path,
    format: str | None = None,
    quantity: str | None = None,
    *,
    geometry: Geometry | None = None,
    lookup: str = "centre",
    bins: int | Literal["all"] | None = None,
    strata: Strata = "bins",
    seed: int = 0,
    wavelengths: tuple[float, float] | None = None,
    corrected: bool | None = None,
) -> Measurements:
    """Read a measurement file: CSV, MERL, RGL, Zemax, LightTools, Speos, WINDOW XML, FRED, ASTM, pab, ALTA, SSDD, iad.

    Args:
        path: the file.
        format: "csv", "totals" (a CSV with shares of light, which gives `Totals`), "rxt" (the totals of a slab, see
            `read_slab`), "merl", "rgl", "zemax", "lighttools", "klems" and "tensortree" (both are XML of WINDOW and
            Radiance), "fred", "astm" (E1392), "pab", "alta", "speos" or "ssdd"; None finds out from the content.
        quantity: what the numbers in the file are: "brdf", f in 1/sr; "brdf_cos", f |cos theta_o|; or
            "reflectance_factor", pi f. A CSV says so in its column names, and then this picks among them; Zemax,
            LightTools, FRED and ASTM files hold "brdf" unless this says otherwise; ALTA files that do not say what they
            hold need it; all others say it themselves.
        geometry: for MERL and RGL only, the directions to look up; None: of MERL the default `slices`, of RGL the
            directions at which the file has values.
        lookup: for MERL only, "centre" or "linear": see `fits.data.formats.merl.read`.
        bins: for MERL and RGL only: so many bins, or nodes, from all over the table, at most 100,000, or "all".
        strata: for MERL only, what each of these bins stands for an equal share of: "bins" of the table, or "flux",
            the projected solid angle of light and viewer.
        seed: of their choice.
        wavelengths, corrected: for iad's files only: see `read_slab`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: on one line, which names the file and, where there is one, line, column, value and allowed range.
    """
    path = Path(path)
    checked = check_quantity(quantity)
    require_file(path)
    kind = sniff(path) if format is None else format
    if kind not in ("merl", "rgl") and (geometry is not None or bins is not None):
        raise ValueError(f"{path}: geometry and bins apply to MERL and RGL files only, this is a {kind} file")
    if kind != "merl" and (lookup != "centre" or strata != "bins"):
        raise ValueError(f"{path}: lookup and strata apply to MERL files only, this is a {kind} file")
    if kind != "rxt" and not (wavelengths is None and corrected is None):
        raise ValueError(f"{path}: wavelengths and corrected apply to rxt files only, this is a {kind} file")
    if kind in ("totals", "rxt") and checked is not None:
        raise ValueError(f"{path}: quantity is {checked!r}, a {kind} file holds shares of the light")
    try:
        if kind == "rxt":
            return rxt.read_slab(path, wavelengths=wavelengths, corrected=corrected).totals
        return _read_as(kind, path, checked, geometry, lookup, bins, strata, seed)
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: {error}") from None  # of numbers that do not go together


def _read_as(
    kind: str,
    path: Path,
    checked: Quantity | None,
    geometry: Geometry | None,
    lookup: str,
    bins: int | Literal["all"] | None,
    strata: Strata,
    seed: int,
) -> Measurements:
    if kind == "csv":
        return csv.read(path, checked)
    if kind == "totals":
        return totals_csv.read(path)
    if kind == "merl":
        if checked not in (None, "brdf"):
            raise ValueError(f"{path}: quantity is {checked!r}, a MERL file always holds 'brdf'")
        return merl.read(path, geometry=geometry, lookup=lookup, bins=bins, strata=strata, seed=seed)
    if kind == "rgl":
        if checked not in (None, "brdf_cos"):
            raise ValueError(f"{path}: quantity is {checked!r}, an RGL file always holds 'brdf_cos'")
        return rgl.read(path, geometry=geometry, bins=bins, seed=seed)
    if kind in _QUANTITY_GIVEN:
        return _QUANTITY_GIVEN[kind](path, checked or "brdf")
    if kind == "alta":
        return alta.read(path, checked)
    if kind in _QUANTITY_STATED:
        found = _QUANTITY_STATED[kind](path)
        if checked not in (None, found.source.quantity):
            raise ValueError(f"{path}: quantity is {checked!r}, this {kind} file says {found.source.quantity!r}")
        return found
    raise ValueError(f"format is {kind!r}, must be one of {', '.join(FORMATS)}")


def sniff(path: Path) -> str:
    """The one of `FORMATS` that a file has, by its content and then by its name; ValueError that names the content."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    if not head.strip():
        raise ValueError(f"{path}: the file is empty")
    for magic, what in _KNOWN_ELSEWHERE.items():
        if head.startswith(magic):
            raise ValueError(f"{path}: this is {what}, which has no reader here (formats: {', '.join(FORMATS)})")
    head = without_mark(head)
    if rgl.recognises(head):
        return "rgl"
    if merl.recognises(head) or path.suffix.lower() == ".binary":
        return "merl"
    if speos.recognises(head):
        return "speos"
    if ssdd.recognises(head):
        return "ssdd"
    if b"\0" in head:
        raise ValueError(
            f"{path}: unknown binary file, starts with {head[:8].hex(' ')} (formats: {', '.join(FORMATS)})"
        )
    return _sniff_text(path, head)


def _sniff_text(path: Path, head: bytes) -> str:
    """`sniff` for a file that holds no zero byte."""
    if window_xml.recognises(head):
        return "tensortree" if b"tensortree" in head.lower() else "klems"
    every = [line.strip() for line in head.decode("utf-8", "replace").splitlines()]
    if alta.recognises(every):
        return "alta"
    if pab.recognises(every):
        return "pab"
    lines = [line for line in every if line and not line.startswith("#")]
    first = lines[0] if lines else ""
    if first.startswith(rxt.FIRST):
        return "rxt"
    if fred.recognises(first):
        return "fred"
    if lighttools.recognises(lines):
        return "lighttools"
    if zemax.recognises(lines):
        return "zemax"
    if astm.recognises(lines):
        return "astm"
    if totals_csv.recognises(first):
        return "totals"
    if csv.recognises(first) or path.suffix.lower() in (".csv", ".tsv"):
        return "csv"
    seen = f"the first line is {first[:60]!r}" if first else "it holds only comments"
    raise ValueError(f"{path}: unknown format, {seen} (formats: {', '.join(FORMATS)})")
