"""What is where a store is to be: it is gone on with, refused by name, or thrown away if that is asked for."""

import json
import multiprocessing
import shutil

import numpy as np
import pytest
import zarr

import fits
from fits.engines.processes import AGAIN
from fits.maps.fit_map import fit_map
from tests.helpers.quick_maps import FREE, NOISE, TRANSPORT, assert_same, coat, fitted, geometry, values


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


OPTIONS = {"noise": NOISE, "transport": TRANSPORT, "chunk": 16, "sample": 8, "starts": 2}


@pytest.mark.parametrize(
    ("changed", "named"),
    [({"seed": 1}, "seed"), ({"chunk": 8}, "chunk"), ({"starts": 3, "sample": 9}, "starts, sample"),
     ({"stack": coat(fits.Free(0.5, 0.05, 3.0), fits.Free(0.4, 0.0, 0.9))}, "stack"),
     ({"mask": np.eye(8, dtype=bool)}, "readings"), ({"sigma": np.full((8, 8, 16, 1), 0.1)}, "readings")],
)  # fmt: skip
def test_what_differs_is_named(out, given, changed, named):
    arguments = {"stack": FREE, **OPTIONS} | changed
    with pytest.raises(ValueError, match=rf"holds a map of another fit, different in {named} \(--force"):
        fit_map(arguments.pop("stack"), geometry(), given, out, **arguments)


@pytest.mark.parametrize("force", [False, True])
def test_what_is_not_ours_is_never_touched(tmp_path, given, force):
    zarr.create_group(tmp_path / "group.zarr", attributes={"mine": 1})
    zarr.create_array(tmp_path / "array.zarr", shape=(3,), dtype="f8")
    (tmp_path / "file.zarr").write_text("precious")
    (tmp_path / "torn.zarr").mkdir()
    (tmp_path / "torn.zarr" / "zarr.json").write_text('{"attributes": {"layerjax": {"kind": "fitted')
    for name, words in {
        "group": "a zarr group that is not ours",
        "array": "no group of zarr arrays",
        "file": "is there, and is no fitted map",
        "torn": r"zarr\.json: damaged, not valid JSON",
    }.items():
        path = tmp_path / f"{name}.zarr"
        with pytest.raises(ValueError, match=words) as error:
            fitted(path, given, force=force)
        assert str(error.value).startswith(str(path))
    assert zarr.open_group(tmp_path / "group.zarr", mode="r").attrs["mine"] == 1
    assert not list(tmp_path.glob("*.lock"))


def test_a_damaged_store_is_named_and_can_be_thrown_away(out, given, whole):
    shutil.rmtree(out / "flags")
    with pytest.raises(ValueError, match=rf"{out}: damaged"):
        fitted(out, given)
    assert_same(fitted(out, given, force=True), whole)


@pytest.mark.parametrize("damaged", ["zarr.json", "vectors/zarr.json", "vectors/c/0/0"])
def test_what_chunks_share_is_found_again_where_it_is_damaged(out, given, whole, damaged):
    shutil.rmtree(out / "flags" / "c" / "0")
    place = out / "pilot" / damaged
    place.write_bytes(place.read_bytes()[:10])
    assert_same(fitted(out, given), whole)


def test_force_keeps_what_is_of_the_same_fit(out, given, whole):
    told = []
    fitted(out, given, force=True, progress=lambda *what: told.append(what))
    assert told == [("map", 4, 4, "")]


def test_force_keeps_a_map_until_there_can_be_another(out, given, whole):
    def interrupt(stage, *_):
        assert stage == "sample"
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


def test_a_link_is_the_store_it_leads_to(tmp_path, out, given):
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
    assert fitted(link, given, seed=5, force=True).attributes["settings"]["seed"] == 5
    assert link.is_symlink()
    assert fits.open_map(out).attributes["settings"]["seed"] == 5


def test_a_folder_that_is_not_there_is_not_made(tmp_path, given):
    with pytest.raises(ValueError, match=r"coat\.zarr: there is no directory"):
        fitted(tmp_path / "no" / "such" / "coat.zarr", given)
    assert not list(tmp_path.iterdir())


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
    assert json.loads((out / "zarr.json").read_text())["node_type"] == "group"
