"""What each command of `layerjax` does with its arguments; the parser defines them and reports errors.

Inputs are checked, and outputs refused, before any work begins. Numbers go to stdout, progress to stderr.
"""

import os
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fits._files import write_bytes, write_text
from fits.cli.input_output import read_options, refuse_alone, refuse_existing, require_free_place, show
from fits.cli.interrupts import hint
from fits.cli.many import fit_many as fit_many
from fits.cli.many import search as search
from fits.cli.maps import fit_map as fit_map
from fits.cli.maps import is_map, report_map
from fits.cli.materials import export as export
from fits.cli.materials import render as render
from fits.cli.materials import simulate as simulate
from fits.cli.materials import write_measurements
from fits.cli.setting import use_jax
from fits.data.geometry import Geometry, slices
from fits.data.measurements import Measurements
from fits.data.totals import Totals
from fits.progress import show_progress

if TYPE_CHECKING:
    from fits.optimise.result import Fit
    from fits.sampling.posterior import Posterior

DONE, DOUBTFUL = 0, 1


def fit(arguments: Namespace) -> int:
    """Fit a stack, save the result with its report, and print the table."""
    use_jax()
    from fits.batch.fit_file import fit_into
    from fits.problem.stack_file import read_problem
    from fits.reports import results, tables, verdicts

    directory = Path(arguments.out)
    results.check_directory(directory, arguments.force)
    data, held_out = read_options(arguments).split(arguments.data)
    given = read_problem(arguments.stack)
    resume = f"{directory} was not written; the same command resumes with the starts that are done"
    with show_progress() as progress, hint(resume):
        result, predicted = fit_into(
            directory,
            given,
            data,
            held_out,
            starts=arguments.starts,
            seed=arguments.seed,
            force=arguments.force,
            progress=progress,
        )
    show(tables.parameter_table(result), *verdicts.summary(result), f"Report: {directory / results.REPORT}")
    if predicted is not None:
        show(tables.scores_table(predicted.prediction, predicted.data, "Held-out data"))
    return DONE if result.converged else DOUBTFUL


