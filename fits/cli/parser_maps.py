"""Options of the commands for whole maps."""

import argparse
from typing import Any

from fits.cli.numbers import count, level, scale, seed
from fits.cli.options import add_force, command


def add_fit_map(commands: "argparse._SubParsersAction[Any]") -> None:
    """`layerjax fit-map`."""
    parser = command(
        commands,
        "fit-map",
        "fit a stack to every texel of a map and write a store with the parameters of each; resumes where it stopped",
        "layerjax fit-map coat.h5 --geometry view.csv --stack coat.toml --out coat.zarr --noise 0.02",
    )
    parser.add_argument(
        "data",
        metavar="DATA",
        help="BSDF (..., N, C) or (..., N) in 1/sr: .npy, HDF5 or zarr; file.h5:/name, store.zarr:/name of several",
    )
    parser.add_argument("--stack", required=True, metavar="TOML", help="the stack, with its free parameters")
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
    group.add_argument("--noise", type=level, metavar="REL", help="relative noise (default: what the stack file says)")
    _add_solving(parser)
    add_force(parser, "replace STORE if it holds the map of another fit, or is damaged")


def _add_solving(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("the fit")
    group.add_argument("--starts", type=count, default=8, metavar="N", help="of a texel of the pilot (default: 8)")
    group.add_argument("--seed", type=seed, default=0, metavar="S", help="of the starts (default: 0)")
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
    group = parser.add_argument_group("where it runs")
    where = group.add_mutually_exclusive_group()
    where.add_argument("--processes", type=count, metavar="N", help="processes (default: one a core)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="of dask.distributed, such as tcp://node1:8786")
