"""Conversion of colours for formats that do not hold red, green and blue."""

import numpy as np

XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""XYZ of linear red, green and blue (IEC 61966-2-1), with a D65 white whose Y is 1."""
