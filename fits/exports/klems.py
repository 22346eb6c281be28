"""A stack as matrices over Klems' full basis of 145 by 145 patches, in the XML of LBNL WINDOW, which Radiance reads.

Top of the stack is WINDOW's front, which is what faces outside; Radiance calls that the back, since its front faces the
room. Patches are rings of polar angle, cut by azimuth; that of a direction is the azimuth along which light travels, so
that collimated and specular light stays in its patch. As z does, x of the stack points against x of Radiance. A
number is the mean of the BSDF over both patches by projected solid angle, so that its sum over outgoing patches is the
hemispherical reflectance or transmittance; collimated light is in its own patch.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fits.data.geometry import Floats
from fits.exports.colours import XYZ
from fits.exports.contents import Contents
from fits.exports.material import Material

NAME = "LBNL/Klems Full"
RINGS = ((0.0, 1), (5.0, 8), (15.0, 16), (25.0, 20), (35.0, 24), (45.0, 24), (55.0, 24), (65.0, 16), (75.0, 12))
"""Polar angle, in degrees, at which each ring begins, and its number of patches; the last ends at 90."""

POINTS_IN, POINTS_OUT = (2, 2), (4, 4)
"""Points of a patch at which the BSDF is evaluated: along its polar angle and its azimuth."""

POINTS_COLLIMATED = (32, 4)
"""The same for collimated light, which costs next to nothing."""

WAVELENGTHS = {1: ("Visible",), 3: ("CIE-X", "Visible", "CIE-Z")}
DETECTORS = {"CIE-X": "ASTM E308 1931 X.dsp", "Visible": "ASTM E308 1931 Y.dsp", "CIE-Z": "ASTM E308 1931 Z.dsp"}
NAMESPACE = "http://windows.lbl.gov"


@dataclass(frozen=True)
class Patches:
    """directions: (145, points, 3), along which light travels, upward, in the frame of the stack seen from its front.
    projected: solid angle of each, (145,).
    """

    directions: Floats
    projected: Floats


def contents(material: Material, wavelengths: Floats | None = None) -> Contents:
    """The file: reflection of the front, and unless the stack is opaque that of the back and both transmissions."""
    if material.channels not in WAVELENGTHS:
        raise ValueError(f"matrices of WINDOW are of one channel or three, this stack has {material.channels}")
    material.require_air_below()
    blocks: dict[str, Floats] = {}
    rescaled = []
    for side, sign in (("Front", 1.0), ("Back", -1.0)):
        if sign < 0.0 and material.opaque:
            break
        for kind in ("Transmission", "Reflection"):
            if kind == "Transmission" and material.opaque:
                continue
            matrix, factor = _matrix(material, f"{kind} {side}".lower(), sign, through=kind == "Transmission")
            blocks[f"{kind} {side}"] = matrix
            rescaled.append(factor)
    notes = [
        f"{', '.join(blocks).lower()}; the front is the top of the stack, which Radiance calls the back",
        "145 by 145 patches; sums over outgoing patches are scaled to those of the stack, by factors up to "
        f"{max(rescaled):.3f}",
        *(["opaque: no data of the back"] if material.opaque else []),
        *(["red, green and blue written as XYZ, by a white of D65"] if material.channels == len(XYZ) else []),
    ]
    return Contents(_xml(material, blocks), tuple(notes))


def patches(points: tuple[int, int]) -> Patches:
    """The basis, with points in every patch for equal parts of its projected solid angle."""
    directions, projected = [], []
    ends = [*(start for start, _ in RINGS[1:]), 90.0]
    for (start, count), end in zip(RINGS, ends, strict=True):
        low, high = np.sin(np.radians([start, end])) ** 2
        square = low + (high - low) * (np.arange(points[0]) + 0.5) / points[0]
        for place in range(count):
            azimuth = 2.0 * np.pi * (place - 0.5 + (np.arange(points[1]) + 0.5) / points[1]) / count
            sine, phi = (grid.ravel() for grid in np.meshgrid(np.sqrt(square), azimuth, indexing="ij"))
            directions.append(np.stack([sine * np.cos(phi), sine * np.sin(phi), np.sqrt(1.0 - sine**2)], axis=-1))
            projected.append(np.pi * (high - low) / count)
    return Patches(np.array(directions), np.array(projected))


def _matrix(material: Material, stage: str, sign: float, through: bool) -> tuple[Floats, float]:
    """Rows of outgoing, columns of incident light, (145, 145, C), and the largest factor that sums are scaled by.

    sign: side of the incident light: 1 for the top.
    """
    incident, outgoing = patches(POINTS_IN), patches(POINTS_OUT)
    count, inside, outside = len(incident.projected), incident.directions.shape[1], outgoing.directions.shape[1]
    # wi points to where light comes from, against its direction of travel
    wi = incident.directions * np.array([1.0, -1.0, sign])
    wo = outgoing.directions * np.array([-1.0, 1.0, -sign if through else sign])
    matrix = np.empty((count, count, material.channels))
    for column in range(count):
        material.progress(stage, column, count)
        light, view = np.broadcast_arrays(wi[column][:, None], wo.reshape(1, -1, 3))
        values = material.values(light.reshape(-1, 3), view.reshape(-1, 3))
        matrix[:, column] = values.reshape(inside, count, outside, -1).mean(axis=(0, 2))
    albedo = material.albedos(wi.reshape(-1, 3))[1 if through else 0].reshape(count, inside, -1).mean(axis=1)
    sums = np.einsum("oic,o->ic", matrix, outgoing.projected)
    factor = np.where(sums > 0, albedo / np.where(sums > 0, sums, 1.0), 1.0)
    matrix *= factor
    fine = patches(POINTS_COLLIMATED).directions * np.array([1.0, -1.0, sign])
    collimated = material.specular(fine.reshape(-1, 3))[1 if through else 0].reshape(count, fine.shape[1], -1)
    matrix[np.arange(count), np.arange(count)] += collimated.mean(axis=1) / incident.projected[:, None]
    return matrix, float(np.max(np.maximum(factor, 1.0 / np.maximum(factor, 1e-9)), initial=1.0, where=sums > 1e-6))


def _xml(material: Material, blocks: dict[str, Floats]) -> bytes:
    root = ElementTree.Element("WindowElement", {"xmlns": NAMESPACE})
    _add(root, "WindowElementType", "System")
    _add(root, "FileType", "BSDF")
    layer = _add(_add(root, "Optical"), "Layer")
    about = _add(layer, "Material")
    _add(about, "Name", material.name)
    _add(about, "Manufacturer", "layerjax")
    _add(about, "DeviceType", "Other")
    definition = _add(layer, "DataDefinition")
    _add(definition, "IncidentDataStructure", "Columns")
    basis = _add(definition, "AngleBasis")
    _add(basis, "AngleBasisName", NAME)
    for (start, count), end in zip(RINGS, [*(start for start, _ in RINGS[1:]), 90.0], strict=True):
        block = _add(basis, "AngleBasisBlock")
        _add(block, "Theta", f"{0.0 if count == 1 else 0.5 * (start + end):g}")
        _add(block, "nPhis", str(count))
        bounds = _add(block, "ThetaBounds")
        _add(bounds, "LowerTheta", f"{start:g}")
        _add(bounds, "UpperTheta", f"{end:g}")
    for channel, wavelength in enumerate(WAVELENGTHS[material.channels]):
        for direction, matrix in blocks.items():
            values = matrix @ XYZ.T if material.channels == len(XYZ) else matrix
            data = _add(layer, "WavelengthData")
            _add(data, "LayerNumber", "System")
            _add(data, "Wavelength", wavelength).set("unit", "Integral")
            _add(data, "SourceSpectrum", "CIE Illuminant D65 1nm.ssp")
            _add(data, "DetectorSpectrum", DETECTORS[wavelength])
            block = _add(data, "WavelengthDataBlock")
            _add(block, "WavelengthDataDirection", direction)
            _add(block, "ColumnAngleBasis", NAME)
            _add(block, "RowAngleBasis", NAME)
            _add(block, "ScatteringDataType", "BTDF" if direction.startswith("T") else "BRDF")
            _add(block, "ScatteringData", "\n" + "\n".join(_rows(values[..., channel])) + "\n")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _add(parent: ElementTree.Element, name: str, text: str | None = None) -> ElementTree.Element:
    child = ElementTree.SubElement(parent, name)
    child.text = text
    return child


def _rows(matrix: Floats) -> Iterator[str]:
    return ((", ".join(f"{value:.6e}" for value in row) + ",") for row in matrix)
