"""`fits.export`: write a stack to a file of a material."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

import layerjax as lj
from fits._files import given_path, require_switch, write_bytes
from fits.data.geometry import Floats
from fits.exports import klems, merl, rgl, slices, zemax
from fits.exports.contents import Contents
from fits.exports.material import Material, material_of
from fits.exports.openpbr import document as openpbr
from fits.names import EXPORTS, To
from fits.optimise.result import Fit
from fits.progress import Progress, given_progress
from layerjax._checks import abbreviate
from layerjax.compiling import program_cache

_WRITERS: dict[str, Callable[[Material, Floats | None], Contents]] = {
    "rgl": rgl.contents,
    "merl": merl.contents,
    "zemax": zemax.contents,
    "klems": klems.contents,
    "openpbr": openpbr.contents,
    "csv": slices.contents,
}

ENDINGS: dict[str, str] = {
    "rgl": ".bsdf",
    "merl": ".binary",
    "zemax": ".bsdf",
    "klems": ".xml",
    "openpbr": ".mtlx",
    "csv": ".csv",
}
"""Suffixes of file names."""


@dataclass(frozen=True)
class ExportReport:
    """A written file.

    Attributes:
        path: the file.
        to: its format.
        notes: what it holds, how accurately, and what it omits, one sentence each.
    """

    path: Path
    to: To
    notes: tuple[str, ...]


MIRRORED = "what smooth surfaces mirror and transmit along single directions is omitted (lj.specular gives it)"


@program_cache()
def export(
    material: "lj.Stack | lj.Mixture | Fit",
    path: str | Path,
    to: To,
    *,
    transport: lj.Transport | Literal["auto"] | None = None,
    wavelengths: ArrayLike | None = None,
    name: str | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> ExportReport:
    """Write a material to a file for renderers or optical design.

    Args:
        material: a stack or a mixture without free parameters, or a fit, whose best values are written.
        path: the file, with the ending of the format.
        to: the format. "rgl": RGL's tensor file, which Mitsuba and pbrt read. "merl": a MERL table. "zemax": Zemax and
            LightTools. "klems": matrices in the XML of WINDOW, which Radiance reads. "openpbr": the closest OpenPBR
            surface in MaterialX (extra `materialx`). "csv": slices in this project's convention.
        transport: solver of the light transport; None: that of the fit, or "auto".
        wavelengths: (C,) nm, ascending, one for each channel: for "rgl" only, which is then spectral.
        name: name of the material in the file; None: that of the file.
        force: replace an existing file.
        progress: called with (stage, done, total, note).

    Raises:
        ValueError: the format cannot hold the material (the number of channels, or an axis that breaks the symmetry it
            needs, or for "openpbr" transmission), a transport that is random or does not support the stack, an extra
            that is not installed, or an existing file without `force`.
    """
    if not isinstance(to, str) or to not in EXPORTS:
        raise ValueError(f"to is {abbreviate(to)}, must be one of {', '.join(EXPORTS)}")
    path = given_path("path", path)
    require_switch("force", force)
    if path.suffix.lower() != ENDINGS[to]:
        raise ValueError(f"{path}: the name of a file for {to!r} must end in {ENDINGS[to]}")
    if path.exists() and not force:
        raise ValueError(f"{path}: the file exists already (--force, or force=True, overwrites it)")
    stack, chosen = _stack_and_transport(material, transport)
    prepared = material_of(stack, chosen, name or path.stem, given_progress(progress))
    written = _WRITERS[to](prepared, _checked(wavelengths, to, prepared.channels))
    write_bytes(path, written.content, force)
    omitted = prepared.is_mirror and to != "klems"
    return ExportReport(path, to, (*written.notes, *([MIRRORED] if omitted else [])))


def _stack_and_transport(material: Any, transport: Any) -> tuple[lj.Stack | lj.Mixture, Any]:
    if isinstance(material, Fit):
        fitted = material.problem.transport
        if transport is None and fitted != "auto" and not isinstance(fitted, lj.Transport):
            raise ValueError("transport: the fit's is a function of one's own; give one of layerjax")
        return material.stack, transport or fitted
    if not isinstance(material, lj.Stack | lj.Mixture):
        raise ValueError(f"material is {abbreviate(material)}, must be a Stack, a Mixture or a Fit")
    return material, transport or "auto"


def _checked(wavelengths: ArrayLike | None, to: str, channels: int) -> Floats | None:
    if wavelengths is None:
        return None
    if to != "rgl":
        raise ValueError(f"wavelengths: a file for {to!r} has none, only one for 'rgl'")
    nanometres = np.atleast_1d(np.asarray(wavelengths, float))
    if nanometres.shape != (channels,):
        raise ValueError(f"wavelengths: {nanometres.size} given, must be one for each of {channels} channels")
    if not (np.isfinite(nanometres).all() and (nanometres > 0).all() and (np.diff(nanometres) > 0).all()):
        raise ValueError(f"wavelengths: {', '.join(f'{one:g}' for one in nanometres)} nm, must be above 0 and ascend")
    return nanometres
