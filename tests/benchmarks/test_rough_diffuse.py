"""Rough diffuse surfaces beside each other: what the tables are made of."""

import numpy as np

import layerjax as lj
from benchmarks.studies import rough_diffuse


def test_white_sky_of_surfaces_that_are_known():
    np.testing.assert_allclose(rough_diffuse.white_sky(lj.Lambertian([0.9, 0.2]), 8), [0.9, 0.2], rtol=1e-6)
    # its multiple scattering is made so that nothing is lost
    np.testing.assert_allclose(rough_diffuse.white_sky(lj.OrenNayar(1.0, 0.6), 8), [1.0], atol=1e-3)
