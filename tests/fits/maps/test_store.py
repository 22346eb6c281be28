"""The store of a map: what was written is read again, also by zarr and xarray alone; nothing is there half."""

import errno
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

import fits
from fits.maps import chunk_files
from fits.maps.fitted_map import open_map
from fits.maps.store import FLAGS, NO_START, arrays_of, clean, create, left, write_chunk
from tests.helpers.files import contents
from tests.helpers.painted_maps import ATTRIBUTES, NAMES, UNITS, numbers, stored

SHAPE, CHUNK = (7, 10), (4, 4)
BLOCKS = [(slice(a, b), slice(c, d)) for a, b in ((0, 4), (4, 7)) for c, d in ((0, 4), (4, 8), (8, 10))]


def empty(path: Path, **changed: Any) -> zarr.Group:
    given = {"names": NAMES, "units": UNITS, "shape": SHAPE, "chunk": CHUNK, "attributes": ATTRIBUTES}
    return create(path, **{**given, "numerical": False, **changed})


def part(found: dict[str, np.ndarray], block: tuple[slice, ...]) -> dict[str, np.ndarray]:
    return {name: values[block] for name, values in found.items()}


@pytest.mark.parametrize(
    ("shape", "chunk"), [((7, 10), (4, 4)), ((11,), (4,)), ((3, 5, 4), (2, 2, 4)), ((2, 2), (9, 9))]
)
def test_what_is_written_is_read(shape: tuple[int, ...], chunk: tuple[int, ...], tmp_path: Path) -> None:
    found = numbers(shape, numerical=True)
    map = stored(tmp_path / "a.zarr", found, chunk)
    for name in NAMES:
        np.testing.assert_array_equal(map.values[name], found[f"values/{name}"])
        np.testing.assert_array_equal(map.errors[name], found[f"errors/{name}"])
    for name in ("reduced_chi_square", "flags", "start", "at_bound", "readings", "numerical_error"):
        np.testing.assert_array_equal(getattr(map, name), found[name])
        assert getattr(map, name).dtype == found[name].dtype
    assert (map.names, map.units, map.shape, map.done) == (NAMES, UNITS, shape, 1.0)
    assert map.attributes["noise"] == ATTRIBUTES["noise"]
    assert left(zarr.open_group(map.path)) == []
    assert fits.open_map(map.path).has("converged").all()


def test_zarr_and_xarray_read_it_without_us(tmp_path: Path) -> None:
    found = numbers(SHAPE)
    stored(tmp_path / "a.zarr", found, CHUNK)
    group = zarr.open_group(tmp_path / "a.zarr", mode="r")
    for name, (dtype, _) in arrays_of(NAMES, False).items():
        array = group[name]
        assert (array.dtype, array.shape, array.chunks) == (dtype, SHAPE, CHUNK)
        np.testing.assert_array_equal(array[...], found[name])
    flags = dict(group["flags"].attrs)
    assert dict(zip(flags["flag_meanings"].split(), flags["flag_masks"], strict=True)) == FLAGS
    assert dict(group["values/base.albedo"].attrs) == {"units": "1"}
    xarray = pytest.importorskip("xarray")
    seen = xarray.open_zarr(tmp_path / "a.zarr", group="values", consolidated=False)
    assert seen["base.albedo"].dims == ("row", "column")
    np.testing.assert_array_equal(seen["base.albedo"], found["values/base.albedo"])


def test_a_store_that_grows_is_nan_where_it_is_not_there(tmp_path: Path) -> None:
    found, group = numbers(SHAPE), empty(tmp_path / "a.zarr")
    map = open_map(tmp_path / "a.zarr")
    assert left(group) == BLOCKS
    assert map.done == 0.0
    assert np.isnan(map.values["base.albedo"]).all()
    for block in BLOCKS[1:3]:
        write_chunk(group, block, part(found, block))
    assert left(group) == [BLOCKS[0], *BLOCKS[3:]]
    assert map.done == pytest.approx(4 * 6 / 70)
    there = np.zeros(SHAPE, bool)
    there[:4, 4:] = True
    np.testing.assert_array_equal(np.isfinite(map.values["base.albedo"]), there)
    np.testing.assert_array_equal(map.start == NO_START, ~there)
    np.testing.assert_array_equal(map.flags != 0, there)


def test_bytes_are_the_same_for_the_same_numbers(tmp_path: Path) -> None:
    for name in ("a", "b"):
        stored(tmp_path / f"{name}.zarr", numbers(SHAPE), CHUNK)
    first, second = contents(tmp_path / "a.zarr"), contents(tmp_path / "b.zarr")
    assert len(first) == 1 + 2 + 11 + 6 * 11  # the root, groups of values and errors, arrays, chunks
    assert {name.replace("a.zarr", "b.zarr"): content for name, content in first.items()} == second


