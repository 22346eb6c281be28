"""Measured BSDFs: files of any supported format go in, `fits.Measurements` over a `fits.Geometry` come out."""
