"""Common parameters of all texels: the joint fit of a pilot against `fits.Joint`, and which they are."""

import dataclasses
from functools import partial

import jax
import numpy as np
import pytest

import fits
import layerjax as lj
from fits import MapOptions, PowerLaw, read_problem, write_problem
from fits.maps.common import fit_common, newton_step, with_common
from fits.maps.texels import make_texels
from fits.problem.parameters import is_free
from tests.helpers.models import along

common = partial(fits.Free, same_for_all_texels=True)
TRANSPORT = lj.SingleScattering()
NOISE = fits.Noise(relative=0.02, floor=1e-4, discrepancy=False)
TRUTH = np.array([[0.3, 0.2], [0.5, 0.3], [0.8, 0.4], [1.2, 0.5]])
G = 0.4
NAMES = ("layers[0].thickness", "base.albedo")


def coat(thickness, albedo, g):
    return lj.Stack([lj.Medium(thickness, 0.8, lj.HenyeyGreenstein(g))], lj.Lambertian(albedo))


def free(low=-0.2, high=0.8, prior=None):
    return coat(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 1.0), common(0.2, low, high, prior=prior))


@pytest.fixture(scope="module")
def values(geometry):
    exact = [lj.evaluate(coat(*one, G), geometry.wi, geometry.wo, transport=TRANSPORT) for one in TRUTH]
    sigma = np.hypot(NOISE.relative * np.array(exact), NOISE.floor)
    return exact + sigma * np.random.default_rng(3).standard_normal(sigma.shape)


@pytest.mark.parametrize(
    ("prior", "bounds"),
    [(None, (-0.2, 0.8)), (fits.Normal(0.2, 0.05), (-0.2, 0.8)), (None, (-0.2, 0.25))],
    ids=["free", "with a prior", "on a bound"],
)
def test_the_joint_fit_of_a_pilot_is_that_of_joint(geometry, values, prior, bounds):
    parts = [fits.Problem(free(*bounds, prior=prior), along(geometry, row), TRANSPORT, NOISE) for row in values[:2]]
    joint = fits.fit(fits.Joint({"one": parts[0], "two": parts[1]}, shared=["layers[0].phase.g"]), starts=4)
    held = fit_common(parts[0], make_texels(values[:2]), MapOptions(starts=4, chunk_size=4))
    ((name, found),) = held.items()
    assert found["converged"]
    assert with_common(parts[0], {name: found["value"]}).names == NAMES
    error = joint.standard_errors[name]
    # a step of a hundredth of an error is the last one
    assert abs(found["value"] - joint.values[name]) < 0.02 * (error if np.isfinite(error) else 1e-3)
    np.testing.assert_allclose(found["error"], error, rtol=0.02)


def test_errors_of_what_a_pilot_does_not_know_are_infinite():
    for information in (np.zeros((2, 2)), np.diag([1e8, 0.0]), np.diag([1e8, -1e-9])):
        step, error = newton_step(np.array([0.5, 0.5]), np.array([1.0, 0.0]), information)
        known = information[0, 0] > 0.0
        np.testing.assert_allclose(error, [1e-4 if known else np.inf, np.inf])
        np.testing.assert_allclose(step, [-1e-8 if known else 0.0, 0.0])


def test_a_map_holds_what_its_texels_have_in_common(tmp_path, geometry, values):
    def fitted(out, stack, noise=NOISE):
        options = MapOptions(starts=2, chunk_size=4)
        return fits.fit_map(stack, geometry, values, out, noise=noise, transport=TRANSPORT, options=options)

    map = fitted(tmp_path / "common.zarr", free())
    assert map.names == NAMES
    shared = map.attributes["common"]["layers[0].phase.g"]
    assert abs(shared["value"] - G) < 4.0 * shared["error"]
    assert (shared["unit"], shared["converged"]) == ("1", True)
    for name, truth in zip(NAMES, TRUTH.T, strict=True):
        assert np.all(np.abs(map.values[name] - truth) < 4.5 * map.errors[name])
    # and a level of noise, of which 64 measurements know 9 %, and 8 of 64 degrees of freedom are fitted away
    stack = coat(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 1.0), G)
    noise = dataclasses.replace(NOISE, relative=common(0.05, 0.001, 0.3))
    map = fitted(tmp_path / "noise.zarr", stack, noise)
    shared = map.attributes["common"]["noise.relative"]
    assert abs(shared["value"] - 0.02) < 4.0 * shared["error"] + 0.002
    with pytest.raises(ValueError, match="all free parameters are common"):
        fitted(tmp_path / "none.zarr", coat(0.5, 0.4, common(0.2, -0.2, 0.8)))
    assert not (tmp_path / "none.zarr").exists()


