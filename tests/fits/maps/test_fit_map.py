"""A fit for every texel: against scipy and `fits.fit`; and what becomes of work that is interrupted or damaged."""

import errno
import os
from dataclasses import replace

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
from fits.maps import chunk_files
from fits.maps.fit_map import tile

TRANSPORT = lj.SingleScattering()
NOISE = fits.Noise(relative=0.02, floor=1e-4)
SHAPE, CHUNK = (8, 8), 16
LOW, HIGH = np.array([0.05, 0.0]), np.array([3.0, 1.0])


def coat(thickness, albedo, g=0.3):
    return lj.Stack([lj.Medium(thickness, 0.8, lj.HenyeyGreenstein(g))], lj.Lambertian(albedo))


FREE = coat(fits.Free(0.5, LOW[0], HIGH[0]), fits.Free(0.4, LOW[1], HIGH[1]))
NAMES = ("layers[0].thickness", "base.albedo")


@pytest.fixture(scope="module")
def geometry():
    every = fits.slices(incidence=[10.0, 60.0])
    places = np.linspace(0, len(every.wi) - 1, 16).astype(int)
    return Geometry(every.wi[places], every.wo[places])


@pytest.fixture(scope="module")
def truth():
    rows, columns = np.meshgrid(*(np.linspace(0.0, 1.0, size) for size in SHAPE), indexing="ij")
    return np.stack([0.2 + 0.8 * rows, 0.2 + 0.6 * columns], axis=-1)


def seen(truth, geometry, seed=0):
    """Readings with noise of texels with these numbers, (..., 2)."""

    def one(numbers):
        return lj.evaluate(coat(*numbers), jnp.asarray(geometry.wi), jnp.asarray(geometry.wo), transport=TRANSPORT)

    exact = np.asarray(jax.jit(jax.vmap(one))(truth.reshape(-1, 2))).reshape(*truth.shape[:-1], -1, 1)
    sigma = np.hypot(NOISE.relative * exact, NOISE.floor)
    return exact + sigma * np.random.default_rng(seed).standard_normal(exact.shape)


@pytest.fixture(scope="module")
def values(truth, geometry):
    values = seen(truth, geometry)
    values[0, 1, :4] = np.nan
    values[0, 2] = np.nan
    return values


@pytest.fixture(scope="module")
def mask():
    mask = np.ones(SHAPE, bool)
    mask[7, 6:] = False
    return mask


def fitted(out, geometry, values, mask=None, **options):
    options = {"noise": NOISE, "transport": TRANSPORT, "chunk": CHUNK, "sample": 8, "starts": 2} | options
    return fits.fit_map(FREE, geometry, values, out, mask=mask, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, geometry, values, mask):
    """The store of an undisturbed run."""
    return fitted(tmp_path_factory.mktemp("map") / "coat.zarr", geometry, values, mask)


def assert_same(found, expected):
    """To the bit, all arrays and all that the stores say."""
    assert found.attributes == expected.attributes
    for name in expected._types:
        np.testing.assert_array_equal(found[name][:], expected[name][:], err_msg=name)


def problem_of(values, geometry, used):
    data = Measurements(geometry.wi, geometry.wo, np.where(used, values, 0.0), None, used[:, 0], ("value",))
    return fits.Problem(FREE, data, transport=TRANSPORT, noise=NOISE)


def test_every_texel_ends_where_scipy_does(whole, geometry, values):
    for place in ((0, 0), (0, 1), (3, 5), (7, 0)):
        used = np.isfinite(values[place])
        problem = problem_of(values[place], geometry, used)

        def residuals(vector, problem=problem):
            return np.asarray(problem.residuals(vector))

        best = least_squares(residuals, [0.5, 0.4], bounds=(LOW, HIGH), xtol=1e-12, ftol=1e-14, gtol=1e-12)
        errors = np.array([whole.errors[name][place] for name in NAMES])
        # a fit has converged within 1e-4 standard errors
        assert np.all(np.abs(best.x - [whole.values[name][place] for name in NAMES]) < 2e-3 * errors)
        assert whole.readings[place] == used.sum()


