"""Densities on the unit square: drawing and its inverse (files that are drawn from: `exports/test_readers`)."""

import numpy as np
import pytest

from fits.data.formats._square import Density, Interpolation

RANDOM = np.random.default_rng(3)
FIRST, SECOND = RANDOM.uniform(0.1, 2.0, (2, 5, 7))
SECOND[:2] = 0.0
SECOND[3, 2:5] = 0.0
DENSITY = Density(np.stack([FIRST, SECOND]))  # two densities, one of them with rows and cells that are 0


@pytest.mark.parametrize("table", [0, 1])
def test_what_is_drawn_goes_back_to_the_numbers_it_was_drawn_by(table):
    sides = np.linspace(0.0, 1.0, 41)[1:-1]
    x, y = (drawn[table] for drawn in DENSITY.drawn(sides, sides))
    only = Interpolation(np.full((x.size, 1), table), np.ones((x.size, 1)))
    sx, sy, _ = DENSITY.undrawn(x.ravel(), y.ravel(), only)
    np.testing.assert_allclose(sx.reshape(x.shape), np.tile(sides, (39, 1)), atol=1e-9)
    np.testing.assert_allclose(sy.reshape(x.shape), np.tile(sides, (39, 1)).T, atol=1e-9)
