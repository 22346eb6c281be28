"""Many files at once, on the command line."""

import sys
from argparse import Namespace
from pathlib import Path

from fits.cli.interrupts import hint
from fits.cli.options import read_options, refuse_alone
from fits.cli.searches import searching
from fits.cli.setting import use_jax
from fits.progress import show_progress

DONE, DOUBTFUL = 0, 1


def fit_many(arguments: Namespace) -> int:
    """Fit every file by every stack, print what became of them, and write the table and its page."""
    use_jax()
    from fits.batch.files import fit_files
    from fits.batch.inputs import PAGE, TABLE
    from fits.batch.page import SHOWN, overview, told
    from fits.problem.compilation import cores
    from fits.reports.tables import print_table

    if not arguments.search:
        only_searches = ("library", "noise", "scale_sd")
        refuse_alone(arguments, only_searches, "search: a stack file says it itself")
    out = Path(arguments.out)
    again = f"{out} keeps what was fitted; the same command again goes on with it"
    with show_progress() as progress, hint(again):
        found = fit_files(
            arguments.data,
            arguments.stacks,
            out,
            processes=cores() if arguments.processes is None else arguments.processes,
            client=arguments.scheduler,
            search=searching(arguments) if arguments.search else False,
            **vars(read_options(arguments)),
            starts=arguments.starts,
            force=arguments.force,
            progress=progress,
        )
    print_table(overview(found.rows, SHOWN), sys.stdout)
    for sentence in (*told(found.rows, found.left_out), f"Table: {out / TABLE}", f"Report: {out / PAGE}"):
        print(sentence)
    return DONE if found.complete else DOUBTFUL
