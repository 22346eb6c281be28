"""What an installed layerjax must do outside its source tree: python smoke.py SITE, SITE being where it is installed.

Run by `python -m tools.check_wheel`. Tables that were not shipped, missing modules and a missing command show here.
"""

import inspect
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Literal

import jax
import numpy as np

import fits
import layerjax as lj

jax.config.update("jax_enable_x64", True)

COAT = """
[[layers]]
kind = "Medium"
thickness = { start = 0.6, low = 0.1, high = 2.0 }
albedo = 0.9
phase = { kind = "HenyeyGreenstein", g = 0.5 }

[base]
kind = "Lambertian"
albedo = { start = 0.4, low = 0.0, high = 1.0 }
"""


def check_places(site: Path) -> None:
    """The packages are those that were installed, of the version that they say."""
    for package in (lj, fits):
        assert package.__file__ is not None
        assert site in Path(package.__file__).resolve().parents, f"{package.__file__} does not lie in {site}"
    assert metadata.version("layerjax") == lj.__version__


def check_transports() -> None:
    """Each gives finite values above 0, with the tables that it needs; small stacks, which compile in seconds."""
    haze = lj.Stack([lj.Medium(1.0, 0.9, lj.HenyeyGreenstein(0.5))], lj.Lambertian(0.5))
    varnish = lj.Stack([lj.Interface(1.5, 0.2)], lj.Lambertian(0.5))
    metal = lj.Stack([lj.Interface(1.5, 0.2)], lj.Conductor(0.2, 3.9, 0.3))
    porous = lj.Stack([], lj.VMFDiffuse(0.8, 0.5, form="all_orders"))
    cases: list[tuple[lj.Stack, lj.Transport | Literal["auto"]]] = [
        (haze, lj.SingleScattering()),
        (haze, lj.SpongeCake()),
        (haze, lj.AddingDoubling(nodes=4, modes=4)),
        (haze, lj.RandomWalk(paths=64)),
        (varnish, lj.Statistical(diffuse="lobe")),
        (metal, lj.ENDF()),
        (metal, lj.WeidlichWilkie()),
        (porous, "auto"),
    ]
    classes = [kind for kind in vars(lj).values() if inspect.isclass(kind) and issubclass(kind, lj.Transport)]
    concrete = {kind.__name__ for kind in classes if not inspect.isabstract(kind)}
    left_out = {type(transport).__name__ for _, transport in cases} ^ concrete
    assert left_out == {"str"}, left_out
    wi, wo = lj.direction(0.5, 0.0), lj.direction(np.array([0.2, 0.6]), np.array([3.1, 2.0]))
    for stack, transport in cases:
        values = lj.evaluate(stack, wi, wo, transport, side="reflection", key=jax.random.key(0))
        assert values.shape == (2, 1), (transport, values.shape)
        assert np.isfinite(values).all(), (transport, values)
        assert (np.asarray(values) > 0).all(), (transport, values)


def check_command(folder: Path) -> None:
    """A simulated file is fitted, and the result opened again."""
    (folder / "coat.toml").write_text(COAT)
    run(folder, "--help")
    assert run(folder, "--version").split() == ["layerjax", lj.__version__]
    run(folder, "simulate", "--stack", "coat.toml", "--noise", "0.01", "--out", "data.csv")
    run(folder, "fit", "data.csv", "--stack", "coat.toml", "--out", "result", "--starts", "2")
    fit = fits.load_fit(folder / "result")
    assert (np.abs(fit.vector - [0.6, 0.4]) < 5 * fit.errors).all(), fit.values
    assert (folder / "result" / "report.html").stat().st_size > 0


def run(folder: Path, *words: str) -> str:
    """Output of the `layerjax` command: the script itself where it is installed, else its module."""
    scripts = Path(sys.executable).with_name("layerjax")
    command = [str(scripts)] if scripts.exists() else [sys.executable, "-m", "fits.cli"]
    done = subprocess.run([*command, *words], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, f"layerjax {' '.join(words)}: {done.stderr}"
    return done.stdout


if __name__ == "__main__":
    check_places(Path(sys.argv[1]).resolve())
    check_transports()
    with tempfile.TemporaryDirectory() as name:
        check_command(Path(name))
    print(f"layerjax {lj.__version__} works as installed in {sys.argv[1]}")
