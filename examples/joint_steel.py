"""One coating, two measurements: a black coat on steel in the plane of incidence and over the hemisphere.

    python examples/joint_steel.py --out DIR

Both were measured at 650 nm by the same laboratory, in separate sessions. The stack is common to them; calibration and
model discrepancy are separate for each data set. Prints the separate fits beside the joint fit, and writes a report of
each part of the joint fit.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import fits

HERE = Path(__file__).parent
COATINGS = HERE / "arizona_black_coatings"
DATA = {part: COATINGS / f"nite_on_blasted_steel1008_650nm_{part}.csv" for part in ("inplane", "hemisphere")}
STACK = HERE / "flake_coat_over_conductor.toml"
SHARED = ("layers", "base")
STARTS = 8


def problems(data=None):
    """A problem for each data set: the same stack, a separate calibration."""
    problem = fits.read_problem(STACK)
    data = data or {part: fits.read(path) for part, path in DATA.items()}
    return {
        part: fits.Problem(problem.stack, measurements, problem.transport, problem.noise, problem.scale)
        for part, measurements in data.items()
    }


def progress(stage, done, total=None, info=""):
    if total is None or done == total:
        print(f"  {stage}: {done} {info}", flush=True)


def shown(fit, name):
    """A value with its error, as the table has it."""
    if name not in fit.values:
        return "-"
    value, error = fit.values[name], fit.standard_errors[name]
    return f"{value:.4g} ± {error:.2g}" if np.isfinite(error) else f"{value:.4g}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("joint_steel"), help="folder for the reports")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)

    parts = problems()
    separate = {}
    for part, problem in parts.items():
        print(f"{part} only: {problem.count} measurements", flush=True)
        separate[part] = fits.fit(problem.stack, problem.data, noise=problem.noise, scale=problem.scale, starts=STARTS)
    print("joint fit", flush=True)
    joint = fits.fit(fits.Joint(parts, shared=SHARED), starts=STARTS, progress=progress)

    table = Table(title="A black coat on steel", box=None)
    for heading in ("parameter", *(f"{part} only" for part in parts), "joint fit"):
        table.add_column(heading)
    for name in joint.values:
        part, _, own = name.partition(".")
        cells = [shown(one, name if part not in parts else own if part == key else "") for key, one in separate.items()]
        table.add_row(name, *cells, shown(joint, name))
    table.add_row(
        "chi-square / dof",
        *(f"{one.reduced_chi_square:.2f}" for one in separate.values()),
        f"{joint.reduced_chi_square:.2f}",
    )
    Console(width=140).print(table)
    print(joint.status)
    for part in parts:
        fits.report(joint.part(part), path=out / f"{part}.html")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
