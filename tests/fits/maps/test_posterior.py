"""Posteriors of a few texels of a map."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import zarr

import fits
import layerjax as lj
from fits.data.geometry import Geometry
from fits.data.measurements import Measurements
from fits.maps.job import Part
from fits.maps.posterior import problem_at, sample_texels
from fits.maps.store import FLAGS

NOISE = fits.Noise(relative=0.02, floor=1e-4, discrepancy=False)
STACK = lj.Stack(
    [lj.Medium(fits.Free(0.5, 0.05, 3.0), 0.8, lj.HenyeyGreenstein(0.3))], lj.Lambertian(fits.Free(0.4, 0.0, 1.0))
)


@pytest.fixture(scope="module")
def map_and_readings(tmp_path_factory):
    every = fits.slices(incidence=[10.0, 60.0])
    places = np.linspace(0, len(every.wi) - 1, 16).astype(int)
    geometry = Geometry(every.wi[places], every.wo[places])
    truth = lj.Stack([lj.Medium(0.4, 0.8, lj.HenyeyGreenstein(0.3))], lj.Lambertian(0.5))
    values = np.stack(
        [fits.simulate(truth, geometry, lj.SingleScattering(), 0.02, 1e-4, seed=k).values for k in range(6)]
    )
    out = tmp_path_factory.mktemp("posterior") / "map.zarr"
    options = {"noise": NOISE, "transport": lj.SingleScattering(), "starts": 2, "sample": 4}
    found = fits.fit_map(STACK, geometry, values, out, posterior=2, **options)
    return found, values, geometry, options


def test_posteriors_are_those_of_the_texels(map_and_readings):
    found, values, geometry, _ = map_and_readings
    sampled = found.posterior
    assert sampled.converged.all()
    assert sampled.mean.shape == (2, 2)
    (place,) = sampled.places[0]
    data = Measurements(geometry.wi, geometry.wo, values[place], None, np.ones(16, bool), ("value",))
    fit = fits.fit(STACK, data, noise=NOISE, transport=lj.SingleScattering(), starts=2)
    alone = fits.sample(fit, seed=5)
    mean, sd = alone.samples.mean(axis=0), alone.samples.std(axis=0)
    # two chains of 50 autocorrelation times of 32 walkers: a mean is known to about 0.04 sd
    assert np.all(np.abs(sampled.mean[0] - mean) < 0.25 * sd)
    np.testing.assert_allclose(sampled.sd[0], sd, rtol=0.2)
    # nearly Gaussian here: the errors hold
    assert np.all(np.abs(sampled.ratio - 1.0) < 0.3)
    assert np.all(np.abs(sampled.shift) < 0.5)


def test_they_are_kept_and_not_done_again(map_and_readings):
    found, values, geometry, options = map_and_readings
    stages = []
    again = fits.fit_map(
        STACK, geometry, values, found.path, posterior=2, progress=lambda stage, *rest: stages.append(stage), **options
    )
    assert "posterior" not in stages
    np.testing.assert_array_equal(again.posterior.mean, found.posterior.mean)


def test_what_is_no_likelihood_has_no_posterior(tmp_path, map_and_readings):
    _, values, geometry, _ = map_and_readings
    with pytest.raises(ValueError, match="posterior is 2"):
        fits.fit_map(STACK, geometry, values, tmp_path / "l2.zarr", objective="cosine_l2", posterior=2)


@pytest.mark.parametrize("sigma", [None, np.full((16, 2), 0.01)], ids=["without sigma", "with sigma"])
def test_readings_of_a_texel_count_as_in_its_fit(map_and_readings, sigma):
    """Where one channel of two is dead, the posterior is that of the other alone."""
    _, values, geometry, _ = map_and_readings
    vectors, used = np.array([[0.3, 0.6], [0.5, 0.4], [0.9, 0.2]]), np.ones(16, bool)
    both = np.concatenate([values[1], np.full((16, 1), np.nan)], axis=1)

    def problem(values, sigma):
        channels = tuple(f"channel{k}" for k in range(values.shape[1]))
        data = Measurements(geometry.wi, geometry.wo, values, sigma, used, channels)
        return fits.Problem(STACK, data, transport=lj.SingleScattering(), noise=NOISE)

    prepared = SimpleNamespace(problem=problem(np.ones((16, 2)), sigma), least=NOISE.floor)
    found = problem_at(prepared, Part(both[None], None if sigma is None else sigma[None], np.ones(1, bool), None, None))
    alone = problem(values[1], None if sigma is None else sigma[:, :1])
    several = [[float(one.log_likelihood(vector)) for vector in vectors] for one in (found, alone)]
    np.testing.assert_allclose(*(np.diff(each) for each in several), rtol=1e-6)


def test_a_map_in_which_no_texel_converged_has_no_posterior(map_and_readings, tmp_path):
    found, *_ = map_and_readings
    copy = shutil.copytree(found.path, tmp_path / "map.zarr")
    shutil.rmtree(copy / "posterior")
    root = zarr.open_group(copy, mode="r+")
    root["flags"][...] = FLAGS["fitted"]
    sample_texels(root, None, None, 2, 0, None)
    assert fits.open_map(copy).posterior is None
