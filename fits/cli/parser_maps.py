"""Options of the commands for whole maps and for many files."""

import argparse
from typing import Any

from fits.cli.numbers import count, level, scale, seed, whole
from fits.cli.options import add_force, command

TABULATE = ("auto", "always", "never")
SMOOTH = ("gaussian", "total_variation")


def add_fit_map(commands: "argparse._SubParsersAction[Any]") -> None:
    """`layerjax fit-map`."""
    parser = command(
        commands,
        "fit-map",
        "fit a stack to every texel of a map and write a store with the parameters of each; goes on where it stopped",
        "layerjax fit-map coat.h5 --geometry view.csv --stack coat.toml --out coat.zarr --noise 0.02",
    )
    parser.add_argument(
        "data",
        metavar="DATA",
        help="readings (..., N, C) or (..., N) in 1/sr: .npy, HDF5 or zarr; file.h5:/name, store.zarr:/name of several",
    )
    parser.add_argument("--stack", required=True, metavar="TOML", help="the stack, with its free parameters")
    parser.add_argument("--out", required=True, metavar="STORE", help="store to write, or to go on with; ends in .zarr")
    group = parser.add_argument_group("the readings")
    group.add_argument(
        "--geometry",
        metavar="FILE",
        help="their directions: csv, or a file with wi and wo, or theta_i, phi_i, theta_o, phi_o in degrees "
        "(default: these stand beside DATA)",
    )
    group.add_argument("--sigma", metavar="FILE", help="their standard deviations, (..., N, C), (..., N) or (N)")
    group.add_argument("--mask", metavar="FILE", help="which texels are fitted, (...): 1, or 0 for those left out")
    group.add_argument("--noise", type=level, metavar="REL", help="relative noise (default: what the stack file says)")
    _add_solving(parser)
    _add_smoothing(parser)
    _add_engine(parser)
    add_force(parser, "replace STORE if it holds the map of another fit, or is damaged")


def _add_solving(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("the fit")
    group.add_argument("--starts", type=count, default=8, metavar="N", help="of a texel of the sample (default: 8)")
    group.add_argument("--seed", type=seed, default=0, metavar="S", help="of sample and starts (default: 0)")
    group.add_argument(
        "--sample", type=count, default=64, metavar="N", help="texels fitted first, from many starts (default: 64)"
    )
    group.add_argument("--chunk", type=count, default=1024, metavar="N", help="texels a task (default: 1024)")
    group.add_argument(
        "--tabulate",
        choices=TABULATE,
        default="auto",
        help="a table over the bounds in place of the transport (default: where it is exact enough)",
    )
    group.add_argument(
        "--posterior",
        type=whole,
        default=0,
        metavar="N",
        help="sample the posterior of N texels: how far errors hold (default: 0)",
    )


def _add_smoothing(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("neighbouring texels held together, beside the plain fit")
    group.add_argument(
        "--smooth",
        choices=SMOOTH,
        help="gaussian: changes are gradual; total_variation: areas are even, edges stay (default: not at all)",
    )
    group.add_argument(
        "--smooth-scale",
        type=scale,
        nargs="+",
        metavar="[NAME=]X",
        help="of the difference between neighbours, as a share of the bounds, of all parameters or of NAME",
    )
    group.add_argument("--smooth-rounds", type=count, metavar="N", help="at most (default: 10)")


def _add_engine(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("where it runs")
    where = group.add_mutually_exclusive_group()
    where.add_argument("--processes", type=count, metavar="N", help="processes (default: one a core)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="of dask.distributed, such as tcp://node1:8786")
