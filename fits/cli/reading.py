"""Measurement files as the command line names them, and how it says that they are read."""

from argparse import Namespace

from fits.data.measurements import Measurements
from fits.data.reading import Reading
from fits.data.totals import Totals


def reading(arguments: Namespace) -> Reading:
    """How files are read as the options say, of those that the command has (see `fits.cli.options.add_reading`)."""
    return Reading(
        format=arguments.format,
        quantity=arguments.quantity,
        bins="all" if arguments.all else arguments.bins,
        strata=arguments.strata,
        wavelengths=arguments.wavelengths,
        corrected=arguments.corrected,
        mask_retro=getattr(arguments, "mask_retro", None),
        mask_grazing=getattr(arguments, "mask_grazing", None),
        only=tuple(getattr(arguments, "only", ())),
        hold_out=tuple(getattr(arguments, "hold_out", ())),
    )


def measurements(arguments: Namespace) -> Measurements:
    """What a command's data file holds, with what the options mask."""
    data = reading(arguments).measurements(arguments.data)
    if arguments.command == "search" and isinstance(data, Totals):  # stacks are searched by angles left out
        raise ValueError(f"{arguments.data}: holds totals; a search takes values along directions")
    return data
