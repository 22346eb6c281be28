"""Kills, full disks, a second writer and damage: what was kept is there, or an error names the file."""

import os
import random
import sqlite3
import time
from contextlib import closing, contextmanager

import jax.numpy as jnp
import numpy as np
import pytest

from fits._files import write_text
from fits.store import Store, differences, fingerprint
from tests.helpers.files import contents, largest_file, read_only
from tests.helpers.refusals import refuses
from tests.helpers.stores import keys
from tests.helpers.tasks import started

WHOSE = fingerprint(data=np.arange(3.0), seed=0)
SCRIPT = """
import sys, os, signal
import numpy as np
from fits.store import Store, fingerprint
path, hold = sys.argv[1:]
with Store.open(path, fingerprint(data=np.arange(3.0), seed=0)) as store:
    for number in range(len(store.all("steps")), 100_000):
        store.append("steps", {"number": number, "coords": np.full((8, 32, 3), number)})
        store.put("last", number)
        if hold == "between" and number == 5:
            os.kill(os.getpid(), signal.SIGSTOP)
        if hold == "within" and number == 5:
            with store._connection:
                store._connection.execute("PRAGMA cache_size = 1")  # pages go to the file before the end
                for _ in range(50):
                    store._connection.execute("UPDATE records SET text = hex(zeroblob(20000)), checksum = 0")
                os.kill(os.getpid(), signal.SIGSTOP)
"""


@contextmanager
def writer(path, hold=""):
    """A process that writes until it is killed in the end; it stops between two records, or within one."""
    with started(["-c", SCRIPT, str(path), hold]) as process:
        if hold:
            os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        yield process


def fill(path, until=60):
    with Store.open(path, WHOSE) as store:
        for number in range(len(store.all("steps")), until):
            store.append("steps", {"number": number, "coords": np.full((8, 32, 3), number)})


def steps_of(store):
    """How many steps were kept, all of which must be as they were written."""
    steps = store.all("steps")
    for number, record in enumerate(steps):
        assert record["number"] == number
        np.testing.assert_array_equal(record["coords"], np.full((8, 32, 3), number))
    assert store.get("last") in (len(steps) - 1, len(steps) - 2, None)
    return len(steps)


def test_records_come_back(tmp_path):
    path = tmp_path / "store"
    record = {"coords": np.arange(24.0).reshape(2, 4, 3), "none": np.zeros((0, 3)), "device": jnp.ones(2)}
    record |= {"state": ["MT19937", np.arange(5, dtype=np.uint32), 3, 0.1], "nothing": None, "words": {"ä": True}}
    record |= {"cost": float("inf"), "worst": np.float64("nan"), "count": np.int64(3)}
    with Store.open(path, WHOSE) as store:
        for name in ("old", "new"):
            store.put("record", {"name": name})
        store.put("record", record)
        for number in range(3):
            store.append("block", number)
    with Store.open(path, WHOSE) as again:
        for one in (store.read(path), again):
            assert keys(one) == ["record", "block"]
            assert one.all("block") == [0, 1, 2]
            assert one.get("other") is None
            assert one.fingerprint == WHOSE
            found = one.get("record")
            np.testing.assert_equal(found, record)
            for key in ("coords", "none", "device"):
                assert found[key].dtype == record[key].dtype
        refuses("object cannot be kept in a store", again.put, "record", {"it": object()}, error=TypeError)
    assert [one.name for one in tmp_path.iterdir()] == ["store"]


@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 50))])
def test_a_writer_is_read_at_any_time_killed_and_gone_on_from(tmp_path, seed):
    """Killed twice at moments that nobody chose."""
    path, chance, kept = tmp_path / "store", random.Random(seed), [0]
    for _ in range(2):
        with writer(path):
            while not path.is_file() or not path.stat().st_size:
                time.sleep(0.001)
            end = time.monotonic() + chance.uniform(0.0, 0.1)
            while time.monotonic() < end:
                kept.append(steps_of(Store.read(path)))
        kept.append(steps_of(Store.read(path)))
    assert kept == sorted(kept)
    with Store.open(path, WHOSE) as store:
        assert steps_of(store) == kept[-1]


def test_readers_change_nothing_and_a_second_writer_is_refused(tmp_path):
    """Beside a writer that stands still between two records, within one, and one that was killed there."""
    for hold in ("between", "within"):
        path = tmp_path / hold / "store"
        path.parent.mkdir()
        with writer(path, hold) as process:
            before = contents(tmp_path)
            assert (f"{path}-journal" in before) == (hold == "within")
            assert steps_of(Store.read(path)) == 6
            refuses(rf"store is in use by another process \({process.pid}\)", Store.open(path, WHOSE).__enter__)
            assert contents(tmp_path) == before
        with read_only(path.parent):
            assert steps_of(Store.read(path)) == 6
        with Store.open(path, WHOSE) as store:
            assert steps_of(store) == 6