def test_errors_and_chi_square_are_those_of_a_fit(whole, geometry, values):
    place = (3, 5)
    problem = problem_of(values[place], geometry, np.isfinite(values[place]))
    found = fits.fit(FREE, problem.data, transport=TRANSPORT, noise=replace(NOISE, discrepancy=False), starts=2)
    for name in NAMES:
        assert whole.errors[name][place] == pytest.approx(found.standard_errors[name], rel=1e-3)
    assert whole.reduced_chi_square[place] == pytest.approx(found.reduced_chi_square, rel=1e-6)


def test_texels_that_take_no_part_are_told_apart(whole):
    assert whole.done == 1.0
    assert whole.has("masked").sum() == 2
    np.testing.assert_array_equal(np.argwhere(whole.has("too_few_readings")), [[0, 2]])
    out = whole.has("masked") | whole.has("too_few_readings")
    for name in NAMES:
        np.testing.assert_array_equal(np.isnan(whole.values[name]), out)
    assert whole.has("fitted").sum() == whole.has("converged").sum() == 61


def test_pulls_have_unit_width(tmp_path, geometry):
    truth = np.tile([0.5, 0.5], (400, 1))
    found = fitted(tmp_path / "flat.zarr", geometry, seen(truth, geometry, seed=1), chunk=64)
    for name in NAMES:
        pulls = (found.values[name] - 0.5) / found.errors[name]
        # of 400 the width is known to 3.5 %
        assert abs(pulls.std() - 1.0) < 0.15
        assert abs(pulls.mean()) < 0.2
    assert abs(found.reduced_chi_square.mean() - 1.0) < 4.0 * np.sqrt(2.0 / 14.0 / 400.0)


def test_a_run_that_was_stopped_is_taken_up_again_to_the_bit(tmp_path, whole, geometry, values, mask):
    def stop(stage, done, total=None, info=""):
        if stage == "map" and done == 2:
            raise KeyboardInterrupt

    out = tmp_path / "stopped.zarr"
    with pytest.raises(KeyboardInterrupt):
        fitted(out, geometry, values, mask, progress=stop)
    assert 0.0 < fits.open_map(out).done < 1.0
    told = []
    found = fitted(out, geometry, values, mask, progress=lambda *told_of: told.append(told_of))
    assert ("map", 2, 4, "") in told or ("map", 3, 4, "") in told  # not begun anew
    assert "sample" not in {stage for stage, *_ in told}
    assert_same(found, whole)


def test_a_run_that_was_killed_before_its_first_chunk_is_taken_up_again(tmp_path, whole, geometry, values, mask):
    out = tmp_path / "killed.zarr"
    found = fitted(out, geometry, values, mask)
    del zarr.open_group(out, mode="r+")["pilot"].attrs["arrays"]  # written last
    for file in (out / "flags").glob("c/*/*"):
        file.unlink()
    assert_same(fitted(out, geometry, values, mask), whole)
    assert_same(found, whole)


@pytest.mark.parametrize(
    ("changed", "named"),
    [({"noise": fits.Noise(relative=0.03, floor=1e-4)}, "noise"), ({"transport": lj.WeidlichWilkie()}, "transport")],
)
def test_a_store_of_another_fit_is_refused_by_what_differs(whole, geometry, values, mask, changed, named):
    with pytest.raises(ValueError, match=f"another fit, different in {named}"):
        fitted(whole.path, geometry, values, mask, **changed)


def test_other_readings_are_refused_unless_forced(tmp_path, geometry, values):
    out = tmp_path / "forced.zarr"
    fitted(out, geometry, values[:2], chunk=64)
    with pytest.raises(ValueError, match="different in readings"):
        fitted(out, geometry, 2.0 * values[:2], chunk=64)
    found = fitted(out, geometry, 2.0 * values[:2], chunk=64, force=True)
    assert found.done == 1.0


