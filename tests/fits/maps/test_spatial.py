"""What texels share: neighbours held together, beside joint minimisations by scipy, and parameters common to all."""

import dataclasses
import shutil
from functools import partial
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import fits
import layerjax as lj
from fits import MapOptions, PowerLaw, read_problem, write_problem
from fits.maps import spatial
from fits.maps.common import fit_common, newton_step, with_common
from fits.maps.inputs import MapData
from fits.maps.texels import make_texels
from fits.problem.parameters import is_free
from tests.helpers import quick_maps
from tests.helpers.models import along
from tests.helpers.quick_maps import NAMES, TRANSPORT, assert_same, coat
from tests.helpers.refusals import refuses
from tests.helpers.tasks import stop_at

SHAPE, CHUNK = (4, 4), 12  # the second chunk begins at an odd column
THICKNESS, ALBEDO = NAMES
LOW, HIGH = np.array([np.log(0.05), 0.0]), np.array([np.log(3.0), 1.0])
MEAN, SD = 0.5, 0.2  # the prior of the albedo
HUBER = 0.1  # share of a scale below which a total variation is quadratic
FREE = coat(fits.Free(0.5, 0.05, 3.0, prior=fits.LogUniform()), fits.Free(0.4, 0.0, 1.0, prior=fits.Normal(MEAN, SD)))
SCALES = {"gaussian": np.array([0.03, 0.02]), "total_variation": np.array([0.09, 0.06])}
"""Those of a total variation, whose neighbours hold on to each other ten times as much, are wider: fewer rounds."""

PRIORS = {kind: fits.SpatialPrior(kind, dict(zip(NAMES, scales, strict=True)), 100) for kind, scales in SCALES.items()}
GAUSSIAN = PRIORS["gaussian"]
MASK = np.ones(SHAPE, bool)
MASK[1, 2] = False
PLACES = np.cumsum(MASK.ravel()).reshape(SHAPE) - 1
PAIRS = [
    (PLACES[row, column], PLACES[other])
    for row, column in np.argwhere(MASK)
    for other in ((row + 1, column), (row, column + 1))
    if max(other) < 4 and MASK[other]
]
"""Places, among the texels that are fitted, of those that lie beside each other."""

GEOMETRY = quick_maps.geometry()
common = partial(fits.Free, same_for_all_texels=True)
NOISE = fits.Noise(relative=0.02, floor=1e-4, discrepancy=False)
TRUTH = np.array([[0.3, 0.2], [0.5, 0.3], [0.8, 0.4], [1.2, 0.5]])
G = 0.4
HAZE = lj.Medium(fits.Free(0.5, 0.1, 2.0), [0.5, 0.6, 0.7], lj.HenyeyGreenstein(common(0.3, 0.0, 0.9)))
COAT = lj.Stack([HAZE], lj.Lambertian(common((0.1, 0.2, 0.3), 0.0, 1.0)))
VALUES = {"layers[0].phase.g": 0.4, "base.albedo[0]": 0.5, "base.albedo[1]": 0.25, "base.albedo[2]": 0.125}


@jax.jit
def predict(unit):
    """Values (16,) of a texel from its numbers (2,) in the unit box."""
    natural = LOW + unit * (HIGH - LOW)
    stack = coat(jnp.exp(natural[0]), natural[1])
    return lj.evaluate(stack, jnp.asarray(GEOMETRY.wi), jnp.asarray(GEOMETRY.wo), transport=TRANSPORT)[:, 0]


@pytest.fixture(scope="module")
def measured():
    """Values of a map whose albedo has an edge in the middle, and their standard deviations."""
    rows, columns = np.indices(SHAPE)
    truth = np.stack([np.log(0.3 + 0.1 * rows), np.where(columns < 2, 0.3, 0.6)], axis=-1)
    exact = np.stack([predict(one) for one in ((truth - LOW) / (HIGH - LOW)).reshape(-1, 2)]).reshape(*SHAPE, -1, 1)
    sigma = 0.03 * exact
    return exact + sigma * np.random.default_rng(4).standard_normal(exact.shape), sigma


