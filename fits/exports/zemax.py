"""A stack as a tabular BSDF of Zemax (see `fits.data.formats.zemax`), which LightTools reads as well.

A file holds reflection or transmission: for a transparent stack the reflection is written.
"""

from collections.abc import Iterator

import numpy as np

from fits.data.formats.zemax import around_specular
from fits.data.geometry import LIGHT_AZIMUTH, Floats, direction
from fits.exports.colours import XYZ
from fits.exports.contents import Contents
from fits.exports.material import VALUES, Material

INCIDENCE = np.array([0.0, 5, 10, 15, 20, 25, 30, 35, 40, 45, 50, 55, 60, 65, 70, 75, 80, 85])
ROTATION = np.arange(0.0, 360.0, 15.0)
AZIMUTH = np.arange(0.0, 181.0, 10.0)
FINE, COARSE = np.array([0.0, 0.5, 1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12, 15, 18, 21, 25]), np.arange(30.0, 181.0, 5.0)

BLOCKS = {1: ("Monochrome",), 3: ("TristimulusX", "TristimulusY", "TristimulusZ")}


def contents(material: Material, wavelengths: Floats | None = None) -> Contents:
    """The file: reflection above the surface, one channel or XYZ, and the total scatter of each incidence."""
    if material.channels not in BLOCKS:
        raise ValueError(f"a Zemax file has one channel or three, this stack has {material.channels}")
    isotropic = material.isotropic
    rotation = np.zeros(1) if isotropic else ROTATION
    azimuth = AZIMUTH if isotropic else np.concatenate([AZIMUTH, AZIMUTH[1:-1] + 180.0])
    radial = np.concatenate([FINE, COARSE])
    theta_i, phi_i = np.meshgrid(INCIDENCE, LIGHT_AZIMUTH - rotation)
    wi = direction(theta_i, phi_i)
    wo = around_specular(theta_i, phi_i, azimuth, radial, btdf=False)
    above = wo[..., 2] > 0
    values = np.zeros((*above.shape, material.channels))
    values[above] = material.values(np.broadcast_to(wi[:, :, None, None], wo.shape)[above], wo[above], VALUES)
    total = material.albedos(wi.reshape(-1, 3))[0].reshape(*theta_i.shape, material.channels)
    if material.channels == len(XYZ):
        values, total = values @ XYZ.T, total @ XYZ.T
    lines = [
        f"# {material.name}",
        "Source\tMeasured",
        f"Symmetry\t{'PlaneSymmetrical' if isotropic else 'ASymmetrical4D'}",
        f"SpectralContent\t{'Monochrome' if material.channels == 1 else 'XYZ'}",
        "ScatterType\tBRDF",
        *_angles("SampleRotation", rotation),
        *_angles("AngleOfIncidence", INCIDENCE),
        *_angles("ScatterAzimuth", azimuth),
        *_angles("ScatterRadial", radial),
        "",
    ]
    for channel, name in enumerate(BLOCKS[material.channels]):
        lines += [name, "DataBegin", *_block(values[..., channel], total[..., channel]), "DataEnd"]
    notes = [
        f"{above.sum():,} values above the horizon, {len(INCIDENCE)} incidences from 0 to 85 degrees, every "
        f"{AZIMUTH[1]:g} degrees around the mirror direction",
        *(["red, green and blue written as XYZ, by a white of D65"] if material.channels == len(XYZ) else []),
        *([] if material.opaque else ["transmission is omitted"]),
    ]
    return Contents(("\n".join(lines) + "\n").encode(), tuple(notes))


def _angles(keyword: str, angles: Floats) -> list[str]:
    return [f"{keyword}\t{len(angles)}", "\t".join(f"{angle:g}" for angle in angles)]


def _block(values: Floats, total: Floats) -> Iterator[str]:
    for rotation, totals in zip(values, total, strict=True):
        for incidence, share in zip(rotation, totals, strict=True):
            yield f"TIS\t{share:.6f}"
            yield from ("\t".join(f"{value:.6e}" for value in row) for row in incidence)
