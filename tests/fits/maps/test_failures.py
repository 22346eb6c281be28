"""Killed workers and parents, schedulers that go away, full disks: nothing is lost or half written, and in the end the
store is that of an undisturbed run, to the bit."""

import json
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest

from fits.cli.parser import main
from fits.maps.store import open_map
from tests.helpers.files import mounted
from tests.helpers.quick_maps import assert_same, command, write_files
from tests.helpers.tasks import running, started, wait_until

CLI, PATIENCE = ["-m", "fits.cli"], 120.0
SLOW_DISK = """import os, time
replace = os.replace
def slowly(*paths):
    time.sleep(0.01)
    replace(*paths)
os.replace = slowly
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a map of 16 chunks."""
    folder = tmp_path_factory.mktemp("map")
    write_files(folder, (16, 16))
    (folder / "sitecustomize.py").write_text(SLOW_DISK)
    return folder


@pytest.fixture(scope="module")
def whole(place):
    """The store of an undisturbed run."""
    assert main(command(place, place / "whole.zarr", "--processes", "1")) == 0
    return open_map(place / "whole.zarr")


def chunks_of(store):
    """How many chunks a store has."""
    return sum(1 for path in store.glob("flags/c/*/*") if path.suffix != ".partial")


def workers_of(process):
    """Worker processes below this one."""
    workers, pending = [], [process]
    while pending:
        with suppress(OSError):
            for thread in Path(f"/proc/{pending.pop(0)}/task").iterdir():
                for child in map(int, (thread / "children").read_text().split()):
                    pending.append(child)
                    if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
                        workers.append(child)
    return workers


def kill_at_random(place, words, store, kills, chunks, seed):
    """The same command repeated until it has been killed so many times, now and then as a whole and else one of its
    workers, after a few chunks each, at any moment; what was killed how often."""
    choice, killed, every = random.Random(seed), Counter(), min(5, kills)
    while killed.total() < kills:
        workers = []
        with started([*CLI, *words], place) as process:
            while process.poll() is None and killed.total() < kills:
                until = chunks_of(store) + int(1.6 * chunks / kills * choice.random())
                late = time.monotonic() + 10.0 * choice.random()  # as it starts, too
                while process.poll() is None and chunks_of(store) < until and time.monotonic() < late:
                    time.sleep(0.002)
                time.sleep(0.05 * choice.random())
                workers = workers_of(process.pid)
                whole = killed.total() % every == every - 1
                if process.poll() is None and (whole or workers):
                    with suppress(ProcessLookupError):
                        os.kill(process.pid if whole else choice.choice(workers), signal.SIGKILL)
                        killed["run" if whole else "worker"] += 1
            process.wait(PATIENCE)
            error = process.stderr.read()
        wait_until(lambda workers=workers: not any(map(running, workers)), 10.0)  # none is left behind
        if process.returncode == 0:
            break
        if process.returncode != -signal.SIGKILL:  # one chunk has cost three workers
            assert process.returncode == 2
            assert "all other chunks are done, and another run does these" in error
    return killed


