"""The `layerjax` command: its commands and options, its errors and exit codes.

Exit codes: 0 done; 1 done, but not to be relied on (a chain or a fit that did not converge); 2 bad input, bad usage, a
full disk or too little memory, named on stderr, with nothing written but what the same command resumes; 130
interrupted.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from io import TextIOWrapper
from typing import Any, NoReturn, TypeAlias

from fits.cli.interrupts import raised_again
from fits.cli.numbers import count, degrees, length, level, seed
from fits.cli.options import (
    DATA,
    MATERIAL,
    add_force,
    add_hold_out,
    add_read,
    add_reading,
    add_searching,
    add_select,
    add_starts,
    command,
)
from fits.cli.parser_many import add_fit_many
from fits.cli.parser_maps import add_fit_map
from fits.names import EXPORTS

MAX_MESSAGE = 1000
"""Characters of an error that are shown: JAX adds a table of all arrays to one of memory."""

Commands: TypeAlias = "argparse._SubParsersAction[Any]"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code; bad usage leaves through `SystemExit` as argparse does."""
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="replace")  # degrees and Greek are not in every encoding
    arguments = build_parser().parse_args(argv)

    try:
        from fits.cli import commands

        with raised_again():
            code = int(getattr(commands, arguments.command.replace("-", "_"))(arguments))
        sys.stdout.flush()  # while an error can still be reported
        return code
    except KeyboardInterrupt as interrupt:
        print(f"layerjax: interrupted{f': {interrupt}' if str(interrupt) else ''}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone, as in `layerjax info FILE | head`
        _end_output()
        return 0
    except Exception as error:
        _end_output()
        if arguments.traceback or not (isinstance(error, ValueError | OSError | OverflowError) or _of_memory(error)):
            raise  # an error of the program needs its traceback
        print(f"layerjax: error: {_one_line(error)}", file=sys.stderr)
        return 2


def _end_output() -> None:
    """Discards what cannot be written to stdout: Python would try again as it ends, and complain."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _of_memory(error: Exception) -> bool:
    """Whether memory was not enough; JAX has an error of its own for it."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" in str(error))


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    words = f"{' '.join(str(error).split()):.{MAX_MESSAGE}}" or type(error).__name__
    if _of_memory(error):
        return f"memory is not enough: {words}"
    return f"a number is too large: {words}" if isinstance(error, OverflowError) else words


def build_parser() -> argparse.ArgumentParser:
    """All commands and options; it imports nothing beyond the standard library."""
    parser = _Parser(
        prog="layerjax", description="Fit layered materials to measured reflectance, with honest uncertainty."
    )
    parser.add_argument("--version", action=_Version, help="print the version and exit")
    parser.add_argument("--traceback", action="store_true", help="show where an error comes from (for bug reports)")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (_fit, add_fit_map, _sample, _predict, _report, _compare, _search, add_fit_many):
        add(commands)
    for add in (_info, _convert, _simulate, _render, _export):
        add(commands)
    return parser


def _fit(commands: Commands) -> None:
    parser = command(
        commands,
        "fit",
        "fit a stack to measurements and write a result directory with a report",
        "layerjax fit slices.csv --stack coat.toml --out result --max-polar-angle 80 --hold-out incidence=30",
    )
    parser.add_argument("data", metavar="DATA", help=DATA)
    parser.add_argument("--stack", required=True, metavar="TOML", help="the stack, with its free parameters")
    parser.add_argument("--out", required=True, metavar="DIR", help="result directory to write")
    add_starts(parser)
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="random seed (default: %(default)s)")
    add_reading(parser)
    add_select(parser, "fit")
    add_hold_out(parser)
    add_force(parser, "replace DIR if it holds an earlier result")


def _sample(commands: Commands) -> None:
    parser = command(
        commands,
        "sample",
        "sample the posterior of a fit; run again, it resumes the chain",
        "layerjax sample result --ess 2000",
    )
    parser.add_argument("directory", metavar="DIR", help="result directory of `layerjax fit`")
    parser.add_argument(
        "--sampler", choices=("emcee", "nuts"), help="nuts: for many parameters (default: the chain's, or emcee)"
    )
    parser.add_argument(
        "--walkers", type=count, metavar="N", help="even number (default: the chain's, or 32; 4 chains of nuts)"
    )
    parser.add_argument(
        "--ess", type=count, metavar="N", help="effective sample size of every parameter (default: 1000)"
    )
    parser.add_argument("--max-steps", type=count, metavar="N", help="most steps (default: 20000)")
    parser.add_argument(
        "--allow-unconverged", action="store_true", help="report estimates from a chain that has not converged, too"
    )
    add_force(parser, "delete an earlier chain and start again")


def _predict(commands: Commands) -> None:
    parser = command(
        commands,
        "predict",
        "predict the BSDF and new measurements at other directions, or score the prediction of measurements",
        "layerjax predict result --incidence 30,70 --out predicted.csv",
    )
    parser.add_argument("directory", metavar="DIR", help="result directory of `layerjax fit`")
    parser.add_argument("--incidence", type=degrees, nargs="+", metavar="DEG", help="polar angles of the light")
    parser.add_argument(
        "--azimuth", type=float, nargs="+", metavar="DEG", help="planes; 0 is that of incidence (default)"
    )
    parser.add_argument("--score", metavar="FILE", help="in place of --incidence: measurements to predict and score")
    add_read(parser)
    add_select(parser, "score")
    parser.add_argument("--out", metavar="CSV", help="file to write; its name ends in .csv")
    add_force(parser)


