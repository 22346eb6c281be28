"""The search for the stack behind data, on the command line."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from fits.cli.interrupts import hint
from fits.cli.options import LAYERS
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
    given = searching(arguments, arguments.starts)
    again = f"{directory} keeps what was fitted; the same command again goes on with it"
    with show_progress() as progress, hint(again):
        found = search_into(directory, data, given, progress, arguments.budget)
    tables.print_table(telling.search_table(found), sys.stdout)
    for sentence in telling.search_sentences(found):
        print(sentence)
    print(f"Report: {directory / REPORT}")
    return DONE


def searching(arguments: Namespace, starts: int) -> "Searching":
    """What the options of a search say."""
    from fits.batch.searching import Searching
    from fits.problem.stack_file import read_instrument
    from fits.structure_search.library import read_library

    return Searching(
        library=None if arguments.library is None else read_library(arguments.library),
        layers=LAYERS if arguments.layers is None else arguments.layers,
        noise=arguments.noise,
        calibration=arguments.calibration or 0.0,
        instrument=None if arguments.instrument is None else read_instrument(arguments.instrument),
        starts=starts,
        seed=arguments.seed,
    )
