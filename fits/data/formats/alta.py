"""ALTA's text of data (Inria's library of BRDF fitting): numbers under a header that says in which coordinates.

    #DIM 2 1
    #PARAM_IN RUSIN_TH_TD
    #PARAM_OUT INV_STERADIAN
    theta_h theta_d value
    ...

Angles are radians, azimuths counter-clockwise about the normal; view and light as in `params::to_cartesian` of ALTA
(`sources/core/params.cpp`), the layout as in its page "Data File Formats". Coordinates that do not fix a direction get
the directions that ALTA gives them. INV_STERADIAN_COSINE_FACTOR is the BRDF times the cosine of the view.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fits.data.formats._text import Line, plural, read_lines, rows
from fits.data.geometry import TANGENT_COSINE, Floats
from fits.data.measurements import Measurements, Source, channel_names, to_bsdf
from fits.names import QUANTITIES, Quantity

_HOLDS: dict[str, tuple[Quantity | None, int, tuple[str, ...] | None]] = {
    "INV_STERADIAN": ("brdf", 0, None),
    "INV_STERADIAN_COSINE_FACTOR": ("brdf_cos", 0, None),
    "UNKNOWN": (None, 0, None),
    "UNKNOWN_OUTPUT": (None, 0, None),
    "ENERGY": (None, 0, None),
    "RGB_COLOR": (None, 3, None),
    "XYZ_COLOR": (None, 3, ("X", "Y", "Z")),
}
"""Of PARAM_OUT: the quantity (None: it does not say), how many columns (0: any), and names."""

_KEYS = ("DIM", "PARAM_IN", "PARAM_OUT", "VS", "FORMAT")
_MOST = 1000

Pair = tuple[Floats, Floats]


def recognises(lines: list[str]) -> bool:
    """Whether the first lines have such a header."""
    keys = {line.split()[0] for line in lines if line}
    return {"#DIM", "#PARAM_IN"} <= keys


def read(path: Path, quantity: Quantity | None = None) -> Measurements:
    """Read such a file, whose numbers are what it says, or `quantity` where it does not. Errors as in `fits.read`."""
    raw = path.read_bytes()
    if b"#BEGIN_STREAM" in raw:
        raise ValueError(f"{path}: ALTA's binary data, which have no reader here; data2data writes them as text")
    lines = read_lines(path)
    said = _header(path, lines)
    coordinates, columns, directions = _coordinates(said["PARAM_IN"])
    dim_x, dim_y, spare = _dimensions(said)
    if dim_x != columns:
        raise said["DIM"][0].error(f"{dim_x} columns of {coordinates}, must be {columns}")
    holds, names = _quantity(path, said, dim_y, quantity)
    body = [line for line in lines if line.text.strip() and not line.text.lstrip().startswith("#")]
    if not body:
        raise ValueError(f"{path}: no samples below the header, must be at least one")
    table = rows(body, dim_x + dim_y + spare)
    with np.errstate(invalid="ignore"):
        wo, wi = directions(table[:, :dim_x])
    length = [np.linalg.norm(w, axis=1) for w in (wo, wi)]
    real = np.isfinite(length).all(axis=0) & (np.minimum(*length) > 1e-6)
    if not real.any():
        raise ValueError(f"{path}: none of the {plural(len(body), 'sample')} has directions in {coordinates}")
    wo, wi = (w[real] / size[real, None] for w, size in zip((wo, wi), length, strict=True))
    values = to_bsdf(table[real, dim_x : dim_x + dim_y], wo, holds)
    used = np.minimum(wi[:, 2], wo[:, 2]) > TANGENT_COSINE
    notes = [f"directions from {coordinates}"]
    if spare:
        notes.append("vertical segments (VS) are skipped: the file does not say how sure they are")
    if not real.all():
        notes.append(f"skipped: {plural(int((~real).sum()), 'sample')} of no directions")
    if not used.all():
        notes.append(f"masked: {plural(int((~used).sum()), 'sample')} with light or view at or below the horizon")
    source = Source(str(path), "alta", holds, tuple(notes))
    return Measurements(wi, wo, values, None, used, names or channel_names(dim_y), source)


def _header(path: Path, lines: list[Line]) -> dict[str, tuple[Line, list[str]]]:
    said: dict[str, tuple[Line, list[str]]] = {}
    for line in lines:
        words = line.text.split()
        if not words:
            continue
        if not words[0].startswith("#") or words[:3] == ["#ALTA", "END", "HEADER"]:
            break
        if words[0][1:] in _KEYS:
            said[words[0][1:]] = (line, words[1:])
    for key in ("DIM", "PARAM_IN"):
        if key not in said or not said[key][1]:
            raise ValueError(f"{path}: the header has no line '#{key} ...'")
    return said


def _dimensions(said: dict[str, tuple[Line, list[str]]]) -> tuple[int, int, int]:
    """Columns of coordinates, of values, and of vertical segments."""
    line, words = said["DIM"]
    if len(words) != 2:
        raise line.error(f"DIM must be followed by two numbers, found {len(words)}")
    sizes = [line.parse(word, "DIM", (1, _MOST)) for word in words]
    if any(size != int(size) for size in sizes):
        raise line.error(f"DIM is {' '.join(words)}, must be whole numbers")
    line, words = said.get("VS", (line, ["0"]))
    if len(words) not in (1, int(sizes[1])) or any(word not in ("0", "1", "2") for word in words):
        raise line.error(f"VS is {' '.join(words)[:40]!r}, must be 0, 1 or 2, once or for each column of values")
    return int(sizes[0]), int(sizes[1]), sum(int(word) for word in words)


def _quantity(
    path: Path, said: dict[str, tuple[Line, list[str]]], dim_y: int, requested: Quantity | None
) -> tuple[Quantity, tuple[str, ...] | None]:
    """Quantity of the values, by the file or else by the caller, and names of their columns."""
    line, words = said.get("PARAM_OUT", (said["DIM"][0], []))
    word = words[0] if words else "UNKNOWN"
    if word not in _HOLDS:
        raise line.error(f"PARAM_OUT is {word[:40]!r}, must be one of {', '.join(_HOLDS)}")
    stated, count, names = _HOLDS[word]
    if count not in (0, dim_y):
        raise line.error(f"{word} has {count} columns, DIM says {dim_y}")
    if requested is not None and stated not in (None, requested):
        raise ValueError(f"{path}: quantity is {requested!r}, this alta file says {stated!r}")
    holds = stated or requested
    if holds is None:
        raise ValueError(
            f"{path}: {f'PARAM_OUT {word}' if words else 'no PARAM_OUT: the header'} does not say what the values are: "
            f"give quantity=... (--read quantity=...), one of {', '.join(QUANTITIES)}"
        )
    return holds, names


def _coordinates(entry: tuple[Line, list[str]]) -> tuple[str, int, Callable[[Floats], Pair]]:
    """The name of PARAM_IN, how many columns it has, and what gives view and light of them."""
    line, words = entry
    if words[0] not in _COORDINATES:
        raise line.error(f"PARAM_IN is {words[0][:40]!r}, must be one of {', '.join(_COORDINATES)}")
    return words[0], *_COORDINATES[words[0]]


def _unit(theta: Floats, phi: Floats) -> Floats:
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1)


def _half(theta_h: Floats, phi_h: Floats, theta_d: Floats, phi_d: Floats) -> Pair:
    """Directions from Rusinkiewicz' half and difference angles; the first is at the difference angles, as in ALTA."""
    x, y, z = _unit(theta_d, phi_d).T
    tilted = np.cos(theta_h) * x + np.sin(theta_h) * z, y, np.cos(theta_h) * z - np.sin(theta_h) * x
    turned = np.cos(phi_h) * tilted[0] - np.sin(phi_h) * y, np.sin(phi_h) * tilted[0] + np.cos(phi_h) * y, tilted[2]
    view, half = np.stack(turned, axis=-1), _unit(theta_h, phi_h)
    return view, 2.0 * np.sum(view * half, axis=-1, keepdims=True) * half - view


