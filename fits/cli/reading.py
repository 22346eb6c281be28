"""Measurement files as the command line names them, and how it says that they are read."""

from argparse import Namespace
from typing import Literal

from fits.data.formats import read
from fits.data.measurements import Measurements
from fits.data.totals import Totals


def readings(path: str, arguments: Namespace) -> Measurements:
    """What a file holds, read as the options say (see `fits.cli.options.add_format`)."""
    bins: int | Literal["all"] | None = "all" if arguments.all else arguments.bins
    if arguments.strata is not None and not arguments.bins:
        raise ValueError("--strata is given without --bins")
    return read(path, arguments.format, arguments.quantity, bins=bins, strata=arguments.strata or "bins")


def measurements(arguments: Namespace) -> Measurements:
    """What a command's data file holds, with what the options mask."""
    data = readings(arguments.data, arguments)
    if isinstance(data, Totals):
        _refuse_angles(arguments)
        return data
    if arguments.mask_retro is not None:
        data = data.without_retro(arguments.mask_retro)
    if arguments.mask_grazing is not None:
        data = data.without_grazing(arguments.mask_grazing)
    return data


def _refuse_angles(arguments: Namespace) -> None:
    """Totals have no direction of view, by which these would choose, and stacks are searched by angles left out."""
    for name in ("mask_retro", "mask_grazing", "only", "hold_out"):
        if getattr(arguments, name, None):
            raise ValueError(f"{arguments.data}: holds totals, of which --{name.replace('_', '-')} chooses nothing")
    if arguments.command == "search":
        raise ValueError(f"{arguments.data}: holds totals; a search takes values along directions")
