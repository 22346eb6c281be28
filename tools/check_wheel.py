"""python -m tools.check_wheel: build the wheel, look into it, and use it as installed, outside the source tree."""

import argparse
import os
import subprocess
import sys
import tempfile
import venv
import zipfile
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("layerjax", "fits")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.check_wheel", description=__doc__)
    parser.add_argument(
        "--here", action="store_true", help="with the dependencies of this Python, not in a fresh environment"
    )
    here = parser.parse_args().here
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheel = build(folder)
        check_content(wheel)
        if here:
            site, python = folder / "site", sys.executable
            run(python, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(wheel))
            surroundings = {"PYTHONPATH": str(site)}  # before the editable install of this Python, if it has one
        else:
            site = folder / "venv"
            venv.create(site, with_pip=True)
            python, surroundings = str(site / "bin" / "python"), {}
            run(python, "-m", "pip", "install", "--quiet", str(wheel))
        script = folder / "smoke.py"
        script.write_text((ROOT / "tools" / "smoke.py").read_text())
        run(python, str(script), str(site), folder=folder, surroundings=surroundings)


def build(folder: Path) -> Path:
    """The wheel of the source tree, in `folder`."""
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT))
    (wheel,) = folder.glob("*.whl")
    return wheel


def check_content(wheel: Path) -> None:
    """It holds every file of both packages, tables and py.typed too, and nothing else."""
    with zipfile.ZipFile(wheel) as archive:
        files = {name for name in archive.namelist() if ".dist-info/" not in name}
    tracked = subprocess.run(
        ["git", "ls-files", "--", *PACKAGES], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    missing, others = set(tracked) - files, files - set(tracked)
    if missing or others:
        raise SystemExit(f"{wheel.name}: lacks {sorted(missing)}, holds {sorted(others)} besides")
    expected = {f"{package}/py.typed" for package in PACKAGES}
    if not expected <= files or not any(name.endswith(".npz") for name in files):
        raise SystemExit(f"{wheel.name}: no tables, or no py.typed")
    print(f"{wheel.name}: {len(files)} files, {wheel.stat().st_size / 1e6:.1f} MB")


def run(*command: str, folder: Path = ROOT, surroundings: Mapping[str, str] | None = None) -> None:
    """Run a command, its output shown; what fails ends this one."""
    # what this process was given to find the source tree by is not handed on
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run(command, cwd=folder, env={**inherited, **(surroundings or {})}, check=True)


if __name__ == "__main__":
    main()