@pytest.mark.parametrize(
    ("shape", "kills"), [((16, 16), 2), pytest.param((80, 40), 50, marks=pytest.mark.slow)], ids=["few", "fifty"]
)
def test_killed_at_random_moments(place, tmp_path, whole, shape, kills):
    if shape != (16, 16):
        write_files(tmp_path, shape)
        shutil.copy(place / "sitecustomize.py", tmp_path)
        place = tmp_path
        assert main(command(place, place / "whole.zarr", "--processes", "1")) == 0
        whole = open_map(place / "whole.zarr")
    (tmp_path / "many").mkdir()
    out, chunks = tmp_path / "many" / "coat.zarr", shape[0] * shape[1] // 16
    words = command(place, out, "--processes", "2")
    killed = kill_at_random(place, words, out, kills, chunks, seed=kills)
    assert killed["run"] == max(kills // 5, 1)
    assert killed.total() == kills
    assert main(command(place, out, "--processes", "1")) == 0
    assert chunks_of(out) == chunks
    assert_same(open_map(out), whole)
    assert os.listdir(tmp_path / "many") == ["coat.zarr"]


@pytest.mark.slow
@pytest.mark.parametrize("processes", ["1", "2"])
def test_one_run_at_a_time_which_the_user_interrupts(place, tmp_path, whole, processes, capsys):
    """Ctrl-C goes to all processes of a terminal."""
    out = tmp_path / "coat.zarr"
    words = command(place, out, "--processes", processes)
    with started([*CLI, *words], place) as process:
        wait_until(lambda: chunks_of(out) >= 2)
        process.send_signal(signal.SIGSTOP)
        assert main(["report", str(out)]) == 0  # while it runs
        for more in ([], ["--force"], ["--noise", "0.03", "--force"]):
            assert main([*words, *more]) == 2
            assert f"{out} is in use by another process ({process.pid})" in capsys.readouterr().err
        workers = workers_of(process.pid)
        process.send_signal(signal.SIGCONT)
        os.killpg(process.pid, signal.SIGINT)
        _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert error.splitlines()[-1].startswith("layerjax: interrupted: what was fitted is in")
    assert not any(map(running, workers))
    assert sorted(os.listdir(tmp_path)) == ["coat.html", "coat.zarr"]
    assert main(command(place, out, "--processes", "1")) == 0
    assert_same(open_map(out), whole)


@pytest.mark.parametrize("processes", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_a_disk_that_fills_up(place, tmp_path, whole, capsys, processes):
    """As the store is made, as the pilot is kept, and among chunks."""
    (tmp_path / "disk").mkdir()
    out = tmp_path / "disk" / "coat.zarr"
    words = command(place, out, "--processes", processes)
    with mounted(tmp_path / "disk", "-t", "tmpfs", "-o", "size=20k", "tmpfs"):
        done = []
        for size in ("20k", "80k", "300k", "400k"):
            subprocess.run(["mount", "-o", f"remount,size={size}", str(tmp_path / "disk")], check=True)
            assert main(words) == 2
            error = capsys.readouterr().err.splitlines()[-1]
            assert error == f"layerjax: error: {out}: no space left on device"
            # where one of several files does not fit, zarr tells before its threads have given up the others
            wait_until(lambda: not list((tmp_path / "disk").rglob("*.partial")))
            done.append(chunks_of(out))
        assert done[0] == done[1] == 0 < done[2] < done[3] < 16
        subprocess.run(["mount", "-o", "remount,size=20m", str(tmp_path / "disk")], check=True)
        assert main(words) == 0
        assert_same(open_map(out), whole)


@pytest.mark.slow
def test_a_worker_and_then_the_scheduler_of_a_cluster_are_killed(place, tmp_path, whole, capsys):
    pytest.importorskip("distributed")
    out, file = tmp_path / "coat.zarr", tmp_path / "scheduler.json"
    where, killed = ["--no-dashboard", "--scheduler-file", str(file)], []
    schedule = ["-m", "distributed.cli.dask_scheduler", "--port", "0", *where]
    work = ["-m", "distributed.cli.dask_worker", "--nworkers", "2", "--nthreads", "1", *where]
    with started(schedule, place) as scheduler, started(work, place) as nanny:

        def kill():
            wait_until(lambda: chunks_of(out) >= 1)
            killed.append(workers_of(nanny.pid)[0])
            os.kill(killed[0], signal.SIGKILL)
            wait_until(lambda: chunks_of(out) >= 4)
            scheduler.kill()

        wait_until(lambda: file.exists() and file.stat().st_size > 0)
        address = json.loads(file.read_text())["address"]
        thread = threading.Thread(target=kill)
        thread.start()
        assert main(command(place, out, "--scheduler", address)) == 2
        thread.join()
        os.killpg(nanny.pid, signal.SIGKILL)
    error = capsys.readouterr().err.splitlines()[-1]
    assert error == f"layerjax: error: {address}: the scheduler has stopped"
    assert killed
    assert 4 <= chunks_of(out) < 16
    assert main(command(place, out, "--processes", "1")) == 0
    assert_same(open_map(out), whole)
