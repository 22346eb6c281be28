"""LightTools' own BSDF text: keywords of Zemax' format, but a header for each table, and angles about the normal.

    Symmetry PlaneSymmetrical
    SpectralContent Monochrome
    ScatterAzimuth 3
    0 90 180
    ScatterRadial 2
    0 30
    DataBegin
    AOI 20
    POI 0
    Side Front
    Wavelength 550
    ScatterType BRDF
    TIS 0.2
    1 2 ...
    ...
    DataEnd

Values are BSDFs in 1/sr, for each azimuth all radial angles. ScatterRadial is the polar angle from the normal of the
side where the light leaves, ScatterAzimuth the azimuth about the front's, and the light stands at azimuth 90. No
specification is public: layout and angles are those of `LightToolsBsdfReader.cpp` of libbsdf. How POI turns the plane
of incidence is not known from there; it is taken as counter-clockwise.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fits.data.formats._rows import Rows
from fits.data.formats._text import Line, content, plural, read_lines
from fits.data.geometry import TANGENT_COSINE, Floats, direction
from fits.data.measurements import Measurements, Source, channel_names, to_bsdf
from fits.names import Quantity

_LIGHT = 90.0
"""Azimuth of the light in these files."""

_HEADER = {  # keyword -> the values that the format knows, in lower case; none: any
    "symmetry": ("planesymmetrical", "asymmetrical", "asymmetric", "asymmetrical4d"),
    "spectralcontent": ("monochrome", "xyz"),
    "source": (),
}
_ANGLES = {"scatterazimuth": (-360.0, 360.0), "scatterradial": (0.0, 90.0)}
_TABLE = {
    "side": ("front", "back"),
    "scattertype": ("brdf", "btdf"),
    "tristimulusvalue": ("trisx", "trisy", "trisz"),
}
_NUMBERS = {"aoi": (0.0, 90.0), "poi": (-360.0, 360.0), "wavelength": (0.0, 1e7)}
_CHANNELS = {"monochrome": channel_names(1), "xyz": ("X", "Y", "Z")}


@dataclass
class _Table:
    line: Line
    words: dict[str, str] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    values: Floats = field(default_factory=lambda: np.empty(0))

    def place(self) -> tuple[str, str, float, float]:
        """Side, type, and direction of the light: tables that share it are channels of one another."""
        return (
            self.words.get("side", "front"),
            self.words.get("scattertype", "brdf"),
            self.numbers["aoi"],
            self.numbers.get("poi", 0.0),
        )


def recognises(lines: list[str]) -> bool:
    """Whether the first lines that are no comments are of such a file: Zemax' has no AOI, and SampleRotation."""
    words = {line.split()[0].lower() for line in lines}
    return {"scatterazimuth", "scatterradial"} <= words and "aoi" in words and "samplerotation" not in words


