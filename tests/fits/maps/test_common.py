"""Common parameters of all texels: the joint fit of a pilot against `fits.Joint`, and which they are."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from fits.data.measurements import Measurements
from fits.maps.common import _Arrow, _step, common_names, fit_common, hold
from fits.maps.descent import make_texels
from fits.maps.options import MapOptions
from fits.problem.discrepancy import Discrepancy
from fits.problem.parameters import PowerLaw, is_free
from fits.problem.stack_file import read_problem, write_problem
from tests.helpers import quick_maps

TRANSPORT = lj.SingleScattering()
NOISE = fits.Noise(relative=0.02, floor=1e-4, discrepancy=False)
TRUTH = np.array([[0.3, 0.2], [0.5, 0.3], [0.8, 0.4], [1.2, 0.5]])
G = 0.4
SMALL = MapOptions(starts=2, chunk_size=4)
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
    return quick_maps.geometry()


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
def test_the_joint_fit_of_a_pilot_is_that_of_joint(geometry, values, prior, bounds):
    stack = free(*bounds, prior=prior)
    problems = {f"t{k}": problem_of(stack, row, geometry) for k, row in enumerate(values)}
    joint = fits.fit(fits.Joint(problems, shared=["layers[0].phase.g"]), starts=4)
    held, common = fit_common(
        problems["t0"], make_texels(values, least=NOISE.floor), MapOptions(starts=4, chunk_size=4)
    )
    (name,) = common.values
    assert common.converged
    assert held.names == NAMES
    error = joint.standard_errors["layers[0].phase.g"]
    scale = error if np.isfinite(error) else 1e-3
    # a step of a hundredth of an error is the last one
    assert abs(common.values[name] - joint.values["layers[0].phase.g"]) < 0.02 * scale
    np.testing.assert_allclose(common.errors[name], error, rtol=0.02)


def test_errors_of_what_a_pilot_does_not_know_are_infinite(geometry, values):
    stack = coat(*(fits.Free(0.5, 0.1, 0.9, same_for_all_texels=k > 0) for k in range(3)))
    problem, gradient = problem_of(stack, values[0], geometry), np.array([1.0, 0.0])
    for information in (np.zeros((2, 2)), np.diag([1e8, 0.0]), np.diag([1e8, -1e-9])):
        step, error, _ = _step(problem, np.array([1, 2]), _Arrow(0.0, gradient, information), np.array([0.5, 0.5]))
        known = information[0, 0] > 0.0
        np.testing.assert_allclose(error, [1e-4 if known else np.inf, np.inf])
        np.testing.assert_allclose(step, [-1e-8 if known else 0.0, 0.0])


def test_a_map_holds_what_its_texels_have_in_common(tmp_path, geometry, values):
    found = fits.fit_map(
        free(), geometry, values, tmp_path / "shared.zarr", noise=NOISE, transport=TRANSPORT, options=SMALL
    )
    assert found.names == NAMES
    said = found.attributes["common"]["layers[0].phase.g"]
    assert abs(said["value"] - G) < 4.0 * said["error"]
    assert (said["unit"], said["converged"]) == ("1", True)
    for column, name in enumerate(NAMES):
        pulls = (found.values[name] - TRUTH[:, column]) / found.errors[name]
        assert np.all(np.abs(pulls) < 4.5)


def test_a_common_level_of_noise_is_found(tmp_path, geometry, values):
    stack = coat(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 1.0), G)
    noise = dataclasses.replace(NOISE, relative=fits.Free(0.05, 0.001, 0.3, same_for_all_texels=True))
    found = fits.fit_map(
        stack, geometry, values, tmp_path / "noise.zarr", noise=noise, transport=TRANSPORT, options=SMALL
    )
    said = found.attributes["common"]["noise.relative"]
    # of 64 measurements a level is known to 9 %, and 8 of 64 degrees of freedom are fitted away
    assert abs(said["value"] - 0.02) < 4.0 * said["error"] + 0.002
    again = fits.fit_map(
        stack, geometry, values, tmp_path / "noise.zarr", noise=noise, transport=TRANSPORT, options=SMALL
    )
    assert again.attributes == found.attributes


def test_a_map_of_common_parameters_alone_is_refused(tmp_path, geometry, values):
    stack = coat(0.5, 0.4, fits.Free(0.2, -0.2, 0.8, same_for_all_texels=True))
    with pytest.raises(ValueError, match="all free parameters are common"):
        fits.fit_map(stack, geometry, values, tmp_path / "none.zarr", noise=NOISE, transport=TRANSPORT)
    assert not (tmp_path / "none.zarr").exists()


# ---- which they are, and the stack with them held ----


HAZE = lj.Medium(
    fits.Free(0.5, 0.1, 2.0), [0.5, 0.6, 0.7], lj.HenyeyGreenstein(fits.Free(0.3, 0.0, 0.9, same_for_all_texels=True))
)
COAT = lj.Stack([HAZE], lj.Lambertian(fits.Free((0.1, 0.2, 0.3), 0.0, 1.0, same_for_all_texels=True)))
VALUES = {"layers[0].phase.g": 0.4, "base.albedo[0]": 0.5, "base.albedo[1]": 0.25, "base.albedo[2]": 0.125}


def _data(channels: int = 3) -> Measurements:
    view = fits.slices(incidence=(10.0, 40.0), outgoing=(-30.0, 0.0, 20.0, 50.0))
    names = tuple(f"channel{k}" for k in range(channels))
    return Measurements(view.wi, view.wo, np.full((8, channels), 0.1), None, np.ones(8, bool), names)


def test_the_mark_is_shown_only_where_it_is_set() -> None:
    assert repr(fits.Free(0.5, 0.0, 1.0)) == "Free(0.5, 0.0, 1.0)"
    assert repr(fits.Free(0.5, 0.0, 1.0, same_for_all_texels=True)) == "Free(0.5, 0.0, 1.0, same_for_all_texels=True)"
    assert fits.Free(0.5, 0.0, 1.0, same_for_all_texels=True) != fits.Free(0.5, 0.0, 1.0)
    for wrong in (1, "yes", None):
        with pytest.raises(ValueError, match=r"Free.same_for_all_texels is .*; it must be True or False"):
            fits.Free(0.5, 0.0, 1.0, fits.Uniform(), None, wrong)  # type: ignore[arg-type]


def test_a_stack_file_has_the_mark(tmp_path) -> None:
    scale = fits.Free(1.0, 0.8, 1.25, same_for_all_texels=True)
    path = tmp_path / "coat.toml"
    write_problem(path, COAT, scale=scale)
    assert path.read_text().count("same_for_all_texels = true") == 3
    again = read_problem(path)
    assert again.scale == scale
    assert again.stack.layers[0].thickness == HAZE.thickness
    assert again.stack.layers[0].phase.g == HAZE.phase.g
    assert again.stack.base.albedo == COAT.base.albedo
    path.write_text(
        "[base]\nkind = 'Lambertian'\nalbedo = { start = 0.5, low = 0, high = 1, same_for_all_texels = 1 }\n"
    )
    with pytest.raises(ValueError, match=r"base.albedo.same_for_all_texels is 1, must be true or false"):
        read_problem(path)


def test_common_names_are_those_of_the_problem() -> None:
    assert common_names(fits.Problem(COAT, _data(), lj.SingleScattering())) == tuple(VALUES)
    plain = fits.Problem(
        lj.Stack([HAZE], lj.Lambertian(0.5)),
        _data(),
        lj.SingleScattering(),
        noise=fits.Noise(
            relative=fits.Free(0.05, 0.01, 0.5),
            discrepancy=Discrepancy(amplitude=fits.Free(0.1, 0.01, 0.5, same_for_all_texels=True)),
        ),
        scale=fits.Free(1.0, 0.8, 1.2, same_for_all_texels=True),
        instrument=fits.Instrument(
            tilt=fits.Free(0.0, -1.0, 1.0, same_for_all_texels=True),
            floor=fits.Free(1e-3, 1e-4, 1e-2, same_for_all_texels=True),
        ),
    )
    expected = {"layers[0].phase.g", "scale", "instrument.tilt", "noise.floor", "noise.discrepancy.amplitude"}
    assert set(common_names(plain)) == expected
    assert common_names(plain) == tuple(name for name in plain.names if name in expected)


def test_common_names_of_mixtures_and_power_laws() -> None:
    waves = (450.0, 550.0, 650.0)
    law = PowerLaw(fits.Free(1.0, 0.1, 3.0), fits.Free(1.0, 0.5, 2.0, same_for_all_texels=True), waves)
    bare = lj.Stack([lj.Medium(law, 0.5)], lj.Lambertian(0.5))
    mixed = lj.Mixture({"bare": bare, "coat": COAT}, [fits.Free(0.3, 0.0, 1.0, same_for_all_texels=True), None])
    names = common_names(fits.Problem(mixed, _data(), lj.SingleScattering()))
    own = {"weights.bare", "bare.layers[0].thickness.exponent", *(f"coat.{name}" for name in VALUES)}
    assert set(names) == own
    held = hold(mixed, dict.fromkeys(names, 0.5))
    left = [leaf for leaf in jax.tree.leaves(held, is_leaf=is_free) if is_free(leaf)]
    assert left == [fits.Free(1.0, 0.1, 3.0), HAZE.thickness]


def test_common_parameters_are_held() -> None:
    held = hold(COAT, VALUES | {"layers[0].thickness": 9.0})
    assert held.layers[0].thickness == HAZE.thickness
    np.testing.assert_array_equal(held.layers[0].phase.g, 0.4)
    np.testing.assert_array_equal(held.base.albedo, [0.5, 0.25, 0.125])
    np.testing.assert_array_equal(held.layers[0].albedo, HAZE.albedo)
    assert fits.Problem(held, _data(), lj.SingleScattering()).names == ("layers[0].thickness",)


def test_a_power_law_that_is_known_becomes_its_numbers() -> None:
    waves = (400.0, 800.0)
    law = PowerLaw(
        fits.Free(1.0, 0.1, 3.0, same_for_all_texels=True),
        fits.Free(1.0, 0.5, 2.0, same_for_all_texels=True),
        waves,
        reference=400.0,
    )
    stack = lj.Stack([lj.Medium(law, fits.Free(0.5, 0.0, 1.0))], lj.Lambertian(0.5))
    held = hold(stack, {"layers[0].thickness.amplitude": 2.0, "layers[0].thickness.exponent": 1.0})
    np.testing.assert_allclose(held.layers[0].thickness, [2.0, 1.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, r"values has no 'layers\[0\].phase.g', which is common; it has none"),
        (VALUES | {"base.albedo[1]": float("nan")}, r"values\['base.albedo\[1\]'\] is nan; it must be finite"),
    ],
)
def test_what_is_missing_is_named(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hold(COAT, values)
