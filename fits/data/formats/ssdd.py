"""Surface scattering distribution data (SSDD) 0.3, of BSDFProcessor and libbsdf; numbers as text or binary.

    VERSION 0.3
    DATA_TYPE brdf
    COLOR_MODEL monochrome
    PARAM_TYPE spherical_coordinate_system
    PARAM0_LIST 0 30 60
    ...
    DATA ascii

A block holds the BSDF in 1/sr, without the cosine, over the product of its lists, PARAM0 running fastest; angles are
degrees. Directions are those of libbsdf: the light at azimuth 0 where there is no PARAM1_LIST, the mirror direction at
180; around it, azimuth 0 points towards the normal. A BTDF is written as if it were reflected, and turned below here.
Where lists name one pair of directions again, as all azimuths do around the pole, and 360 beside 0, the first is taken.
As in its "SSDD file format", and in `SpecularCoordinateSystem.h`, `HalfDifferenceCoordinateSystem.h` and `Btdf.h`.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fits.data.formats._text import Line, plural, require_room, rows, without_mark
from fits.data.geometry import TANGENT_COSINE, Floats, direction
from fits.data.measurements import Measurements, Source, channel_names

_LISTS = {f"PARAM{number}_LIST": number for number in range(5)}
_COLOURS = {"monochrome": channel_names(1), "rgb": channel_names(3), "xyz": ("X", "Y", "Z")}
_SYSTEMS = ("spherical_coordinate_system", "specular_coordinate_system", "half_difference_coordinate_system")
_TYPES = ("brdf", "btdf", "specular_reflectance", "specular_transmittance")
_FREE = ("SOFTWARE", "API", "DATE", "NAME", "SOURCE_TYPE", "DEVICE", "CREATION_DATE", "MEASUREMENT_DATE")


@dataclass
class _Block:
    """One table: what its header says, and its numbers (values, channels)."""

    line: Line
    kind: str
    said: dict[str, tuple[Line, list[str]]] = field(default_factory=dict)
    lists: dict[int, Floats] = field(default_factory=dict)
    values: Floats = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the lists, PARAM3 first: PARAM0 runs fastest."""
        return tuple(len(self.lists.get(number, [0.0])) for number in (3, 2, 1, 0))


def recognises(head: bytes) -> bool:
    """Whether a file starts as this format."""
    return head.lstrip().startswith(b"VERSION") and b"DATA_TYPE" in head


def read(path: Path) -> Measurements:
    """Read all BRDFs and BTDFs of a file. Errors as in `fits.read`."""
    blocks = _blocks(path)
    tables = [block for block in blocks if block.kind in ("brdf", "btdf")]
    if not tables:
        raise ValueError(f"{path}: no brdf or btdf, it holds {', '.join(block.kind for block in blocks) or 'no data'}")
    channels = _channels(tables[0])
    for block in tables[1:]:
        if _channels(block) != channels:
            raise block.line.error("this block has other colours than the first")
    directions = [_directions(block) for block in tables]
    firsts = [_once(*pair) for pair in directions]
    wi, wo = (np.concatenate([pair[k][rows] for pair, rows in zip(directions, firsts, strict=True)]) for k in (0, 1))
    values = np.concatenate([block.values[rows] for block, rows in zip(tables, firsts, strict=True)])
    below = np.repeat([block.kind == "btdf" for block in tables], [len(rows) for rows in firsts])
    seen = np.minimum(wi[:, 2], wo[:, 2]) > TANGENT_COSINE
    wo[below, 2] *= -1.0
    if not seen.any():
        raise ValueError(f"{path}: no value has light and viewer above the horizon")
    notes = [" and ".join(f"{block.kind} in a {block.said['PARAM_TYPE'][1][0]}" for block in tables)]
    again = sum(len(block.values) for block in tables) - len(values)
    if again:
        notes.append(f"skipped: {plural(again, 'value')} at directions that the file holds already")
    if not seen.all():
        notes.append(f"skipped: {plural(int((~seen).sum()), 'value')} at or beyond the horizon")
    if any("REDUCTION_TYPE" in block.said for block in tables):
        notes.append("what the file leaves to symmetry is not filled in")
    other = [block.kind for block in blocks if block not in tables]
    if other:
        notes.append(f"skipped: {', '.join(other)}")
    source = Source(str(path), "ssdd", "brdf", tuple(notes))
    return Measurements(wi[seen], wo[seen], values[seen], None, np.ones(int(seen.sum()), bool), channels, source)


