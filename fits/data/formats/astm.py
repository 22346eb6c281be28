"""ASTM E1392 (later E2387) text of scatterometers, as Cornell's gonioreflectometer and libbsdf write it.

    KEY anything
    ...
    VARS theta_i,phi_i,theta_s,phi_s,R,G,B
    0.17,3.14,0.35,0.02,0.1,0.2,0.3
    ...

Header lines start with a key in capitals; VARS is the last and names the columns. theta_i and phi_i are the direction
towards the light, theta_s and phi_s that of the detector: polar angles from the normal, azimuths about it. The other
columns are the BSDF in 1/sr without the cosine, one channel each. Layout and units as libbsdf (`AstmReader.cpp`) and
ALTA (`data_io/astm.cpp`) read them: angles in radians. They are taken as degrees where one of them is above 2 pi, which
no angle in radians is.
"""

import re
from pathlib import Path

import numpy as np

from fits.data.formats._text import Line, plural, read_lines, require_range, rows
from fits.data.geometry import LIGHT_AZIMUTH, TANGENT_COSINE, direction
from fits.data.measurements import Measurements, Source, channel_names, to_bsdf
from fits.names import Quantity

_ANGLES = ("theta_i", "phi_i", "theta_s", "phi_s")
_NOT_VALUES = ("theta", "phi", "beta", "alpha", "psi", "angle", "polar", "cos")
_KEY = re.compile(r"[A-Z][A-Z0-9_]*$")
_TURN = 2.0 * np.pi


def recognises(lines: list[str]) -> bool:
    """Whether one of the first lines names columns, theta_i among them."""
    return any(line.startswith("VARS") and "theta_i" in line.lower() for line in lines)


def read(path: Path, quantity: Quantity = "brdf") -> Measurements:
    """Read such a file, whose numbers are `quantity`. Errors as in `fits.read`."""
    lines = [line for line in read_lines(path, "latin-1") if line.text.strip()]
    at = _vars(path, lines)
    named = lines[at].text.strip()[4:].strip(" ,\t=")
    columns = [name.strip() for name in (named.split(",") if "," in named else named.split())]
    names = [name.lower() for name in columns]
    channels = _channels(lines[at], columns)
    body = lines[at + 1 :]
    if not body:
        raise ValueError(f"{path}: no samples below VARS, must be at least one")
    table = dict(zip(names, rows(body, len(columns)).T, strict=True))
    angles = {name: table[name] for name in _ANGLES if name in table}
    degrees = any((abs(angle) > 1.0001 * _TURN).any() for angle in angles.values())
    half, turn = (180.0, 360.0) if degrees else (np.pi * 1.0001, _TURN * 1.0001)
    for name, angle in angles.items():
        require_range(body, angle, name, (-half, half) if name.startswith("theta") else (-turn, turn))
    if not degrees:
        angles = {name: np.degrees(angle) for name, angle in angles.items()}
    light = angles.get("phi_i", np.full(len(body), LIGHT_AZIMUTH))
    wi = direction(angles["theta_i"], light)
    wo = direction(angles["theta_s"], angles.get("phi_s", np.zeros(len(body))))
    values = to_bsdf(np.stack([table[name.lower()] for name in channels], axis=-1), wo, quantity)
    used = np.minimum(abs(wi[:, 2]), abs(wo[:, 2])) > TANGENT_COSINE
    notes = ["angles taken as degrees: some are above 2 pi" if degrees else "angles taken as radians"]
    if "phi_i" not in angles:
        notes.append("no phi_i: the light taken to stand opposite to phi_s = 0")
    if (values < 0).any():
        notes.append(f"{plural(int((values < 0).any(axis=1).sum()), 'sample')} below zero, kept as measured")
    if not used.all():
        notes.append(f"masked: {plural(int((~used).sum()), 'sample')} in the tangent plane")
    source = Source(str(path), "astm", quantity, tuple(notes))
    return Measurements(wi, wo, values, None, used, _names(channels), source)


def _vars(path: Path, lines: list[Line]) -> int:
    """The place of the line that names the columns."""
    for place, line in enumerate(lines):
        words = line.text.replace("=", " ").split()
        if words and words[0] == "VARS":
            return place
        if not words or not _KEY.match(words[0].rstrip(":")):
            raise line.error(f"{line.text.strip()[:40]!r} found, must be a key in capitals; VARS ends the header")
    raise ValueError(f"{path}: no line 'VARS theta_i,phi_i,theta_s,phi_s,...' that names the columns")


def _names(channels: tuple[str, ...]) -> tuple[str, ...]:
    """Channels as they are called elsewhere."""
    if [name.lower() for name in channels] == ["r", "g", "b"]:
        return channel_names(3)
    if len(channels) == 1:
        return channel_names(1)
    return tuple(re.sub(r"^([\d.]+)\s*nm$", r"\1 nm", name) for name in channels)


def _channels(line: Line, columns: list[str]) -> tuple[str, ...]:
    """The columns that are no angles."""
    names = [name.lower() for name in columns]
    twice = [name for name in columns if names.count(name.lower()) > 1]
    if twice or "" in names:
        raise line.error(f"column {twice[0] if twice else ''!r} is named twice, or not at all")
    for name in ("theta_i", "theta_s"):
        if name not in names:
            raise line.error(f"no column {name!r} among {', '.join(columns)}")
    channels = tuple(name for name in columns if name.lower() not in _ANGLES)
    for name in channels:
        if any(word in name.lower() for word in _NOT_VALUES):
            raise line.error(f"column {name!r} is not known; angles are {', '.join(_ANGLES)}, the others BSDFs")
    if not channels:
        raise line.error("no column of values beside the angles")
    return channels