def test_a_directory_that_is_no_store_stays(tmp_path, geometry, values):
    (tmp_path / "notes").mkdir()
    with pytest.raises(ValueError, match="is no fitted map"):
        fitted(tmp_path / "notes", geometry, values, force=True)


def test_a_second_run_is_refused_while_the_first_lives(tmp_path, geometry, values):
    refused = []

    def second(stage, done, total=None, info=""):
        if stage == "map" and not refused:
            refused.append(True)
            with pytest.raises(ValueError, match="in use by another process"):
                fitted(tmp_path / "one.zarr", geometry, values[:2])

    fitted(tmp_path / "one.zarr", geometry, values[:2], progress=second)
    assert refused


def test_a_damaged_chunk_of_readings_costs_itself(tmp_path, whole, geometry, values, mask):
    path = tmp_path / "readings.zarr"
    stored = zarr.create_array(path, shape=values.shape, chunks=(4, 4, 16, 1), dtype="f8")
    stored[...] = values
    damaged = path / "c" / "1" / "0" / "0" / "0"
    content = damaged.read_bytes()
    damaged.write_bytes(content[:10])
    with pytest.raises(ValueError, match="all other chunks are done"):
        fitted(tmp_path / "out.zarr", geometry, path, mask)
    assert fits.open_map(tmp_path / "out.zarr").done == 0.75
    damaged.write_bytes(content)
    found = fitted(tmp_path / "out.zarr", geometry, path, mask)
    assert found.done == 1.0
    for name in NAMES:  # from other starts, as the sample lacked these texels: within what a converged fit leaves
        apart = np.abs(found.values[name] - whole.values[name]) / whole.errors[name]
        assert np.nanmax(apart) < 2e-3


def test_chunks_that_cannot_be_read_are_named(tmp_path, geometry, values):
    """All four, and not the first alone."""
    path = tmp_path / "readings.zarr"
    zarr.create_array(path, shape=values.shape, chunks=(4, 4, 16, 1), dtype="f8")[...] = values
    damaged = [path / "c" / row / column / "0" / "0" for row in "01" for column in "01"]

    def damage(stage, *_):
        for one in damaged if stage == "map" else ():
            one.write_bytes(b"")

    with pytest.raises(ValueError, match="all other chunks are done") as error:
        fitted(tmp_path / "out.zarr", geometry, path, progress=damage)
    for block in ("0:4, 0:4", "0:4, 4:8", "4:8, 0:4", "4:8, 4:8"):
        assert f"chunk [{block}]: {path}: block [{block}] cannot be read" in str(error.value)


def test_a_full_disk_leaves_no_half_chunk(tmp_path, monkeypatch, whole, geometry, values, mask):
    write, calls = chunk_files.write, []

    def full(*arguments):
        calls.append(arguments)
        if len(calls) == 12:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(*arguments)

    monkeypatch.setattr(chunk_files, "write", full)
    out = tmp_path / "full.zarr"
    with pytest.raises(OSError, match="No space left"):
        fitted(out, geometry, values, mask)
    monkeypatch.undo()
    grown = fits.open_map(out)
    done = grown.flags > 0
    assert 0 < done.sum() < done.size
    for name in NAMES:
        assert np.isnan(grown.values[name][~done]).all()
    assert_same(fitted(out, geometry, values, mask), whole)


