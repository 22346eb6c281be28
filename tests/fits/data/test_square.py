"""Densities on the unit square: drawing and its inverse, against sums over fine grids."""

import numpy as np
import pytest

from fits.data.formats._square import Density, Interpolation, bilinear

RANDOM = np.random.default_rng(3)
FIRST, SECOND = RANDOM.uniform(0.1, 2.0, (2, 5, 7))
SECOND[:2] = 0.0
SECOND[3, 2:5] = 0.0
DENSITY = Density(np.stack([FIRST, SECOND]))  # two densities, one of them with rows and cells that are 0


def only(table, count):
    return Interpolation(np.full((count, 1), table), np.ones((count, 1)))


@pytest.mark.parametrize("table", [0, 1])
def test_what_is_drawn_goes_back_to_the_numbers_it_was_drawn_by(table):
    sides = np.linspace(0.0, 1.0, 41)[1:-1]
    x, y = (drawn[table] for drawn in DENSITY.drawn(sides, sides))
    sx, sy, _ = DENSITY.undrawn(x.ravel(), y.ravel(), only(table, x.size))
    np.testing.assert_allclose(sx.reshape(x.shape), np.tile(sides, (39, 1)), atol=1e-9)
    np.testing.assert_allclose(sy.reshape(x.shape), np.tile(sides, (39, 1)).T, atol=1e-9)


@pytest.mark.parametrize("table", [0, 1])
def test_areas_of_the_drawn_hold_what_the_density_says(table):
    fine = (np.arange(600) + 0.5) / 600
    grid = np.array(np.meshgrid(fine, fine)).reshape(2, -1)
    values = bilinear(DENSITY.tables, *grid, only(table, grid.shape[1])) * 4 * 6  # per cell of the table to per unit
    assert np.mean(values) == pytest.approx(1.0, abs=1e-4)
    for y in (0.31, 0.77):  # of all that is drawn, the share below a height
        _, sy, _ = DENSITY.undrawn(np.array([0.5]), np.array([y]), only(table, 1))
        assert sy[0] == pytest.approx(np.mean(values * (grid[1] < y)), abs=2e-3)
    x, y, step = np.array([0.23, 0.61]), np.array([0.83, 0.52]), 1e-6
    sx, sy, value = DENSITY.undrawn(x, y, only(table, 2))
    right, _, _ = DENSITY.undrawn(x + step, y, only(table, 2))
    _, up, _ = DENSITY.undrawn(x, y + step, only(table, 2))
    np.testing.assert_allclose((right - sx) * (up - sy) / step**2, value, rtol=1e-4)