def _blocks(path: Path) -> list[_Block]:
    raw = without_mark(path.read_bytes())
    raw = raw if b"\n" in raw else raw.replace(b"\r", b"\n")  # as old programs end lines
    blocks: list[_Block] = []
    place, number = 0, 0
    current: _Block | None = None
    while place < len(raw):
        line, place, number = _line(path, raw, place, number)
        words = line.text.split()
        if not words or line.text.startswith("#"):
            continue
        key = words[0]
        if number == 1 and key != "VERSION":
            raise line.error(f"{key[:40]!r} found, must be VERSION")
        if key == "VERSION":
            if len(words) != 2 or not words[1].startswith("0."):
                raise line.error(f"VERSION is {' '.join(words[1:])[:20]!r}, must be 0.1, 0.2 or 0.3")
        elif key == "DATA_TYPE":
            if words[1:] not in [[kind] for kind in _TYPES]:
                raise line.error(f"DATA_TYPE is {' '.join(words[1:])[:40]!r}, must be one of {', '.join(_TYPES)}")
            current = _Block(line, words[1])
        elif key in _FREE:
            continue
        elif current is None:
            raise line.error(f"{key[:40]!r} found before any DATA_TYPE")
        elif key == "DATA":
            place, number = _data(path, raw, place, number, line, current)
            blocks.append(current)
            current = None
        else:
            _describe(line, key, words[1:], current)
    if current is not None:
        raise ValueError(f"{path}: the file ends where DATA is expected (truncated?)")
    return blocks


def _line(path: Path, raw: bytes, place: int, number: int) -> tuple[Line, int, int]:
    """The line that starts here, and where the next one does."""
    end = raw.find(b"\n", place)
    end = len(raw) if end < 0 else end
    return Line(path, number + 1, raw[place:end].decode("utf-8", "replace").strip()), end + 1, number + 1


def _describe(line: Line, key: str, words: list[str], block: _Block) -> None:
    if key in _LISTS:
        high = 180.0 if key == "PARAM2_LIST" else 90.0 if key in ("PARAM0_LIST", "PARAM4_LIST") else 360.0
        allowed = (-90.0 if key == "PARAM4_LIST" else 0.0, high)
        if not words:
            raise line.error(f"{key} without numbers")
        block.lists[_LISTS[key]] = np.array([line.parse(word, key, allowed) for word in words])
    elif key in ("COLOR_MODEL", "WAVELENGTH_LIST", "PARAM_TYPE", "REDUCTION_TYPE") and words:
        block.said[key] = (line, words)
    else:
        raise line.error(f"unknown entry {key[:40]!r}")


def _data(path: Path, raw: bytes, place: int, number: int, line: Line, block: _Block) -> tuple[int, int]:
    """Fill in the numbers; returns where the next line starts."""
    _check(line, block)
    count, width = int(np.prod([float(size) for size in block.shape])), len(_channels(block))
    require_room(path, count, width)
    mode = line.text.split()[1:]
    if mode == ["binary"]:
        size = 4 * count * width
        if len(raw) - place < size:
            raise line.error(f"{len(raw) - place} bytes of data, must be {size} (truncated?)")
        values = np.frombuffer(raw, "<f4", count * width, place).astype(float).reshape(count, width)
        if not np.isfinite(values).all():
            raise line.error(f"the data hold {values[~np.isfinite(values)][0]}, must be finite")
        block.values = values
        return place + size, number
    if mode != ["ascii"]:
        raise line.error(f"DATA is {' '.join(mode)[:40]!r}, must be ascii or binary")
    body: list[Line] = []
    while len(body) < count:
        if place >= len(raw):
            raise ValueError(f"{path}: the file ends where {plural(count, 'line')} of data are expected (truncated?)")
        wanted = count - len(body)
        for piece in raw[place:].split(b"\n", wanted)[:wanted]:
            number, place = number + 1, place + len(piece) + 1
            words = piece.decode("utf-8", "replace").strip()
            if words and not words.startswith("#"):
                body.append(Line(path, number, words))
    block.values = rows(body, width)
    return place, number