@pytest.fixture(scope="module")
def fitted(measured):
    def fit(out, **options):
        values, sigma = measured
        options = {"chunk_size": CHUNK, "pilot_texels": 4, "noise": fits.Noise(relative=0.0, floor=0.0)} | options
        return quick_maps.fitted(out, values, FREE, sigma=sigma, mask=MASK, **options)

    return fit


@pytest.fixture(scope="module")
def whole(tmp_path_factory, fitted):
    return fitted(tmp_path_factory.mktemp("map") / "plain.zarr")


@pytest.fixture(scope="module")
def smoothed(tmp_path_factory, whole, fitted):
    folder = tmp_path_factory.mktemp("map")
    return {kind: fitted(shutil.copytree(whole.path, folder / kind), spatial_prior=PRIORS[kind]) for kind in PRIORS}


def units_of(values):
    """Numbers of the texels that are fitted, (15, 2), in the unit box."""
    natural = np.stack([np.log(values[THICKNESS][MASK]), values[ALBEDO][MASK]], axis=-1)
    return (natural - LOW) / (HIGH - LOW)


@pytest.mark.slow
@pytest.mark.parametrize("kind", PRIORS)
def test_it_ends_where_a_joint_minimisation_does(smoothed, measured, kind):
    map, (first, second) = smoothed[kind], np.array(PAIRS).T
    values, sigma = (jnp.asarray(one[MASK][..., 0]) for one in measured)

    def residuals(flat):  # of the data and the prior, written down anew
        units = flat.reshape(-1, 2)
        data = (jax.vmap(predict)(units) - values) / sigma
        return jnp.concatenate([data.reshape(-1), (units[:, 1] - MEAN) / SD])

    def share(flat):
        units = flat.reshape(-1, 2)
        return jnp.abs(units[second] - units[first]) / SCALES[kind]

    def cost(flat):
        size = share(flat)
        quadratic = 0.5 * size**2
        if kind == "total_variation":
            quadratic = jnp.where(size < HUBER, quadratic / HUBER + 0.5 * HUBER, size)
        return 0.5 * jnp.sum(residuals(flat) ** 2) + jnp.sum(quadratic)

    both = jax.jit(jax.value_and_grad(cost))
    plain, ends = units_of(map.values), units_of(map.smoothed)
    options = {"gtol": 1e-4, "maxiter": 2000}
    best = minimize(lambda x: [np.asarray(one, float) for one in both(x)], plain.ravel(), jac=True, options=options)
    assert np.max(np.abs(best.jac)) < 1e-2  # slopes over a box: of next to nothing within an error
    slope = (HIGH - LOW) * np.stack([map.smoothed[THICKNESS][MASK], np.ones(15)], axis=-1)
    errors = np.stack([map.smoothed_errors[name][MASK] for name in NAMES], axis=-1) / slope
    joint = best.x.reshape(-1, 2)
    assert np.max(np.abs(joint - plain) / errors) > 3.0  # what is compared is no small change
    *_, before, last = map.smoothing["largest_moves"]
    remaining = last / (1.0 - last / before)  # at most, of a geometric series of moves, in standard errors
    assert map.smoothing["settled"]
    assert remaining < 0.1
    assert np.max(np.abs(joint - ends) / errors) < remaining + (2e-3 if kind == "gaussian" else 2e-2)
    assert cost(ends.ravel()) < cost(plain.ravel())
    if kind == "gaussian":  # errors are those of Gauss-Newton at the optimum, with the neighbours held
        jacobian = jax.jacfwd(lambda flat: jnp.concatenate([residuals(flat), share(flat).ravel()]))(best.x)
        information = np.asarray(jacobian.T @ jacobian)
        exact = [np.sqrt(np.diag(np.linalg.inv(information[k : k + 2, k : k + 2]))) for k in range(0, 30, 2)]
        np.testing.assert_allclose(errors, exact, rtol=0.01)


