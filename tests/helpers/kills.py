"""Commands killed at random moments and run again: `python -m tests.helpers.kills [TIMES] [DIR]` says how many resumed.

Each command runs once undisturbed, then so many times more (10), killed at a moment drawn from the time that the first
took and run again until it ends. What it leaves is the same then, to the last digit: all but seconds.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import fits
from fits.store import Store
from tests.helpers.coats import make_folder

ALBEDO, ALPHA = "albedo = { start = 0.5, low = 0.0, high = 1.0 }", "{ start = 0.3, low = 0.05, high = 1.0 }"
INDEX = "ior = { start = 1.5, low = 0.1, high = 5.0 }, k = { start = 2.0, low = 0.1, high = 8.0 }"
LIBRARY = f"""
[bases]
diffuse = {{ kind = "Lambertian", {ALBEDO} }}
rough = {{ kind = "OrenNayar", {ALBEDO}, roughness = {ALPHA} }}
metal = {{ kind = "Conductor", {INDEX}, alpha = {ALPHA} }}
[layers]
haze = {{ kind = "Medium", thickness = {{ start = 1.0, low = 0.05, high = 5.0 }}, albedo = 0.8 }}
"""
COMMANDS = {
    "sample": "sample result --ess 1500",
    "fit": "fit scans/coated.csv --stack coat.toml --out fitted --starts 400",
    "search": "search scans/paint.csv --out stacks --library library.toml --layers 0",
    "fit-many": "fit-many scans --stacks bare.toml coat.toml --out many --starts 20 --processes 2",
    "fit-map": "fit-map map.npy --geometry view.csv --stack coat.toml --out map.zarr --noise 0.03 --chunk-size 64 "
    "--processes 2",
}


def prepare(folder: Path) -> None:
    """The inputs of all commands."""
    make_folder(folder)
    (folder / "library.toml").write_text(LIBRARY)
    data = fits.read(folder / "scans/coated.csv")
    angles = np.stack([data.theta_i, data.phi_i, data.theta_o, data.phi_o], axis=1)
    head = "theta_i,phi_i,theta_o,phi_o"
    np.savetxt(folder / "view.csv", angles, delimiter=",", header=head, comments="")
    noise = 1.0 + 0.03 * np.random.default_rng(0).standard_normal((40, 40, *data.values.shape))
    np.save(folder / "map.npy", data.values * noise)
    run(folder, "fit scans/coated.csv --stack coat.toml --out result --starts 4").wait()


def run(folder: Path, words: str) -> "subprocess.Popen[bytes]":
    """The command in a process of its own."""
    with (folder / "log.txt").open("wb") as log:
        return subprocess.Popen([sys.executable, "-m", "fits.cli", *words.split()], cwd=folder, stdout=log, stderr=log)


def result(folder: Path, name: str) -> Any:
    """The numbers that a command has left, and what lies beside them."""
    beside = sorted(os.listdir(folder))
    if name == "sample":
        path = folder / "result/chain.db"
        blocks = Store.read(path).all("steps") if path.exists() else []
        return beside, b"".join(np.ascontiguousarray(block["coords"]).tobytes() for block in blocks)
    out = folder / {"fit": "fitted", "search": "stacks", "fit-many": "many", "fit-map": "map.zarr"}[name]
    found = [path for path in out.rglob("*" if name == "fit-map" else "fit.json") if path.is_file()]
    return beside, {str(path.relative_to(out)): path.read_bytes() for path in found}


def main(times: int = 10, where: str | None = None) -> int:
    """Prints a line a kill; the exit code is the number of those that were not resumed with the same result."""
    moments, failed = random.Random(0), 0
    with tempfile.TemporaryDirectory(dir=where) as base:
        inputs, whole, killed = (Path(base, name) for name in ("inputs", "whole", "killed"))
        inputs.mkdir()
        prepare(inputs)
        for name, words in COMMANDS.items():
            shutil.copytree(inputs, whole)
            begun = time.monotonic()
            code = run(whole, words).wait()
            seconds, expected = time.monotonic() - begun, result(whole, name)
            assert expected[1], (whole / "log.txt").read_text()  # else all would be the same
            done = 0
            while done < times:
                shutil.copytree(inputs, killed)
                process, moment = run(killed, words), moments.uniform(0.1, 1.0) * seconds
                time.sleep(moment)
                process.send_signal(signal.SIGKILL)
                # else it had ended before, but perhaps for what it prints
                if process.wait() == -signal.SIGKILL and result(killed, name)[1] != expected[1]:
                    done += 1
                    same = run(killed, words).wait() == code and result(killed, name) == expected
                    failed += not same
                    outcome = "the same" if same else "ANOTHER RESULT"
                    print(f"{name} {done}: killed after {moment:.1f} of {seconds:.1f} s, {outcome}", flush=True)
                shutil.rmtree(killed)
            shutil.rmtree(whole)
    print(f"{len(COMMANDS) * times - failed} of {len(COMMANDS) * times} resumed with the same result")
    return failed


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 10, *sys.argv[2:3]))
