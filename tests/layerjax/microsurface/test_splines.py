"""Uniform cubic splines beside scipy's, and what a look costs."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

from benchmarks.measuring.operations import count
from layerjax.microsurface.splines import read

COUNTS = (7, 5, 6)
COLUMNS = 3


def coefficients(axes: int) -> np.ndarray:
    return np.random.default_rng(axes).normal(size=(COLUMNS, *COUNTS[:axes]))


def by_scipy(table: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Value of one table at a place, and its derivative along each axis."""
    axes = len(places)
    bases = []
    for place, size in zip(places, table.shape, strict=True):
        spline = BSpline(np.arange(-3, size + 1) / (size - 3), np.eye(size), 3)
        bases.append((spline(place), spline.derivative()(place)))
    found = []
    for sloped in (None, *range(axes)):
        value = table
        for axis, (plain, slope) in enumerate(bases):
            value = np.tensordot(slope if axis == sloped else plain, value, (0, 0))
        found.append(value)
    return np.array(found)


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_columns_and_their_derivatives(axes: int) -> None:
    table = coefficients(axes)
    places = np.random.default_rng(9).uniform(size=(axes, 4))
    places[:, 0] = 0.0

    def columns(*places: jax.Array) -> jax.Array:
        return jnp.stack(read(table.ravel(), 0, COUNTS[:axes], places, COLUMNS, table[0].size))

    modes = (mode(columns, argnums=tuple(range(axes))) for mode in (jax.jacfwd, jax.jacrev))
    functions = [columns, *(jax.vmap(mode, 0, -1) for mode in modes)]
    values, slopes, back = jax.jit(lambda *at: [function(*at) for function in functions])(*places)
    for c in range(COLUMNS):
        wanted = np.stack([by_scipy(table[c], at) for at in places.T], axis=-1)
        np.testing.assert_allclose(values[c], wanted[0], rtol=0.0, atol=1e-14)
        for found in (slopes, back):
            np.testing.assert_allclose([one[c] for one in found], wanted[1:], rtol=0.0, atol=1e-12)


def test_a_look_is_compiled_for_four_taps() -> None:
    """Whatever the number of axes and columns, with derivatives as without."""

    def value(axes: int, columns: int, *places: jax.Array) -> jax.Array:
        return sum(map(jnp.sum, read(coefficients(axes).ravel(), 0, COUNTS[:axes], places, columns, 1)))

    gathers = set()
    for axes in (1, 2, 3):
        places = [jnp.full(8, 0.3)] * axes
        for columns in (1, COLUMNS):
            look = partial(value, axes, columns)
            gathers |= {count(look, *places)["gather"], count(jax.grad(look), *places)["gather"]}
    assert len(gathers) == 1  # those of one column along one axis