def test_the_plain_fit_stays_and_masked_texels_stay_out(whole, smoothed):
    gaussian = smoothed["gaussian"]
    assert whole.attributes == gaussian.attributes
    for name in whole.arrays:
        np.testing.assert_array_equal(gaussian[name][:], whole[name][:], err_msg=name)
    for name in NAMES:
        for numbers in (gaussian.smoothed[name], gaussian.smoothed_errors[name]):
            np.testing.assert_array_equal(np.isfinite(numbers), MASK)


def test_parameters_that_are_not_named_are_not_smoothed(out, fitted):
    map = fitted(out, spatial_prior=fits.SpatialPrior("gaussian", {ALBEDO: 0.001}, rounds=4))
    assert map.smoothing["prior"] == {"kind": "gaussian", "scale": {ALBEDO: 0.001}, "rounds": 4, "settled": 0.01}
    assert not map.smoothing["settled"]
    rough = {name: np.nanstd(map.smoothed[name]) / np.nanstd(map.values[name]) for name in NAMES}
    assert rough[ALBEDO] < 0.5 < rough[THICKNESS]


def test_a_run_that_was_stopped_is_resumed_to_the_bit(out, fitted, smoothed):
    with pytest.raises(KeyboardInterrupt):
        fitted(out, spatial_prior=GAUSSIAN, progress=stop_at("smoothing", 2))
    assert (fits.open_map(out).done, fits.open_map(out).smoothed) == (1.0, None)
    (out / "smoothed.partial" / "values").mkdir(parents=True)  # killed in the midst of the next
    rounds = []
    again = fitted(out, spatial_prior=GAUSSIAN, progress=lambda stage, done, *_: rounds.append((stage, done)))
    assert_same(again, smoothed["gaussian"])
    assert next(done for stage, done in rounds if stage == "smoothing") >= 1  # not begun anew


def test_data_that_cannot_be_read_again_are_named(out, monkeypatch, fitted):
    work, gone = spatial.work, Mock(side_effect=ValueError("values: damaged"))
    monkeypatch.setattr(spatial, "work", lambda *task: monkeypatch.setattr(MapData, "read", gone) or work(*task))
    with pytest.raises(ValueError, match=r"smoothing of chunk \[0:4, 0:3\]: values: damaged; the map is fitted"):
        fitted(out, spatial_prior=GAUSSIAN)


def test_another_prior_smooths_anew_and_fits_nothing_again(tmp_path, smoothed, fitted):
    out, stages = shutil.copytree(smoothed["total_variation"].path, tmp_path / "again.zarr"), []
    before = {path: path.stat().st_mtime_ns for path in out.glob("values/**/c/*/*")}
    again = fitted(out, spatial_prior=GAUSSIAN, progress=lambda stage, *_: stages.append(stage))
    assert_same(again, smoothed["gaussian"])
    assert "pilot" not in stages
    assert {path: path.stat().st_mtime_ns for path in before} == before
    fitted(out, spatial_prior=GAUSSIAN, progress=stop_at("smoothing"))  # it is there
    assert fitted(out).smoothed is not None  # and stays