def sample(arguments: Namespace) -> int:
    """Sample the posterior of a saved fit, resuming its chain."""
    use_jax()
    from fits.reports import results, tables, verdicts
    from fits.reports.html import write_report
    from fits.sampling.sample import sample as run_sampler

    directory = Path(arguments.directory)
    result = results.load_fit(directory)
    if not result.is_posterior:
        raise ValueError(f"{directory}: fitted with {result.problem.objective!r}, which has no posterior to sample")
    settings = _chain_settings(directory / results.CHAIN, arguments)
    with show_progress() as progress, hint(f"the chain is kept, `layerjax sample {directory}` resumes it"):
        posterior = run_sampler(
            result,
            **settings,
            ess=arguments.ess,
            max_steps=arguments.max_steps,
            path=directory / results.CHAIN,
            resume=not arguments.force,
            allow_unconverged=arguments.allow_unconverged,
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
        show(tables.posterior_table(posterior))
    show(*verdicts.sampled(posterior), f"Report: {directory / results.REPORT}")
    reached = float(np.min(posterior.effective_samples))
    enough = posterior.converged and reached >= posterior.options.ess
    if not enough:
        ess = "" if arguments.ess is None else f" --ess {arguments.ess}"
        print(f"To resume: layerjax sample {directory}{ess} --max-steps {2 * len(posterior.chain)}")
    return DONE if enough else DOUBTFUL


def _chain_settings(path: Path, arguments: Namespace) -> dict[str, Any]:
    """Sampler and walkers: those of the chain that is kept, which arguments must not contradict, or defaults."""
    from fits.sampling.sample import settings_of
    from fits.store import Store

    stored: dict[str, Any] = {}
    if not arguments.force and path.is_file() and (there := Store.read(path)).fingerprint:
        stored = dict(zip(("sampler", "walkers"), settings_of(there), strict=False))
    settings: dict[str, Any] = {}
    for name, default in (("sampler", "emcee"), ("walkers", None)):
        given, before = getattr(arguments, name), stored.get(name)
        if given is not None and before is not None and given != before:
            raise ValueError(f"--{name} is {given}, the chain in {path} has {before} (--force starts it again)")
        settings[name] = given if given is not None else default if before is None else before
    return settings


def predict(arguments: Namespace) -> int:
    """Write the prediction at other directions, or print how well measurements are predicted."""
    if (arguments.incidence is None) == (arguments.score is None):
        raise ValueError("predict needs one of --incidence and --score")
    if arguments.score is None and arguments.out is None:
        raise ValueError("predict --incidence needs --out FILE")
    if arguments.score is None:
        refuse_alone(arguments, ("select", "read"), "score")
    else:
        refuse_alone(arguments, ("azimuth",), "incidence")
    if arguments.out is not None:
        require_free_place(arguments, ".csv", "predictions")
    use_jax()
    from fits.prediction.predict import predict as run_prediction
    from fits.reports import tables

    source = _result(Path(arguments.directory))
    if arguments.score is None:
        at: Geometry | Measurements = slices(np.concatenate(arguments.incidence), azimuth=arguments.azimuth or (0,))
    else:
        at = read_options(arguments).read(arguments.score)
    found = run_prediction(source, at)
    if isinstance(at, Measurements):
        show(tables.scores_table(found, at, f"Prediction of {arguments.score}"))
    if arguments.out is not None:
        write_text(arguments.out, tables.prediction_csv(found), force=arguments.force)
        show(
            f"{arguments.out}: predicted BSDF in 1/sr (bsdf_*), of a new measurement (predictive_*), of the stack "
            "without model discrepancy (latent_*)",
            *([] if found.reliable else [tables.UNRELIABLE]),
        )
    return DONE


def report(arguments: Namespace) -> int:
    """Write the report of a saved fit again, beside that of others if given; or that of a fitted map."""
    if is_map(arguments.directory) or Path(arguments.directory).suffix == ".zarr":
        return report_map(arguments)
    use_jax()
    from fits.any_report import report as write_elsewhere
    from fits.reports import html, results

    refuse_existing(arguments.out, arguments.force)
    directory = Path(arguments.directory)
    name, out = directory.resolve().name, arguments.out or directory / results.REPORT
    result, posterior = results.load_fit(directory), results.load_posterior(directory)
    if arguments.out is None and not os.access(directory, os.W_OK):
        raise ValueError(f"{directory}: cannot be written to (--out FILE writes the report elsewhere)")
    others = _candidates([Path(other) for other in arguments.compare], reference=directory)
    with show_progress() as progress:
        progress("pictures and report", 0, 1)
        if arguments.out is None:
            html.write_report(directory, name, result, posterior, others)
        else:
            held_out = results.load_held_out(directory)
            write_elsewhere(result, posterior, out, others=others, name=name, held_out=held_out, force=arguments.force)
        progress("pictures and report", 1, 1)
    print(f"Report: {out}")
    return DONE


def compare(arguments: Namespace) -> int:
    """Print which of several saved fits predicts the data best."""
    if len(arguments.directories) < 2:
        raise ValueError(f"{arguments.directories[0]} is the only directory given, must be two or more")
    refuse_existing(arguments.out, arguments.force)
    use_jax()
    from fits.prediction.compare import compare as run_compare
    from fits.reports import tables
    from fits.reports.html import comparison_page

    candidates = _candidates([Path(directory) for directory in arguments.directories])
    with show_progress() as progress:
        compared = run_compare(candidates, refit=not arguments.no_refit, progress=progress)
    show(tables.comparison_table(compared), *compared.verdict)
    if arguments.out:
        write_text(arguments.out, comparison_page(candidates, compared), force=arguments.force)
        print(f"Comparison: {arguments.out}")
    return DONE


def _candidates(directories: list[Path], reference: Path | None = None) -> "dict[str, Fit | Posterior]":
    """The fits of these directories, or their posteriors, under their names; whole paths where names repeat.

    reference: the result that they are compared with, whose name is taken.
    """
    places = [directory.resolve() for directory in (*directories, *([] if reference is None else [reference]))]
    names = [place.name for place in places]
    candidates: dict[str, Fit | Posterior] = {}
    for directory, place in zip(directories, places, strict=False):
        if places.count(place) > 1:
            raise ValueError(f"{directory} is given twice")
        candidates[place.name if names.count(place.name) == 1 else str(directory)] = _result(directory)
    return candidates


def _result(directory: Path) -> "Fit | Posterior":
    """The posterior of a directory, if there are estimates of it, or else the fit."""
    from fits.reports import results, verdicts

    posterior = results.load_posterior(directory)
    return posterior if posterior is not None and verdicts.reportable(posterior) else results.load_fit(directory)


def info(arguments: Namespace) -> int:
    """Print what is in a measurement file, and draw it."""
    from fits.reports.data_summary import data_statements, data_table, source_table
    from fits.reports.plots.data import as_png, data_picture, totals_picture

    out = arguments.out or f"{Path(arguments.data).stem}.png"
    if arguments.out is not None:
        refuse_existing(out, arguments.force)
    data = read_options(arguments).read(arguments.data)
    show(source_table(data), data_table(data), *data_statements(data))
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
    return write_measurements(read_options(arguments).read(arguments.data), arguments)