def _check(line: Line, block: _Block) -> None:
    """Whether all is said that the numbers need."""
    for key in ("COLOR_MODEL", *(("PARAM_TYPE",) if block.kind in ("brdf", "btdf") else ())):
        if key not in block.said:
            raise line.error(f"the header of this {block.kind} has no {key}")
    needed = (0, 2, 3) if block.kind in ("brdf", "btdf") else (0,)
    for number in needed:
        if number not in block.lists:
            raise line.error(f"the header of this {block.kind} has no PARAM{number}_LIST")
    if block.kind not in ("brdf", "btdf"):
        block.lists = {number: values for number, values in block.lists.items() if number < 2}
        return
    where, words = block.said["PARAM_TYPE"]
    if words not in [[system] for system in _SYSTEMS]:
        raise where.error(f"PARAM_TYPE is {' '.join(words)[:40]!r}, must be one of {', '.join(_SYSTEMS)}")
    if len(block.lists.get(4, block.lists[0])) != len(block.lists[0]):
        raise line.error(
            f"{len(block.lists[4])} offsets in PARAM4_LIST, must be {len(block.lists[0])} as in PARAM0_LIST"
        )


def _channels(block: _Block) -> tuple[str, ...]:
    line, words = block.said["COLOR_MODEL"]
    if words[0] == "spectrum":
        where, wavelengths = block.said.get("WAVELENGTH_LIST", (line, []))
        if not wavelengths:
            raise line.error("spectrum without WAVELENGTH_LIST")
        return tuple(f"{where.parse(word, 'WAVELENGTH_LIST', (0.0, 1e6)):g} nm" for word in wavelengths)
    if words[0] not in _COLOURS:
        raise line.error(f"COLOR_MODEL is {words[0][:40]!r}, must be one of {', '.join((*_COLOURS, 'spectrum'))}")
    return _COLOURS[words[0]]


def _directions(block: _Block) -> tuple[Floats, Floats]:
    """wi and wo (N, 3), both as if reflected."""
    lists = [block.lists.get(number, np.zeros(1)) for number in range(4)]
    third, second, first, zeroth = (grid.ravel() for grid in np.meshgrid(*lists[::-1], indexing="ij"))
    system = block.said["PARAM_TYPE"][1][0]
    local = direction(second, third)
    if system == "half_difference_coordinate_system":
        wi, half = _tilted(local, zeroth, first), direction(zeroth, first)
        return wi, 2.0 * np.sum(wi * half, axis=-1, keepdims=True) * half - wi
    wi = direction(zeroth, first)
    if system == "spherical_coordinate_system":
        return wi, local
    offset = block.lists.get(4, np.zeros(len(lists[0])))
    tilt = zeroth + np.broadcast_to(offset, block.shape).ravel()
    return wi, _tilted(local, -tilt, first)


def _once(wi: Floats, wo: Floats) -> NDArray[np.int_]:
    """Rows at which a pair of directions (N, 3) stands first, in their order."""
    pairs = np.round(np.concatenate([wi, wo], axis=-1), 9) + 0.0  # no -0
    return np.sort(np.unique(pairs, axis=0, return_index=True)[1])


def _tilted(local: Floats, theta: Floats, phi: Floats) -> Floats:
    """Vectors (N, 3) turned by theta about y, from z towards x, and then by phi about z; degrees."""
    tilt, turn = np.radians(theta), np.radians(phi)
    x = np.cos(tilt) * local[:, 0] + np.sin(tilt) * local[:, 2]
    z = np.cos(tilt) * local[:, 2] - np.sin(tilt) * local[:, 0]
    y = local[:, 1]
    return np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z], axis=-1)