def _report(commands: Commands) -> None:
    parser = command(
        commands,
        "report",
        "write the report and the pictures of a result directory again, or the report of a fitted map",
        "layerjax report result --compare other_result",
    )
    parser.add_argument("directory", metavar="DIR", help="result of `layerjax fit`, or store of `layerjax fit-map`")
    parser.add_argument("--compare", nargs="+", default=(), metavar="DIR2", help="results to compare on the same data")
    parser.add_argument("--out", metavar="HTML", help="file to write (default: in DIR, or beside the store of a map)")
    add_force(parser, "overwrite the file of --out, or the page of a map")


def _compare(commands: Commands) -> None:
    parser = command(
        commands,
        "compare",
        "compare fits of the same data by out-of-sample prediction",
        "layerjax compare coated bare --out comparison.html",
    )
    parser.add_argument("directories", nargs="+", metavar="DIR", help="two or more result directories")
    parser.add_argument("--out", metavar="HTML", help="write the comparison with its pictures to this file")
    parser.add_argument("--no-refit", action="store_true", help="rank by AIC, without cross-validation")
    add_force(parser)


def _search(commands: Commands) -> None:
    parser = command(
        commands,
        "search",
        "search for the stack behind data: stacks grow layer by layer and are ranked by out-of-sample prediction",
        "layerjax search slices.csv --out stacks --noise 0.03 --scale-sd 0.1",
    )
    parser.add_argument("data", metavar="DATA", help=DATA)
    parser.add_argument("--out", required=True, metavar="DIR", help="directory to write, or to resume")
    parser.add_argument(
        "--budget",
        type=level,
        metavar="MINUTES",
        help="begin no stack after this time, and report what was found; the same command resumes (default: none)",
    )
    parser.add_argument("--layers", type=int, default=3, metavar="N", help="most layers over the base (default: 3)")
    parser.add_argument("--instrument", metavar="TOML", help="a file with an [instrument], such as a stack file")
    add_searching(parser)
    add_reading(parser)


def _info(commands: Commands) -> None:
    parser = command(commands, "info", "say what is in a measurement file, and draw it", "layerjax info slices.csv")
    parser.add_argument("data", metavar="FILE", help=DATA)
    parser.add_argument("--out", metavar="PNG", help="picture (default: FILE's name as .png, in the current directory)")
    add_read(parser)
    add_force(parser, "overwrite the picture")


def _convert(commands: Commands) -> None:
    parser = command(
        commands,
        "convert",
        "write measurements as csv in this project's convention",
        "layerjax convert AnoBlackNiTEonSteel.bsdf steel.csv",
    )
    parser.add_argument("data", metavar="IN", help=DATA)
    parser.add_argument("out", metavar="OUT", help="file to write; its name ends in .csv")
    add_read(parser)
    add_force(parser)


def _simulate(commands: Commands) -> None:
    parser = command(
        commands,
        "simulate",
        "simulate goniometer measurements of a stack, with noise",
        "layerjax simulate --stack coat.toml --incidence 10 30 50 70 --noise 0.05 --out simulated.csv",
    )
    parser.add_argument(
        "--stack",
        required=True,
        metavar="TOML",
        help="the stack, free parameters at their start; its [noise], [scale] and [instrument] are not simulated",
    )
    parser.add_argument("--out", required=True, metavar="CSV", help="file to write; its name ends in .csv")
    for name, default, what in (
        ("--incidence", (10, 30, 50, 70), "polar angles of the light (default: 10 30 50 70)"),
        ("--azimuth", (0,), "planes; 0 is that of incidence (default)"),
    ):
        parser.add_argument(name, type=float, nargs="+", default=default, metavar="DEG", help=what)
    parser.add_argument("--noise", type=level, default=0.0, metavar="REL", help="relative noise (default: none)")
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="random seed (default: %(default)s)")
    add_force(parser)


def _render(commands: Commands) -> None:
    parser = command(
        commands,
        "render",
        "draw a material: spheres, lobes and a map of its BSDF",
        "layerjax render window_shade --out window_shade.png",
    )
    parser.add_argument("material", metavar="DIR|TOML|NAME", help=MATERIAL)
    parser.add_argument("--out", required=True, metavar="PNG", help="file to write; its name ends in .png")
    parser.add_argument("--size", type=count, default=256, metavar="N", help="pixels a sphere (default: %(default)s)")
    add_force(parser)


def _export(commands: Commands) -> None:
    parser = command(
        commands,
        "export",
        "write a material for renderers (Mitsuba, pbrt, MaterialX) or for optical design (Zemax, LightTools)",
        "layerjax export result --to rgl --out coat.bsdf",
    )
    parser.add_argument("material", metavar="DIR|TOML|NAME", help=MATERIAL)
    parser.add_argument(
        "--to", required=True, choices=EXPORTS, help="rgl: Mitsuba's and pbrt's tensor file; openpbr: MaterialX"
    )
    parser.add_argument("--out", required=True, metavar="FILE", help="file to write")
    parser.add_argument(
        "--wavelengths",
        type=length,
        nargs="+",
        metavar="NM",
        help="wavelengths of the channels, for a spectral rgl file",
    )
    add_force(parser)


class _Parser(argparse.ArgumentParser):
    """Reports an error in one line, as every other error of the command."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


class _Version(argparse.Action):
    """Prints the version; only then is the library imported."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str | None = None):
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from layerjax import __version__

        print(f"layerjax {__version__}")
        parser.exit()
