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
    data = read(path, arguments.format, arguments.quantity, bins=bins, strata=arguments.strata or "bins")
    if isinstance(data, Totals):
        raise ValueError(f"{path}: holds totals, which no command takes; in Python see fits.Joint")
    return data


def measurements(arguments: Namespace) -> Measurements:
    """What a command's data file holds, with what the options mask."""
    data = readings(arguments.data, arguments)
    if arguments.mask_retro is not None:
        data = data.without_retro(arguments.mask_retro)
    if arguments.mask_grazing is not None:
        data = data.without_grazing(arguments.mask_grazing)
    return data