def test_what_fails_in_the_midst_leaves_nothing_of_the_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.zarr"
    found, group = numbers(SHAPE), empty(path)
    write_chunk(group, BLOCKS[0], part(found, BLOCKS[0]))
    before, replaced, replace = contents(path), [], os.replace

    def full(source: str, target: str) -> None:
        replaced.append(target)
        if len(replaced) == 5:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source)
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="space") as caught:
        write_chunk(group, BLOCKS[1], part(found, BLOCKS[1]))
    monkeypatch.undo()
    assert caught.value.errno == errno.ENOSPC
    assert caught.value.filename == str(path)
    assert contents(path) == before
    assert BLOCKS[1] in left(group)
    write_chunk(group, BLOCKS[1], part(found, BLOCKS[1]))
    assert BLOCKS[1] not in left(group)


def test_flags_are_written_last_and_go_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, group, order = numbers(SHAPE), empty(tmp_path / "a.zarr"), []
    write = chunk_files.write

    def watched(array: Path, *arguments: Any) -> None:
        order.append(array.name)
        assert not chunk_files.file_at(tmp_path / "a.zarr" / "flags", (0, 0)).exists()
        write(array, *arguments)

    monkeypatch.setattr(chunk_files, "write", watched)
    for _ in range(2):
        write_chunk(group, BLOCKS[0], part(found, BLOCKS[0]))
    assert order[10] == order[-1] == "flags"


@pytest.mark.parametrize("size", [None, 0, 100])
def test_a_chunk_with_a_damaged_file_is_left(size: int | None, tmp_path: Path) -> None:
    map = stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK)
    file = map.path / "values" / NAMES[0] / "c" / "1" / "0"
    assert file.stat().st_size == 4 * 4 * 8 + 4
    if size is None:
        file.unlink()
        assert np.isnan(map.values[NAMES[0]][4:, :4]).all()
    else:
        os.truncate(file, size)
        with pytest.raises(ValueError, match=rf"^{re.escape(str(file))}: damaged, holds {size} bytes, must be 132$"):
            map.values[NAMES[0]]
    assert left(zarr.open_group(map.path)) == [BLOCKS[3]]


def test_leftovers_of_killed_writers_are_removed(tmp_path: Path) -> None:
    map = stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK)
    before = contents(map.path)
    for folder in ("flags/c/0", "values/base.albedo/c/1"):
        (map.path / folder / f"0.123{chunk_files.PARTIAL}").write_bytes(b"half")
    clean(map.path)
    assert contents(map.path) == before


def test_a_store_rewritten_with_compression_can_be_read(tmp_path: Path) -> None:
    found = numbers(SHAPE)
    map = stored(tmp_path / "a.zarr", found, CHUNK)
    shutil.rmtree(map.path / "flags")
    root = zarr.open_group(map.path)
    root.create_array("flags", data=found["flags"], chunks=(2, 3))
    assert open_map(map.path).done == 1.0
    np.testing.assert_array_equal(open_map(map.path).flags, found["flags"])


def test_many_parameters_have_a_bit_each(tmp_path: Path) -> None:
    names = [f"base.albedo[{index}]" for index in range(40)]
    assert arrays_of(names, False)["at_bound"][0] == np.uint64
    with pytest.raises(ValueError, match=r"^names: 65 parameters given, must be 1 to 64 and different$"):
        empty(tmp_path / "a.zarr", names=[str(index) for index in range(65)])


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"shape": (7, 0)}, r"shape: \(7, 0\) given"),
        ({"shape": (), "chunk": ()}, r"shape: \(\) given"),
        ({"chunk": (4,)}, "chunk: has 1 axes, must be 2"),
        ({"names": ("a", "a")}, "names: 2 parameters given"),
    ],
)
def test_what_cannot_be_a_store_is_refused(changed: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        empty(tmp_path / "a.zarr", **changed)
    assert list(tmp_path.iterdir()) == []


def test_a_store_replaces_nothing_and_is_not_made_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.zarr").write_text("mine")
    with pytest.raises(ValueError, match="exists already"):
        empty(tmp_path / "a.zarr")
    with pytest.raises(ValueError, match="there is no directory"):
        empty(tmp_path / "none" / "a.zarr")

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(zarr.Group, "create_array", killed)
    with pytest.raises(KeyboardInterrupt):
        empty(tmp_path / "b.zarr")
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]


