"""Benchmarks: ``throughput`` (times, beside numpy and peers), ``textured`` (maps of stacks, beside Mitsuba's textures),
``maps`` (fits of maps, texels a second, beside scipy),
``recovery`` (are errors and intervals honest?), ``calibration`` (are posteriors?), ``samplers`` (do they agree?),
``error-vs-time`` (every model against the truth, over the suite of stacks), ``references`` (the solver and the walk
beside PythonicDISORT and Mitsuba), ``statistics`` (directional statistics, lobe by lobe, beside the walk),
``spongecake`` (its multiple scattering beside the truth: held-out materials, energy, figures, fits), ``endf`` (thin
coats beside a walk of one bounce), ``rough-diffuse`` (rough diffuse surfaces beside each other), ``held-out`` (how well
stacks predict held-out measurements of real coatings), ``wrong-stacks`` (coverage of prediction intervals where a
simulated material is fitted by a wrong stack), ``pulls`` (whether instruments, mixtures and bins of tables give
parameters and honest errors), ``structures`` (whether a search finds the stack behind simulated data),
``accelerator`` (a GPU beside the processor) and ``side-by-side`` (which transport when: a page of docs from the results
of error-vs-time)."""

import argparse
import importlib
import os
import sys
import time
from pathlib import Path
from typing import Any

NAMES = ("throughput", "textured", "maps", "recovery", "calibration", "samplers", "error-vs-time", "references",
         "statistics", "spongecake", "endf", "rough-diffuse", "held-out", "wrong-stacks", "pulls", "structures",
         "accelerator", "side-by-side")  # fmt: skip

POSTERIORS = ("haze", "discrepancy", "banana", "degenerate", "bounded")


def main(arguments: list[str] | None = None) -> int:
    """Run a benchmark, print its tables, and write them with all figures into a directory."""
    parser = _parser()
    parsed = parser.parse_args(arguments)

    # before numpy is loaded: two threads on a 2,000 x 6 matrix only get into each other's way, and scipy pays for it
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import jax

    from fits.problem.compilation import devices_of_cores

    jax.config.update("jax_enable_x64", True)
    devices_of_cores()
    began = time.perf_counter()

    def report(line: str) -> None:
        print(f"[{time.perf_counter() - began:5.0f} s] {line}", file=sys.stderr, flush=True)

    try:
        options = _options(parsed)
    except ValueError as error:
        parser.error(str(error))
    study = importlib.import_module(f"benchmarks.studies.{parsed.benchmark.replace('-', '_')}").study
    text, paths = study(report=report, **options)
    print(text)
    report(f"written: {', '.join(map(str, paths))}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(dest="benchmark", required=True)
    for name in NAMES:
        command = commands.add_parser(name)
        command.add_argument("--quick", action="store_true", help="fewer repeats: a look, no result to quote")
        command.add_argument("--out", type=Path, help="directory to write into (default: benchmarks/results)")
    for name, named_peers in (
        ("throughput", "Mitsuba and Dr.Jit"),
        ("textured", "Mitsuba"),
        ("maps", "scipy"),
        ("references", "Mitsuba and PythonicDISORT"),
    ):
        commands.choices[name].add_argument("--no-peers", action="store_true", help=f"without {named_peers}")
    commands.choices["spongecake"].add_argument(
        "--work", type=Path, default=Path("spongecake-data"), help="folder for the truth of its materials"
    )
    compared = commands.choices["error-vs-time"]
    families = sorted({path.parent.name for path in (Path(__file__).parent / "suite").glob("*/*.toml")})
    compared.add_argument("--families", nargs="+", choices=families, help="of benchmarks/suite (default: all)")
    compared.add_argument("--stacks", nargs="+", metavar="STACK", help="of those families (default: all)")
    compared.add_argument("--truths", type=Path, metavar="DIR", help="results whose truths the models are held against")
    compared.add_argument("--models", nargs="+", metavar="MODEL", help="names as in the tables (default: all)")
    calibrated = commands.choices["calibration"]
    calibrated.add_argument("--repeats", type=int, metavar="N", help="how many there are to be in all")
    calibrated.add_argument(
        "--resolution", type=int, nargs=2, metavar=("NODES", "MODES"), help="of AddingDoubling (default: 6 6)"
    )
    calibrated.add_argument(
        "--posterior", choices=POSTERIORS, default="haze", help="which one: with all orders of scattering the first two"
    )
    for command in (
        compared,
        calibrated,
        commands.choices["samplers"],
        commands.choices["held-out"],
        commands.choices["wrong-stacks"],
        commands.choices["structures"],
    ):
        command.add_argument(
            "--resume", action="store_true", help="keep what the directory holds, and add what it lacks"
        )
    return parser


def _options(parsed: argparse.Namespace) -> dict[str, Any]:
    """Arguments of a study, from those of the command line; ValueError names an unknown family, stack or model."""
    options: dict[str, Any] = {"quick": parsed.quick}
    if parsed.out is not None:
        options["directory"] = parsed.out
    if parsed.benchmark in ("throughput", "textured", "maps", "references"):
        options["with_peers"] = not parsed.no_peers
    if parsed.benchmark == "spongecake":
        options["work"] = parsed.work
    if parsed.benchmark in ("error-vs-time", "calibration", "samplers", "held-out", "wrong-stacks", "structures"):
        options["resume"] = parsed.resume
    if parsed.benchmark == "error-vs-time":
        from benchmarks.studies.error_vs_time.models import named
        from benchmarks.suite.cases import load

        load(parsed.families, parsed.stacks)  # raises for unknown names
        options |= {name: getattr(parsed, name) for name in ("families", "stacks", "truths")}
        options["models"] = named(parsed.models)
    if parsed.benchmark == "calibration":
        from layerjax import AddingDoubling

        options |= {"repeats": parsed.repeats, "posterior": parsed.posterior}
        if parsed.resolution is not None:
            nodes, modes = parsed.resolution
            options["transport"] = AddingDoubling(nodes=nodes, modes=modes)
    return options


if __name__ == "__main__":
    sys.exit(main())
