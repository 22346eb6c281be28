"""FRED tabulated BSDF text (Photon Engineering).

    type bsdf_data
    format angles=deg bsdf=value scale=1
    theta_spec phi_spec
    theta_scat phi_scat bsdf
    ...

A line of two numbers starts a block: the *specular* direction, so that the light stands opposite to it. Lines of three
follow: a scatter direction and the BSDF. All angles are from the normal, in degrees; a negative theta tilts to the
other side. BSDFs are multiplied by `scale`.
"""

from pathlib import Path

import numpy as np

from fits.data.formats._text import Line, content, plural, read_lines
from fits.data.geometry import TANGENT_COSINE, direction
from fits.data.measurements import Measurements, Source, channel_names, to_bsdf
from fits.names import Quantity

_FORMAT = {"angles": ("deg",), "bsdf": ("value",)}  # FRED also knows angles=sin and bsdf=log
_NOTHING = "a specular direction (a line of two numbers) without scatter directions, or the last number is missing"
_TILT, _INCIDENCE, _AZIMUTH = (-90.0, 90.0), (0.0, 90.0), (-360.0, 360.0)


def recognises(first_line: str) -> bool:
    """Whether this is the first line of a FRED table."""
    return first_line.lower().split()[:2] == ["type", "bsdf_data"]


def read(path: Path, quantity: Quantity = "brdf") -> Measurements:
    """Read a FRED table whose numbers are `quantity`. Errors as in `fits.read`."""
    lines = content(read_lines(path))
    if not recognises(lines[0].text if lines else ""):
        raise ValueError(
            f"{path}: a FRED table starts with 'type bsdf_data', found {lines[0].text[:40] if lines else ''!r}"
        )
    if len(lines) < 2 or lines[1].text.split()[0].lower() != "format":
        raise lines[0].error("must be followed by a line 'format angles=deg bsdf=value scale=1'")
    scale = _scale(lines[1])

    specular: tuple[float, float] | None = None
    opened: Line | None = None  # a block in which nothing was found yet
    rows = []
    for line in lines[2:]:
        cells = line.text.split()
        if len(cells) == 2:
            if opened is not None:
                raise opened.error(_NOTHING)
            opened = line
            specular = line.parse(cells[0], "theta_spec", _INCIDENCE), line.parse(cells[1], "phi_spec", _AZIMUTH)
        elif len(cells) == 3:
            if specular is None:
                raise line.error("a scatter direction before any specular direction (a line of two numbers)")
            opened = None
            scatter = line.parse(cells[0], "theta_scat", _TILT), line.parse(cells[1], "phi_scat", _AZIMUTH)
            rows.append((*specular, *scatter, line.parse(cells[2], "bsdf")))
        else:
            raise line.error(
                f"{plural(len(cells), 'number')}, must be 2 (specular direction) or 3 (direction and BSDF)"
            )
    if opened is not None:
        raise opened.error(_NOTHING)
    if not rows:
        raise ValueError(f"{path}: no samples below the header, must be at least one")
    theta_s, phi_s, theta_o, phi_o, bsdf = np.array(rows).T
    wi, wo = direction(theta_s, phi_s + 180.0), direction(theta_o, phi_o)
    values = to_bsdf(scale * bsdf[:, None], wo, quantity)
    above = np.minimum(wi[:, 2], wo[:, 2]) > TANGENT_COSINE
    notes = [] if above.all() else [f"masked: {plural(int((~above).sum()), 'sample')} in the tangent plane"]
    if (values < 0).any():
        notes.append(f"{plural(int((values < 0).sum()), 'sample')} below zero, kept as measured")
    return Measurements(
        wi, wo, values, None, above, channel_names(1), Source(str(path), "fred", quantity, tuple(notes))
    )


def _scale(line: Line) -> float:
    """The scale factor of a format line; anything that it says and we cannot read is an error."""
    scale = 1.0
    for word in line.text.split()[1:]:
        key, _, value = word.partition("=")
        if key.lower() == "scale":
            scale = line.parse(value, "scale", (0.0, float("inf")))
        elif key.lower() not in _FORMAT or value.lower() not in _FORMAT[key.lower()]:
            raise line.error(f"{word!r} is not supported, must be angles=deg, bsdf=value or scale=NUMBER")
    return scale
