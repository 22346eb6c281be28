"""The commands of `layerjax` and their arguments; it imports nothing beyond the standard library."""

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn, TypeAlias

from fits.cli.numbers import angle, count, degrees, length, level, scale, seed
from fits.names import EXPORTS

Commands: TypeAlias = "argparse._SubParsersAction[Any]"
Arguments: TypeAlias = "argparse._ActionsContainer"

DATA = "measurements: csv, MERL .binary, .bsdf and others, see docs/formats.md"
MATERIAL = "result directory of `layerjax fit`, a stack (free parameters at their start), or a material of the gallery"
SELECTIONS = "incidence=10,50; plane=0; angle=-60:60; share=0.2; channel=red"

SHARED: dict[str, dict[str, Any]] = {
    "--stack": {"required": True, "metavar": "TOML", "help": "the stack, with its free parameters"},
    "--starts": {"type": count, "default": 32, "metavar": "N", "help": "starting points (default: %(default)s)"},
    "--seed": {"type": seed, "default": 0, "metavar": "S", "help": "random seed (default: %(default)s)"},
    "--force": {"action": "store_true", "help": "overwrite the file"},
    "--read": {
        "nargs": "+",
        "default": (),
        "metavar": "OPTION",
        "help": "options of the reader: format=merl; quantity=brdf, brdf_cos or reflectance_factor; bins=5000 or all, "
        "strata=flux (MERL, RGL); wavelengths=600,620 in nm, corrected=yes or no (.rxt); default: as the file says",
    },
    "--min-retro-angle": {"type": angle, "metavar": "DEG", "help": "mask measurements closer to retro-reflection"},
    "--max-polar-angle": {"type": angle, "metavar": "DEG", "help": "mask measurements farther from the normal"},
    "--select": {"nargs": "+", "default": (), "metavar": "DATA", "help": f"use only these data: {SELECTIONS}"},
    "--hold-out": {
        "nargs": "+",
        "default": (),
        "metavar": "DATA",
        "help": "hold these data out of the fit and score their prediction, such as incidence=30,70",
    },
    "--library": {"metavar": "TOML", "help": "layers and bases to choose from (default: built in)"},
    "--noise": {
        "type": level,
        "metavar": "REL",
        "help": "relative noise beside the file's sigma (default: 0.05 without one)",
    },
    "--scale-sd": {
        "type": level,
        "metavar": "SD",
        "help": "relative standard deviation of the global scale (default: 0)",
    },
}
"""Options of several commands."""


def build_parser() -> argparse.ArgumentParser:
    """All commands and options."""
    parser = _Parser(
        prog="layerjax", description="Fit layered materials to measured reflectance, with honest uncertainty."
    )
    parser.add_argument("--version", action=_Version, help="print the version and exit")
    parser.add_argument("--traceback", action="store_true", help="show where an error comes from (for bug reports)")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (_fit, _fit_map, _sample, _predict, _report, _compare, _search, _fit_many):
        add(commands)
    for add in (_info, _convert, _simulate, _render, _export):
        add(commands)
    return parser


def _command(commands: Commands, name: str, what: str, example: str) -> argparse.ArgumentParser:
    """One of the commands: what it does, and an example."""
    description = f"{what[0].upper()}{what[1:]}."
    return commands.add_parser(name, help=what, description=description, epilog=f"example: {example}")


def _add(parser: Arguments, *names: str, **changes: Any) -> None:
    """Shared options by name; changes: of what they have in common."""
    for name in names:
        parser.add_argument(name, **SHARED[name] | changes)