HAZE = lj.Medium(fits.Free(0.5, 0.1, 2.0), [0.5, 0.6, 0.7], lj.HenyeyGreenstein(common(0.3, 0.0, 0.9)))
COAT = lj.Stack([HAZE], lj.Lambertian(common((0.1, 0.2, 0.3), 0.0, 1.0)))
VALUES = {"layers[0].phase.g": 0.4, "base.albedo[0]": 0.5, "base.albedo[1]": 0.25, "base.albedo[2]": 0.125}


def problem_of(stack, noise=None, **more):
    view = fits.slices(incidence=(10.0, 40.0), outgoing=(-30.0, 0.0, 20.0, 50.0))
    data = along(view, 0.1, channels=("red", "green", "blue"))
    return fits.Problem(stack, data, lj.SingleScattering(), noise or fits.Noise(relative=0.05, floor=1e-3), **more)


def test_a_stack_file_has_the_mark(tmp_path):
    scale, path = common(1.0, 0.8, 1.25), tmp_path / "coat.toml"
    write_problem(path, COAT, scale=scale)
    again = read_problem(path)
    assert (again.scale, again.stack.layers[0].phase.g) == (scale, HAZE.phase.g)
    path.write_text("[base]\nkind = 'Lambertian'\nalbedo = { start = 0, low = 0, high = 1, same_for_all_texels = 1 }\n")
    with pytest.raises(ValueError, match=r"base.albedo: same_for_all_texels: 1 is not True or False"):
        read_problem(path)


def test_common_parameters_are_held():
    noise = fits.Noise(fits.Free(0.05, 0.01, 0.5), common(1e-3, 1e-4, 1e-2))
    instrument = fits.Instrument(tilt=fits.Free(0.0, -1.0, 1.0))
    problem = problem_of(COAT, noise, scale=common(1.0, 0.8, 1.2), instrument=instrument)
    assert set(problem.common_names) == {*VALUES, "scale", "noise.floor"}
    held = with_common(problem, VALUES | {"scale": 1.1, "noise.floor": 2e-3})
    assert held.names == ("layers[0].thickness", "instrument.tilt", "noise.relative")
    np.testing.assert_array_equal(held.stack.layers[0].phase.g, 0.4)
    np.testing.assert_array_equal(held.stack.base.albedo, [0.5, 0.25, 0.125])
    assert (held.scale, held.noise.floor) == (1.1, 2e-3)
    # of mixtures and power laws, too
    law = PowerLaw(fits.Free(1.0, 0.1, 3.0), common(1.0, 0.5, 2.0), (450.0, 550.0, 650.0))
    bare = lj.Stack([lj.Medium(law, 0.5)], lj.Lambertian(0.5))
    problem = problem_of(lj.Mixture({"bare": bare, "coat": COAT}, [common(0.3, 0.0, 1.0), None]))
    names = {"weights.bare", "bare.layers[0].thickness.exponent", *(f"coat.{name}" for name in VALUES)}
    assert set(problem.common_names) == names
    held = with_common(problem, dict.fromkeys(problem.common_names, 0.5))
    left = [leaf for leaf in jax.tree.leaves(held.stack, is_leaf=is_free) if is_free(leaf)]
    assert left == [fits.Free(1.0, 0.1, 3.0), HAZE.thickness]
    np.testing.assert_array_equal(held.stack.parts["bare"].layers[0].thickness.exponent, 0.5)
