"""Fits of many texels in turns: each against one of its own, and what is known where they begin."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
from fits.maps import texels
from fits.maps.options import DEFAULT
from fits.maps.search import search, starts_at
from fits.maps.texels import fit_texels, linearise_at, make_texels, standard_errors, to_units, with_own_directions
from fits.optimise.levenberg_marquardt import COST_TOLERANCE, descend
from fits.problem.compilation import _program
from tests.helpers import quick_maps
from tests.helpers.quick_maps import FREE, TRANSPORT

SIZE, TEXELS = 16, 21
LEVEL = 0.02
FIXED = fits.Noise(relative=LEVEL, floor=1e-4)
LEVELS = fits.Noise(relative=fits.Free(0.05, 1e-3, 0.5), floor=1e-4)


@pytest.fixture(scope="module")
def noisy(geometry):
    """Values of texels with numbers of their own, the last at a bound: (M, N, 1)."""
    rng = np.random.default_rng(4)
    truth = np.append(rng.uniform((0.2, 0.2), (2.0, 0.9), (TEXELS - 1, 2)), [[0.4, 1.0]], axis=0)
    exact = quick_maps.exact(truth, geometry)
    return exact * (1.0 + LEVEL * rng.standard_normal(exact.shape))


def problem_of(geometry, noise, values=None, objective="likelihood"):
    values = np.ones((len(geometry.wi), 1)) if values is None else values
    data = fits.Measurements(geometry.wi, geometry.wo, values, None, np.ones(len(values), bool), ("bsdf",))
    return fits.Problem(FREE, data, transport=TRANSPORT, noise=noise, objective=objective)


@pytest.mark.parametrize(("noise", "objective"), [(LEVELS, "likelihood"), (FIXED, "cube_root")], ids=["free", "named"])
def test_each_ends_where_a_descent_of_its_own_does(geometry, noisy, noise, objective):
    """However the descent is cut short, from starts far away and near.

    It differs by no more than what `Fits.improve` counts as nothing: 10 `COST_TOLERANCE` of the cost, half a square of
    standard errors. A named objective stops at 1e-10 of its cost.
    """
    left = 10.0 * COST_TOLERANCE
    cost, apart = (left, np.sqrt(2.0 * left)) if objective == "likelihood" else (0.0, 1e-3)
    problem, rng = problem_of(geometry, noise, objective=objective), np.random.default_rng(7)
    rows = make_texels(noisy, least=1e-4)
    units = rng.uniform(0.2, 0.8, (5, len(problem.names)))[np.arange(TEXELS) % 5]
    for fresh in (True, False):
        found = fit_texels(problem, units, rows, SIZE, fresh=fresh)
        errors, at_bound, _ = standard_errors(problem, found, rows)
        for place in range(TEXELS):
            own = problem_of(geometry, noise, noisy[place], objective)
            alone = own.call(descend, units[place], fresh, 200, COST_TOLERANCE)
            assert bool(alone.converged)
            assert bool(found.converged[place])
            assert found.cost[place] == pytest.approx(float(alone.cost), abs=cost, rel=2e-10 if not cost else 0.0)
            error = np.where(np.isfinite(errors[place]), errors[place], 1e-3)
            assert np.all(np.abs(found.vector[place] - np.asarray(alone.vector)) < apart * error)
        assert np.isnan(errors[at_bound]).all()
        units = np.clip(found.unit + rng.uniform(-0.02, 0.02, found.unit.shape), 0.0, 1.0)
    again = fit_texels(problem, found.unit, rows, SIZE, fresh=False)  # at the minimum
    assert np.all(again.converged)
    np.testing.assert_allclose(again.cost, found.cost, rtol=1e-9, atol=1e-7)


def test_what_is_known_at_starts_is_what_the_model_says(geometry):
    """Values and derivatives of few points, and of more than a program takes at once."""
    problem = problem_of(geometry, LEVELS)
    slopes_at = jax.jit(jax.jacrev(problem.model.predict))
    for count in (1, 70):
        units = np.random.default_rng(count).random((count, 3))
        known = linearise_at(problem, units, SIZE)
        assert known.values.shape == (count, 16, 1)
        for place in (0, count - 1):
            vector = problem.model.box.from_unit(jnp.asarray(units[place]))
            np.testing.assert_allclose(known.values[place], problem.predict(vector), rtol=1e-12)
            slopes = np.moveaxis(np.asarray(slopes_at(vector)), -1, 0)
            np.testing.assert_allclose(known.slopes[place], slopes, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(to_units(problem, np.asarray(vector)), units[place], rtol=1e-12)


def test_the_model_stands_in_the_program_once(geometry, noisy, monkeypatch):
    """It takes most of the time and the memory that compiling takes."""
    traced = []
    original = texels._linearise
    monkeypatch.setattr(texels, "_linearise", lambda *call: traced.append(call) or original(*call))
    model, rows = problem_of(geometry, FIXED).model, make_texels(noisy, least=1e-4).rows(np.arange(SIZE))
    known = texels.Linearisation(np.zeros((64, 16, 1)), np.zeros((64, 2, 16, 1)))
    arguments = np.full((SIZE, 2), 0.5), known, np.zeros(SIZE, int), rows, *map(np.asarray, (SIZE, 0, False, 200))
    jax.make_jaxpr(lambda *parts: texels._program(model, *parts))(*jax.tree.map(jnp.asarray, arguments))
    assert len(traced) == 1


@pytest.mark.parametrize("each", [False, True], ids=["common directions", "own directions"])
def test_any_number_of_texels_is_searched_by_the_same_programs(geometry, noisy, each):
    problem = problem_of(geometry, FIXED)
    problem = with_own_directions(problem) if each else problem
    sides = [np.broadcast_to(part, (TEXELS, *part.shape)) for part in (geometry.wi, geometry.wo)] if each else []
    rows, vectors = make_texels(noisy, None, 1e-4, *sides), np.array([[0.3, 0.3], [0.5, 0.5], [1.5, 0.7]])
    starts = starts_at(problem, vectors, each, SIZE)
    whole = search(problem, starts, rows, SIZE, DEFAULT)
    before = _program(True)._cache_size()
    for count in (1, 6, SIZE, SIZE + 1):
        some = search(problem, starts, rows.rows(np.arange(count)), SIZE, DEFAULT)
        np.testing.assert_allclose(some.fits.cost, whole.fits.cost[:count], rtol=1e-9)
    assert _program(True)._cache_size() == before
