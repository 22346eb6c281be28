"""Numbers that all texels share: the joint fit of a sample against `fits.Joint` of the same readings."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from fits.data.geometry import Geometry
from fits.data.measurements import Measurements
from fits.maps.sharing import _Arrow, _step, fit_shared
from fits.maps.texels import texels

TRANSPORT = lj.SingleScattering()
NOISE = fits.Noise(relative=0.02, floor=1e-4, discrepancy=False)
TRUTH = np.array([[0.3, 0.2], [0.5, 0.3], [0.8, 0.4], [1.2, 0.5]])
G = 0.4
NAMES = ("layers[0].thickness", "base.albedo")


def coat(thickness, albedo, g):
    return lj.Stack([lj.Medium(thickness, 0.8, lj.HenyeyGreenstein(g))], lj.Lambertian(albedo))


def free(low=-0.2, high=0.8, prior=None):
    return coat(
        fits.Free(0.5, 0.05, 3.0),
        fits.Free(0.4, 0.0, 1.0),
        fits.Free(0.2, low, high, prior=prior, same_for_all_texels=True),
    )


@pytest.fixture(scope="module")
def geometry():
    every = fits.slices(incidence=[10.0, 60.0])
    places = np.linspace(0, len(every.wi) - 1, 16).astype(int)
    return Geometry(every.wi[places], every.wo[places])


@pytest.fixture(scope="module")
def values(geometry):
    def one(numbers):
        stack = coat(*numbers, G)
        return lj.evaluate(stack, jnp.asarray(geometry.wi), jnp.asarray(geometry.wo), transport=TRANSPORT)

    exact = np.asarray(jax.jit(jax.vmap(one))(TRUTH)).reshape(len(TRUTH), -1, 1)
    sigma = np.hypot(NOISE.relative * exact, NOISE.floor)
    return exact + sigma * np.random.default_rng(3).standard_normal(exact.shape)


def problem_of(stack, values, geometry):
    data = Measurements(geometry.wi, geometry.wo, values, None, np.ones(len(values), bool), ("value",))
    return fits.Problem(stack, data, transport=TRANSPORT, noise=NOISE)


@pytest.mark.parametrize(
    ("prior", "bounds"),
    [(None, (-0.2, 0.8)), (fits.Normal(0.2, 0.05), (-0.2, 0.8)), (None, (-0.2, 0.25))],
    ids=["free", "with a prior", "on a bound"],
)
def test_the_joint_fit_of_a_sample_is_that_of_joint(geometry, values, prior, bounds):
    stack = free(*bounds, prior=prior)
    problems = {f"t{k}": problem_of(stack, row, geometry) for k, row in enumerate(values)}
    joint = fits.fit(fits.Joint(problems, shared=["layers[0].phase.g"]), starts=4)
    held, shared = fit_shared(problems["t0"], texels(values, least=NOISE.floor), starts=4, seed=0, size=4)
    (name,) = shared.values
    assert shared.converged
    assert held.names == NAMES
    error = joint.standard_errors["layers[0].phase.g"]
    scale = error if np.isfinite(error) else 1e-3
    # a step of a hundredth of an error is the last one
    assert abs(shared.values[name] - joint.values["layers[0].phase.g"]) < 0.02 * scale
    np.testing.assert_allclose(shared.errors[name], error, rtol=0.02)


def test_errors_of_what_a_sample_does_not_know_are_infinite(geometry, values):
    stack = coat(*(fits.Free(0.5, 0.1, 0.9, same_for_all_texels=k > 0) for k in range(3)))
    problem, gradient = problem_of(stack, values[0], geometry), np.array([1.0, 0.0])
    for information in (np.zeros((2, 2)), np.diag([1e8, 0.0]), np.diag([1e8, -1e-9])):
        step, error, _ = _step(problem, np.array([1, 2]), _Arrow(0.0, gradient, information), np.array([0.5, 0.5]))
        known = information[0, 0] > 0.0
        np.testing.assert_allclose(error, [1e-4 if known else np.inf, np.inf])
        np.testing.assert_allclose(step, [-1e-8 if known else 0.0, 0.0])


def test_a_map_holds_what_its_sample_shares(tmp_path, geometry, values):
    found = fits.fit_map(
        free(), geometry, values, tmp_path / "shared.zarr", noise=NOISE, transport=TRANSPORT, starts=2, chunk=4
    )
    assert found.names == NAMES
    said = found.attributes["shared"]["layers[0].phase.g"]
    assert abs(said["value"] - G) < 4.0 * said["error"]
    assert (said["unit"], said["converged"]) == ("1", True)
    for column, name in enumerate(NAMES):
        pulls = (found.values[name] - TRUTH[:, column]) / found.errors[name]
        assert np.all(np.abs(pulls) < 4.5)


def test_a_shared_level_of_noise_is_found(tmp_path, geometry, values):
    stack = coat(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 1.0), G)
    noise = dataclasses.replace(NOISE, relative=fits.Free(0.05, 0.001, 0.3, same_for_all_texels=True))
    found = fits.fit_map(
        stack, geometry, values, tmp_path / "noise.zarr", noise=noise, transport=TRANSPORT, starts=2, chunk=4
    )
    said = found.attributes["shared"]["noise.relative"]
    # of 64 readings a level is known to 9 %, and 8 of 64 degrees of freedom are fitted away
    assert abs(said["value"] - 0.02) < 4.0 * said["error"] + 0.002
    again = fits.fit_map(
        stack, geometry, values, tmp_path / "noise.zarr", noise=noise, transport=TRANSPORT, starts=2, chunk=4
    )
    assert again.attributes == found.attributes


def test_a_map_of_shared_numbers_alone_is_refused(tmp_path, geometry, values):
    stack = coat(0.5, 0.4, fits.Free(0.2, -0.2, 0.8, same_for_all_texels=True))
    with pytest.raises(ValueError, match="all free parameters are shared"):
        fits.fit_map(stack, geometry, values, tmp_path / "none.zarr", noise=NOISE, transport=TRANSPORT)
    assert not (tmp_path / "none.zarr").exists()
