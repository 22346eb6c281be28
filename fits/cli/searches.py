"""The search for the stack behind data, on the command line."""

import sys
from argparse import Namespace
from pathlib import Path

import numpy as np

from fits._files import write_together
from fits.cli.interrupts import hint
from fits.cli.setting import use_jax
from fits.data.measurements import Measurements
from fits.progress import show_progress

DONE = 0
REPORT, PICTURE = "search.html", "search.png"


def search(data: Measurements, arguments: Namespace) -> int:
    """Fit stacks from a library, print which the data prefer, and write the report."""
    use_jax()
    from fits.problem.likelihood import Noise
    from fits.problem.parameters import Free, LogNormal
    from fits.problem.stack_file import read_instrument
    from fits.reporting import tables
    from fits.reporting.plots.data import as_png
    from fits.structures import telling
    from fits.structures.library import read_library
    from fits.structures.searching import search as run_search

    directory = Path(arguments.out)
    library = None if arguments.library is None else read_library(arguments.library)
    instrument = None if arguments.instrument is None else read_instrument(arguments.instrument)
    level, sd = arguments.noise, arguments.calibration
    # far enough for four standard deviations
    scale = Free(1.0, float(np.exp(-4.0 * sd)), float(np.exp(4.0 * sd)), LogNormal(1.0, sd)) if sd > 0.0 else None
    noise = Noise() if level is None else Noise(relative=level)
    again = f"{directory} keeps what was fitted; the same command again goes on with it"
    with show_progress() as progress, hint(again):
        found = run_search(
            data,
            library,
            layers=arguments.layers,
            noise=noise,
            scale=scale,
            instrument=instrument,
            starts=arguments.starts,
            seed=arguments.seed,
            progress=progress,
            directory=directory,
        )
    tables.print_table(telling.search_table(found), sys.stdout)
    for sentence in telling.search_sentences(found):
        print(sentence)
    picture = as_png(telling.search_picture(found))
    write_together(directory, {PICTURE: picture, REPORT: telling.search_page(found).encode()})
    print(f"Report: {directory / REPORT}")
    return DONE