def test_directions_of_their_own(tmp_path, truth, geometry):
    """Every texel seen along other directions, of which all are its own."""
    turn = np.linspace(0.0, 0.3, 4)
    own = []
    for angle in turn:
        tilt = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        own.append(Geometry(geometry.wi, geometry.wo @ tilt.T))
    keep = np.all([one.wo[:, 2] > 0.05 for one in own], axis=0)
    own = [Geometry(one.wi[keep], one.wo[keep]) for one in own]
    values = np.stack([seen(truth[3, 4], one) for one in own])
    wi, wo = (np.stack([getattr(one, name) for one in own]) for name in ("wi", "wo"))
    found = fitted(tmp_path / "own.zarr", (wi, wo), values)
    alone = fitted(tmp_path / "alone.zarr", own[2], values[2:3])
    for name in NAMES:
        assert abs(found.values[name][2] - alone.values[name][0]) < 2e-3 * alone.errors[name][0]
        assert found.errors[name][2] == pytest.approx(alone.errors[name][0], rel=1e-3)


def test_named_objective_has_errors_by_its_scatter(tmp_path, geometry, values):
    found = fitted(tmp_path / "l2.zarr", geometry, values[3:4], noise=None, objective="cosine_l2")
    one = fits.fit(
        FREE, problem_of(values[3, 2], geometry, np.ones((16, 1), bool)).data, transport=TRANSPORT,
        objective="cosine_l2", starts=2,
    )  # fmt: skip
    for name in NAMES:
        assert found.errors[name][0, 2] == pytest.approx(one.standard_errors[name], rel=1e-3)


def test_what_cannot_be_is_refused(tmp_path, geometry, values):
    out = tmp_path / "none.zarr"
    for options, words in (
        ({"starts": 0}, "starts is 0"),
        ({"chunk": 0}, "chunk is 0; it must be a whole number of at least 1"),
        ({"chunk": 1e4}, "chunk is 10000.0; it must be a whole number of at least 1"),
        ({"starts": "8"}, "starts is '8'; it must be a whole number of at least 1"),
        ({"noise": 0.02}, "noise is 0.02; it must be a fits.Noise, or None"),
        ({"noise": fits.Noise(relative=0.02, discrepancy=True)}, "noise.discrepancy"),
    ):
        with pytest.raises(ValueError, match=words):
            fitted(out, geometry, values, **options)
        assert not out.exists()
    with pytest.raises(ValueError, match="no reading of a texel that takes part"):
        fitted(out, geometry, np.full_like(values, np.nan))
    assert not out.exists()


@pytest.mark.parametrize(
    ("shape", "texels", "expected"),
    [((512, 512), 1024, (32, 32)), ((100,), 1024, (100,)), ((3, 5000), 1024, (3, 341)), ((4, 8, 8), 16, (1, 4, 4))],
)
def test_chunks_are_as_square_as_the_map_allows(shape, texels, expected):
    assert tile(shape, texels) == expected


def test_an_instrument_stands_between_map_and_readings(tmp_path, geometry, values):
    instrument = fits.Instrument(detector_aperture=2.0, floor=1e-4, gain_sd=0.01)
    noise = fits.Noise(relative=0.02)
    found = fitted(tmp_path / "seen.zarr", geometry, values[3:4], noise=noise, instrument=instrument)
    data = problem_of(values[3, 2], geometry, np.ones((16, 1), bool)).data
    alone = replace(noise, discrepancy=False)
    one = fits.fit(FREE, data, transport=TRANSPORT, noise=alone, instrument=instrument, starts=2)
    assert found.names == one.problem.names
    for name in found.names:
        assert abs(found.values[name][0, 2] - one.values[name]) < 2e-3 * one.standard_errors[name]
        assert found.errors[name][0, 2] == pytest.approx(one.standard_errors[name], rel=1e-3)
    kept = zarr.open_group(tmp_path / "seen.zarr", mode="r")["pilot"].attrs["rings"]
    assert kept == one.problem.instrument.rings == 1
    assert found.numerical_error is not None
    shared = fits.Instrument(tilt=fits.Free(0.0, -1.0, 1.0, same_for_all_texels=True))
    with pytest.raises(ValueError, match=r"instrument\.offset is shared"):
        fitted(tmp_path / "none.zarr", geometry, values, instrument=shared)
