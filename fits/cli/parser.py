"""The `layerjax` command: what may be asked for, and how it ends.

Exit codes: 0 done; 1 done, but not to be relied on (a chain that is too short, a fit that did not converge); 2 bad
input, bad usage, a full disk or too little memory, named on stderr, with nothing written but what the same command goes
on with; 130 interrupted.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from io import TextIOWrapper
from typing import NoReturn

from fits.cli.interrupts import raised_again
from fits.cli.numbers import count, degrees, length, level, seed
from fits.cli.options import (
    add_fitting,
    add_force,
    add_format,
    add_hold_out,
    add_only,
    add_reading,
    add_sampling,
    add_searching,
    command,
)
from fits.cli.parser_many import add_fit_many
from fits.cli.parser_maps import add_fit_map
from fits.names import EXPORTS

MOST_LETTERS = 1000
"""Of an error: JAX adds a table of all that it holds to one of memory."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit code; bad usage leaves through `SystemExit` as argparse does."""
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="replace")  # degrees and Greek are not in every encoding
    arguments = build_parser().parse_args(argv)

    try:
        from fits.cli import commands

        with raised_again():
            code = int(getattr(commands, arguments.command.replace("-", "_"))(arguments))
        sys.stdout.flush()  # here, where a full disk or a reader that has gone can still be told
        return code
    except KeyboardInterrupt as interrupt:
        print(f"layerjax: interrupted{f': {interrupt}' if str(interrupt) else ''}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone, as in `layerjax info FILE | head`
        _end_output()
        return 0
    except Exception as error:
        _end_output()
        if arguments.traceback or not _is_of_input(error):
            raise
        print(f"layerjax: error: {_one_line(error)}", file=sys.stderr)
        return 2


def _end_output() -> None:
    """What cannot be written to stdout goes nowhere: Python would try again as it ends, and complain."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def build_parser() -> argparse.ArgumentParser:
    """All commands and options; it imports nothing beyond the standard library."""
    parser = _Parser(
        prog="layerjax", description="Fit layered materials to measured reflectance, with honest uncertainty."
    )
    parser.add_argument("--version", action=_Version, help="print the version and exit")
    parser.add_argument("--traceback", action="store_true", help="show where an error comes from (for bug reports)")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (
        _add_fit,
        add_fit_map,
        _add_sample,
        _add_predict,
        _add_report,
        _add_compare,
        _add_search,
        add_fit_many,
        _add_info,
        _add_convert,
        _add_simulate,
        _add_render,
        _add_export,
    ):
        add(commands)
    return parser


def _add_fit(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "fit",
        "fit a stack to measured data and write a result directory with a report",
        "layerjax fit slices.csv --stack coat.toml --out result --mask-grazing 80 --starts 32",
    )
    parser.add_argument(
        "data", metavar="DATA", help="measurements: csv, MERL .binary, .bsdf and others, see docs/formats.md"
    )
    parser.add_argument("--stack", required=True, metavar="TOML", help="the stack, with its free parameters")
    parser.add_argument("--out", required=True, metavar="DIR", help="result directory to write")
    add_fitting(parser)
    add_reading(parser)
    add_only(parser, "fit")
    add_hold_out(parser)
    parser.add_argument("--sample", action="store_true", help="sample the posterior as well (see `layerjax sample`)")
    add_sampling(parser)
    add_force(parser, "replace DIR if it holds an earlier result")


def _add_sample(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "sample",
        "sample the posterior of a fit; goes on where it stopped when it is run again",
        "layerjax sample result --walkers 32 --max-steps 50000",
    )
    parser.add_argument("directory", metavar="DIR", help="result directory of `layerjax fit`")
    add_sampling(parser)
    parser.add_argument("--seed", type=seed, metavar="S", help="seed (default: the chain's, or 0)")
    add_force(parser, "throw an earlier chain away and start again")


def _add_predict(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "predict",
        "predict readings elsewhere from a saved result, or score readings",
        "layerjax predict result --incidence 30,70 --out predicted.csv",
    )
    parser.add_argument("directory", metavar="DIR", help="result directory of `layerjax fit`")
    parser.add_argument("--incidence", type=degrees, nargs="+", metavar="DEG", help="polar angles of the light")
    parser.add_argument(
        "--azimuth", type=float, nargs="+", metavar="DEG", help="planes; 0 holds the light (default: 0)"
    )
    parser.add_argument("--at", metavar="FILE", help="in place of --incidence: readings, whose prediction is scored")
    add_format(parser)
    add_only(parser, "predict")
    parser.add_argument("--out", metavar="CSV", help="file to write; its name ends in .csv")
    add_force(parser, "overwrite the file")


def _add_report(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "report",
        "write the report and the pictures of a result directory again, or the report of a fitted map",
        "layerjax report result --compare other_result",
    )
    parser.add_argument(
        "directory", metavar="DIR", help="result directory of `layerjax fit`, or the store of `layerjax fit-map`"
    )
    parser.add_argument(
        "--compare", nargs="+", default=(), metavar="DIR2", help="results for the same data to compare with"
    )
    parser.add_argument(
        "--out",
        metavar="HTML",
        help="write the report to this file, and leave DIR as it is (default of a map: beside it)",
    )
    add_force(parser, "overwrite the file of --out, or the page beside a map")


def _add_compare(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "compare",
        "compare fits of the same data: which stack explains it",
        "layerjax compare coated bare --out comparison.html",
    )
    parser.add_argument("directories", nargs="+", metavar="DIR", help="two or more result directories")
    parser.add_argument("--out", metavar="HTML", help="write the comparison with its pictures to this file")
    parser.add_argument(
        "--refit",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="fit each again without each incidence, and rank by what they foretell of it (default); else by AIC",
    )
    add_force(parser, "overwrite the file")


def _add_search(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "search",
        "look for the stack behind data: stacks grow layer by layer, and are ranked by what they foretell",
        "layerjax search slices.csv --out stacks --noise 0.03 --calibration 0.1",
    )
    parser.add_argument(
        "data", metavar="DATA", help="measurements: csv, MERL .binary, .bsdf and others, see docs/formats.md"
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="directory to write, or to resume")
    parser.add_argument(
        "--budget",
        type=level,
        metavar="MINUTES",
        help="begin no stack after this time, and report what was found; the same command resumes (default: none)",
    )
    add_searching(parser)
    parser.add_argument("--starts", type=count, default=8, metavar="N", help="of each fit (default: %(default)s)")
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="seed of the starts (default: %(default)s)")
    add_reading(parser)


def _add_info(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "info",
        "say what is in a measurement file, and draw it",
        "layerjax info slices.csv",
    )
    parser.add_argument(
        "data", metavar="FILE", help="measurements: csv, MERL .binary, .bsdf and others, see docs/formats.md"
    )
    parser.add_argument(
        "--out", metavar="PNG", help="picture to draw (default: FILE's name as .png, in the current directory)"
    )
    add_reading(parser)
    add_force(parser, "overwrite the picture")


def _add_convert(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "convert",
        "write measurements as csv in this project's convention",
        "layerjax convert AnoBlackNiTEonSteel.bsdf steel.csv",
    )
    parser.add_argument(
        "data", metavar="IN", help="measurements: csv, MERL .binary, .bsdf and others, see docs/formats.md"
    )
    parser.add_argument("out", metavar="OUT", help="file to write; its name ends in .csv")
    add_reading(parser)
    add_force(parser, "overwrite the file")


def _add_simulate(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "simulate",
        "write what a goniometer would measure of a stack, with noise",
        "layerjax simulate --stack coat.toml --incidence 10 30 50 70 --noise 0.05 --out simulated.csv",
    )
    parser.add_argument(
        "--stack",
        required=True,
        metavar="TOML",
        help="the stack, free parameters at their start; its [noise], [scale] and [instrument] are left out",
    )
    parser.add_argument("--out", required=True, metavar="CSV", help="file to write; its name ends in .csv")
    parser.add_argument(
        "--incidence", type=float, nargs="+", default=(10, 30, 50, 70), metavar="DEG", help="(default: 10 30 50 70)"
    )
    parser.add_argument(
        "--azimuth", type=float, nargs="+", default=(0,), metavar="DEG", help="planes; 0 holds the light (default: 0)"
    )
    parser.add_argument("--noise", type=level, default=0.0, metavar="REL", help="relative noise (default: none)")
    parser.add_argument("--floor", type=level, default=0.0, metavar="ABS", help="absolute noise, 1/sr (default: none)")
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="seed of the noise (default: %(default)s)")
    add_force(parser, "overwrite the file")


def _add_render(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "render",
        "draw a material: spheres, lobes and a map of its BSDF",
        "layerjax render window_shade --out window_shade.png",
    )
    parser.add_argument(
        "material",
        metavar="DIR|TOML|NAME",
        help="result directory of `layerjax fit`, a stack (free parameters at their start), or one of the gallery",
    )
    parser.add_argument("--out", required=True, metavar="PNG", help="file to write; its name ends in .png")
    parser.add_argument(
        "--size", type=count, default=256, metavar="N", help="pixels a sphere, 16 to 1024 (default: %(default)s)"
    )
    add_force(parser, "overwrite the file")


def _add_export(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = command(
        commands,
        "export",
        "write a material for renderers (Mitsuba, pbrt, MaterialX) or for optical design (Zemax, LightTools)",
        "layerjax export result --to rgl --out coat.bsdf",
    )
    parser.add_argument(
        "material",
        metavar="DIR|TOML|NAME",
        help="result directory of `layerjax fit`, a stack (free parameters at their start), or one of the gallery",
    )
    parser.add_argument(
        "--to", required=True, choices=EXPORTS, help="rgl: Mitsuba's and pbrt's tensor file; openpbr: MaterialX"
    )
    parser.add_argument("--out", required=True, metavar="FILE", help="file to write")
    parser.add_argument(
        "--wavelengths", type=length, nargs="+", metavar="NM", help="of the channels: an rgl file is spectral then"
    )
    add_force(parser, "overwrite the file")


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, as every other error of the command."""

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


def _is_of_input(error: Exception) -> bool:
    """Whether it is of what was given, or of the machine; of a fault of the program a traceback tells."""
    return isinstance(error, ValueError | OSError | OverflowError) or _is_of_memory(error)


def _is_of_memory(error: Exception) -> bool:
    """JAX says it by the words of an error of its own."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" in str(error))


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    words = f"{' '.join(str(error).split()):.{MOST_LETTERS}}" or type(error).__name__
    if _is_of_memory(error):
        return f"memory is not enough: {words}"
    return f"a number is too large: {words}" if isinstance(error, OverflowError) else words
