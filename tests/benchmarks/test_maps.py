"""The painted map: its measurements are those of its truth, texel by texel, with the noise that it states."""

import numpy as np
import pytest
from scipy import stats

import layerjax as lj
from benchmarks.suite import maps
from benchmarks.suite.maps import NAMES, ROUGHNESS, THICKNESS, Painted, emblem, painted
from fits.maps.inputs import map_data
from fits.problem.parameters import split

SHAPE = (13, 11)


@pytest.fixture(scope="module")
def flakes() -> Painted:
    """A small one, in more than one part."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maps, "TOGETHER", 50)
        return painted(SHAPE, lj.SingleScattering(), material="flakes", seed=3)


def test_measurements_are_those_of_the_truth(flakes: Painted) -> None:
    assert flakes.values.shape == (*SHAPE, 64, 1)
    found = map_data(flakes.values, flakes.geometry)
    assert (found.shape, found.samples, found.channels) == (SHAPE, 64, 1)
    exact = painted(SHAPE, lj.SingleScattering(), material="flakes", noise=0.0)
    for place in ((0, 0), (6, 5), (12, 10)):
        alpha, thickness = (flakes.truth[name][place] for name in NAMES["flakes"])
        medium = lj.Medium(thickness, 0.8, lj.SGGX("surface", alpha), f0=0.5)
        alone = lj.Stack([medium], lj.Lambertian(0.3))
        seen = lj.evaluate(alone, flakes.geometry.wi, flakes.geometry.wo, lj.SingleScattering())
        # a map of stacks is computed side by side, to rounding
        np.testing.assert_allclose(exact.values[place], seen, rtol=1e-10)
    z = (flakes.values / exact.values - 1.0) / 0.02
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3  # a fixed seed: passes or fails for good


def test_seeds_repeat(flakes: Painted) -> None:
    again = painted(SHAPE, lj.SingleScattering(), material="flakes", seed=3)
    np.testing.assert_allclose(again.values, flakes.values, rtol=1e-12)  # in one part here
    other = painted(SHAPE, lj.SingleScattering(), material="flakes", seed=4)
    assert (other.values != flakes.values).all()


def test_what_is_free_is_what_was_painted(flakes: Painted) -> None:
    free = split(flakes.stack)[1]
    assert set(free) == set(flakes.truth) == set(NAMES["flakes"])
    for name, entry in free.items():
        assert entry.low < flakes.truth[name].min()
        assert entry.high > flakes.truth[name].max()
    assert flakes.noise.relative == 0.02


def test_the_coat_may_share_a_base(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[lj.Stack] = []

    def evaluate(stack: lj.Stack, wi: np.ndarray, wo: np.ndarray, *_: object, **__: object) -> np.ndarray:
        seen.append(stack)
        return np.ones((len(wi), stack.layers[0].alpha.shape[0], 1))

    monkeypatch.setattr(lj, "evaluate", evaluate)
    coat = painted((2, 3), noise=0.0, shared=True)
    free = split(coat.stack)[1]
    assert set(free) == set(coat.truth) == {*NAMES["coat"], "base.albedo"}
    assert [name for name, entry in free.items() if entry.same_for_all_texels] == ["base.albedo"]
    (stack,) = seen
    np.testing.assert_array_equal(stack.layers[0].alpha, coat.truth["layers[0].alpha"].ravel())
    np.testing.assert_array_equal(stack.layers[1].thickness[:, 0], coat.truth["layers[1].thickness"].ravel())
    np.testing.assert_array_equal(stack.base.albedo, coat.truth["base.albedo"][0, 0])


def test_the_emblem_is_smooth_but_for_its_edges() -> None:
    for picture, (low, high) in zip(emblem((256, 256)), (ROUGHNESS, THICKNESS), strict=True):
        assert picture.shape == (256, 256)
        assert low * (1.0 - 1e-12) <= picture.min()
        assert picture.max() <= high * (1.0 + 1e-12)
        steps = np.abs(np.diff(np.log(picture), axis=1))
        # of star and ring: far fewer than a tenth of the pairs; elsewhere a step is the slope times 2 / 256, and all
        # slopes of the formulas are below 8 in the logarithm
        jumps = steps > 8.0 * 2.0 / 256
        assert 0.005 < jumps.mean() < 0.1
        assert np.median(steps[jumps]) > 5.0 * np.quantile(steps[~jumps], 0.99)
