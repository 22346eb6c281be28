"""Options that several commands have."""

import argparse
from typing import Any

from fits.cli.numbers import angle, count, interval, level, seed
from fits.names import FORMATS, OBJECTIVES, QUANTITIES, STRATA

MAX_STEPS = 20_000
LAYERS = 3

SAMPLING = ("sampler", "walkers", "ess", "surrogate", "max_steps", "allow_unconverged")
"""Options of `add_sampling`."""

READING = ("format", "quantity", "bins", "all", "strata", "wavelengths", "corrected")
"""Options of `add_format`."""


def refuse_alone(arguments: argparse.Namespace, names: tuple[str, ...], needed: str) -> None:
    """ValueError for the first of these options that is given, where the one that they belong to is not."""
    for name in names:
        given = getattr(arguments, name)
        if given not in (None, ()):
            switched_off = "no-" if given is False else ""
            raise ValueError(f"--{switched_off}{name.replace('_', '-')} is given without --{needed}")


def command(commands: "argparse._SubParsersAction[Any]", name: str, what: str, example: str) -> argparse.ArgumentParser:
    """One of the commands: what it does, and an example."""
    return commands.add_parser(
        name, help=what, description=f"{what[0].upper()}{what[1:]}.", epilog=f"example: {example}"
    )


def add_reading(parser: argparse.ArgumentParser) -> None:
    """How a measurement file is read."""
    group = parser.add_argument_group("reading the data")
    add_format(group)
    group.add_argument(
        "--mask-retro", type=angle, metavar="DEG", help="leave out readings within DEG of retro-reflection"
    )
    group.add_argument(
        "--mask-grazing", type=angle, metavar="DEG", help="leave out readings beyond DEG from the normal"
    )


def add_format(parser: "argparse._ActionsContainer") -> None:
    """What is in it."""
    parser.add_argument("--format", choices=FORMATS, help="default: from the content of the file")
    parser.add_argument("--quantity", choices=QUANTITIES, help="what the values are (default: what the file says)")
    several = parser.add_mutually_exclusive_group()
    several.add_argument("--bins", type=count, metavar="N", help="of a MERL or RGL table, N bins from all over it")
    several.add_argument(
        "--all", action="store_const", const=True, help="of such a table, every bin that holds a measurement"
    )
    parser.add_argument(
        "--wavelengths", type=interval, metavar="LOW,HIGH", help="of an .rxt file, the rows between these, in nm"
    )
    parser.add_argument(
        "--corrected",
        action=argparse.BooleanOptionalAction,
        help="of an .rxt file, values are the sample's own, whatever its spheres (default: what its comments say)",
    )
    parser.add_argument(
        "--strata", choices=STRATA, help="what each of N bins has an equal share of: the table, or flux (default: bins)"
    )


def add_sampling(parser: argparse.ArgumentParser) -> None:
    """How a posterior is sampled."""
    group = parser.add_argument_group("sampling")
    group.add_argument(
        "--sampler", choices=("emcee", "nuts"), help="nuts: for many parameters (default: the chain's, or emcee)"
    )
    group.add_argument(
        "--walkers",
        type=count,
        metavar="N",
        help="an even number (default: the chain's, or 32; 4 chains of nuts)",
    )
    group.add_argument(
        "--ess",
        type=count,
        metavar="N",
        help="go on until the worst parameter has N effective samples (default: until the chain is long enough)",
    )
    group.add_argument(
        "--surrogate",
        action=argparse.BooleanOptionalAction,
        help="proposals from a surrogate of the model (default: the chain's, or where an evaluation is costly)",
    )
    group.add_argument("--max-steps", type=count, metavar="N", help=f"hard limit (default: {MAX_STEPS})")
    group.add_argument(
        "--allow-unconverged",
        action="store_const",
        const=True,
        help="report estimates from a chain under 50 autocorrelation times too",
    )


def add_force(parser: argparse.ArgumentParser, what: str) -> None:
    """Leave to replace what is there."""
    parser.add_argument("--force", action="store_true", help=what)


def add_fitting(parser: argparse.ArgumentParser) -> None:
    """How a stack is fitted."""
    parser.add_argument("--starts", type=count, default=32, metavar="N", help="starting points (default: %(default)s)")
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="seed of the starts (default: %(default)s)")
    parser.add_argument(
        "--solver",
        choices=("least_squares", "bounded"),
        default="least_squares",
        help="bounded: for best values that lie on a bound (default: %(default)s)",
    )
    parser.add_argument(
        "--objective",
        choices=OBJECTIVES,
        help="what is minimised; all but the likelihood give no posterior (default: the stack file's, or likelihood)",
    )


def add_only(parser: argparse.ArgumentParser, what: str) -> None:
    """Which readings."""
    parser.add_argument(
        "--only",
        nargs="+",
        default=(),
        metavar="WHAT",
        help=f"{what} these readings alone: incidence=10,50  plane=0  angle=-60:60  share=0.2  channel=red",
    )


def add_hold_out(parser: argparse.ArgumentParser) -> None:
    """Which readings are kept for the end."""
    parser.add_argument(
        "--hold-out", nargs="+", default=(), metavar="WHAT", help="leave these readings out, and score their prediction"
    )


def add_searching(parser: "argparse._ActionsContainer") -> None:
    """What is looked for, and how readings are believed."""
    parser.add_argument("--library", metavar="TOML", help="layers and bases to choose from (default: built in)")
    parser.add_argument("--layers", type=int, metavar="N", help=f"over the base, at most (default: {LAYERS})")
    parser.add_argument("--instrument", metavar="TOML", help="a stack file, or any other, with an [instrument]")
    parser.add_argument(
        "--noise",
        type=level,
        metavar="REL",
        help="relative noise beside the file's sigma (default: 0.05 without one)",
    )
    parser.add_argument(
        "--calibration",
        type=level,
        metavar="SD",
        help="relative, of a common factor (default: it is exact)",
    )
