"""Emulators in the place of a transport: their values and derivatives against the transport itself, a toy of one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import qmc

import fits
import layerjax as lj
from fits.maps.emulator import emulate
from fits.problem.model import Model
from tests.helpers.models import along

ERROR = fits.MapOptions.emulator_error
NOISE = fits.Noise(relative=0.02, floor=1e-4, discrepancy=False)
NAMES = ("layers[0].thickness", "base.albedo[0]", "base.albedo[1]")
TRUTH = 0.4, 0.3, 0.6
FREE = lj.Stack([lj.Medium(fits.Free(0.5, 0.1, 2.0), 0.8)], lj.Lambertian(fits.Free((0.4, 0.5), 0.05, 0.95)))


def haze(stack, wi, wo):
    """A base through an absorber that scatters once, evenly."""
    passed = jnp.exp(-stack.layers[0].thickness * (1.0 / wi[:, 2] + 1.0 / wo[:, 2]))[:, None]
    return passed * stack.base.albedo / np.pi + (1.0 - passed) * 0.1 / (wi[:, 2] + wo[:, 2])[:, None]


def problem_of(transport):
    data = along(fits.slices([10.0, 60.0], np.linspace(-80.0, 80.0, 6)), 0.1, channels=("one", "two"))
    return fits.Problem(FREE, data, transport=transport, noise=NOISE, scale=fits.Free(1.0, 0.8, 1.25))


@pytest.fixture(scope="module")
def problem():
    return problem_of(haze)


@pytest.fixture(scope="module")
def emulated(problem):
    emulator, words = emulate(problem)
    assert emulator is not None
    assert "an emulator of" in words
    return problem.with_model(replace(problem.model, stand_in=emulator))


@pytest.fixture(scope="module")
def vectors(problem):
    points = qmc.Sobol(len(problem.names), rng=np.random.default_rng(5)).random(64)
    return qmc.scale(points, problem.low, problem.high)


def test_values_are_those_of_the_transport_within_a_tenth_of_the_noise_or_it_is_too_dear(problem, emulated, vectors):
    for vector in (*vectors, problem.low, problem.high):
        exact, found = (np.asarray(one.predict(vector)) for one in (problem, emulated))
        sigma = np.asarray(problem.call(Model.sigma_at, vector, problem.predict(vector)))
        assert np.max(np.abs(found - exact) / sigma) < 2.0 * ERROR  # at points that no check has seen
    emulator, words = emulate(problem, fits.MapOptions(emulator_max_solves=10))
    assert (emulator, "of 10 allowed" in words) == (None, True)


def test_derivatives_are_those_of_the_emulator(emulated, vectors):
    predict = jax.jit(lambda vector: emulated.model.predict(vector))
    slopes_at = jax.jit(jax.jacfwd(predict))
    for vector, step in ((vectors[7], 1e-5), (emulated.low, 1e-5), (emulated.high, -1e-5)):
        vector, slopes = jnp.asarray(vector), np.asarray(slopes_at(jnp.asarray(vector)))
        for place in range(vector.size):
            # differences: rounding of 1e-16 / 1e-5, and a further derivative of about 100 times the step
            expected = (predict(vector.at[place].add(step)) - predict(vector)) / step
            np.testing.assert_allclose(slopes[..., place], expected, rtol=2e-2, atol=1e-5)
    first, second = (emulated.names.index(name) for name in NAMES[1:])  # each channel has its own
    assert np.any(slopes[:, 0, first] != 0.0)
    assert not np.any(slopes[:, [0, 1], [second, first]])


def fitted(out, transport, **options):
    problem = problem_of(transport)
    exact = np.asarray(problem.predict(np.array([*TRUTH, 1.0])))
    values = exact * (1.0 + NOISE.relative * np.random.default_rng(2).standard_normal((6, *exact.shape)))
    view, options = fits.Geometry(problem.data.wi, problem.data.wo), fits.MapOptions(starts=2, chunk_size=4, **options)
    return fits.fit_map(FREE, view, values, out, NOISE, transport=transport, options=options)


def test_a_map_by_an_emulator_ends_where_it_does_without(tmp_path):
    emulated, direct = (fitted(tmp_path / f"{one}.zarr", haze, emulator=one) for one in (True, False))
    # values move by as much as the emulator's error is of the noise, a tenth at most in a measurement
    for name, truth in zip(NAMES, TRUTH, strict=True):
        assert np.all(np.abs(emulated.values[name] - direct.values[name]) < ERROR * direct.errors[name])
        np.testing.assert_allclose(emulated.errors[name], direct.errors[name], rtol=0.02)
        assert np.all(np.abs(direct.values[name] - truth) < 4.0 * direct.errors[name])


@pytest.mark.slow  # an exact transport compiles for ten seconds
def test_an_exact_transport_is_emulated_where_that_pays(tmp_path):
    transport = lj.AddingDoubling(nodes=4, modes=4)
    map = fitted(tmp_path / "coat.zarr", transport, emulator_min_texels=6)
    assert "an emulator of" in map.attributes["numerical"]["emulator"]
    assert map.numerical_error > 0.0
    for name, truth in zip(NAMES, TRUTH, strict=True):
        assert np.all(np.abs(map.values[name] - truth) < 4.0 * map.errors[name])
    assert fitted(tmp_path / "coat.zarr", transport, emulator_min_texels=6).attributes == map.attributes