def read(path: Path, quantity: Quantity = "brdf") -> Measurements:
    """Read such a file, whose numbers are `quantity`. Errors as in `fits.read`."""
    lines = [line for line in content(read_lines(path)) if not line.text.lower().startswith("lighttools")]
    rest = Rows(path, lines)
    choices, angles = _header(rest)
    azimuth, radial = angles["scatterazimuth"], angles["scatterradial"]
    tables = _tables(rest, len(azimuth) * len(radial))
    channels = _CHANNELS[choices["spectralcontent"]]
    groups: dict[tuple[str, str, float, float], dict[int, _Table]] = {}
    for table in tables:
        colour = table.words.get("tristimulusvalue", "trisx") if len(channels) > 1 else "trisx"
        channel = _TABLE["tristimulusvalue"].index(colour)
        if groups.setdefault(table.place(), {}).setdefault(channel, table) is not table:
            raise table.line.error("this table stands twice in the file: the same AOI, POI, Side and ScatterType")
    once = np.ones((len(azimuth), len(radial)), bool)
    once[1:, radial == 0] = False
    once[azimuth >= azimuth[0] + 360.0] = False
    theta, phi = (grid[once] for grid in np.meshgrid(radial, azimuth))
    wi, wo, values = [], [], []
    for (side, kind, aoi, poi), parts in groups.items():
        if len(parts) != len(channels):
            raise parts[min(parts)].line.error(f"{plural(len(parts), 'table')} of this AOI, must be {len(channels)}")
        sign = 1.0 if side == "front" else -1.0
        leaves = direction(theta, phi) * np.array([1.0, 1.0, sign if kind == "brdf" else -sign])
        comes = direction(aoi, _LIGHT + poi) * np.array([1.0, 1.0, sign])
        wi.append(np.broadcast_to(comes, leaves.shape))
        wo.append(leaves)
        values.append(np.stack([parts[c].values.reshape(once.shape)[once] for c in range(len(channels))], axis=-1))
    comes, leaves = np.concatenate(wi), np.concatenate(wo)
    used = np.minimum(abs(comes[:, 2]), abs(leaves[:, 2])) > TANGENT_COSINE
    notes = [
        "azimuths about the normal, the light at 90 degrees; as libbsdf reads these files, there is no public rule"
    ]
    if any(place[3] != 0.0 for place in groups):
        notes.append("POI taken as counter-clockwise")
    if not used.all():
        notes.append(f"masked: {plural(int((~used).sum()), 'sample')} in the tangent plane")
    source = Source(str(path), "lighttools", quantity, tuple(notes))
    bsdf = to_bsdf(np.concatenate(values), leaves, quantity)
    return Measurements(comes, leaves, bsdf, None, used, channels, source)


def _header(rest: Rows) -> tuple[dict[str, str], dict[str, Floats]]:
    """The header before DataBegin."""
    choices: dict[str, str] = {}
    angles: dict[str, Floats] = {}
    while True:
        line = rest.text("DataBegin")
        words = line.text.split()
        key = words[0].lower()
        if key == "databegin":
            break
        if key in _ANGLES and len(words) == 2:
            count = line.parse(words[1], words[0], (1, 100_000))
            if count != int(count):
                raise line.error(f"{words[0]} is {words[1]}, must be a whole number")
            angles[key] = rest.numbers(int(count), f"angles of {words[0]}", _ANGLES[key])
        elif key in _HEADER and len(words) >= 2:
            if _HEADER[key] and words[1].lower() not in _HEADER[key]:
                raise line.error(f"{words[0]} is {words[1]!r}, must be one of {', '.join(_HEADER[key])}")
            choices[key] = words[1].lower()
        else:
            raise line.error(f"{line.text.strip()[:40]!r} found, must be one of {', '.join((*_HEADER, *_ANGLES))}")
    missing = [key for key in ("spectralcontent", *_ANGLES) if key not in choices and key not in angles]
    if missing:
        raise line.error(f"the header ends here without {', '.join(missing)}")
    return choices, angles


def _tables(rest: Rows, size: int) -> list[_Table]:
    """All tables up to DataEnd."""
    tables: list[_Table] = []
    table: _Table | None = None
    while True:
        line = rest.text("DataEnd")
        words = line.text.split()
        key = words[0].lower()
        if key == "dataend":
            break
        table = table or _Table(line)
        if len(words) != 2 or key not in (*_TABLE, *_NUMBERS, "tis"):
            known = ", ".join((*_NUMBERS, *_TABLE, "tis"))
            raise line.error(f"{line.text.strip()[:40]!r} found, must be one value after one of {known}")
        if key in _TABLE:
            if words[1].lower() not in _TABLE[key]:
                raise line.error(f"{words[0]} is {words[1]!r}, must be one of {', '.join(_TABLE[key])}")
            table.words[key] = words[1].lower()
        elif key in _NUMBERS:
            table.numbers[key] = line.parse(words[1], words[0], _NUMBERS[key])
        else:
            if "aoi" not in table.numbers:
                raise line.error("a table without AOI")
            table.values = rest.numbers(size, "values of a table")
            tables.append(table)
            table = None
    if table is not None:
        raise line.error("DataEnd in the header of a table")
    rest.end()
    if not tables:
        raise line.error("no tables between DataBegin and DataEnd")
    return tables
