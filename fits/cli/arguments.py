"""The commands of `layerjax` and their arguments; it imports nothing beyond the standard library."""

import argparse
import math
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, NamedTuple, NoReturn

from fits.names import EXPORTS

# ---- what may stand there ----


def _number(kind: type[int] | type[float], low: float, high: float = math.inf) -> Callable[[str], Any]:
    """What reads a number of this kind and range."""
    span = f">= {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
    allowed = f"{'a whole number' if kind is int else 'a number'} {span}"

    def read(word: str) -> Any:
        try:
            value = kind(word)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{word!r} given, must be {allowed}") from None
        if not low <= value <= high or value == math.inf:
            raise argparse.ArgumentTypeError(f"{word} given, must be {allowed}")
        return value

    return read


count, level, share = _number(int, 1), _number(float, 0.0), _number(float, 0.0, 1.0)
angle, polar, azimuth = (_number(float, *ends) for ends in ((0.0, 90.0), (0.0, 180.0), (-360.0, 360.0)))

Settings = dict[str, Any]


def _one(what: str, metavar: str | None = None, **settings: Any) -> Settings:
    """Settings of an argument; what: its help."""
    return {"help": what} | ({} if metavar is None else {"metavar": metavar}) | settings


def _several(what: str, metavar: str, **settings: Any) -> Settings:
    return _one(what, metavar, nargs="+", **{"default": ()} | settings)


def _numbers(what: str, metavar: str, number: Callable[[str], Any]) -> Settings:
    """Those of several numbers, with commas between them."""

    def read(words: str) -> list[Any]:
        return [number(word) for word in words.split(",")]

    return _one(what, metavar, type=read)


def _flag(what: str) -> Settings:
    return _one(what, action="store_true")


def _out(metavar: str, what: str = "file to write", required: bool = True) -> Settings:
    return _one(what, metavar, required=required)


DATA = _one("measurements: csv, MERL .binary, .bsdf and others, see docs/formats.md", "DATA")
RESULT = _one("result directory of `layerjax fit`", "DIR")
MATERIAL = _one("result directory, stack (free parameters at their start), or material of the gallery", "DIR|TOML|NAME")
INCIDENCE = _numbers("polar angles of the light", "DEG,...", polar)
AZIMUTH = _numbers("planes; 0 is that of incidence (default)", "DEG,...", azimuth)
READ_HELP = (
    "options of the reader: format=merl; quantity=brdf, brdf_cos or reflectance_factor; bins=5000 or all, strata=flux "
    "(MERL, RGL); wavelengths=600,620 in nm, corrected=yes or no (.rxt); default: as the file says"
)

OPTIONS: dict[str, Settings] = {
    "--stack": _one("the stack, with its free parameters", "TOML", required=True),
    "--starts": _one("starting points (default: %(default)s)", "N", type=count, default=32),
    "--seed": _one("random seed (default: %(default)s)", "S", type=_number(int, 0, 2**32 - 1), default=0),
    "--force": _flag("overwrite the file"),
    "--read": _several(READ_HELP, "OPTION"),
    "--min-retro-angle": _one("mask measurements closer to retro-reflection", "DEG", type=angle),
    "--max-polar-angle": _one("mask measurements farther from the normal", "DEG", type=angle),
    "--select": _several("use only these data: incidence=10,50; azimuth=0; theta_o=20:60; channels=red", "DATA"),
    "--hold-out": _several("hold these data out and score their prediction, such as incidence=30,70", "DATA"),
    "--library": _one("layers and bases to choose from (default: built in)", "TOML"),
    "--noise": _one("relative noise beside the file's sigma (default: 0.05 without one)", "REL", type=share),
    "--scale-sd": _one("relative standard deviation of the global scale (default: 0)", "SD", type=level),
    "--processes": _one("worker processes (default: threads of a single one)", "N", type=count, default=1),
    "--scheduler": _one("in place of --processes: dask.distributed cluster, such as tcp://...:8786", "ADDRESS"),
}
"""Options of several commands; `COMMANDS` says what differs."""


class Command(NamedTuple):
    """What a command does, an example, its own arguments, and those of `OPTIONS`, which may have another help."""

    what: str
    example: str
    particular: dict[str, Settings]
    shared: str
    changes: Mapping[str, Settings] = MappingProxyType({})


_READ = "--read --min-retro-angle --max-polar-angle"