def test_scales_are_positive_and_of_parameters_that_there_are(tmp_path, measured):
    for options, words in (
        ({"scale": {"albedo": 0.1}}, r"names 'albedo'; it must be one of layers\[0\].thickness, base.albedo"),
        ({"objective": "cosine_l2", "stack": quick_maps.FREE}, "objective 'cosine_l2' has no noise"),
        ({"kind": "laplace"}, "SpatialPrior.kind: 'laplace' is not one of 'gaussian', 'total_variation'"),
        ({"scale": 0.0}, r"SpatialPrior.scale is 0.0; it must be a number in \[1e-06, 1e"),
        ({"scale": {"base.albedo": -1.0}}, r"SpatialPrior.scale\['base.albedo'\] is -1.0"),
        ({"scale": {}}, "SpatialPrior.scale is empty"),
    ):
        prior = {"kind": "gaussian", "scale": 0.1} | options
        more = {name: prior.pop(name) for name in ("objective", "stack") if name in prior}
        with pytest.raises(ValueError, match=words):
            quick_maps.fitted(tmp_path / "no.zarr", measured[0], **more, spatial_prior=fits.SpatialPrior(**prior))
        assert not (tmp_path / "no.zarr").exists()
    names = ["base.albedo[0]", "base.albedo[1]", "layers[0].thickness"]  # all channels of a parameter have its scale
    assert fits.SpatialPrior("gaussian", {"base.albedo": 0.1}).scales(names) == dict.fromkeys(names[:2], 0.1)
    assert fits.SpatialPrior("gaussian", 0.2).scales(names) == dict.fromkeys(names, 0.2)


def hazy(thickness, albedo, g):
    return lj.Stack([lj.Medium(thickness, 0.8, lj.HenyeyGreenstein(g))], lj.Lambertian(albedo))


def free(low=-0.2, high=0.8, prior=None):
    return hazy(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 1.0), common(0.2, low, high, prior=prior))


@pytest.fixture(scope="module")
def values():
    exact = [lj.evaluate(hazy(*one, G), GEOMETRY.wi, GEOMETRY.wo, transport=TRANSPORT) for one in TRUTH]
    sigma = np.hypot(NOISE.relative * np.array(exact), NOISE.floor)
    return exact + sigma * np.random.default_rng(3).standard_normal(sigma.shape)


@pytest.mark.parametrize(
    ("prior", "bounds"),
    [(None, (-0.2, 0.8)), (fits.Normal(0.2, 0.05), (-0.2, 0.8)), (None, (-0.2, 0.25))],
    ids=["free", "with a prior", "on a bound"],
)
def test_the_joint_fit_of_a_pilot_is_that_of_joint(values, prior, bounds):
    parts = [fits.Problem(free(*bounds, prior=prior), along(GEOMETRY, row), TRANSPORT, NOISE) for row in values[:2]]
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


def test_a_map_holds_what_its_texels_have_in_common(tmp_path, values):
    def fitted(out, stack, noise=NOISE):
        options = MapOptions(starts=2, chunk_size=4)
        return fits.fit_map(stack, GEOMETRY, values, out, noise=noise, transport=TRANSPORT, options=options)

    map = fitted(tmp_path / "common.zarr", free())
    assert map.names == NAMES
    shared = map.attributes["common"]["layers[0].phase.g"]
    assert abs(shared["value"] - G) < 4.0 * shared["error"]
    assert (shared["unit"], shared["converged"]) == ("1", True)
    for name, truth in zip(NAMES, TRUTH.T, strict=True):
        assert np.all(np.abs(map.values[name] - truth) < 4.5 * map.errors[name])
    # and a level of noise, of which 64 measurements know 9 %, and 8 of 64 degrees of freedom are fitted away
    stack = hazy(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 1.0), G)
    noise = dataclasses.replace(NOISE, relative=common(0.05, 0.001, 0.3))
    map = fitted(tmp_path / "noise.zarr", stack, noise)
    shared = map.attributes["common"]["noise.relative"]
    assert abs(shared["value"] - 0.02) < 4.0 * shared["error"] + 0.002
    refuses("all free parameters are common", fitted, tmp_path / "none.zarr", hazy(0.5, 0.4, common(0.2, -0.2, 0.8)))
    assert not (tmp_path / "none.zarr").exists()


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
    refuses(r"base.albedo: same_for_all_texels: 1 is not True or False", read_problem, path)


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
