"""Readers and writers of measured BSDFs, one file format a module.

`read_file` takes any of them, looks at the content first and at the name last, and gives `fits.Measurements`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

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


@dataclass(frozen=True, eq=False)
class FileOptions:
    """Options of the readers of files; `fits.ReadOptions` says what each field means."""

    format: str | None = None
    quantity: str | None = None
    geometry: Geometry | None = None
    lookup: str = "centre"
    bins: int | Literal["all"] | None = None
    strata: Strata = "bins"
    seed: int = 0
    wavelengths: tuple[float, float] | None = None
    corrected: bool | None = None


def read_file(path: Path, options: FileOptions) -> Measurements:
    """All that a file holds; errors as of `fits.read`."""
    quantity = check_quantity(options.quantity)
    require_file(path)
    kind = sniff(path) if options.format is None else options.format
    applying: dict[tuple[str, ...], dict[str, Any]] = {
        ("merl", "rgl"): {"geometry": None, "bins": None},
        ("merl",): {"lookup": "centre", "strata": "bins"},
        ("rxt",): {"wavelengths": None, "corrected": None},
    }
    for kinds, defaults in applying.items():
        if kind not in kinds and any(getattr(options, name) != default for name, default in defaults.items()):
            files = " and ".join(one if one == "rxt" else one.upper() for one in kinds)
            raise ValueError(f"{path}: {' and '.join(defaults)} apply to {files} files only, this is a {kind} file")
    if options.strata != "bins" and options.bins in (None, "all"):
        raise ValueError(f"{path}: strata is given without a number of bins")
    try:
        return _read_as(kind, path, quantity, options)
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: {error}") from None  # of numbers that do not go together


def _read_as(kind: str, path: Path, quantity: Quantity | None, options: FileOptions) -> Measurements:
    always: dict[str, str | None] = {"totals": None, "rxt": None, "merl": "brdf", "rgl": "brdf_cos"}
    if quantity is not None and quantity != always.get(kind, quantity):
        held = "holds shares of the light" if always[kind] is None else f"always holds {always[kind]!r}"
        name = kind if always[kind] is None else kind.upper()
        raise ValueError(f"{path}: quantity is {quantity!r}, {'an' if kind == 'rgl' else 'a'} {name} file {held}")
    if kind == "csv":
        return csv.read(path, quantity)
    if kind == "totals":
        return totals_csv.read(path)
    if kind == "rxt":
        return rxt.read_slab(path, wavelengths=options.wavelengths, corrected=options.corrected).totals
    if kind == "merl":
        choice: dict[str, Any] = {"bins": options.bins, "strata": options.strata, "seed": options.seed}
        return merl.read(path, geometry=options.geometry, lookup=options.lookup, **choice)
    if kind == "rgl":
        return rgl.read(path, geometry=options.geometry, bins=options.bins, seed=options.seed)
    if kind in _QUANTITY_GIVEN:
        return _QUANTITY_GIVEN[kind](path, quantity or "brdf")
    if kind == "alta":
        return alta.read(path, quantity)
    if kind in _QUANTITY_STATED:
        found = _QUANTITY_STATED[kind](path)
        if quantity not in (None, found.source.quantity):
            raise ValueError(f"{path}: quantity is {quantity!r}, this {kind} file says {found.source.quantity!r}")
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