COMMANDS = {
    "fit": Command(
        "fit a stack to measurements and write a result directory with a report",
        "layerjax fit slices.csv --stack coat.toml --out result --max-polar-angle 80 --hold-out incidence=30",
        {"data": DATA, "--out": _out("DIR", "result directory to write")},
        f"--stack --starts --seed {_READ} --select --hold-out --force",
        {"--force": {"help": "replace DIR if it holds an earlier result"}},
    ),
    "fit-map": Command(
        "fit a stack to every texel of a map and write a store with the parameters of each; resumes where it stopped",
        "layerjax fit-map coat.h5 --geometry view.csv --stack coat.toml --out coat.zarr --noise 0.02",
        {
            "data": _one("BSDF (..., N, C) or (..., N) in 1/sr: .npy, HDF5 or zarr (file.h5:/name of several)", "DATA"),
            "--out": _out("STORE", "store to write, or to resume; ends in .zarr"),
            "--geometry": _one("directions: csv, or a file with wi and wo or angles (default: beside DATA)", "FILE"),
            "--sigma": _one("their standard deviations, (..., N, C), (..., N) or (N)", "FILE"),
            "--mask": _one("which texels are fitted, (...): 1, or 0 for those skipped", "FILE"),
            "--pilot-texels": _one("fitted first, from many starts (default: 64)", "N", type=count, default=64),
            "--chunk-size": _one("texels a task (default: 1024)", "N", type=count, default=1024),
            "--emulator": _one(
                "Chebyshev series in place of the transport", choices=("auto", "always", "never"), default="auto"
            ),
            "--spatial-prior": _one(
                "prior of differences between texels: gradual changes, or even areas with edges",
                choices=("gaussian", "total_variation"),
            ),
            "--spatial-scale": _one("scale of these differences, as a share of the bounds", "X", type=level),
        },
        "--stack --noise --starts --seed --processes --scheduler --force",
        {
            "--noise": {"help": "relative noise (default: what the stack file says)"},
            "--starts": {"default": 8, "help": "starting points of a texel of the pilot (default: %(default)s)"},
            "--force": {"help": "replace STORE if it holds the map of another fit, or is damaged"},
        },
    ),
    "sample": Command(
        "sample the posterior of a fit; run again, it resumes the chain",
        "layerjax sample result --ess 2000",
        {
            "directory": RESULT,
            "--sampler": _one("nuts: for many parameters (default: the chain's, or emcee)", choices=("emcee", "nuts")),
            "--walkers": _one("even number (default: the chain's, or 32; 4 chains of nuts)", "N", type=count),
            "--ess": _one("effective sample size of every parameter (default: 1000)", "N", type=count),
            "--max-steps": _one("most steps (default: 20000)", "N", type=count),
            "--allow-unconverged": _flag("report estimates from a chain that has not converged, too"),
        },
        "--force",
        {"--force": {"help": "delete an earlier chain and start again"}},
    ),
    "predict": Command(
        "predict the BSDF and new measurements at other directions, or score the prediction of measurements",
        "layerjax predict result --incidence 30,70 --out predicted.csv",
        {
            "directory": RESULT,
            "--incidence": INCIDENCE,
            "--azimuth": AZIMUTH,
            "--score": _one("in place of --incidence: measurements to predict and score", "FILE"),
            "--out": _out("CSV", "file to write; its name ends in .csv", required=False),
        },
        "--read --select --force",
    ),
    "report": Command(
        "write the report of a result directory again, or that of a fitted map",
        "layerjax report result --compare other_result",
        {
            "directory": RESULT | {"help": "result directory of `layerjax fit`, or store of `layerjax fit-map`"},
            "--compare": _several("results to compare on the same data", "DIR2"),
            "--out": _out("HTML", "file to write (default: in DIR, or beside the store of a map)", required=False),
        },
        "--force",
        {"--force": {"help": "overwrite the file of --out, or the page of a map"}},
    ),
    "compare": Command(
        "compare fits of the same data by out-of-sample prediction",
        "layerjax compare coated bare",
        {
            "directories": _several("two or more result directories", "DIR"),
            "--no-refit": _flag("rank by AIC, without cross-validation"),
        },
        "",
    ),
    "search": Command(
        "search for the stack behind data: stacks grow layer by layer and are ranked by out-of-sample prediction",
        "layerjax search slices.csv --out stacks --noise 0.03 --scale-sd 0.1",
        {
            "data": DATA,
            "--out": _out("DIR", "directory to write, or to resume"),
            "--layers": _one("most layers over the base (default: 3)", "N", type=int, default=3),
            "--instrument": _one("a file with an [instrument], such as a stack file", "TOML"),
        },
        f"--library --noise --scale-sd {_READ}",
    ),
    "fit-many": Command(
        "fit every file of a folder by every one of several stacks, and write one table over all of them",
        "layerjax fit-many scans --stacks coat.toml bare.toml --out fitted --processes 8",
        {
            "data": _several("measurements, see docs/formats.md", "FOLDER|FILE"),
            "--stacks": _several("stacks, with their free parameters", "TOML"),
            "--out": _out("DIR", "directory to write, or to resume: DIR/FILE/STACK is a result"),
        },
        f"--processes --scheduler --starts {_READ} --select --hold-out --force",
        {"--force": {"help": "fit again where stack, settings or the content of the file have changed"}},
    ),
    "info": Command(
        "say what is in a measurement file, and draw it",
        "layerjax info slices.csv",
        {"data": DATA, "--out": _out("PNG", "picture (default: the file's name as .png, here)", required=False)},
        "--read --force",
    ),
    "convert": Command(
        "write measurements as csv in this project's convention",
        "layerjax convert AnoBlackNiTEonSteel.bsdf steel.csv",
        {"data": DATA, "out": _one("file to write; its name ends in .csv", "OUT")},
        "--read --force",
    ),
    "simulate": Command(
        "simulate goniometer measurements of a stack, with noise",
        "layerjax simulate --stack coat.toml --incidence 10,30,50,70 --noise 0.05 --out simulated.csv",
        {
            "--out": _out("CSV", "file to write; its name ends in .csv"),
            "--incidence": INCIDENCE | {"default": (10, 30, 50, 70)},
            "--azimuth": AZIMUTH | {"default": (0,)},
        },
        "--stack --noise --seed --force",
        {
            "--stack": {"help": "free parameters at their start; [noise], [scale], [instrument] are not simulated"},
            "--noise": {"default": 0.0, "help": "relative noise (default: none)"},
        },
    ),
    "render": Command(
        "draw a material: spheres, lobes and a map of its BSDF",
        "layerjax render window_shade --out window_shade.png",
        {
            "material": MATERIAL,
            "--out": _out("PNG", "file to write; its name ends in .png"),
            "--size": _one("pixels a sphere (default: %(default)s)", "N", type=count, default=256),
        },
        "--force",
    ),
    "export": Command(
        "write a material for renderers (Mitsuba, pbrt, MaterialX) or for optical design (Zemax, LightTools)",
        "layerjax export result --to rgl --out coat.bsdf",
        {
            "material": MATERIAL,
            "--to": _one("rgl: Mitsuba's and pbrt's tensor file; openpbr: MaterialX", choices=EXPORTS, required=True),
            "--out": _out("FILE"),
            "--wavelengths": _numbers("of the channels, for a spectral rgl file", "NM,...", _number(float, 1.0, 1e9)),
        },
        "--force",
    ),
}


