"""A stack as slices in CSV, as a goniometer would measure it without noise."""

import numpy as np

from fits.data.formats.csv import csv_text
from fits.data.geometry import Floats, slices
from fits.data.measurements import Measurements, Source, channel_names
from fits.exports.contents import Contents
from fits.exports.material import Material

INCIDENCE = np.array([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0])
OUTGOING = np.arange(-85.0, 86.0, 5.0)
AZIMUTH = (0.0, 45.0, 90.0, 135.0)


def contents(material: Material, wavelengths: Floats | None = None) -> Contents:
    """The file: reflection, and transmission unless the stack is opaque."""
    outgoing = OUTGOING if material.opaque else np.concatenate([OUTGOING, OUTGOING + 180.0])
    outgoing = np.where(outgoing > 180.0, outgoing - 360.0, outgoing)
    geometry = slices(INCIDENCE, outgoing, AZIMUTH)
    values = material.values(geometry.wi, geometry.wo)
    source = Source("", "simulated", "brdf", ("values of a stack, without noise",))
    names = channel_names(material.channels)
    data = Measurements(geometry.wi, geometry.wo, values, None, np.ones(len(values), bool), names, source)
    return Contents(csv_text(data).encode(), (f"{len(values):,} data points, incidence from 0 to 80 degrees",))
