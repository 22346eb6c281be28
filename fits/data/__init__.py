"""Measured BSDFs: files of any supported format go in, `fits.Measurements` over a `fits.Geometry` come out."""

from fits.data.geometry import Geometry as Geometry
from fits.data.geometry import slices as slices
from fits.data.measurements import Measurements as Measurements
from fits.data.measurements import Source as Source
