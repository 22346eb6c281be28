"""Neighbouring texels held together: against joint minimisations by scipy, and what becomes of work that is stopped."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import fits
import layerjax as lj
from fits.maps import spatial
from fits.maps.inputs import MapData
from tests.helpers import quick_maps
from tests.helpers.quick_maps import NAMES, TRANSPORT, assert_same, coat

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


@pytest.fixture(scope="module")
def predict(geometry):
    """Values (16,) of a texel from its numbers (2,) in the unit box."""

    def one(unit):
        natural = LOW + unit * (HIGH - LOW)
        stack = coat(jnp.exp(natural[0]), natural[1])
        return lj.evaluate(stack, jnp.asarray(geometry.wi), jnp.asarray(geometry.wo), transport=TRANSPORT)[:, 0]

    return jax.jit(one)


@pytest.fixture(scope="module")
def measured(predict):
    """Values of a map whose albedo has an edge in the middle, and their standard deviations."""
    rows, columns = np.indices(SHAPE)
    truth = np.stack([np.log(0.3 + 0.1 * rows), np.where(columns < 2, 0.3, 0.6)], axis=-1)
    exact = np.stack([predict(one) for one in ((truth - LOW) / (HIGH - LOW)).reshape(-1, 2)]).reshape(*SHAPE, -1, 1)
    sigma = 0.03 * exact
    return exact + sigma * np.random.default_rng(4).standard_normal(exact.shape), sigma


@pytest.fixture(scope="module")
def fitted(measured):
    """Fits the map, with these options."""

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
    """The maps with a spatial prior of each kind."""
    folder = tmp_path_factory.mktemp("map")
    return {kind: fitted(shutil.copytree(whole.path, folder / kind), spatial_prior=PRIORS[kind]) for kind in PRIORS}


def units_of(values):
    """Numbers of the texels that are fitted, (15, 2), in the unit box."""
    natural = np.stack([np.log(values[THICKNESS][MASK]), values[ALBEDO][MASK]], axis=-1)
    return (natural - LOW) / (HIGH - LOW)


@pytest.mark.slow
@pytest.mark.parametrize("kind", PRIORS)
def test_it_ends_where_a_joint_minimisation_does(smoothed, predict, measured, kind):
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
        if kind == "gaussian":
            size = 0.5 * size**2
        else:
            size = jnp.where(size < HUBER, 0.5 * size**2 / HUBER + 0.5 * HUBER, size)
        return 0.5 * jnp.sum(residuals(flat) ** 2) + jnp.sum(size)

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
        fitted(out, spatial_prior=GAUSSIAN, progress=quick_maps.stop_at("smoothing", 2))
    assert (fits.open_map(out).done, fits.open_map(out).smoothed) == (1.0, None)
    (out / "smoothed.partial" / "values").mkdir(parents=True)  # killed in the midst of the next
    rounds = []
    again = fitted(out, spatial_prior=GAUSSIAN, progress=lambda stage, done, *_: rounds.append((stage, done)))
    assert_same(again, smoothed["gaussian"])
    assert next(done for stage, done in rounds if stage == "smoothing") >= 1  # not begun anew


def test_data_that_cannot_be_read_again_are_named(out, monkeypatch, fitted):
    def gone(*_):
        raise ValueError("values: damaged")

    work = spatial.work
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
    fitted(out, spatial_prior=GAUSSIAN, progress=quick_maps.stop_at("smoothing"))  # it is there
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
