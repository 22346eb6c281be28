"""Text of pab's goniophotometers (pgII, "mountain" files): one direction of the light a file.

    #incident_angle 30 180
    #format: theta phi DSF
    theta phi value
    ...

Angles are degrees from the normal of the front (above 90: behind it) and counter-clockwise about it, seen from the
front; those of the light point towards it. DSF is the BSDF times |cos theta| of the viewer; BSDF, BRDF and BTDF are
without it. As `pabopto2bsdf` of Radiance reads them and its manual says (`pabopto2bsdf.c`, `pabopto2bsdf.1`).
"""

from pathlib import Path

import numpy as np

from fits.data.formats._text import Line, plural, read_lines, require_range, rows
from fits.data.geometry import TANGENT_COSINE, direction
from fits.data.measurements import Measurements, Source, channel_names, to_bsdf
from fits.names import Quantity

_HOLDS: dict[str, Quantity] = {"dsf": "brdf_cos", "bsdf": "brdf", "brdf": "brdf", "btdf": "brdf"}
_COLOURS = {"cie-y": channel_names(1), "cie-xyz": ("X", "Y", "Z")}
_POLAR, _AZIMUTH = (-180.0, 180.0), (-360.0, 720.0)


def recognises(lines: list[str]) -> bool:
    """Whether one of the first lines says what the columns are."""
    return any(line.lower().split()[:3] == ["#format:", "theta", "phi"] for line in lines)


def read(path: Path) -> Measurements:
    """Read such a file; the quantity is what it says. Errors as in `fits.read`."""
    lines = [line for line in read_lines(path, "latin-1") if line.text.strip()]
    header = [line for line in lines if line.text.startswith("#")]
    body = [line for line in lines if not line.text.startswith("#")]
    said: dict[str, tuple[Line, list[str]]] = {}
    for line in header:
        words = line.text[1:].split()
        if words:
            said[words[0].lower().rstrip(":")] = (line, words[1:])
    quantity = _quantity(path, said)
    theta, phi = _light(path, said)
    line, words = said.get("colorimetry", (header[0], ["CIE-Y"]))
    colour = " ".join(words).lower()
    if colour not in _COLOURS:
        raise line.error(f"colorimetry is {' '.join(words)[:40]!r}, must be CIE-Y or CIE-XYZ")
    channels = _COLOURS[colour]
    if not body:
        raise ValueError(f"{path}: no samples below the header, must be at least one")
    table = rows(body, 2 + len(channels))
    require_range(body, table[:, 0], "theta", _POLAR)
    require_range(body, table[:, 1], "phi", _AZIMUTH)
    wi = np.broadcast_to(direction(theta, phi), (len(body), 3))
    wo = direction(table[:, 0], table[:, 1])
    values = to_bsdf(table[:, 2:], wo, quantity)
    used = np.minimum(abs(wi[:, 2]), abs(wo[:, 2])) > TANGENT_COSINE
    notes = [f"light at theta {theta:g}, phi {phi:g}; a file holds one direction of it"]
    if not used.all():
        notes.append(f"masked: {plural(int((~used).sum()), 'sample')} in the tangent plane")
    if (values < 0).any():
        notes.append(f"{plural(int((values < 0).any(axis=1).sum()), 'sample')} below zero, kept as measured")
    if "upphi" in said:
        notes.append(f"the sample's up is at phi {' '.join(said['upphi'][1])}; azimuths are kept as they are")
    return Measurements(wi, wo, values, None, used, channels, Source(str(path), "pab", quantity, tuple(notes)))


def _quantity(path: Path, said: dict[str, tuple[Line, list[str]]]) -> Quantity:
    if "format" not in said:
        raise ValueError(f"{path}: no line '#format: theta phi DSF' (or BSDF, BRDF, BTDF)")
    line, words = said["format"]
    found = [word.lower() for word in words]
    if found[:2] != ["theta", "phi"] or len(found) != 3 or found[2] not in _HOLDS:
        raise line.error(f"format is {' '.join(words)[:40]!r}, must be theta phi DSF, BSDF, BRDF or BTDF")
    return _HOLDS[found[2]]


def _light(path: Path, said: dict[str, tuple[Line, list[str]]]) -> tuple[float, float]:
    """Polar angle and azimuth of the light."""
    if "incident_angle" in said:
        line, words = said["incident_angle"]
        if len(words) != 2:
            raise line.error(f"incident_angle must be followed by theta and phi, found {plural(len(words), 'word')}")
        pair = [(line, words[0]), (line, words[1])]
    else:
        pair = []
        for name in ("intheta", "inphi"):
            if name not in said:
                raise ValueError(f"{path}: no #incident_angle, nor #intheta and #inphi (missing: {name})")
            line, words = said[name]
            if len(words) != 1:
                raise line.error(f"{name} must be followed by one number, found {plural(len(words), 'word')}")
            pair.append((line, words[0]))
    (first, theta), (second, phi) = pair
    return first.parse(theta, "theta", _POLAR), second.parse(phi, "phi", _AZIMUTH)
