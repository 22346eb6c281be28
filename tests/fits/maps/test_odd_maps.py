"""Maps of all shapes and precisions, values that no texel can have, models that break: each costs itself alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fits
import layerjax as lj
from fits.maps.fitted_map import FittedMap
from tests.helpers.quick_maps import FREE, NAMES, NOISE, TRANSPORT, fitted, geometry, values

SHAPE = (8, 8)
CLOSE = 2e-3
"""Standard errors that a converged fit may be off by, times twenty: it has converged within 1e-4."""


@pytest.fixture(scope="module")
def given() -> np.ndarray:
    return values(SHAPE)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, given):
    return fitted(tmp_path_factory.mktemp("map") / "whole.zarr", given)


def apart(found: FittedMap, expected: FittedMap, where=Ellipsis) -> float:
    """How far values are from each other at most, in standard errors."""
    return max(
        float(np.max(np.abs(found.values[name].ravel() - expected.values[name].ravel())[where]
                     / expected.errors[name].ravel()[where]))
        for name in NAMES
    )  # fmt: skip


@pytest.mark.parametrize("shape", [(64,), (4, 4, 4), (1, 64), (64, 1)])
def test_maps_of_every_rank_are_the_same(tmp_path, given, whole, shape):
    found = fitted(tmp_path / "map.zarr", given.reshape(*shape, 16, 1))
    assert found.shape == shape
    assert found.has("converged").all()
    assert apart(found, whole) < CLOSE


def test_a_single_texel_and_values_without_channels(tmp_path, given, whole):
    found = fitted(tmp_path / "one.zarr", given[:1, :1, :, 0], pilot_texels=64)
    assert found.shape == (1, 1)
    for name in NAMES:
        assert abs(found.values[name][0, 0] - whole.values[name][0, 0]) < CLOSE * whole.errors[name][0, 0]


def test_a_chunk_larger_than_the_map_is_the_map(tmp_path, given, whole):
    """And no program is made for a million texels, nor is another size another fit."""
    found = fitted(tmp_path / "map.zarr", given, chunk_size=10**9, pilot_texels=10**6)
    assert found.chunk == SHAPE
    assert apart(found, whole) < CLOSE
    assert fitted(found.path, given, chunk_size=10**8, pilot_texels=10**6).done == 1.0


@pytest.mark.parametrize("kind", [np.float32, np.float16, ">f8"])
def test_values_of_other_types(tmp_path, given, whole, kind):
    rounding = {"2": 1e-3, "4": 1e-7, "8": 1e-16}[str(np.dtype(kind).itemsize)]
    found = fitted(tmp_path / "map.zarr", given.astype(kind))
    # all values rounded the same way, in units of their noise of 2 %: sixteen of them weigh four times as much
    assert apart(found, whole) < CLOSE + 4.0 * 4.0 * rounding / NOISE.relative


def test_channels_have_numbers_of_their_own(tmp_path, given, whole):
    three = np.concatenate([given, given, 1.2 * given], axis=-1)
    albedo = fits.Free([0.4, 0.4, 0.4], 0.0, 1.0)
    stack = lj.Stack([lj.Medium(fits.Free(0.5, 0.05, 3.0), 0.8, lj.HenyeyGreenstein(0.3))], lj.Lambertian(albedo))
    found = fitted(tmp_path / "map.zarr", three, stack)
    assert found.names == ("layers[0].thickness", "base.albedo[0]", "base.albedo[1]", "base.albedo[2]")
    assert found.has("converged").all()
    same = np.abs(found.values["base.albedo[0]"] - found.values["base.albedo[1]"]) / found.errors["base.albedo[0]"]
    assert np.max(same) < CLOSE
    assert np.all(found.values["base.albedo[2]"] > found.values["base.albedo[0]"])


def awkward(given: np.ndarray) -> tuple[np.ndarray, dict[int, str]]:
    """Texels that cannot be, in the first row, and the flag that each of them must have."""
    changed, flags = given.copy(), {}
    row = {
        "poor": [1e30, 0.0, -given[0, 2], 1e-300],
        "too_few_measurements": [np.nan, np.inf],
        "failed": [1e300, -1e308],
    }
    for flag, numbers in row.items():
        for number in numbers:
            changed[0, len(flags)] = number
            flags[len(flags)] = flag
    return changed, flags


def test_values_that_cannot_be_cost_their_texel_alone(tmp_path, given, whole):
    changed, flags = awkward(given)
    found = fitted(tmp_path / "map.zarr", changed)
    for column, flag in flags.items():
        assert found.has(flag)[0, column], column
        assert np.isfinite(found.values[NAMES[0]][0, column]) == (flag == "poor")
    assert found.has("converged")[1:].all()
    assert not found.has("poor")[1:].any()
    assert apart(found, whole, slice(8, None)) < CLOSE


def test_in_single_precision_errors_are_those_of_double(tmp_path, given, whole):
    jax.config.update("jax_enable_x64", False)
    try:
        found = fitted(tmp_path / "clean.zarr", given)
        spoilt = fitted(tmp_path / "map.zarr", awkward(given)[0])
        with pytest.raises(ValueError, match="different in precision"):
            fitted(whole.path, given)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert found.has("converged").all()
    assert np.all(found.flags == whole.flags)
    # of a cost of ten, 1e-6 is lost to rounding there: 1e-3 standard errors, and a few times that for its gradient
    assert apart(found, whole) < 0.1
    assert apart(spoilt, whole, slice(8, None)) < 0.1
    for name in NAMES:
        np.testing.assert_allclose(found.errors[name], whole.errors[name], rtol=0.03)


def test_values_beyond_single_precision_are_left_out_there(tmp_path, given):
    changed = given.copy()
    changed[0, 0, 3] = 1e300
    jax.config.update("jax_enable_x64", False)
    try:
        found = fitted(tmp_path / "map.zarr", changed)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert found.measurements[0, 0] == 15
    assert found.has("converged").all()


def broken(stack, wi, wo, beyond):
    exact = lj.evaluate(stack, wi, wo, TRANSPORT)
    return jnp.where(jnp.max(stack.layers[0].thickness) > 0.6, beyond, exact)


def nan_beyond(stack, wi, wo):
    return broken(stack, wi, wo, jnp.nan)


def infinite_beyond(stack, wi, wo):
    return broken(stack, wi, wo, jnp.inf)


@pytest.mark.parametrize("transport", [nan_beyond, infinite_beyond])
def test_a_model_that_breaks_costs_what_lies_beyond(tmp_path, given, whole, transport):
    """Texels whose best thickness is beyond 0.6 have no fit, or one this side of it that has not converged."""
    found = fitted(tmp_path / "map.zarr", given, transport=transport)
    near = whole.values[NAMES[0]] + 5.0 * whole.errors[NAMES[0]] < 0.6
    far = whole.values[NAMES[0]] > 0.61
    assert near.sum() >= 16
    assert far.sum() >= 16
    assert apart(found, whole, np.flatnonzero(near)) < CLOSE
    assert found.has("converged")[near].all()
    assert not found.has("converged")[far].any()
    assert (found.has("fitted") | found.has("failed")).all()
    for name in NAMES:
        assert np.isfinite(found.values[name][found.has("fitted")]).all()


def test_a_model_that_is_never_finite_is_said_at_once(tmp_path, given):
    with pytest.raises(ValueError, match="no texel of the pilot has a finite fit"):
        fitted(
            tmp_path / "map.zarr",
            given,
            transport=lambda stack, wi, wo: jnp.nan * lj.evaluate(stack, wi, wo, TRANSPORT),
        )
    assert not (tmp_path / "map.zarr").exists()


def test_what_leaves_nothing_to_fit_is_named(tmp_path, given):
    out, mask = tmp_path / "map.zarr", np.zeros(SHAPE, bool)
    with pytest.raises(ValueError, match="mask: no texel takes part, it is 0 everywhere"):
        fitted(out, given, mask=mask)
    with pytest.raises(ValueError, match="no measurement of a texel that takes part is a finite number"):
        fitted(out, np.full_like(given, np.nan))
    with pytest.raises(ValueError, match="no texel has as many measurements as there are free parameters, 2"):
        fits.fit_map(FREE, (geometry().wi[:1], geometry().wo[:1]), given[:, :, :1], out, NOISE, transport=TRANSPORT)
    for sigma, words in ((0.0, "sigma is 0 in block"), (-1.0, "sigma is -1 in block")):
        with pytest.raises(ValueError, match=words):
            fitted(out, given, sigma=np.full_like(given, sigma))
    assert not out.exists()


def test_what_stands_in_masked_texels_is_not_looked_at(tmp_path, given, whole):
    mask, sigma = np.ones(SHAPE, bool), np.full_like(given, 1e-9)
    mask[0], sigma[0, :4], sigma[0, 4:] = False, 0.0, -999.0
    found = fitted(tmp_path / "map.zarr", given, sigma=sigma, mask=mask)
    assert found.has("masked")[0].all()
    assert apart(found, whole, slice(8, None)) < CLOSE


def test_noise_that_does_not_use_sigma_is_without_it(tmp_path, given, whole):
    found = fitted(tmp_path / "map.zarr", given, sigma=given, noise=replace(NOISE, use_sigma=False))
    for name in NAMES:
        np.testing.assert_array_equal(found.errors[name], whole.errors[name])


def test_the_only_texel_that_can_be_fitted_is_found(tmp_path, given, whole):
    alone = np.full_like(given, np.nan)
    alone[5, 3] = given[5, 3]
    found = fitted(tmp_path / "map.zarr", alone, pilot_texels=1)
    assert found.has("converged").sum() == 1
    assert abs(found.values[NAMES[0]][5, 3] - whole.values[NAMES[0]][5, 3]) < CLOSE * whole.errors[NAMES[0]][5, 3]
