"""The search for the stack behind data, and the fits of many files, on the command line."""

from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

from fits.cli.input_output import read_options, refuse_alone, show
from fits.cli.interrupts import hint
from fits.cli.setting import use_jax
from fits.data.totals import Totals
from fits.progress import show_progress

DONE, DOUBTFUL = 0, 1


def search(arguments: Namespace) -> int:
    """Search for the stack behind the data among those of a library, and write the report."""
    data = read_options(arguments).read(arguments.data)
    if isinstance(data, Totals):  # stacks are compared by cross-validation over incidences
        raise ValueError(f"{arguments.data}: holds totals; a search needs measurements along directions")
    use_jax()
    from fits.structure_search import report
    from fits.structure_search.search import search as run_search

    directory = Path(arguments.out)
    settings = search_settings(arguments, layers=arguments.layers, budget=arguments.budget)
    with show_progress() as progress, hint(_resume(directory)):
        found = run_search(data, **settings, directory=directory, progress=progress)
        report.write_report(found, directory)
    show(report.search_table(found), *report.search_sentences(found), f"Report: {directory / report.PAGE}")
    return DONE


def search_settings(arguments: Namespace, **options: Any) -> dict[str, Any]:
    """Arguments of `fits.search` from the options of a search; options: further ones of `SearchOptions`."""
    from fits.problem.noise import Noise
    from fits.problem.parameters import Free, LogNormal
    from fits.problem.stack_file import read_instrument
    from fits.structure_search.library import read_library
    from fits.structure_search.search import SearchOptions

    sd = arguments.scale_sd or 0.0
    bound, instrument = float(np.exp(4.0 * sd)), getattr(arguments, "instrument", None)
    return {
        "library": None if arguments.library is None else read_library(arguments.library),
        "noise": Noise() if arguments.noise is None else Noise(relative=arguments.noise),
        "scale": Free(1.0, 1.0 / bound, bound, LogNormal(1.0, sd)) if sd > 0.0 else None,
        "instrument": None if instrument is None else read_instrument(instrument),
        "options": SearchOptions(**options),
    }


def fit_many(arguments: Namespace) -> int:
    """Fit every file by every stack, print the outcomes, and write the table and its page."""
    use_jax()
    from fits.batch.fit_files import PAGE, SHOWN, TABLE, fit_files, overview, statements
    from fits.problem.compilation import cores

    if not arguments.search:
        refuse_alone(arguments, ("library", "noise", "scale_sd"), "search: a stack file states it")
    out = Path(arguments.out)
    with show_progress() as progress, hint(_resume(out)):
        found = fit_files(
            arguments.data,
            arguments.stacks,
            out,
            processes=cores() if arguments.processes is None else arguments.processes,
            client=arguments.scheduler,
            search=search_settings(arguments) if arguments.search else False,
            read_options=read_options(arguments),
            starts=arguments.starts,
            force=arguments.force,
            progress=progress,
        )
    show(overview(found.rows, SHOWN), *statements(found), f"Table: {out / TABLE}", f"Report: {out / PAGE}")
    return DONE if found.complete else DOUBTFUL


def _resume(directory: Path) -> str:
    return f"{directory} keeps what was fitted; the same command resumes it"
