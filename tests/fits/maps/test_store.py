"""The store of a map: read as it was written, whole or not at all; resumed, refused by name, or replaced if wanted."""

import errno
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr

import fits
import layerjax as lj
from fits._files import PARTIAL
from fits.maps.store import FLAGS, SMOOTHED, Store, arrays_of, blocks_of, open_map
from tests.helpers.files import contents
from tests.helpers.painted_maps import ATTRIBUTES, NAMES, UNITS, numbers, stored
from tests.helpers.quick_maps import assert_same, coat, fitted, full_disk
from tests.helpers.refusals import refuses
from tests.helpers.tasks import stop_at

SHAPE, CHUNK = (7, 10), (4, 4)
BLOCKS = list(blocks_of(SHAPE, CHUNK))
FILE = Path("values") / NAMES[0] / "c" / "1" / "0"


@pytest.fixture
def map(tmp_path):
    return stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK)


def write(store, block):
    store.write(block, {name: values[block] for name, values in numbers(SHAPE).items()})


def test_what_is_written_is_read_also_by_zarr_and_xarray_without_us(map, tmp_path):
    arrays, group = numbers(SHAPE), zarr.open_group(map.path, mode="r")
    read = {f"{part}/{name}": getattr(map, part)[name] for part in ("values", "errors") for name in NAMES}
    read |= {name: getattr(map, name) for name in ("reduced_chi_square", "flags", "at_bound", "measurements")}
    assert arrays.keys() == arrays_of(NAMES).keys()
    for name, (dtype, _) in arrays_of(NAMES).items():
        np.testing.assert_array_equal(read[name], arrays[name], err_msg=name)
        assert (group[name].dtype, group[name].shape, group[name].chunks) == (dtype, SHAPE, CHUNK)
        np.testing.assert_array_equal(group[name][...], arrays[name])
    assert (map.names, map.units, map.shape, map.done, len(map.values)) == (NAMES, UNITS, SHAPE, 1.0, 3)
    assert map.attributes["noise"] == ATTRIBUTES["noise"]
    assert Store(map.path).unfinished() == []
    assert map.has("converged").all()
    assert (map.option("starts"), map.option("converged_share"), map.numerical_error) == (8, 0.99, None)
    assert map.smoothed is map.smoothed_errors is map.smoothing is None
    refuses(r"meaning: 'good' given, must be one of fitted, ", map.has, "good")
    for mapping, name in ((map.values, "albedo"), (map, "smoothed/values/base.albedo")):
        with pytest.raises(KeyError, match=r"is not one of .*base\.albedo"):
            mapping[name]

    flags = dict(group["flags"].attrs)
    assert dict(zip(flags["flag_meanings"].split(), flags["flag_masks"], strict=True)) == FLAGS
    assert dict(group["values/base.albedo"].attrs) == {"units": "1"}
    values = xarray.open_zarr(map.path, group="values", consolidated=False)
    assert values["base.albedo"].dims == ("row", "column")
    np.testing.assert_array_equal(values["base.albedo"], arrays["values/base.albedo"])
    assert_same(map, stored(tmp_path / "b.zarr", arrays, CHUNK))  # the same numbers are the same bytes


def test_a_full_disk_in_the_midst_of_a_chunk_is_named_and_the_chunk_is_not_there(tmp_path, monkeypatch):
    store = Store(stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK, chunks=1).path)
    np.testing.assert_array_equal(np.argwhere(store.flags), np.argwhere(np.ones(CHUNK)))
    with full_disk(monkeypatch, 5), pytest.raises(OSError, match="space") as caught:
        write(store, BLOCKS[1])
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "a.zarr"))
    assert (store.unfinished(), store.done) == (BLOCKS[1:], 16 / 70)
    store.clean()
    assert not list(tmp_path.rglob(f"*{PARTIAL}"))
    shutil.rmtree(tmp_path / "a.zarr")
    with pytest.raises(OSError, match=r"No such file.*a\.zarr"):  # one that was removed is not made again
        write(store, BLOCKS[0])


@pytest.mark.parametrize("damage", [None, 0, 100, "flipped"])
def test_a_damaged_chunk_is_named_and_unfinished(damage, map):
    file = map.path / FILE
    content = file.read_bytes()
    assert len(content) == 4 * 4 * 8 + 4
    if damage is None:
        file.unlink()
        assert np.isnan(map.values[NAMES[0]][4:, :4]).all()
    else:
        file.write_bytes(bytes([content[0] ^ 0x5A]) + content[1:] if damage == "flipped" else content[:damage])
        with pytest.raises(ValueError, match=r"a\.zarr/values/layers.0..thickness: damaged, "):
            map.values[NAMES[0]]
    store = Store(map.path)
    assert store.unfinished() == [BLOCKS[3]]
    write(store, BLOCKS[3])
    assert store.unfinished() == []


