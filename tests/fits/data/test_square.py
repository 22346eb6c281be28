"""Densities on the unit square: drawing and its inverse, against sums over fine grids."""

import numpy as np
import pytest

from fits.data.formats._square import Density, Interpolation, bilinear

SIDES = np.linspace(0.0, 1.0, 41)


@pytest.fixture(scope="module")
def tables() -> np.ndarray:
    """Two densities, one of them with rows and cells that are 0."""
    random = np.random.default_rng(3)
    first, second = random.uniform(0.1, 2.0, (2, 5, 7))
    second[:2] = 0.0
    second[3, 2:5] = 0.0
    return np.stack([first, second])


def test_what_is_drawn_goes_back_to_the_numbers_it_was_drawn_by(tables: np.ndarray) -> None:
    density = Density(tables)
    x, y = density.drawn(SIDES[1:-1], SIDES[1:-1])
    for table in range(len(tables)):
        only = Interpolation(np.full((x[table].size, 1), table), np.ones((x[table].size, 1)))
        sx, sy, _ = density.undrawn(x[table].ravel(), y[table].ravel(), only)
        np.testing.assert_allclose(sx.reshape(x[table].shape), np.tile(SIDES[1:-1], (39, 1)), atol=1e-9)
        np.testing.assert_allclose(sy.reshape(x[table].shape), np.tile(SIDES[1:-1], (39, 1)).T, atol=1e-9)


def test_areas_of_the_drawn_hold_what_the_density_says(tables: np.ndarray) -> None:
    density = Density(tables)
    fine = (np.arange(2000) + 0.5) / 2000
    grid = np.array(np.meshgrid(fine, fine)).reshape(2, -1)
    for table in range(len(tables)):
        only = Interpolation(np.full((grid.shape[1], 1), table), np.ones((grid.shape[1], 1)))
        values = bilinear(density.tables, *grid, only) * 4 * 6  # per cell of the table to per unit
        assert np.mean(values) == pytest.approx(1.0, abs=1e-5)
        # of all that is drawn, the share below a height and, in a row, the share left of a place
        for y in (0.31, 0.77):
            below = np.mean(values * (grid[1] < y))
            _, sy, _ = density.undrawn(
                np.array([0.5]), np.array([y]), Interpolation(np.array([[table]]), np.ones((1, 1)))
            )
            assert sy[0] == pytest.approx(below, abs=1e-3)


def test_density_is_that_of_the_drawing(tables: np.ndarray) -> None:
    density = Density(tables)
    x, y, step = np.array([0.23, 0.61]), np.array([0.83, 0.52]), 1e-6
    for table in range(len(tables)):
        only = Interpolation(np.full((2, 1), table), np.ones((2, 1)))
        sx, sy, value = density.undrawn(x, y, only)
        right, _, _ = density.undrawn(x + step, y, only)
        _, up, _ = density.undrawn(x, y + step, only)
        np.testing.assert_allclose((right - sx) * (up - sy) / step**2, value, rtol=1e-4)


def test_between_tables_all_is_linear(tables: np.ndarray) -> None:
    density = Density(tables)
    x, y = np.array([0.4]), np.array([0.7])
    both = Interpolation(np.array([[0, 1]]), np.array([[0.25, 0.75]]))
    mixed = Density(0.25 * density.tables[:1] + 0.75 * density.tables[1:])
    np.testing.assert_allclose(density.undrawn(x, y, both), mixed.undrawn(x, y), rtol=1e-12)
    np.testing.assert_allclose(bilinear(density.tables, x, y, both), bilinear(mixed.tables, x, y), rtol=1e-12)
