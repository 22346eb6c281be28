"""The search for the stack behind data, on the command line."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fits.cli.interrupts import hint
from fits.cli.setting import use_jax
from fits.data.measurements import Measurements
from fits.progress import show_progress

if TYPE_CHECKING:
    from fits.batch.searching import Searching

DONE = 0


def search(data: Measurements, arguments: Namespace) -> int:
    """Fit stacks from a library, print which the data prefer, and write the report."""
    use_jax()
    from fits.batch.searching import REPORT, search_into
    from fits.reports import tables
    from fits.structure_search import telling

    directory = Path(arguments.out)
    given = searching(arguments)
    again = f"{directory} keeps what was fitted; the same command again goes on with it"
    with show_progress() as progress, hint(again):
        found = search_into(directory, data, given, progress, arguments.budget)
    tables.print_table(telling.search_table(found), sys.stdout)
    for sentence in telling.search_sentences(found):
        print(sentence)
    print(f"Report: {directory / REPORT}")
    return DONE


def searching(arguments: Namespace) -> "Searching":
    """What the options of a search say."""
    from fits.batch.searching import Searching
    from fits.problem.stack_file import read_instrument
    from fits.structure_search.library import read_library

    more: dict[str, Any] = {"layers": arguments.layers} if arguments.command == "search" else {}
    if getattr(arguments, "instrument", None) is not None:
        more["instrument"] = read_instrument(arguments.instrument)
    return Searching(
        library=None if arguments.library is None else read_library(arguments.library),
        noise=arguments.noise,
        scale_sd=arguments.scale_sd or 0.0,
        **more,
    )
