"""The store of a map: what was written is read again, also by zarr and xarray alone; nothing counts that is half there;
and what is where a store is to be is resumed, refused by name, or thrown away if that is asked for."""

import errno
import json
import multiprocessing
import os
import shutil
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import xarray
import zarr

import fits
import layerjax as lj
from fits.engines.processes import AGAIN
from fits.maps.store import FLAGS, NO_START, PARTIAL, Store, arrays_of, blocks_of, create, open_map
from tests.helpers.files import contents
from tests.helpers.painted_maps import ATTRIBUTES, NAMES, UNITS, numbers, stored
from tests.helpers.quick_maps import assert_same, coat, fitted, values

SHAPE, CHUNK = (7, 10), (4, 4)
BLOCKS = list(blocks_of(SHAPE, CHUNK))
FILE = Path("values") / NAMES[0] / "c" / "1" / "0"


def empty(path: Path) -> Store:
    return create(path, names=NAMES, units=UNITS, shape=SHAPE, chunk=CHUNK, attributes=ATTRIBUTES)


def part(found: dict[str, np.ndarray], block: tuple[slice, ...]) -> dict[str, np.ndarray]:
    return {name: values[block] for name, values in found.items()}


# ---- what is written ----


@pytest.mark.parametrize(
    ("shape", "chunk"), [((7, 10), (4, 4)), ((11,), (4,)), ((3, 5, 4), (2, 2, 4)), ((2, 2), (9, 9))]
)
def test_what_is_written_is_read(shape: tuple[int, ...], chunk: tuple[int, ...], tmp_path: Path) -> None:
    found = numbers(shape)
    map = stored(tmp_path / "a.zarr", found, chunk)
    for name in NAMES:
        np.testing.assert_array_equal(map.values[name], found[f"values/{name}"])
        np.testing.assert_array_equal(map.errors[name], found[f"errors/{name}"])
    for name in ("reduced_chi_square", "flags", "start", "at_bound", "measurements"):
        np.testing.assert_array_equal(getattr(map, name), found[name])
        assert getattr(map, name).dtype == found[name].dtype
    assert (map.names, map.units, map.shape, map.done) == (NAMES, UNITS, shape, 1.0)
    assert map.attributes["noise"] == ATTRIBUTES["noise"]
    assert Store(map.path).unfinished() == []
    assert fits.open_map(map.path).has("converged").all()
    assert (map.option("starts"), map.option("converged_share"), map.numerical_error) == (8, 0.99, None)
    assert map.smoothed is map.smoothed_errors is map.smoothing is None
    assert repr(map).endswith(f"100 % done: {', '.join(NAMES)}; {map.path}>")
    assert len(map.values) == 3


def test_zarr_and_xarray_read_it_without_us(tmp_path: Path) -> None:
    found = numbers(SHAPE)
    for name in ("a", "b"):
        stored(tmp_path / f"{name}.zarr", found, CHUNK)
    group = zarr.open_group(tmp_path / "a.zarr", mode="r")
    for name, (dtype, _) in arrays_of(NAMES).items():
        array = group[name]
        assert (array.dtype, array.shape, array.chunks) == (dtype, SHAPE, CHUNK)
        np.testing.assert_array_equal(array[...], found[name])
    flags = dict(group["flags"].attrs)
    assert dict(zip(flags["flag_meanings"].split(), flags["flag_masks"], strict=True)) == FLAGS
    assert dict(group["values/base.albedo"].attrs) == {"units": "1"}
    seen = xarray.open_zarr(tmp_path / "a.zarr", group="values", consolidated=False)
    assert seen["base.albedo"].dims == ("row", "column")
    np.testing.assert_array_equal(seen["base.albedo"], found["values/base.albedo"])
    # the same numbers are the same bytes
    first, second = contents(tmp_path / "a.zarr"), contents(tmp_path / "b.zarr")
    assert {name.replace("a.zarr", "b.zarr"): content for name, content in first.items()} == second


def test_a_store_that_grows_is_nan_where_it_is_not_there(tmp_path: Path) -> None:
    found, store = numbers(SHAPE), empty(tmp_path / "a.zarr")
    map = open_map(tmp_path / "a.zarr")
    assert store.unfinished() == BLOCKS
    assert map.done == 0.0
    for block in BLOCKS[1:3]:
        store.write(block, part(found, block))
    assert store.unfinished() == [BLOCKS[0], *BLOCKS[3:]]
    assert map.done == pytest.approx(4 * 6 / 70)
    there = np.zeros(SHAPE, bool)
    there[:4, 4:] = True
    np.testing.assert_array_equal(np.isfinite(map.values["base.albedo"]), there)
    np.testing.assert_array_equal(map.start == NO_START, ~there)
    np.testing.assert_array_equal(map.flags != 0, there)