def _add_where(parser: Arguments) -> None:
    """Where work in parallel runs."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--processes", type=count, metavar="N", help="worker processes (default: one a core)")
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="dask.distributed cluster that sees the files, such as tcp://...:8786"
    )


def _fit(commands: Commands) -> None:
    what = "fit a stack to measurements and write a result directory with a report"
    example = "layerjax fit slices.csv --stack coat.toml --out result --max-polar-angle 80 --hold-out incidence=30"
    parser = _command(commands, "fit", what, example)
    parser.add_argument("data", metavar="DATA", help=DATA)
    parser.add_argument("--out", required=True, metavar="DIR", help="result directory to write")
    _add(parser, "--stack", "--starts", "--seed")
    _add(parser, "--read", "--min-retro-angle", "--max-polar-angle", "--select", "--hold-out")
    _add(parser, "--force", help="replace DIR if it holds an earlier result")


def _fit_map(commands: Commands) -> None:
    what = "fit a stack to every texel of a map and write a store with the parameters of each; resumes where it stopped"
    example = "layerjax fit-map coat.h5 --geometry view.csv --stack coat.toml --out coat.zarr --noise 0.02"
    parser = _command(commands, "fit-map", what, example)
    parser.add_argument(
        "data",
        metavar="DATA",
        help="BSDF (..., N, C) or (..., N) in 1/sr: .npy, HDF5 or zarr; file.h5:/name, store.zarr:/name of several",
    )
    _add(parser, "--stack")
    parser.add_argument("--out", required=True, metavar="STORE", help="store to write, or to resume; ends in .zarr")
    group = parser.add_argument_group("the measurements")
    group.add_argument(
        "--geometry",
        metavar="FILE",
        help="their directions: csv, or a file with wi and wo, or theta_i, phi_i, theta_o, phi_o in degrees "
        "(default: these stand beside DATA)",
    )
    group.add_argument("--sigma", metavar="FILE", help="their standard deviations, (..., N, C), (..., N) or (N)")
    group.add_argument("--mask", metavar="FILE", help="which texels are fitted, (...): 1, or 0 for those skipped")
    _add(group, "--noise", help="relative noise (default: what the stack file says)")
    group = parser.add_argument_group("the fit")
    _add(group, "--starts", default=8, help="of a texel of the pilot (default: %(default)s)")
    _add(group, "--seed")
    group.add_argument(
        "--pilot-texels", type=count, default=64, metavar="N", help="fitted first, from many starts (default: 64)"
    )
    group.add_argument("--chunk-size", type=count, default=1024, metavar="N", help="texels a task (default: 1024)")
    group.add_argument(
        "--emulator",
        choices=("auto", "always", "never"),
        default="auto",
        help="Chebyshev series over the bounds in place of the transport (default: where they are exact enough)",
    )
    group = parser.add_argument_group("a prior of neighbouring texels, beside the plain fit")
    group.add_argument(
        "--spatial-prior",
        choices=("gaussian", "total_variation"),
        help="gaussian: changes are gradual; total_variation: areas are even, edges stay (default: none)",
    )
    group.add_argument(
        "--spatial-scale",
        type=scale,
        nargs="+",
        metavar="[NAME=]X",
        help="of the difference between neighbours, as a share of the bounds, of all parameters or of NAME",
    )
    group.add_argument("--spatial-rounds", type=count, default=10, metavar="N", help="at most (default: 10)")
    _add_where(parser.add_argument_group("where it runs"))
    _add(parser, "--force", help="replace STORE if it holds the map of another fit, or is damaged")


def _sample(commands: Commands) -> None:
    what = "sample the posterior of a fit; run again, it resumes the chain"
    parser = _command(commands, "sample", what, "layerjax sample result --ess 2000")
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
    _add(parser, "--force", help="delete an earlier chain and start again")


def _predict(commands: Commands) -> None:
    what = "predict the BSDF and new measurements at other directions, or score the prediction of measurements"
    parser = _command(commands, "predict", what, "layerjax predict result --incidence 30,70 --out predicted.csv")
    parser.add_argument("directory", metavar="DIR", help="result directory of `layerjax fit`")
    parser.add_argument("--incidence", type=degrees, nargs="+", metavar="DEG", help="polar angles of the light")
    parser.add_argument(
        "--azimuth", type=float, nargs="+", metavar="DEG", help="planes; 0 is that of incidence (default)"
    )
    parser.add_argument("--score", metavar="FILE", help="in place of --incidence: measurements to predict and score")
    parser.add_argument("--out", metavar="CSV", help="file to write; its name ends in .csv")
    _add(parser, "--read", "--select", "--force")


def _report(commands: Commands) -> None:
    what = "write the report and the pictures of a result directory again, or the report of a fitted map"
    parser = _command(commands, "report", what, "layerjax report result --compare other_result")
    parser.add_argument("directory", metavar="DIR", help="result of `layerjax fit`, or store of `layerjax fit-map`")
    parser.add_argument("--compare", nargs="+", default=(), metavar="DIR2", help="results to compare on the same data")
    parser.add_argument("--out", metavar="HTML", help="file to write (default: in DIR, or beside the store of a map)")
    _add(parser, "--force", help="overwrite the file of --out, or the page of a map")


def _compare(commands: Commands) -> None:
    what = "compare fits of the same data by out-of-sample prediction"
    parser = _command(commands, "compare", what, "layerjax compare coated bare --out comparison.html")
    parser.add_argument("directories", nargs="+", metavar="DIR", help="two or more result directories")
    parser.add_argument("--out", metavar="HTML", help="write the comparison with its pictures to this file")
    parser.add_argument("--no-refit", action="store_true", help="rank by AIC, without cross-validation")
    _add(parser, "--force")


def _search(commands: Commands) -> None:
    what = "search for the stack behind data: stacks grow layer by layer and are ranked by out-of-sample prediction"
    parser = _command(commands, "search", what, "layerjax search slices.csv --out stacks --noise 0.03 --scale-sd 0.1")
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
    _add(parser, "--library", "--noise", "--scale-sd", "--read", "--min-retro-angle", "--max-polar-angle")


def _fit_many(commands: Commands) -> None:
    what = "fit every file of a folder by every one of several stacks, and write one table over all of them"
    example = "layerjax fit-many scans --stacks coat.toml bare.toml --out fitted --processes 8"
    parser = _command(commands, "fit-many", what, example)
    parser.add_argument("data", nargs="+", metavar="FOLDER|FILE", help="measurements, see docs/formats.md")
    parser.add_argument("--stacks", nargs="+", default=(), metavar="TOML", help="stacks, with their free parameters")
    parser.add_argument(
        "--out", required=True, metavar="DIR", help="directory to write, or to resume: DIR/FILE/STACK is a result"
    )
    _add_where(parser)
    _add(parser, "--starts", "--read", "--min-retro-angle", "--max-polar-angle", "--select", "--hold-out")
    group = parser.add_argument_group("searching for stacks")
    group.add_argument("--search", action="store_true", help="search for the stack behind each file as well")
    _add(group, "--library", "--noise", "--scale-sd")
    _add(parser, "--force", help="fit again where stack, settings or the content of the file have changed")


def _info(commands: Commands) -> None:
    parser = _command(commands, "info", "say what is in a measurement file, and draw it", "layerjax info slices.csv")
    parser.add_argument("data", metavar="FILE", help=DATA)
    parser.add_argument("--out", metavar="PNG", help="picture (default: FILE's name as .png, in the current directory)")
    _add(parser, "--read")
    _add(parser, "--force", help="overwrite the picture")


def _convert(commands: Commands) -> None:
    example = "layerjax convert AnoBlackNiTEonSteel.bsdf steel.csv"
    parser = _command(commands, "convert", "write measurements as csv in this project's convention", example)
    parser.add_argument("data", metavar="IN", help=DATA)
    parser.add_argument("out", metavar="OUT", help="file to write; its name ends in .csv")
    _add(parser, "--read", "--force")


def _simulate(commands: Commands) -> None:
    example = "layerjax simulate --stack coat.toml --incidence 10 30 50 70 --noise 0.05 --out simulated.csv"
    parser = _command(commands, "simulate", "simulate goniometer measurements of a stack, with noise", example)
    what = "the stack, free parameters at their start; its [noise], [scale] and [instrument] are not simulated"
    _add(parser, "--stack", help=what)
    parser.add_argument("--out", required=True, metavar="CSV", help="file to write; its name ends in .csv")
    for name, default, what in (
        ("--incidence", (10, 30, 50, 70), "polar angles of the light (default: 10 30 50 70)"),
        ("--azimuth", (0,), "planes; 0 is that of incidence (default)"),
    ):
        parser.add_argument(name, type=float, nargs="+", default=default, metavar="DEG", help=what)
    _add(parser, "--noise", default=0.0, help="relative noise (default: none)")
    _add(parser, "--seed", "--force")


def _render(commands: Commands) -> None:
    what = "draw a material: spheres, lobes and a map of its BSDF"
    parser = _command(commands, "render", what, "layerjax render window_shade --out window_shade.png")
    parser.add_argument("material", metavar="DIR|TOML|NAME", help=MATERIAL)
    parser.add_argument("--out", required=True, metavar="PNG", help="file to write; its name ends in .png")
    parser.add_argument("--size", type=count, default=256, metavar="N", help="pixels a sphere (default: %(default)s)")
    _add(parser, "--force")


def _export(commands: Commands) -> None:
    what = "write a material for renderers (Mitsuba, pbrt, MaterialX) or for optical design (Zemax, LightTools)"
    parser = _command(commands, "export", what, "layerjax export result --to rgl --out coat.bsdf")
    parser.add_argument("material", metavar="DIR|TOML|NAME", help=MATERIAL)
    parser.add_argument(
        "--to", required=True, choices=EXPORTS, help="rgl: Mitsuba's and pbrt's tensor file; openpbr: MaterialX"
    )
    parser.add_argument("--out", required=True, metavar="FILE", help="file to write")
    what = "wavelengths of the channels, for a spectral rgl file"
    parser.add_argument("--wavelengths", type=length, nargs="+", metavar="NM", help=what)
    _add(parser, "--force")


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