def build_parser() -> argparse.ArgumentParser:
    """All commands and options."""
    about = "Fit layered materials to measured reflectance, with honest uncertainty."
    parser = _Parser(prog="layerjax", description=about)
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    parser.add_argument("--traceback", action="store_true", help="show where an error comes from (for bug reports)")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for name, (what, example, particular, shared, changes) in COMMANDS.items():
        description = f"{what[0].upper()}{what[1:]}."
        command = commands.add_parser(name, help=what, description=description, epilog=f"example: {example}")
        for argument, settings in particular.items():
            command.add_argument(argument, **settings)
        exclusive: argparse._MutuallyExclusiveGroup | None = None
        for option in shared.split():
            group: Any = command
            if option in ("--processes", "--scheduler"):  # some versions of Python show no help of an empty group
                group = exclusive = exclusive or command.add_mutually_exclusive_group()
            group.add_argument(option, **OPTIONS[option] | changes.get(option, {}))
    return parser


class _Parser(argparse.ArgumentParser):
    """Reports an error in one line, as every other error of the command; of flags first one that there is not."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        flags = () if self._subparsers else [word.partition("=")[0] for word in args or () if word.startswith("--")]
        for flag in flags:
            if not any(option.startswith(flag) for option in self._option_string_actions):
                near = get_close_matches(flag, self._option_string_actions, 1)
                self.error(f"unrecognized argument: {flag}{f'; is it {near[0]}?' if near else ''}")
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")