def change_root(path, **changes):
    attributes = zarr.open_group(path).attrs
    about = attributes["layerjax"] | changes
    attributes["layerjax"] = {name: one for name, one in about.items() if one is not None}


def spoil_smoothed(path, *names):
    arrays = {f"{part}/{name}": np.zeros(SHAPE) for part in ("values", "errors") for name in NAMES}
    Store(path).save_group(SMOOTHED, arrays, {"finished": True, "smoothing": {}})
    path.joinpath(SMOOTHED, *names, "zarr.json").write_text("{,")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (shutil.rmtree, "no such file or directory"),
        (lambda path: (path / "zarr.json").unlink(), "is no store of a fitted map"),
        (lambda path: (path / "zarr.json").write_text("{"), "is no store of a fitted map"),
        (lambda path: change_root(path, kind="x"), "is no store of a fitted map"),
        (lambda path: change_root(path, format=1), "is version 1 of the"),
        (lambda path: change_root(path, names=None), "damaged, its description lacks or misstates 'names'"),
        (lambda path: change_root(path, shape=[7, 9]), "misstates the shape"),
        (lambda path: shutil.rmtree(path / "flags"), "damaged, .*flags"),
        (lambda path: spoil_smoothed(path, "values", NAMES[0]), "smoothed/values/layers.0..thickness: damaged, "),
        (spoil_smoothed, "smoothed: damaged, "),
    ],
)
def test_what_is_no_such_store_is_refused(damage, words, map):
    damage(map.path)
    with pytest.raises((ValueError, FileNotFoundError), match=words) as caught:
        open_map(map.path).smoothed[NAMES[0]]
    assert str(map.path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"starts": 3, "seed": 1}, "starts 2, not 3, seed 0, not 1"),
        ({"stack": coat(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 0.9))}, "stack"),
        ({"noise": fits.Noise(relative=0.03)}, "noise"),
        ({"transport": lj.WeidlichWilkie()}, "transport"),
        ({"mask": np.eye(8, dtype=bool)}, "measurements"),
    ],
)
def test_what_differs_is_named(whole, measured, changed, named):
    refuses(rf"holds the work of another problem \({named}\); --force", fitted, whole.path, measured, **changed)


def test_what_is_not_ours_is_never_touched(tmp_path, measured):
    zarr.create_group(tmp_path / "group.zarr", attributes={"mine": 1})
    (tmp_path / "file.zarr").write_text("precious")
    (tmp_path / "torn.zarr").mkdir()
    (tmp_path / "torn.zarr" / "zarr.json").write_text('{"attributes": {"layerjax": {"kind": "fitted')
    before = contents(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        for force in (False, True):
            words = refuses("is no store of a fitted map", fitted, path, measured, force=force)
            assert words.startswith(str(path))
    assert contents(tmp_path) == before
    refuses(r"coat\.zarr: there is no directory", fitted, tmp_path / "no" / "coat.zarr", measured)


@pytest.mark.parametrize("damaged", ["pilot/zarr.json", "pilot/starts/c/0/0", "pilot", "flags"])
def test_a_damaged_store_is_named_and_can_be_replaced(out, measured, whole, damaged):
    shutil.rmtree(out / damaged) if (out / damaged).is_dir() else os.truncate(out / damaged, 10)
    refuses(rf"{out}.*: damaged", fitted, out, measured)
    assert_same(fitted(out, measured, force=True), whole)


def test_force_keeps_what_is_of_the_same_fit_and_a_map_until_there_can_be_another(out, measured, whole):
    calls = []
    thresholds = {"converged_share": 0.5, "chi_square_sigmas": 5.0}  # of verdicts: they make no other fit
    fitted(out, measured, force=True, **thresholds, progress=lambda *call: calls.append(call))
    assert calls == [("map", 4, 4)]

    refuses("mask: no texel takes part", fitted, out, measured, mask=np.zeros((8, 8), bool), force=True)
    with pytest.raises(KeyboardInterrupt):
        fitted(out, measured, seed=1, force=True, progress=stop_at("pilot"))
    assert_same(fits.open_map(out), whole)


def test_one_writer_and_what_killed_runs_left_beside_it_is_removed(tmp_path, out, measured):
    for name in (".coat.zarr.new.partial", ".other.zarr.new.partial"):
        (tmp_path / name / "values").mkdir(parents=True)
    (tmp_path / "coat.zarr.lock").write_text("123\n")
    refused = []

    def second(stage, done, total=None, info=""):
        refuses("in use by another process", fitted, out, measured)
        refused.append(stage)

    fitted(out, measured, progress=second)
    assert refused
    assert sorted(path.name for path in tmp_path.iterdir()) == [".other.zarr.new.partial", "coat.zarr"]
