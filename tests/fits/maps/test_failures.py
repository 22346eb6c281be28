"""Killed workers and parents: nothing is lost or half written, and in the end the store is that of an undisturbed run,
to the bit (full disks: `test_store`; schedulers that stop: `test_engines`)."""

import os
import random
import signal
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest

from fits.cli.parser import main
from fits.maps.store import open_map
from tests.helpers.quick_maps import assert_same, command, write_files
from tests.helpers.tasks import running, started, wait_until

pytest.importorskip("distributed")

CLI, PATIENCE = ["-m", "fits.cli"], 120.0
SLOW_DISK = """import os, time
replace = os.replace
def slowly(*paths):
    time.sleep(0.01)
    replace(*paths)
os.replace = slowly
"""


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


@pytest.mark.slow
@pytest.mark.parametrize("kills", [2, 50])
def test_killed_at_random_moments(tmp_path, kills):
    """The same command repeated until it has been killed so many times, now and then as a whole and else one of its
    workers, after a few chunks each, at any moment."""
    folder = tmp_path
    write_files(folder, (16, 16) if kills == 2 else (80, 40))  # in chunks of 16 texels
    (folder / "sitecustomize.py").write_text(SLOW_DISK)
    assert main(command(folder, folder / "whole.zarr")) == 0
    whole = open_map(folder / "whole.zarr")
    (tmp_path / "many").mkdir()
    out, chunks = tmp_path / "many" / "coat.zarr", whole.flags.size // 16
    choice, killed, every = random.Random(kills), Counter(), min(5, kills)
    while killed.total() < kills:
        workers = []
        with started([*CLI, *command(folder, out, "--processes", "2")], folder) as process:
            while process.poll() is None and killed.total() < kills:
                until = chunks_of(out) + int(1.6 * chunks / kills * choice.random())
                late = time.monotonic() + 10.0 * choice.random()  # as it starts, too
                while process.poll() is None and chunks_of(out) < until and time.monotonic() < late:
                    time.sleep(0.002)
                time.sleep(0.05 * choice.random())
                workers, all_of_it = workers_of(process.pid), killed.total() % every == every - 1
                if process.poll() is None and (all_of_it or workers):
                    with suppress(ProcessLookupError):
                        os.kill(process.pid if all_of_it else choice.choice(workers), signal.SIGKILL)
                        killed["run" if all_of_it else "worker"] += 1
            process.wait(PATIENCE)
            error = process.stderr.read()
        wait_until(lambda workers=workers: not any(map(running, workers)), 10.0)  # none is left behind
        if process.returncode == 0:
            break
        if process.returncode != -signal.SIGKILL:  # a worker was killed as it started, or one chunk has cost four
            assert process.returncode == 2
            assert "worker processes cannot start" in error or "all other chunks are done, and another run" in error
    assert killed.total() == kills
    assert main(command(folder, out)) == 0
    assert chunks_of(out) == chunks
    assert_same(open_map(out), whole)
    assert os.listdir(tmp_path / "many") == ["coat.zarr"]