def test_a_full_disk_in_the_midst_of_a_chunk_is_named_and_the_chunk_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, store = numbers(SHAPE), empty(tmp_path / "a.zarr")
    store.write(BLOCKS[0], part(found, BLOCKS[0]))
    replaced, replace = [], Path.replace

    def full(source: Path, target: Path) -> None:
        replaced.append(target)
        if len(replaced) == 5:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source)
        replace(source, target)

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="space") as caught:
        store.write(BLOCKS[1], part(found, BLOCKS[1]))
    monkeypatch.undo()
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "a.zarr"))
    assert store.unfinished() == BLOCKS[1:]
    store.clean()
    assert not list(tmp_path.rglob(f"*{PARTIAL}"))
    shutil.rmtree(tmp_path / "a.zarr")
    with pytest.raises(OSError, match=r"No such file.*a\.zarr"):  # one that was removed is not made again
        store.write(BLOCKS[0], part(found, BLOCKS[0]))
    assert not (tmp_path / "a.zarr").exists()


@pytest.mark.parametrize("damage", [None, 0, 100, "flipped"])
def test_a_damaged_chunk_is_told_and_unfinished(damage: Any, tmp_path: Path) -> None:
    map = stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK)
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
    store.write(BLOCKS[3], part(numbers(SHAPE), BLOCKS[3]))
    assert store.unfinished() == []


def test_groups_are_there_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, arrays = Store(stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK).path), {"values/x": np.arange(3.0)}
    store.save_group("more", arrays, {"of": 1})
    create_array = zarr.Group.create_array

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(zarr.Group, "create_array", killed)
    with pytest.raises(KeyboardInterrupt):
        store.save_group("more", {"values/x": np.zeros(3)}, {"of": 2})
    with pytest.raises(KeyboardInterrupt):  # nor is a store
        empty(tmp_path / "b.zarr")
    monkeypatch.setattr(zarr.Group, "create_array", create_array)
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]
    found, about = store.load_group("more")
    assert about["of"] == 1
    np.testing.assert_array_equal(found["values/x"], arrays["values/x"])
    assert store.load_group("none") is None


def _root(path: Path, change: Any) -> None:
    described = json.loads((path / "zarr.json").read_text())
    change(described["attributes"]["layerjax"])
    (path / "zarr.json").write_text(json.dumps(described))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: shutil.rmtree(path), "no such file or directory"),
        (lambda path: (shutil.rmtree(path), path.write_text("x")), "is no store of a fitted map"),
        (lambda path: (path / "zarr.json").unlink(), "is no store of a fitted map"),
        (lambda path: (path / "zarr.json").write_text("{"), "is no store of a fitted map"),
        (lambda path: _root(path, lambda about: about.update(kind="x")), "it holds a x"),
        (lambda path: _root(path, lambda about: about.update(format=1)), "is version 1 of the"),
        (lambda path: _root(path, lambda about: about.pop("names")), "damaged, KeyError 'names'"),
        (lambda path: _root(path, lambda about: about.update(shape=[7, 9])), "has shape"),
        (lambda path: shutil.rmtree(path / "flags"), "damaged, .*flags"),
    ],
)
def test_what_is_no_such_store_says_what_it_is(damage: Any, words: str, tmp_path: Path) -> None:
    path = stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK).path
    damage(path)
    with pytest.raises((ValueError, FileNotFoundError), match=words) as caught:
        open_map(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_names_that_are_not_there_are_told(tmp_path: Path) -> None:
    map = stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK)
    with pytest.raises(ValueError, match=r"meaning: 'good' given, must be one of fitted, "):
        map.has("good")
    for ask, words in (
        (lambda: map.values["albedo"], r"base\.albedo"),
        (lambda: map["chi"], "reduced_chi_square"),
        (lambda: map["smoothed/values/base.albedo"], "is not one of"),
    ):
        with pytest.raises(KeyError, match=words):
            ask()


# ---- whose map it is ----


@pytest.fixture(scope="module")
def given() -> np.ndarray:
    return values((8, 8))


@pytest.fixture(scope="module")
def whole(tmp_path_factory, given):
    return fitted(tmp_path_factory.mktemp("map") / "coat.zarr", given)


@pytest.fixture
def out(tmp_path, whole):
    """A copy of it."""
    return shutil.copytree(whole.path, tmp_path / "coat.zarr")


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"seed": 1}, "seed 0, not 1"),
        ({"starts": 3, "pilot_texels": 9}, "starts 2, not 3, pilot_texels 8, not 9"),
        ({"stack": coat(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 0.9))}, "stack"),
        ({"noise": fits.Noise(relative=0.03)}, "noise"),
        ({"transport": lj.WeidlichWilkie()}, "transport"),
        ({"mask": np.eye(8, dtype=bool)}, "measurements"),
        ({"sigma": np.full((8, 8, 16, 1), 0.1)}, "measurements"),
    ],
)
def test_what_differs_is_named(whole, given, changed, named):
    with pytest.raises(ValueError, match=rf"holds the work of another problem \({named}\); --force"):
        fitted(whole.path, given, **changed)


