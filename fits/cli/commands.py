"""What each command of `layerjax` does with its arguments; `cli` says how it is asked for and what errors look like.

Inputs are checked, and outputs refused, before any work begins. Numbers go to stdout, progress to stderr.
"""

import os
import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fits._files import write_bytes, write_text
from fits.cli.interrupts import hint
from fits.cli.many import fit_many as fit_many
from fits.cli.many import search as search
from fits.cli.map_reports import report_map
from fits.cli.maps import fit_map as fit_map
from fits.cli.materials import export as export
from fits.cli.materials import render as render
from fits.cli.materials import simulate as simulate
from fits.cli.materials import write_measurements
from fits.cli.options import MAX_STEPS, SAMPLING, refuse_alone
from fits.cli.places import refuse_existing, require_free_place
from fits.cli.predictions import predict as predict
from fits.cli.predictions import print_scores
from fits.cli.reading import measurements, reading
from fits.cli.setting import use_jax
from fits.data.measurements import Measurements
from fits.data.totals import Totals
from fits.maps.fitted_map import is_store
from fits.progress import show_progress

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.problem.stack_file import ProblemFile
    from fits.sampling.posterior import Posterior
    from fits.sampling.sample import Sampler

DONE, DOUBTFUL = 0, 1
SAMPLER: "Sampler" = "emcee"


def fit(arguments: Namespace) -> int:
    """Fit a stack, save the result with its report, and print the table."""
    if not arguments.sample:
        refuse_alone(arguments, SAMPLING, "sample")
    use_jax()
    from fits.batch.fit_file import fit_into, require_posterior
    from fits.problem.stack_file import read_problem
    from fits.reports import results, tables, verdicts
    from fits.reports.diagnostics import residual_structure, standardised
    from fits.reports.directories import check_directory

    directory = Path(arguments.out)
    check_directory(directory, arguments.force)
    data, unseen = reading(arguments).parts(arguments.data)
    given = read_problem(arguments.stack)
    require_posterior(arguments.objective or given.objective, "--sample" if arguments.sample else None)
    if arguments.sample:
        _require_sampling(given, data, arguments)
    kept = f"{directory} was not written; the same command again goes on with the starts that are done"
    with show_progress() as progress, hint(kept):
        result, foretold = fit_into(
            directory,
            given,
            data,
            unseen,
            objective=arguments.objective,
            starts=arguments.starts,
            seed=arguments.seed,
            solver=arguments.solver,
            force=arguments.force,
            progress=progress,
        )
    tables.print_table(tables.parameter_table(result), sys.stdout)
    structure = residual_structure(result.problem.data, standardised(result))
    for sentence in (*verdicts.outcome(result, structure), f"Report: {directory / results.REPORT}"):
        print(sentence)
    if foretold is not None:
        print_scores(foretold.prediction, foretold.readings, "Readings that were held out")
    if arguments.sample:
        return _sample(directory, arguments)
    return DONE if result.converged else DOUBTFUL


def _require_sampling(given: "ProblemFile", data: Measurements, arguments: Namespace) -> None:
    """ValueError, before anything is fitted, for settings of a sampler that is to follow."""
    from fits.problem.problem import Problem
    from fits.sampling.sample import require_settings

    problem = Problem(given.stack, data, given.transport, given.noise, given.scale, instrument=given.instrument)
    require_settings(
        len(problem.names),
        sampler=SAMPLER if arguments.sampler is None else arguments.sampler,
        walkers=arguments.walkers,
        surrogate=arguments.surrogate,
        ess=arguments.ess,
        max_steps=arguments.max_steps or MAX_STEPS,
    )


def sample(arguments: Namespace) -> int:
    """Sample the posterior of a saved fit, going on with the chain that is there."""
    use_jax()
    return _sample(Path(arguments.directory), arguments)


def _sample(directory: Path, arguments: Namespace) -> int:
    from fits.reports import results, tables, verdicts
    from fits.reports.report_files import write_report
    from fits.sampling.sample import sample as run_sampler

    result = results.load_fit(directory)
    if not result.is_posterior:
        raise ValueError(f"{directory}: fitted with {result.problem.objective!r}, which has no posterior to sample")
    settings = _chain_settings(directory / results.CHAIN, arguments)
    again = f"the chain is kept, `layerjax sample {directory}` goes on with it"
    with show_progress() as progress, hint(again):
        posterior = run_sampler(
            result,
            **settings,
            surrogate=arguments.surrogate,
            ess=arguments.ess,
            max_steps=arguments.max_steps or MAX_STEPS,
            path=directory / results.CHAIN,
            resume=not arguments.force,
            allow_unconverged=bool(arguments.allow_unconverged),
            progress=progress,
        )
        progress("pictures and report", 0, 1)
        if verdicts.reportable(posterior):
            results.save_posterior(posterior, directory)
        else:
            (directory / results.SUMMARY).unlink(missing_ok=True)
        write_report(directory, directory.resolve().name, result, posterior)
        progress("pictures and report", 1, 1)
    if verdicts.reportable(posterior):
        tables.print_table(tables.posterior_table(posterior), sys.stdout)
    for sentence in (*verdicts.sampled(posterior), f"Report: {directory / results.REPORT}"):
        print(sentence)
    reached = float(np.min(posterior.effective_samples))
    enough = posterior.converged and (arguments.ess is None or reached >= arguments.ess)
    if not enough:
        asked = "" if arguments.ess is None else f" --ess {arguments.ess}"
        print(f"To go on: layerjax sample {directory}{asked} --max-steps {2 * len(posterior.chain)}")
    return DONE if enough else DOUBTFUL


