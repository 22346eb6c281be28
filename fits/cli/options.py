"""Options that several commands have."""

import argparse
from typing import TYPE_CHECKING, Any

from fits.cli.numbers import angle, count, level

if TYPE_CHECKING:
    from fits.data.reading import ReadOptions

DATA = "measurements: csv, MERL .binary, .bsdf and others, see docs/formats.md"
MATERIAL = "result directory of `layerjax fit`, a stack (free parameters at their start), or a material of the gallery"
SELECTIONS = "incidence=10,50; plane=0; angle=-60:60; share=0.2; channel=red"


def command(commands: "argparse._SubParsersAction[Any]", name: str, what: str, example: str) -> argparse.ArgumentParser:
    """One of the commands: what it does, and an example."""
    return commands.add_parser(
        name, help=what, description=f"{what[0].upper()}{what[1:]}.", epilog=f"example: {example}"
    )


def add_read(parser: "argparse._ActionsContainer") -> None:
    """Options of the reader."""
    parser.add_argument(
        "--read",
        nargs="+",
        default=(),
        metavar="OPTION",
        help="options of the reader: format=merl; quantity=brdf, brdf_cos or reflectance_factor; bins=5000 or all, "
        "strata=flux (MERL, RGL); wavelengths=600,620 in nm, corrected=yes or no (.rxt); default: as the file says",
    )


def add_reading(parser: argparse.ArgumentParser) -> None:
    """How a measurement file is read and masked."""
    group = parser.add_argument_group("reading the data")
    add_read(group)
    group.add_argument(
        "--min-retro-angle", type=angle, metavar="DEG", help="mask measurements closer to retro-reflection"
    )
    group.add_argument("--max-polar-angle", type=angle, metavar="DEG", help="mask measurements farther from the normal")


def add_select(parser: argparse.ArgumentParser, what: str) -> None:
    """Which data are used."""
    parser.add_argument("--select", nargs="+", default=(), metavar="DATA", help=f"{what} only these data: {SELECTIONS}")


def add_hold_out(parser: argparse.ArgumentParser) -> None:
    """Which data are held out."""
    parser.add_argument(
        "--hold-out",
        nargs="+",
        default=(),
        metavar="DATA",
        help="hold these data out of the fit and score their prediction, such as incidence=30,70",
    )


def add_force(parser: argparse.ArgumentParser, what: str = "overwrite the file") -> None:
    """Leave to replace what is there."""
    parser.add_argument("--force", action="store_true", help=what)


def add_starts(parser: argparse.ArgumentParser) -> None:
    """Multi-start of a fit."""
    parser.add_argument("--starts", type=count, default=32, metavar="N", help="starting points (default: 32)")


def add_searching(parser: "argparse._ActionsContainer") -> None:
    """Which stacks are searched, and the noise model."""
    parser.add_argument("--library", metavar="TOML", help="layers and bases to choose from (default: built in)")
    parser.add_argument(
        "--noise", type=level, metavar="REL", help="relative noise beside the file's sigma (default: 0.05 without one)"
    )
    parser.add_argument(
        "--scale-sd", type=level, metavar="SD", help="relative standard deviation of the global scale (default: 0)"
    )


def read_options(arguments: argparse.Namespace) -> "ReadOptions":
    """How files are read, from the options that the command has."""
    from fits.data.reading import ReadOptions

    return ReadOptions.parse(
        arguments.read,
        min_retro_angle=getattr(arguments, "min_retro_angle", None),
        max_polar_angle=getattr(arguments, "max_polar_angle", None),
        select=tuple(getattr(arguments, "select", ())),
        hold_out=tuple(getattr(arguments, "hold_out", ())),
    )


def refuse_alone(arguments: argparse.Namespace, names: tuple[str, ...], needed: str) -> None:
    """ValueError for the first of these options that is given without the one that they belong to."""
    for name in names:
        if getattr(arguments, name) not in (None, ()):
            raise ValueError(f"--{name.replace('_', '-')} is given without --{needed}")