def test_thresholds_of_verdicts_make_no_other_fit(out, given, whole):
    assert_same(fitted(out, given, converged_share=0.5, chi_square_sigmas=5.0), whole)


def test_a_transport_of_ones_own_is_known_again_by_what_it_predicts(tmp_path, given):
    def scaled(factor):
        def transport(stack, wi, wo):
            return factor * lj.evaluate(stack, wi, wo, lj.SingleScattering())

        return transport

    fitted(tmp_path / "own.zarr", given, transport=scaled(jnp.asarray(1.0)))
    fitted(tmp_path / "own.zarr", given, transport=scaled(1.0))
    with pytest.raises(ValueError, match=r"another problem \(transport\)"):
        fitted(tmp_path / "own.zarr", given, transport=scaled(1.1))


@pytest.mark.parametrize("force", [False, True])
def test_what_is_not_ours_is_never_touched(tmp_path, given, force):
    zarr.create_group(tmp_path / "group.zarr", attributes={"mine": 1})
    zarr.create_array(tmp_path / "array.zarr", shape=(3,), dtype="f8")
    (tmp_path / "file.zarr").write_text("precious")
    (tmp_path / "folder.zarr").mkdir()
    (tmp_path / "torn.zarr").mkdir()
    (tmp_path / "torn.zarr" / "zarr.json").write_text('{"attributes": {"layerjax": {"kind": "fitted')
    before = contents(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(ValueError, match="is no store of a fitted map") as error:
            fitted(path, given, force=force)
        assert str(error.value).startswith(str(path))
    assert contents(tmp_path) == before
    with pytest.raises(ValueError, match=r"coat\.zarr: there is no directory"):
        fitted(tmp_path / "no" / "such" / "coat.zarr", given)


def test_a_damaged_store_is_named_and_can_be_thrown_away(out, given, whole):
    shutil.rmtree(out / "flags")
    with pytest.raises(ValueError, match=rf"{out}: damaged"):
        fitted(out, given)
    assert_same(fitted(out, given, force=True), whole)


@pytest.mark.parametrize("damaged", ["zarr.json", "vectors/c/0/0"])
def test_what_chunks_have_in_common_is_found_again_where_it_is_damaged(out, given, whole, damaged):
    shutil.rmtree(out / "flags" / "c" / "0")
    place = out / "pilot" / damaged
    place.write_bytes(place.read_bytes()[:10])
    assert_same(fitted(out, given), whole)


def test_force_keeps_what_is_of_the_same_fit_and_a_map_until_there_can_be_another(out, given, whole):
    told = []
    fitted(out, given, force=True, progress=lambda *what: told.append(what))
    assert told == [("map", 4, 4, "")]

    def interrupt(stage, *_):
        assert stage == "pilot"
        raise KeyboardInterrupt

    with pytest.raises(ValueError, match="mask: no texel takes part"):
        fitted(out, given, mask=np.zeros((8, 8), bool), force=True)
    with pytest.raises(KeyboardInterrupt):
        fitted(out, given, seed=1, force=True, progress=interrupt)
    assert_same(fits.open_map(out), whole)


def test_what_killed_runs_left_beside_it_is_taken_away(tmp_path, given):
    for name in (".coat.zarr.abcd.partial", ".other.zarr.abcd.partial"):
        (tmp_path / name / "values").mkdir(parents=True)
    (tmp_path / "coat.zarr.lock").write_text("123\n")
    fitted(tmp_path / "coat.zarr", given)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".other.zarr.abcd.partial", "coat.zarr"]


def test_one_writer_also_by_a_link(tmp_path, out, given):
    (tmp_path / "other").mkdir()
    link = tmp_path / "other" / "link.zarr"
    link.symlink_to(out)
    refused = []

    def second(stage, done, total=None, info=""):
        with pytest.raises(ValueError, match="in use by another process"):
            fitted(out, given)
        refused.append(stage)

    fitted(link, given, progress=second)
    assert refused
    assert fitted(link, given, seed=5, force=True).attributes["options"]["seed"] == 5
    assert link.is_symlink()
    assert fits.open_map(out).attributes["options"]["seed"] == 5


def test_the_script_of_a_worker_ends_before_it_does_anything(tmp_path, given, monkeypatch):
    """As a script without a guard has it, which workers run again."""
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(SystemExit) as end:
        fitted(tmp_path / "coat.zarr", given, processes=2)
    assert end.value.code == AGAIN
    assert not list(tmp_path.iterdir())


def test_chunks_that_vanish_while_it_runs_are_told_of(tmp_path, given):
    out = tmp_path / "coat.zarr"

    def meddle(stage, done, total=None, info=""):
        if stage == "map" and done == total:
            next(out.glob("flags/c/*/*")).unlink()

    with pytest.raises(ValueError, match="was written, and is not there; all other chunks are done"):
        fitted(out, given, progress=meddle)
    assert fitted(out, given).done == 1.0
