"""Emulators in the place of a transport: their values and derivatives against the transport itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import qmc

import fits
import layerjax as lj
from fits.data.geometry import Geometry
from fits.data.measurements import Measurements
from fits.maps.emulator import chebyshev, coarser, emulate, with_emulator
from fits.maps.options import MapOptions
from fits.problem.model import Model

TRANSPORT = lj.AddingDoubling(nodes=4, modes=4)
ERROR = MapOptions.emulator_error
NOISE = fits.Noise(relative=0.02, floor=1e-4, discrepancy=False)


def coat(alpha, albedo):
    return lj.Stack([lj.Interface(1.5, alpha)], lj.Lambertian(albedo))


FREE = coat(fits.Free(0.3, 0.1, 0.6), fits.Free((0.4, 0.5), 0.05, 0.95))


@pytest.fixture(scope="module")
def problem():
    every = fits.slices(incidence=[10.0, 60.0])
    places = np.linspace(0, len(every.wi) - 1, 12).astype(int)
    data = Measurements(
        every.wi[places], every.wo[places], np.full((12, 2), 0.1), None, np.ones(12, bool), ("one", "two")
    )
    return fits.Problem(FREE, data, transport=TRANSPORT, noise=NOISE, scale=fits.Free(1.0, 0.8, 1.25))


@pytest.fixture(scope="module")
def emulator(problem):
    tried = emulate(problem)
    assert tried.problem is not None
    assert tried.error <= ERROR
    return tried.problem


@pytest.fixture(scope="module")
def vectors(problem):
    points = qmc.Sobol(len(problem.names), rng=np.random.default_rng(5)).random(64)
    return qmc.scale(points, problem.low, problem.high)


def test_values_are_those_of_the_transport_within_a_tenth_of_the_noise(problem, emulator, vectors):
    ends = np.stack([problem.low, problem.high])
    for vector in (*vectors, *ends):
        exact, found = (np.asarray(one.predict(vector)) for one in (problem, emulator))
        sigma = np.asarray(problem.call(Model.sigma_at, vector, problem.predict(vector)))
        assert np.max(np.abs(found - exact) / sigma) < 2.0 * ERROR  # at points that no check has seen


def test_derivatives_are_those_of_the_emulator(problem, emulator, vectors):
    def predict(vector):
        return emulator.model.predict(vector)

    for vector in (jnp.asarray(vectors[7]), jnp.asarray(problem.low), jnp.asarray(problem.high)):
        forward, reverse = jax.jacfwd(predict)(vector), jax.jacrev(predict)(vector)
        np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    inside, step = jnp.asarray(vectors[7]), 1e-5
    for place in range(inside.size):
        moved = [predict(inside.at[place].add(sign * step)) for sign in (1.0, -1.0)]
        # central differences: rounding of 1e-16 / 1e-5 and a third derivative of about 100 times 1e-10
        np.testing.assert_allclose(
            jax.jacfwd(predict)(inside)[..., place], (moved[0] - moved[1]) / (2 * step), rtol=1e-5, atol=1e-7
        )


def test_each_channel_has_its_own_parameters(emulator, vectors):
    slopes = np.asarray(jax.jacfwd(emulator.model.predict)(jnp.asarray(vectors[3])))
    names = emulator.names
    first, second = names.index("base.albedo[0]"), names.index("base.albedo[1]")
    assert np.all(slopes[:, 0, second] == 0.0)
    assert np.all(slopes[:, 1, first] == 0.0)
    assert np.any(slopes[:, 0, first] != 0.0)


def test_the_last_terms_tell_of_the_error(problem, emulator, vectors):
    rough = problem.with_model(with_emulator(emulator.model, coarser(emulator.model.emulator)))
    apart = [float(np.max(np.abs(np.asarray(rough.predict(v)) - np.asarray(emulator.predict(v))))) for v in vectors[:8]]
    assert 0.0 < max(apart) < 0.05


def test_chebyshev_polynomials_are_cosines():
    for x in (-1.0, -0.3, 0.0, 0.8, 1.0):
        basis, slope = chebyshev(jnp.asarray(x), 6)
        angle = np.arccos(x)
        np.testing.assert_allclose(basis, np.cos(np.arange(6) * angle), atol=1e-12)
        exact = np.polynomial.chebyshev.chebder(np.eye(6))
        np.testing.assert_allclose(slope, np.polynomial.chebyshev.chebval(x, exact), atol=1e-12)


def test_too_dear_a_table_is_not_made(problem):
    tried = emulate(problem, MapOptions(emulator_max_solves=10))
    assert tried.problem is None
    assert "of 10 allowed" in tried.words


def test_a_map_of_exact_transport_by_a_table_ends_where_it_does_without(tmp_path, problem):
    def small(**more):
        return MapOptions(starts=2, chunk_size=4, **more)

    truth = np.array([0.2, 0.3, 0.6, 1.0])
    names = ("layers[0].alpha", "base.albedo[0]", "base.albedo[1]")
    exact = np.asarray(problem.predict(truth))
    noise = np.random.default_rng(2).standard_normal((6, *exact.shape))
    values = exact * (1.0 + NOISE.relative * noise)
    geometry = Geometry(problem.data.wi, problem.data.wo)
    options = {"noise": NOISE, "transport": TRANSPORT}
    emulated, direct = (
        fits.fit_map(FREE, geometry, values, tmp_path / f"{known}.zarr", **options, options=small(emulator=known))
        for known in (True, False)
    )
    assert "an emulator of" in emulated.attributes["numerical"]["emulator"]
    # values move by as much as the emulator's error is of the noise, a tenth at most in a reading
    for name in names:
        assert np.all(np.abs(emulated.values[name] - direct.values[name]) < ERROR * direct.errors[name])
        np.testing.assert_allclose(emulated.errors[name], direct.errors[name], rtol=0.02)
    assert np.all(emulated.numerical_error > 0.0)
    again = fits.fit_map(FREE, geometry, values, tmp_path / "True.zarr", **options, options=small(emulator=True))
    assert again.attributes == emulated.attributes