def _chain_settings(path: Path, arguments: Namespace) -> dict[str, Any]:
    """Sampler, walkers and seed: those of the chain that is there, which arguments must not contradict, or defaults."""
    from fits.sampling.chain import read_chain

    stored = {} if arguments.force or not path.is_file() else read_chain(path)["identity"]
    settings: dict[str, Any] = {}
    for name, kind, default in (("sampler", str, SAMPLER), ("walkers", int, None), ("seed", int, 0)):
        wanted, there = getattr(arguments, name), stored.get(name)
        if wanted is not None and there is not None and wanted != there:
            raise ValueError(f"--{name} is {wanted}, the chain in {path} has {there} (--force starts it again)")
        settings[name] = wanted if wanted is not None else default if there is None else kind(there)
    return settings


def report(arguments: Namespace) -> int:
    """Write the report of a saved fit again, if asked for beside others; or that of a fitted map."""
    if is_store(arguments.directory) or Path(arguments.directory).suffix == ".zarr":
        return report_map(arguments)
    use_jax()
    from fits.reports import results
    from fits.reports.html import report as write_page
    from fits.reports.report_files import write_report
    from fits.reports.stored import held_out_of

    refuse_existing(arguments.out, arguments.force)
    directory = Path(arguments.directory)
    name, out = directory.resolve().name, arguments.out or directory / results.REPORT
    result, posterior = results.load_fit(directory), results.load_posterior(directory)
    if arguments.out is None and not os.access(directory, os.W_OK):
        raise ValueError(f"{directory}: cannot be written to (--out FILE writes the report elsewhere)")
    others = _candidates([Path(other) for other in arguments.compare], own=directory)
    with show_progress() as progress:
        progress("pictures and report", 0, 1)
        if arguments.out is None:
            write_report(directory, name, result, posterior, others)
        else:
            unseen = held_out_of(directory)
            write_page(result, posterior, out, others=others, name=name, unseen=unseen, force=arguments.force)
        progress("pictures and report", 1, 1)
    print(f"Report: {out}")
    return DONE


def compare(arguments: Namespace) -> int:
    """Print which of several saved fits explains the data."""
    if len(arguments.directories) < 2:
        raise ValueError(f"{arguments.directories[0]} is the only directory given, must be two or more")
    refuse_existing(arguments.out, arguments.force)
    use_jax()
    from fits.prediction.compare import compare as run_compare
    from fits.reports import tables

    candidates = _candidates([Path(directory) for directory in arguments.directories])
    with show_progress() as progress:
        compared = run_compare(candidates, refit=arguments.refit, progress=progress)
    tables.print_table(tables.comparison_table(compared), sys.stdout)
    for sentence in compared.verdict:
        print(sentence)
    if arguments.out:
        from fits.reports.html import comparison_page

        write_text(arguments.out, comparison_page(candidates, compared), force=arguments.force)
        print(f"Comparison: {arguments.out}")
    return DONE


def info(arguments: Namespace) -> int:
    """Print what is in a measurement file, and draw it."""
    from fits.reports.data_statements import data_statements
    from fits.reports.data_tables import data_table, source_table
    from fits.reports.plots.data import as_png, data_picture
    from fits.reports.plots.totals import totals_picture
    from fits.reports.tables import print_table

    out = arguments.out or f"{Path(arguments.data).stem}.png"
    if arguments.out is not None:
        refuse_existing(out, arguments.force)
    data = measurements(arguments)
    for table in (source_table(data), data_table(data)):
        print_table(table, sys.stdout)
    for sentence in data_statements(data):
        print(sentence)
    if Path(out).exists() and not arguments.force:
        print(f"Picture: {out} exists already (--force draws it again)")
        return DONE
    picture = totals_picture(data) if isinstance(data, Totals) else data_picture(data)
    write_bytes(out, as_png(picture), arguments.force)
    print(f"Picture: {out}")
    return DONE


def convert(arguments: Namespace) -> int:
    """Read any supported format and write csv."""
    require_free_place(arguments, ".csv", "measurements")
    return write_measurements(measurements(arguments), arguments)


def _candidates(directories: list[Path], own: Path | None = None) -> "dict[str, Fit | Posterior]":
    """The fits of these directories, or their posteriors, under their names; whole paths where names repeat.

    own: a result that they are compared with, whose place and name are taken.
    """
    from fits.reports import results, verdicts

    places = [directory.resolve() for directory in (*directories, *([] if own is None else [own]))]
    names = [place.name for place in places]
    candidates: dict[str, Fit | Posterior] = {}
    for directory, place in zip(directories, places, strict=False):
        if places.count(place) > 1:
            raise ValueError(f"{directory} is given twice")
        posterior = results.load_posterior(directory)
        found = posterior if posterior is not None and verdicts.reportable(posterior) else results.load_fit(directory)
        candidates[place.name if names.count(place.name) == 1 else str(directory)] = found
    return candidates