def test_results_must_be_those_of_a_chunk(tmp_path: Path) -> None:
    found, group = numbers(SHAPE), empty(tmp_path / "a.zarr")
    with pytest.raises(ValueError, match="is no chunk"):
        write_chunk(group, (slice(0, 4), slice(2, 6)), part(found, (slice(0, 4), slice(2, 6))))
    with pytest.raises(ValueError, match=r"'flags'.* are not both"):
        write_chunk(group, BLOCKS[0], {name: one for name, one in part(found, BLOCKS[0]).items() if name != "flags"})
    with pytest.raises(ValueError, match=r"shape \(3, 4\), must be \(4, 4\)"):
        write_chunk(group, BLOCKS[0], part(found, BLOCKS[3]))
    assert left(group) == BLOCKS


def test_a_store_that_was_removed_is_not_made_again(tmp_path: Path) -> None:
    found, group = numbers(SHAPE), empty(tmp_path / "a.zarr")
    shutil.rmtree(tmp_path / "a.zarr")
    with pytest.raises(OSError, match=r"No such file.*a\.zarr"):
        write_chunk(group, BLOCKS[0], part(found, BLOCKS[0]))
    assert not (tmp_path / "a.zarr").exists()


def _root(path: Path, change: Any) -> None:
    described = json.loads((path / "zarr.json").read_text())
    change(described)
    (path / "zarr.json").write_text(json.dumps(described))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: shutil.rmtree(path), "no such file or directory"),
        (lambda path: (shutil.rmtree(path), path.write_text("x")), "is a file, must be the store of a fitted map"),
        (lambda path: (path / "zarr.json").unlink(), "is a directory without zarr.json, must be the store"),
        (lambda path: (path / "zarr.json").write_text("{"), "not valid JSON"),
        (lambda path: (path / "zarr.json").write_text("[]"), "is no group of zarr arrays"),
        (lambda path: _root(path, lambda root: root["attributes"].clear()), "is a zarr group that is not ours"),
        (lambda path: _root(path, lambda root: root["attributes"]["layerjax"].update(kind="x")), "holds a x, must be"),
        (lambda path: _root(path, lambda root: root["attributes"]["layerjax"].update(format=1)), "is version 1 of the"),
        (
            lambda path: _root(path, lambda root: root["attributes"]["layerjax"].pop("names")),
            "damaged, KeyError 'names'",
        ),
        (lambda path: _root(path, lambda root: root["attributes"]["layerjax"].update(shape=7)), "damaged, TypeError"),
        (lambda path: shutil.rmtree(path / "flags"), "damaged, .*flags"),
        (lambda path: (path / "flags" / "zarr.json").write_text("{"), "damaged, "),
        (lambda path: _root(path, lambda root: root["attributes"]["layerjax"].update(shape=[7, 9])), "has shape"),
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
    with pytest.raises(KeyError, match=r"base\.albedo"):
        map.values["albedo"]
    with pytest.raises(KeyError, match="reduced_chi_square"):
        map["chi"]
    assert map.numerical_error is None
    assert repr(map).startswith("<FittedMap of 7 x 10 texels, 100 % done: layers[0].thickness, ")
    assert len(map.values) == 3


@pytest.mark.parametrize("at", [0, 40, 130])
def test_flipped_bytes_are_damage_and_done_again(at: int, tmp_path: Path) -> None:
    """Of the numbers and of the checksum; zarr by itself sees it as well."""
    map = stored(tmp_path / "a.zarr", numbers(SHAPE), CHUNK)
    file = map.path / "values" / NAMES[0] / "c" / "1" / "0"
    content = bytearray(file.read_bytes())
    content[at : at + 16] = bytes(byte ^ 0x5A for byte in content[at : at + 16])
    file.write_bytes(content)
    with pytest.raises(
        ValueError, match=rf"^{re.escape(str(file))}: damaged, its checksum is not that of its content$"
    ):
        map.values[NAMES[0]]
    with pytest.raises(ValueError, match="checksum"):
        map[f"values/{NAMES[0]}"][...]
    assert left(zarr.open_group(map.path)) == [BLOCKS[3]]


def test_what_is_written_is_what_zarr_reads_and_writes(tmp_path: Path) -> None:
    found = numbers(SHAPE)
    map = stored(tmp_path / "a.zarr", found, CHUNK)
    name = f"values/{NAMES[0]}"
    np.testing.assert_array_equal(map[name][...], found[name])
    before = contents(map.path)
    zarr.open_group(map.path, mode="r+")[name][...] = found[name]
    assert contents(map.path) == before
