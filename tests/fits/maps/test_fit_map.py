"""A fit for every texel: against scipy and `fits.fit`; and what becomes of work that is interrupted or damaged."""

import errno
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from scipy.optimize import least_squares

import fits
from fits.data.geometry import Geometry
from fits.data.measurements import Measurements
from fits.maps.fit_map import tile
from fits.maps.options import MapOptions
from tests.helpers import quick_maps
from tests.helpers.quick_maps import FREE, NAMES, TRANSPORT, assert_same

NOISE = fits.Noise(relative=0.02, floor=1e-4)
SHAPE = (8, 8)
LOW, HIGH = np.array([0.05, 0.0]), np.array([3.0, 1.0])


def fitted(out, values, **options):
    return quick_maps.fitted(out, values, **{"noise": NOISE} | options)


@pytest.fixture(scope="module")
def geometry():
    return quick_maps.geometry()


@pytest.fixture(scope="module")
def values():
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


def problem_of(values, geometry, used=None):
    used = np.isfinite(values) if used is None else used
    data = Measurements(geometry.wi, geometry.wo, np.where(used, values, 0.0), None, used[:, 0], ("value",))
    return fits.Problem(FREE, data, transport=TRANSPORT, noise=NOISE)


def assert_as_fit(map, place, one, values=True):
    """A texel is as `fits.fit` has it."""
    for name in map.names:
        assert map.errors[name][place] == pytest.approx(one.standard_errors[name], rel=1e-3)
        if values:
            assert abs(map.values[name][place] - one.values[name]) < 2e-3 * one.standard_errors[name]


def test_every_texel_ends_where_scipy_does(whole, geometry, values):
    for place in ((0, 0), (0, 1), (3, 5), (7, 0)):
        problem = problem_of(values[place], geometry)

        def residuals(vector, problem=problem):
            return np.asarray(problem.residuals(vector))

        best = least_squares(residuals, [0.5, 0.4], bounds=(LOW, HIGH), xtol=1e-12, ftol=1e-14, gtol=1e-12)
        errors = np.array([whole.errors[name][place] for name in NAMES])
        # a fit has converged within 1e-4 standard errors
        assert np.all(np.abs(best.x - [whole.values[name][place] for name in NAMES]) < 2e-3 * errors)
        assert whole.measurements[place] == np.isfinite(values[place]).sum()


def test_errors_and_chi_square_are_those_of_a_fit(tmp_path, whole, geometry, values):
    """Of a likelihood, of a named objective by its scatter, and behind an instrument."""
    place, alone = (3, 5), replace(NOISE, discrepancy=False)
    data = problem_of(values[place], geometry).data
    found = fits.fit(FREE, data, transport=TRANSPORT, noise=alone, starts=2)
    assert_as_fit(whole, place, found)
    assert whole.reduced_chi_square[place] == pytest.approx(found.reduced_chi_square, rel=1e-6)
    named = fitted(tmp_path / "l2.zarr", values[3:4], noise=None, objective="cosine_l2")
    assert_as_fit(
        named, (0, 5), fits.fit(FREE, data, transport=TRANSPORT, objective="cosine_l2", starts=2), values=False
    )
    instrument = fits.Instrument(detector_aperture=2.0, floor=1e-4, gain_sd=0.01)
    noise = fits.Noise(relative=0.02)
    seen = fitted(tmp_path / "seen.zarr", values[3:4], noise=noise, instrument=instrument)
    noise = replace(noise, discrepancy=False)
    one = fits.fit(FREE, data, transport=TRANSPORT, noise=noise, instrument=instrument, starts=2)
    assert_as_fit(seen, (0, 5), one)
    assert seen.names == one.problem.names
    kept = zarr.open_group(tmp_path / "seen.zarr", mode="r")["pilot"].attrs["layerjax"]["rings"]
    assert kept == one.problem.instrument.rings == 1
    assert seen.numerical_error is not None
    common = fits.Instrument(tilt=fits.Free(0.0, -1.0, 1.0, same_for_all_texels=True))
    with pytest.raises(ValueError, match=r"instrument\.tilt is common"):
        fitted(tmp_path / "none.zarr", values, instrument=common)


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


def test_a_run_that_was_killed_before_its_first_chunk_is_resumed(tmp_path, whole, values, mask):
    out = tmp_path / "killed.zarr"
    found = fitted(out, values, mask=mask)
    del zarr.open_group(out, mode="r+")["pilot"].attrs["layerjax"]  # written last
    for file in (out / "flags").glob("c/*/*"):
        file.unlink()
    assert_same(fitted(out, values, mask=mask), whole)
    assert_same(found, whole)


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
    for name in NAMES:  # from other starts, as the pilot lacked these texels: within what a converged fit leaves
        apart = np.abs(found.values[name] - whole.values[name]) / whole.errors[name]
        assert np.nanmax(apart) < 2e-3

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
    found = fitted(tmp_path / "own.zarr", values, view=(wi, wo))
    alone = fitted(tmp_path / "alone.zarr", values[2:3], view=own[2])
    for name in NAMES:
        assert abs(found.values[name][2] - alone.values[name][0]) < 2e-3 * alone.errors[name][0]
        assert found.errors[name][2] == pytest.approx(alone.errors[name][0], rel=1e-3)
    for options, words in (
        ({"emulator": True}, "emulator: there is none where every texel has directions of its own"),
        ({"instrument": fits.Instrument(detector_aperture=2.0)}, "there can be no instrument"),
    ):
        with pytest.raises(ValueError, match=words):
            fitted(tmp_path / "none.zarr", values, view=(wi, wo), **options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"starts": 0}, "starts is 0"),
        ({"chunk_size": 0}, "chunk_size is 0; it must be a whole number of at least 1"),
        ({"chunk_size": 1e4}, "chunk_size is 10000.0; it must be a whole number of at least 1"),
        ({"starts": "8"}, "starts is '8'; it must be a whole number of at least 1"),
        ({"poor_probability": 2.0}, "poor_probability is 2.0; it must be a number from 0 to 1"),
        ({"emulator_error": "small"}, "emulator_error is 'small'; it must be a number from 0 to inf"),
        ({"noise": 0.02}, "noise is 0.02; it must be a fits.Noise, or None"),
        ({"noise": fits.Noise(relative=0.02, discrepancy=True)}, "noise.discrepancy"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, values, options, words):
    with pytest.raises(ValueError, match=words):
        fitted(tmp_path / "none.zarr", values, **options)
    assert not (tmp_path / "none.zarr").exists()


def test_thresholds_of_flags_are_options(tmp_path, values):
    """A chi-square that every other texel exceeds is poor if it is asked for, and is stored with the map."""
    found = fitted(
        tmp_path / "map.zarr", values, poor_probability=0.5, pilot_quantile=0.0, pilot_factor=0.01, restarts=0
    )
    assert 0.2 < found.has("poor").sum() / found.has("fitted").sum() < 0.8
    assert found.option("poor_probability") == 0.5
    assert found.option("numerical_error") == MapOptions.numerical_error


@pytest.mark.parametrize(
    ("shape", "texels", "expected"),
    [((512, 512), 1024, (32, 32)), ((100,), 1024, (100,)), ((3, 5000), 1024, (3, 341)), ((4, 8, 8), 16, (1, 4, 4))],
)
def test_chunks_are_as_square_as_the_map_allows(shape, texels, expected):
    assert tile(shape, texels) == expected