def _projected(light: Floats, x: Floats, y: Floats) -> Pair:
    """View at polar angle |(x, y)| and azimuth atan2(y, x) from that of the light."""
    return _unit(np.hypot(x, y), np.arctan2(y, x)), _unit(light, np.zeros_like(light))


_COORDINATES: dict[str, tuple[int, Callable[[Floats], Pair]]] = {
    "RUSIN_TH_PH_TD_PD": (4, lambda t: _half(t[:, 0], t[:, 1], t[:, 2], t[:, 3])),
    "RUSIN_TH_TD_PD": (3, lambda t: _half(t[:, 0], 0.0 * t[:, 0], t[:, 1], t[:, 2])),
    "RUSIN_TH_TD": (2, lambda t: _half(t[:, 0], 0.0 * t[:, 0], t[:, 1], 0.0 * t[:, 0] + 0.5 * np.pi)),
    "COS_TH_TD": (2, lambda t: _half(np.arccos(t[:, 0]), 0.0 * t[:, 0], np.arccos(t[:, 1]), 0.0 * t[:, 0])),
    "COS_TH": (1, lambda t: _half(np.arccos(t[:, 0]), 0.0 * t[:, 0], 0.0 * t[:, 0], 0.0 * t[:, 0])),
    "SPHERICAL_TL_PL_TV_PV": (4, lambda t: (_unit(t[:, 2], t[:, 3]), _unit(t[:, 0], t[:, 1]))),
    "ISOTROPIC_TV_TL_DPHI": (3, lambda t: (_unit(t[:, 0], 0.0 * t[:, 0]), _unit(t[:, 1], t[:, 2]))),
    "ISOTROPIC_TL_TV_PROJ_DPHI": (3, lambda t: _projected(t[:, 0], t[:, 1], t[:, 2])),
    "ISOTROPIC_TV_PROJ_DPHI": (2, lambda t: _projected(0.0 * t[:, 0], t[:, 0], t[:, 1])),
    "CARTESIAN": (6, lambda t: (t[:, :3], t[:, 3:])),
}