def test_a_full_disk_costs_the_record_that_was_written(tmp_path):
    path = tmp_path / "store"
    with largest_file(100_000), pytest.raises(OSError, match="No space left") as error:
        fill(path)
    assert error.value.filename == str(path)
    assert 0 < steps_of(Store.read(path)) < 60
    fill(path)
    assert steps_of(Store.read(path)) == 60


def test_a_store_that_is_removed_or_replaced_while_it_is_written_is_said_to_be(tmp_path):
    path = tmp_path / "store"
    for change in (path.unlink, lambda: write_text(path, "", force=True)):
        with Store.open(path, WHOSE, fresh=True) as store:
            store.put("one", 1)
            change()
            with pytest.raises(FileNotFoundError, match="Removed, or replaced, while it was written") as caught:
                store.put("two", 2)
        assert caught.value.filename == str(path)


def test_damage_is_reported_and_never_read(tmp_path):
    path = tmp_path / "store"
    fill(path, 6)
    whole, reported = path.read_bytes(), 0
    places = [*range(0, 8192, 64), *range(8192, len(whole), 512)]
    for place in places:
        run = whole[place : place + 64]
        for bad in (bytes(len(run)), bytes(255 - byte for byte in run), run[:1] + bytes([run[1] ^ 1]) + run[2:]):
            path.write_bytes(whole[:place] + bad + whole[place + 64 :])
            try:
                found = Store.read(path)
            except ValueError as error:
                assert str(error).startswith(f"{path}: damaged")  # noqa: PT017
                reported += 1
            else:  # of what no record uses
                assert steps_of(found) == 6
                assert found.fingerprint == WHOSE
    assert reported > len(places) / 2
    for length in (100, 4096, len(whole) - 4096):
        path.write_bytes(whole[:length])
        refuses("store: damaged, or no store of this version", Store.read, path)
        refuses("store: damaged, or no store of this version", Store.open(path, WHOSE).__enter__)
    with Store.open(path, WHOSE, fresh=True) as store:
        assert keys(store) == []


def test_what_is_no_store_is_left_alone(tmp_path):
    (tmp_path / "text").write_text("precious")
    with closing(sqlite3.connect(tmp_path / "database")) as connection:
        connection.execute("CREATE TABLE head (it)")
        connection.commit()
    before = contents(tmp_path)
    for name in ("text", "database"):
        refuses(f"{name}: damaged, or no store", Store.open(tmp_path / name, WHOSE, replace=True).__enter__)
    assert contents(tmp_path) == before
    refuses("absent", Store.read, tmp_path / "absent", error=FileNotFoundError)
    (tmp_path / "absent").touch()  # killed as it was made
    assert keys(Store.read(tmp_path / "absent")) == []
    fill(tmp_path / "absent")


def test_the_work_of_another_problem_is_refused_by_name(tmp_path):
    path = tmp_path / "store"
    fill(path)
    before = contents(tmp_path)
    other = fingerprint(data=np.arange(4.0), seed=1)
    refuses(r"holds the work of another problem \(data, seed 0, not 1\)", Store.open(path, other).__enter__)
    assert contents(tmp_path) == before
    with Store.open(path, other, replace=True) as store:
        assert keys(store) == []
    assert Store.read(path).fingerprint == other


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (None, 0.0),
        ("a" * 100, "a" * 99),
        (np.zeros((2, 3)), np.zeros((3, 2))),
        (np.zeros(2), np.zeros(2, np.float32)),
        ([np.zeros(2), 1], [np.zeros(2), 2]),
        ({"a": np.zeros(1)}, {"b": np.zeros(1)}),
        ([["a"], "b"], [["a", "b"]]),
        (("a", "b"), ("a;b",)),
    ],
)
def test_a_fingerprint_tells_problems_apart(one, other):
    assert "part" in differences(fingerprint(part=one), fingerprint(part=other))
    assert fingerprint(part=one) == fingerprint(part=one)
    here, there = object(), object()  # both at once, so that they differ in place, as they do in other processes
    assert fingerprint(part=here) == fingerprint(part=there)


def test_files_are_written_without_touching_the_umask_that_other_threads_share(tmp_path, monkeypatch):
    (tmp_path / "plain").touch()
    monkeypatch.setattr(os, "umask", lambda mode: pytest.fail("the umask is set"))
    write_text(tmp_path / "own", "text")
    assert (tmp_path / "own").stat().st_mode == (tmp_path / "plain").stat().st_mode
