"""Zemax (OpticStudio) tabular BSDF text, also called Radiant Imaging's BSDF data interchange format.

For every sample rotation and angle of incidence the file holds a rectangle of values over ScatterAzimuth and
ScatterRadial. These are polar coordinates around the *specular* direction (BRDF) or the direction of collimated
transmission (BTDF), not around the normal: ScatterRadial is the angle from that direction, and ScatterAzimuth 0 points
from it towards the normal, counter-clockwise seen against the specular ray. Documented in "Zemax Tabular BSDF data file
format", Zemax knowledge base.

A rectangle reaches below the horizon; such points are skipped. A zero above it means "not measured": it is masked.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fits.data.formats._text import Line, content, plural, read_lines
from fits.data.geometry import LIGHT_AZIMUTH, TANGENT_COSINE, Floats, direction
from fits.data.measurements import Measurements, Source, channel_names, to_bsdf
from fits.names import Quantity

_CHOICES = {  # keyword -> the values that the format knows, in lower case
    "source": ("measured",),
    "symmetry": ("planesymmetrical", "asymmetrical", "asymmetrical4d"),
    "spectralcontent": ("monochrome", "xyz"),
    "scattertype": ("brdf", "btdf"),
}
_ANGLES = {  # keyword -> allowed range in degrees
    "samplerotation": (-360.0, 360.0),
    "angleofincidence": (0.0, 90.0),
    "scatterazimuth": (0.0, 360.0),
    "scatterradial": (0.0, 180.0),
}
_BLOCKS = {"monochrome": ("monochrome",), "xyz": ("tristimulusx", "tristimulusy", "tristimulusz")}
_CHANNELS = {"monochrome": channel_names(1), "xyz": ("X", "Y", "Z")}


@dataclass
class _File:
    """The header of a file, and its values as (channel, rotation, incidence, azimuth, radial)."""

    choices: dict[str, str] = field(default_factory=dict)
    angles: dict[str, Floats] = field(default_factory=dict)
    values: Floats = field(default_factory=lambda: np.empty(0))


def recognises(lines: list[str]) -> bool:
    """Whether the first lines that are no comments are such a header."""
    words = {line.split()[0].lower() for line in lines[:20]}
    return {"scatterazimuth", "scatterradial"} <= words or {"spectralcontent", "scattertype"} <= words


def read(path: Path, quantity: Quantity = "brdf") -> Measurements:
    """Read a Zemax BSDF whose numbers are `quantity`. Errors as in `fits.read`.

    AngleOfIncidence is taken as theta_i. The light stands at phi_i = 180 - SampleRotation: the sample turns
    counter-clockwise under it. The specular direction, which the file repeats for every azimuth, is taken once.
    """
    file = _parse(path)
    btdf = file.choices["scattertype"] == "btdf"
    rotation, incidence, azimuth, radial = (file.angles[name] for name in _ANGLES)
    once = np.ones((len(azimuth), len(radial)), bool)
    once[1:, radial == 0] = False
    once[azimuth >= 360] = False

    theta_i, phi_i = np.meshgrid(incidence, LIGHT_AZIMUTH - rotation)  # (rotation, incidence)
    wi = np.broadcast_to(direction(theta_i, phi_i)[:, :, None, None], (*theta_i.shape, *once.shape, 3))
    wo = around_specular(theta_i, phi_i, azimuth, radial, btdf)
    above = (wo[..., 2] * (-1 if btdf else 1)) > TANGENT_COSINE
    keep = once & above
    values = to_bsdf(np.moveaxis(file.values, 0, -1)[keep], wo[keep], quantity)
    measured = (values != 0).any(axis=-1)

    notes = [
        "ScatterRadial and ScatterAzimuth converted from around the specular direction to theta_o, phi_o",
        f"skipped: {plural(int((once & ~above).sum()), 'grid point')} at or beyond the horizon",
    ]
    if not measured.all():
        notes.append(f"masked: {plural(int((~measured).sum()), 'zero')} above the horizon, not measured")
    if len(rotation) > 1 or file.choices["symmetry"] != "planesymmetrical":
        notes.append("SampleRotation and ScatterAzimuth taken as counter-clockwise, seen from the lit side")
    if len(rotation) > 1:
        notes.append("the sample's x of Zemax is at right angles to the plane of incidence at SampleRotation 0")
    if btdf:
        notes.append("BTDF: AngleOfIncidence taken as the angle of collimated transmission, equal to theta_i")
    channels = _CHANNELS[file.choices["spectralcontent"]]
    source = Source(str(path), "zemax", quantity, tuple(notes))
    return Measurements(wi[keep], wo[keep], values, None, measured, channels, source)


def around_specular(theta_i: Floats, phi_i: Floats, azimuth: Floats, radial: Floats, btdf: bool) -> Floats:
    """Scatter directions (rotation, incidence, azimuth, radial, 3) from angles in degrees around the specular ray."""
    theta_s = (180.0 - theta_i) if btdf else theta_i
    specular = direction(theta_s, phi_i + 180.0)
    towards_normal = direction(theta_s + (90.0 if btdf else -90.0), phi_i + 180.0)  # at a right angle to specular
    sideways = np.cross(specular, towards_normal)  # a counter-clockwise quarter turn, seen against the specular ray
    turn, away = (np.radians(angle)[..., None] for angle in np.meshgrid(azimuth, radial, indexing="ij"))
    axis = [vector[:, :, None, None, :] for vector in (specular, towards_normal, sideways)]
    return np.cos(away) * axis[0] + np.sin(away) * (np.cos(turn) * axis[1] + np.sin(turn) * axis[2])


def _parse(path: Path) -> _File:
    lines = iter(content(read_lines(path)))
    file = _File()
    start = _parse_header(path, lines, file)
    shape = tuple(len(file.angles[name]) for name in _ANGLES)
    values = []
    for number, name in enumerate(_BLOCKS[file.choices["spectralcontent"]]):
        if number > 0:
            start = _next(path, lines, f"the block {name!r}")
        _expect(start, name)
        values.append(_parse_block(path, lines, shape))
    trailing = next(lines, None)
    if trailing is not None:
        raise trailing.error(f"{trailing.text.strip()[:40]!r} found after the last block")
    file.values = np.stack(values)
    return file


def _parse_header(path: Path, lines: Iterator[Line], file: _File) -> Line:
    """Fill in the header; returns the line that starts the first block."""
    while True:
        line = _next(path, lines, "the header")
        words = line.text.split()
        key = words[0].lower()
        if key in (name for names in _BLOCKS.values() for name in names):
            break
        if key not in _CHOICES and key not in _ANGLES:
            raise line.error(f"unknown keyword {words[0]!r}, must be one of {', '.join((*_CHOICES, *_ANGLES))}")
        if len(words) != 2:
            raise line.error(f"{words[0]} must be followed by one value, found {len(words) - 1}")
        if key in _CHOICES:
            if words[1].lower() not in _CHOICES[key]:
                raise line.error(f"{words[0]} is {words[1]!r}, must be one of {', '.join(_CHOICES[key])}")
            file.choices[key] = words[1].lower()
        else:
            file.angles[key] = _angles(path, lines, line, _ANGLES[key])
    missing = [name for name in (*_CHOICES, *_ANGLES) if name not in file.choices and name not in file.angles]
    if "source" in missing:
        missing.remove("source")  # it says nothing that we need
    if missing:
        raise line.error(f"the header ends here without {', '.join(missing)}")
    return line


def _angles(path: Path, lines: Iterator[Line], header: Line, allowed: tuple[float, float]) -> Floats:
    """The angles listed below a keyword, on one or more lines, as many as it announces."""
    name, announced = header.text.split()
    count = header.parse(announced, name, (1, 100_000))
    angles: list[float] = []
    while len(angles) < count:
        line = _next(path, lines, f"{count:g} angles for {name}")
        angles += line.numbers(allowed)
    if len(angles) != count:
        raise line.error(f"{len(angles)} angles for {name}, must be {count:g} as announced in line {header.number}")
    return np.array(angles)


def _parse_block(path: Path, lines: Iterator[Line], shape: tuple[int, ...]) -> Floats:
    """One spectral block: for each rotation and incidence a TIS line, and a line of radial values for each azimuth."""
    rotations, incidences, azimuths, radials = shape
    _expect(_next(path, lines, "DataBegin"), "databegin")
    rows = []
    for _ in range(rotations * incidences):
        _expect(_next(path, lines, "TIS"), "tis")
        for _ in range(azimuths):
            line = _next(path, lines, "a row of values")
            row = line.numbers()
            if len(row) != radials:
                raise line.error(f"{plural(len(row), 'value')}, must be {radials} as announced by ScatterRadial")
            rows.append(row)
    _expect(_next(path, lines, "DataEnd"), "dataend")
    return np.array(rows).reshape(shape)


def _expect(line: Line, word: str) -> None:
    if line.text.split()[0].lower() != word:
        raise line.error(f"{line.text.strip()[:40]!r} found, must be {word!r}")


def _next(path: Path, lines: Iterator[Line], wanted: str) -> Line:
    line = next(lines, None)
    if line is None:
        raise ValueError(f"{path}: the file ends where {wanted} is expected (truncated?)")
    return line
