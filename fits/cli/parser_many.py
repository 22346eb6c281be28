"""Options of the command for many files."""

import argparse
from typing import Any

from fits.cli.numbers import count
from fits.cli.options import add_force, add_hold_out, add_reading, add_searching, add_select, add_starts, command


def add_fit_many(commands: "argparse._SubParsersAction[Any]") -> None:
    """The options of ``layerjax fit-many``."""
    parser = command(
        commands,
        "fit-many",
        "fit every file of a folder by every one of several stacks, and write one table over all of them",
        "layerjax fit-many scans --stacks coat.toml bare.toml --out fitted --processes 8",
    )
    parser.add_argument("data", nargs="+", metavar="FOLDER|FILE", help="measurements, see docs/formats.md")
    parser.add_argument("--stacks", nargs="+", default=(), metavar="TOML", help="stacks, with their free parameters")
    parser.add_argument(
        "--out", required=True, metavar="DIR", help="directory to write, or to resume: DIR/FILE/STACK is a result"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--processes", type=count, metavar="N", help="worker processes (default: one a core)")
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="dask.distributed cluster that sees the files, such as tcp://...:8786"
    )
    add_starts(parser)
    add_reading(parser)
    add_select(parser, "fit")
    add_hold_out(parser)
    group = parser.add_argument_group("searching for stacks")
    group.add_argument("--search", action="store_true", help="search for the stack behind each file as well")
    add_searching(group)
    add_force(parser, "fit again where stack, settings or the content of the file have changed")
