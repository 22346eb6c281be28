"""A fit for every texel: against scipy and `fits.fit`; maps of all shapes and precisions, values that no texel can
have, models that break; and what becomes of work that is interrupted or damaged."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zarr
from scipy.optimize import least_squares

import fits
import layerjax as lj
from fits.data.geometry import Geometry
from fits.data.measurements import Measurements
from fits.maps.fit_map import tile
from fits.maps.options import MapOptions
from fits.maps.store import FittedMap
from tests.helpers import quick_maps
from tests.helpers.quick_maps import FREE, NAMES, NOISE, TRANSPORT, assert_same, fitted

SHAPE = (8, 8)
CLOSE = 2e-3
"""Standard errors that a converged fit may be off by, times twenty: it has converged within 1e-4."""


@pytest.fixture(scope="module")
def geometry():
    return quick_maps.geometry()


@pytest.fixture(scope="module")
def values():
    """Of a map with a texel of which four measurements are missing, and one that has none."""
    values = quick_maps.values(SHAPE)
    values[0, 1, :4] = np.nan
    values[0, 2] = np.nan
    return values


@pytest.fixture(scope="module")
def mask():
    mask = np.ones(SHAPE, bool)
    mask[7, 6:] = False
    return mask


@pytest.fixture(scope="module")
def whole(tmp_path_factory, values, mask):
    """The store of an undisturbed run."""
    return fitted(tmp_path_factory.mktemp("map") / "coat.zarr", values, mask=mask)


@pytest.fixture(scope="module")
def given():
    """Values without anything missing."""
    return quick_maps.values(SHAPE)


@pytest.fixture(scope="module")
def plain(tmp_path_factory, given):
    """Their map."""
    return fitted(tmp_path_factory.mktemp("map") / "plain.zarr", given)


def apart(found: FittedMap, expected: FittedMap, where=Ellipsis) -> float:
    """How far values are from each other at most, in standard errors."""
    off = [(found.values[name].ravel() - expected.values[name].ravel()) / expected.errors[name].ravel()
           for name in NAMES]  # fmt: skip
    return float(np.nanmax(np.abs(np.array(off)[:, where])))


# ---- what is found ----


def test_every_texel_ends_where_scipy_does(whole, geometry, values):
    for place in ((0, 0), (0, 1), (3, 5), (7, 0)):
        used = np.isfinite(values[place])
        data = Measurements(geometry.wi, geometry.wo, np.where(used, values[place], 0.0), None, used[:, 0], ("value",))
        floor = float(whole.attributes["noise"].partition("floor=")[2].partition(",")[0])
        problem = fits.Problem(FREE, data, transport=TRANSPORT, noise=replace(NOISE, floor=floor))
        best = least_squares(
            lambda vector, problem=problem: np.asarray(problem.residuals(vector)), [0.5, 0.4],
            bounds=([0.05, 0.0], [3.0, 1.0]), xtol=1e-12, ftol=1e-14, gtol=1e-12,
        )  # fmt: skip
        errors = np.array([whole.errors[name][place] for name in NAMES])
        assert np.all(np.abs(best.x - [whole.values[name][place] for name in NAMES]) < CLOSE * errors)
        assert whole.measurements[place] == used.sum()


@pytest.mark.parametrize(
    "options",
    [
        {"noise": fits.Noise(relative=0.02, floor=1e-4)},
        {"noise": None, "objective": "cosine_l2"},
        {"noise": NOISE, "instrument": fits.Instrument(detector_aperture=2.0, floor=1e-4, gain_sd=0.01)},
    ],
    ids=["likelihood", "named objective", "instrument"],
)
def test_errors_and_chi_square_are_those_of_a_fit(tmp_path, geometry, values, options):
    data = Measurements(geometry.wi, geometry.wo, values[3, 5], None, np.ones(16, bool), ("value",))
    found = fitted(tmp_path / "map.zarr", values[3:4], **options)
    noise = options["noise"] and replace(options["noise"], discrepancy=False)
    one = fits.fit(FREE, data, transport=TRANSPORT, **options | {"noise": noise}, starts=2)
    assert found.names == one.problem.names
    for name in NAMES:
        assert found.errors[name][0, 5] == pytest.approx(one.standard_errors[name], rel=1e-3)
        if "objective" not in options:
            assert abs(found.values[name][0, 5] - one.values[name]) < CLOSE * one.standard_errors[name]
    if options["noise"] is not None:
        assert found.reduced_chi_square[0, 5] == pytest.approx(one.reduced_chi_square, rel=1e-6)
    assert (found.numerical_error is not None) == ("instrument" in options)
    if "instrument" in options:
        assert found.attributes["pilot"]["rings"] == one.problem.instrument.rings == 1


def test_texels_that_take_no_part_are_told_apart(whole):
    assert whole.done == 1.0
    assert whole.has("masked").sum() == 2
    np.testing.assert_array_equal(np.argwhere(whole.has("too_few_measurements")), [[0, 2]])
    out = whole.has("masked") | whole.has("too_few_measurements")
    for name in NAMES:
        np.testing.assert_array_equal(np.isnan(whole.values[name]), out)
    assert whole.has("fitted").sum() == whole.has("converged").sum() == 61


def test_pulls_have_unit_width(tmp_path):
    found = fitted(tmp_path / "map.zarr", quick_maps.values((400,), seed=1), chunk_size=64)
    for name, truth in zip(NAMES, quick_maps.truth((400,)).T, strict=True):
        pulls = (found.values[name] - truth) / found.errors[name]
        # of 400 the width is known to 3.5 %
        assert abs(pulls.std() - 1.0) < 0.15
        assert abs(pulls.mean()) < 0.2
    assert abs(found.reduced_chi_square.mean() - 1.0) < 4.0 * np.sqrt(2.0 / 14.0 / 400.0)


def test_directions_of_their_own(tmp_path, geometry):
    """Every texel seen along other directions, of which all are its own."""
    own = []
    for angle in np.linspace(0.0, 0.3, 4):
        tilt = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        own.append(Geometry(geometry.wi, geometry.wo @ tilt.T))
    keep = np.all([one.wo[:, 2] > 0.05 for one in own], axis=0)
    own = [Geometry(one.wi[keep], one.wo[keep]) for one in own]
    values = np.stack([quick_maps.seen(np.array([0.6, 0.5]), one) for one in own])
    wi, wo = (np.stack([getattr(one, name) for one in own]) for name in ("wi", "wo"))
    noise = fits.Noise(relative=0.02, floor=1e-4)
    found = fitted(tmp_path / "own.zarr", values, view=(wi, wo), noise=noise)
    alone = fitted(tmp_path / "alone.zarr", values[2:3], view=own[2], noise=noise)
    for name in NAMES:
        assert abs(found.values[name][2] - alone.values[name][0]) < CLOSE * alone.errors[name][0]
        assert found.errors[name][2] == pytest.approx(alone.errors[name][0], rel=1e-3)
    for options, words in (
        ({"emulator": True}, "emulator: there is none where every texel has directions of its own"),
        ({"instrument": fits.Instrument(detector_aperture=2.0)}, "there can be no instrument"),
    ):
        with pytest.raises(ValueError, match=words):
            fitted(tmp_path / "none.zarr", values, view=(wi, wo), **options)


def test_thresholds_of_flags_are_options(tmp_path, values):
    """A chi-square that every other texel exceeds is poor if it is asked for, and is stored with the map."""
    thresholds = {"poor_probability": 0.5, "pilot_quantile": 0.0, "pilot_factor": 0.01}
    found = fitted(tmp_path / "map.zarr", values, **thresholds, restarts=0)
    assert 0.2 < found.has("poor").sum() / found.has("fitted").sum() < 0.8
    assert found.option("poor_probability") == 0.5
    assert found.option("numerical_error") == MapOptions.numerical_error


@pytest.mark.parametrize(
    ("shape", "texels", "expected"),
    [((512, 512), 1024, (32, 32)), ((100,), 1024, (100,)), ((3, 5000), 1024, (3, 341)), ((4, 8, 8), 16, (1, 4, 4))],
)
def test_chunks_are_as_square_as_the_map_allows(shape, texels, expected):
    assert tile(shape, texels) == expected


# ---- maps of all kinds ----


@pytest.mark.parametrize("shape", [(64,), (4, 4, 4), (1, 64)])
def test_maps_of_every_rank_are_the_same(tmp_path, given, plain, shape):
    found = fitted(tmp_path / "map.zarr", given.reshape(*shape, 16, 1))
    assert found.shape == shape
    assert found.has("converged").all()
    assert apart(found, plain) < CLOSE


def test_a_single_texel_and_values_without_channels(tmp_path, given, plain):
    found = fitted(tmp_path / "one.zarr", given[:1, :1, :, 0], pilot_texels=64)
    assert found.shape == (1, 1)
    for name in NAMES:
        assert abs(found.values[name][0, 0] - plain.values[name][0, 0]) < CLOSE * plain.errors[name][0, 0]


def test_a_chunk_larger_than_the_map_is_the_map(tmp_path, given, plain):
    """And no program is made for a million texels, nor is another size another fit."""
    found = fitted(tmp_path / "map.zarr", given, chunk_size=10**9, pilot_texels=10**6)
    assert found.chunk == SHAPE
    assert apart(found, plain) < CLOSE
    assert fitted(found.path, given, chunk_size=10**8, pilot_texels=10**6).done == 1.0


@pytest.mark.parametrize("kind", [np.float16, ">f8"])
def test_values_of_other_types(tmp_path, given, plain, kind):
    rounding = {"2": 1e-3, "8": 1e-16}[str(np.dtype(kind).itemsize)]
    found = fitted(tmp_path / "map.zarr", given.astype(kind))
    # all values rounded the same way, in units of their noise of 2 %: sixteen of them weigh four times as much
    assert apart(found, plain) < CLOSE + 4.0 * 4.0 * rounding / NOISE.relative


def test_channels_have_numbers_of_their_own(tmp_path, given):
    three = np.concatenate([given, given, 1.2 * given], axis=-1)
    found = fitted(tmp_path / "map.zarr", three, quick_maps.coat(fits.Free(0.5, 0.05, 3.0), fits.Free([0.4] * 3, 0, 1)))
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


def test_values_that_cannot_be_cost_their_texel_alone(tmp_path, given, plain):
    changed, flags = awkward(given)
    found = fitted(tmp_path / "map.zarr", changed)
    for column, flag in flags.items():
        assert found.has(flag)[0, column], column
        assert np.isfinite(found.values[NAMES[0]][0, column]) == (flag == "poor")
    assert found.has("converged")[1:].all()
    assert not found.has("poor")[1:].any()
    assert apart(found, plain, slice(8, None)) < CLOSE


def test_in_single_precision_errors_are_those_of_double(tmp_path, given, plain):
    changed = awkward(given)[0]
    changed[1, 0, 3] = 1e300  # finite in double precision alone
    jax.config.update("jax_enable_x64", False)
    try:
        found = fitted(tmp_path / "clean.zarr", given)
        spoilt = fitted(tmp_path / "map.zarr", changed)
        with pytest.raises(ValueError, match="precision float64, not float32"):
            fitted(plain.path, given)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert np.all(found.flags == plain.flags)
    # of a cost of ten, 1e-6 is lost to rounding there: 1e-3 standard errors, and a few times that for its gradient
    assert apart(found, plain) < 0.1
    assert apart(spoilt, plain, slice(9, None)) < 0.1
    assert spoilt.measurements[1, 0] == 15
    for name in NAMES:
        np.testing.assert_allclose(found.errors[name], plain.errors[name], rtol=0.03)


@pytest.mark.parametrize("beyond", [jnp.nan, jnp.inf])
def test_a_model_that_breaks_costs_what_lies_beyond(tmp_path, given, plain, beyond):
    """Texels whose best thickness is beyond 0.6 have no fit, or one this side of it that has not converged."""

    def transport(stack, wi, wo):
        exact = lj.evaluate(stack, wi, wo, TRANSPORT)
        return jnp.where(jnp.max(stack.layers[0].thickness) > 0.6, beyond, exact)

    found = fitted(tmp_path / "map.zarr", given, transport=transport)
    near = plain.values[NAMES[0]] + 5.0 * plain.errors[NAMES[0]] < 0.6
    far = plain.values[NAMES[0]] > 0.61
    assert min(near.sum(), far.sum()) >= 16
    assert apart(found, plain, np.flatnonzero(near)) < CLOSE
    assert found.has("converged")[near].all()
    assert not found.has("converged")[far].any()
    assert (found.has("fitted") | found.has("failed")).all()
    for name in NAMES:
        assert np.isfinite(found.values[name][found.has("fitted")]).all()


def never_finite(stack, wi, wo):
    return jnp.nan * lj.evaluate(stack, wi, wo, TRANSPORT)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"starts": 0}, "starts: 0 is not a whole number of at least 1"),
        ({"chunk_size": 1e4}, "chunk_size: 10000.0 is not a whole number of at least 1"),
        ({"poor_probability": 2.0}, "poor_probability is 2.0; it must be a number from 0 to 1"),
        ({"emulator_error": "small"}, "emulator_error is 'small'; it must be a number from 0 to inf"),
        ({"noise": 0.02}, "noise: 0.02 is not a Noise or None"),
        ({"noise": fits.Noise(relative=0.02, discrepancy=True)}, "noise.discrepancy"),
        ({"instrument": fits.Instrument(tilt=fits.Free(0, -1, 1, same_for_all_texels=True))}, r"\.tilt is common"),
        ({"transport": never_finite}, "no texel of the pilot has a finite fit"),
        ({"mask": np.zeros(SHAPE, bool)}, "mask: no texel takes part, it is 0 everywhere"),
        ({"values": np.full((*SHAPE, 16, 1), np.nan)}, "no measurement of a texel that takes part is a finite number"),
        ({"sigma": np.zeros((*SHAPE, 16, 1))}, "sigma is 0 in block"),
        ({"sigma": np.full((*SHAPE, 16, 1), -1.0)}, "sigma is -1 in block"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, values, options, words):
    with pytest.raises(ValueError, match=words):
        fitted(tmp_path / "none.zarr", options.pop("values", values), **options)
    assert not (tmp_path / "none.zarr").exists()


def test_too_few_measurements_everywhere_are_named(tmp_path, geometry, given):
    with pytest.raises(ValueError, match="no texel has as many measurements as there are free parameters, 2"):
        fitted(tmp_path / "none.zarr", given[:, :, :1], view=(geometry.wi[:1], geometry.wo[:1]))


def test_what_stands_in_masked_texels_is_not_looked_at(tmp_path, given, plain):
    mask, sigma = np.ones(SHAPE, bool), np.full_like(given, 1e-9)
    mask[0], sigma[0, :4], sigma[0, 4:] = False, 0.0, -999.0
    found = fitted(tmp_path / "map.zarr", given, sigma=sigma, mask=mask)
    assert found.has("masked")[0].all()
    assert apart(found, plain, slice(8, None)) < CLOSE
    without = fitted(tmp_path / "without.zarr", given, sigma=given, noise=replace(NOISE, use_sigma=False))
    for name in NAMES:
        np.testing.assert_array_equal(without.errors[name], plain.errors[name])


def test_the_only_texel_that_can_be_fitted_is_found(tmp_path, given, plain):
    alone = np.full_like(given, np.nan)
    alone[5, 3] = given[5, 3]
    found = fitted(tmp_path / "map.zarr", alone, pilot_texels=1)
    assert found.has("converged").sum() == 1
    assert abs(found.values[NAMES[0]][5, 3] - plain.values[NAMES[0]][5, 3]) < CLOSE * plain.errors[NAMES[0]][5, 3]


# ---- work that is interrupted or damaged ----


def test_a_run_that_was_stopped_is_resumed_to_the_bit(tmp_path, whole, values, mask):
    def stop(stage, done, total=None, info=""):
        if stage == "map" and done == 2:
            raise KeyboardInterrupt

    out = tmp_path / "stopped.zarr"
    with pytest.raises(KeyboardInterrupt):
        fitted(out, values, mask=mask, progress=stop)
    assert 0.0 < fits.open_map(out).done < 1.0
    told = []
    found = fitted(out, values, mask=mask, progress=lambda *told_of: told.append(told_of))
    assert ("map", 2, 4, "") in told or ("map", 3, 4, "") in told  # not begun anew
    assert "pilot" not in {stage for stage, *_ in told}
    assert_same(found, whole)
    # killed before its first chunk
    del zarr.open_group(out, mode="r+")["pilot"].attrs["layerjax"]  # written last
    for file in (out / "flags").glob("c/*/*"):
        file.unlink()
    assert_same(fitted(out, values, mask=mask), whole)


def test_damaged_chunks_of_measurements_cost_themselves_and_are_named(tmp_path, whole, values, mask):
    path, out = tmp_path / "measured.zarr", tmp_path / "out.zarr"
    zarr.create_array(path, shape=values.shape, chunks=(4, 4, 16, 1), dtype="f8")[...] = values
    damaged = [path / "c" / row / column / "0" / "0" for row in "01" for column in "01"]
    content = damaged[2].read_bytes()
    damaged[2].write_bytes(content[:10])
    with pytest.raises(ValueError, match="all other chunks are done"):
        fitted(out, path, mask=mask)
    assert fits.open_map(out).done == 0.75
    damaged[2].write_bytes(content)
    found = fitted(out, path, mask=mask)
    assert found.done == 1.0
    assert apart(found, whole) < CLOSE  # from other starts, as the pilot lacked these texels

    def damage(stage, *_):
        for one in damaged if stage == "map" else ():
            one.write_bytes(b"")

    with pytest.raises(ValueError, match="all other chunks are done") as error:
        fitted(tmp_path / "none.zarr", path, progress=damage)
    for block in ("0:4, 0:4", "0:4, 4:8", "4:8, 0:4", "4:8, 4:8"):  # all four, and not the first alone
        assert f"chunk [{block}]: {path}: block [{block}] cannot be read" in str(error.value)


def test_a_full_disk_leaves_no_half_chunk(tmp_path, monkeypatch, whole, values, mask):
    replace, calls, out = Path.replace, [], tmp_path / "full.zarr"

    def full(source, target):
        if "flags" in target.parts or "values" in target.parts:
            calls.append(target)
        if len(calls) == 12:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        fitted(out, values, mask=mask)
    monkeypatch.undo()
    done = fits.open_map(out).flags > 0
    assert done.sum() < done.size
    assert_same(fitted(out, values, mask=mask), whole)
