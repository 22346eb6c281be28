"""The search for the stack behind data, and the fits of many files, on the command line."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

from fits.cli.interrupts import hint
from fits.cli.options import refuse_alone
from fits.cli.reading import measurements, reading
from fits.cli.setting import use_jax
from fits.progress import show_progress

DONE, DOUBTFUL = 0, 1


def search(arguments: Namespace) -> int:
    """Look for the stack behind the data among those that a library makes, and write the report."""
    data = measurements(arguments)
    use_jax()
    from fits.reports import tables
    from fits.structure_search import report
    from fits.structure_search.search import search as run_search

    directory = Path(arguments.out)
    with show_progress() as progress, hint(_goes_on(directory)):
        settings = search_settings(arguments, starts=arguments.starts, budget=arguments.budget)
        found = run_search(data, **settings, directory=directory, progress=progress)
        report.write_report(found, directory)
    tables.print_table(report.search_table(found), sys.stdout)
    for sentence in (*report.search_sentences(found), f"Report: {directory / report.PAGE}"):
        print(sentence)
    return DONE


def search_settings(arguments: Namespace, **given: Any) -> dict[str, Any]:
    """What the options of a search say, as the arguments of `fits.search`; given: further ones of `SearchOptions`."""
    from fits.problem.noise import Noise
    from fits.problem.parameters import Free, LogNormal
    from fits.problem.stack_file import read_instrument
    from fits.structure_search.library import read_library
    from fits.structure_search.search import SearchOptions

    if arguments.layers is not None:
        given["layers"] = arguments.layers
    sd, reach = arguments.calibration or 0.0, np.exp(4.0 * (arguments.calibration or 0.0))
    return {
        "library": None if arguments.library is None else read_library(arguments.library),
        "noise": Noise() if arguments.noise is None else Noise(relative=arguments.noise),
        "scale": Free(1.0, float(1.0 / reach), float(reach), LogNormal(1.0, sd)) if sd > 0.0 else None,
        "instrument": None if arguments.instrument is None else read_instrument(arguments.instrument),
        "seed": arguments.seed,
        "options": SearchOptions(**given),
    }


def fit_many(arguments: Namespace) -> int:
    """Fit every file by every stack, print what became of them, and write the table and its page."""
    use_jax()
    from fits.batch.fit_files import PAGE, SHOWN, TABLE, fit_files, overview, statements
    from fits.problem.compilation import cores
    from fits.reports.tables import print_table

    if not arguments.search:
        only_searches = ("library", "layers", "instrument", "noise", "calibration")
        refuse_alone(arguments, only_searches, "search: a stack file says it itself")
    out = Path(arguments.out)
    with show_progress() as progress, hint(_goes_on(out)):
        found = fit_files(
            arguments.data,
            arguments.stacks,
            out,
            processes=cores() if arguments.processes is None else arguments.processes,
            client=arguments.scheduler,
            search=search_settings(arguments) if arguments.search else False,
            reading=reading(arguments),
            objective=arguments.objective,
            starts=arguments.starts,
            seed=arguments.seed,
            solver=arguments.solver,
            reports=not arguments.no_reports,
            force=arguments.force,
            progress=progress,
        )
    print_table(overview(found.rows, SHOWN), sys.stdout)
    for sentence in (*statements(found), f"Table: {out / TABLE}", f"Report: {out / PAGE}"):
        print(sentence)
    return DONE if found.complete else DOUBTFUL


def _goes_on(directory: Path) -> str:
    return f"{directory} keeps what was fitted; the same command again goes on with it"
