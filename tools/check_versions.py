"""python -m tools.check_versions: the tests under every supported Python, with the lowest and the newest dependencies.

Lowest: every dependency that pyproject.toml names, at its lower bound, and what these need in turn as pip finds it.
Newest: what `pip install -e ".[test]"` finds. Without --all only tests that take a minute run, of imports, stacks,
values, files and fits.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SHORT = (
    "tests/test_imports.py",
    "tests/layerjax/test_stack.py",
    "tests/layerjax/test_reference_values.py",
    "tests/fits/data",
    "tests/fits/problem",
)
RUNNERS = ("pytest", "pytest-xdist", "hypothesis")
"""Packages of the extra "test" that running tests needs."""

BOUNDS = ("lowest", "newest")


def main() -> int:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    supported = [each.rsplit(" ", 1)[1] for each in project["classifiers"] if re.search(r":: 3\.\d+$", each)]
    parser = argparse.ArgumentParser(prog="python -m tools.check_versions", description=__doc__)
    parser.add_argument("--python", action="append", choices=supported, help="this version alone; may be repeated")
    parser.add_argument("--bounds", choices=BOUNDS, help="with these dependencies alone")
    parser.add_argument("--all", action="store_true", help="every test that `pytest` runs")
    given = parser.parse_args()
    outcomes: dict[str, bool] = {}
    for version in given.python or supported:
        python = interpreter(version)
        if python is None:
            print(f"Python {version}: none found, skipped", flush=True)
            continue
        for bounds in BOUNDS if given.bounds is None else (given.bounds,):
            name = f"Python {version}, {bounds} dependencies"
            print(f"{name}: {python}", flush=True)
            with tempfile.TemporaryDirectory() as folder:
                outcomes[name] = works(python, bounds, project, Path(folder), () if given.all else SHORT)
    for name, good in outcomes.items():
        print(f"{name}: {'passed' if good else 'FAILED'}")
    if not outcomes:
        print("no supported Python found: nothing was tested")
    return 0 if outcomes and all(outcomes.values()) else 1


def interpreter(version: str) -> str | None:
    """A Python of that version, on the PATH or of pyenv, that runs and can make environments."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    on_path = shutil.which(f"python{version}")
    installed = (str(path) for path in sorted(pyenv.glob(f"{version}.*/bin/python")))
    for python in (*([on_path] if on_path else []), *installed):
        code = "import sys, ensurepip; print('%d.%d' % sys.version_info[:2])"
        # a shim of pyenv stands on the PATH for versions that are not chosen, too, and fails
        done = subprocess.run([python, "-c", code], capture_output=True, text=True)
        if done.returncode == 0 and done.stdout.strip() == version:
            return python
    return None


def works(python: str, bounds: str, project: dict[str, Any], folder: Path, tests: tuple[str, ...]) -> bool:
    """Whether the tests pass in a fresh environment, made in `folder`."""
    subprocess.run([python, "-m", "venv", str(folder)], check=True)
    own = str(folder / "bin" / "python")
    install = [own, "-m", "pip", "install", "--quiet"]
    if bounds == "lowest":
        commands = [[*install, *lowest(project)], [*install, "--no-deps", "-e", str(ROOT)]]
    else:
        commands = [[*install, "-e", f"{ROOT}[test]"]]
    # notices of what lowest versions use of each other are no errors of ours
    allowed = ["-W", "ignore::DeprecationWarning"] if bounds == "lowest" else []
    commands.append([own, "-m", "pytest", *allowed, *tests])
    return all(subprocess.run(command, cwd=ROOT).returncode == 0 for command in commands)


def lowest(project: dict[str, Any]) -> Iterator[str]:
    """Requirements that pin what the project needs, and what runs its tests, to the lower bounds."""
    for kind, requirements in (("needed", project["dependencies"]), ("test", project["optional-dependencies"]["test"])):
        for requirement in requirements:
            if requirement.startswith(f"{project['name']}["):  # the site is built with the newest alone
                continue
            found = re.match(r"([\w-]+)>=([\w.]+)", requirement)
            if found is None:
                raise SystemExit(f"pyproject.toml: {requirement!r} has no lower bound")
            if kind == "needed" or found[1] in RUNNERS:
                yield f"{found[1]}=={found[2]}"


if __name__ == "__main__":
    sys.exit(main())
