"""A stack file fitted to measurements, as a result directory with its report: what `layerjax fit` does."""

from pathlib import Path
from typing import NamedTuple

from fits.data.formats.csv import write_csv
from fits.data.measurements import Measurements
from fits.names import Objective
from fits.optimise.fit import discrepancy_checkpoint
from fits.optimise.fit import fit as run_fit
from fits.optimise.multi_start import Solver
from fits.optimise.options import options_from
from fits.optimise.result import Fit
from fits.problem.stack_file import ProblemFile
from fits.progress import Progress, silent
from fits.reports import results
from fits.reports.html import HeldOut, predict_held_out, write_report
from fits.reports.results import HELD_OUT, replacing, reserved

DRAWING = "pictures and report"


class Fitted(NamedTuple):
    """A fit, and its prediction of held-out data; None without any."""

    fit: Fit
    held_out: HeldOut | None


def fit_into(
    directory: str | Path,
    given: ProblemFile,
    data: Measurements,
    held_out: Measurements | None = None,
    *,
    objective: Objective | None = None,
    starts: int = 32,
    seed: int = 0,
    solver: Solver = "least_squares",
    force: bool = False,
    report: bool = True,
    progress: Progress | None = None,
) -> Fitted:
    """Fit what a stack file says and write the result directory, whole or not at all.

    Args:
        directory: as of `save_fit`.
        given: the stack file.
        data, held_out: what is fitted, and what its prediction is scored by.
        objective: in place of that of the stack file.
        starts, seed, solver, progress: see `fit`; starts are kept beside the directory until it is there.
        force: replace an earlier result.
        report: with it and its pictures, which take longer than a fit of a transport in closed form.

    Raises:
        ValueError: as `fit` and `save_fit`; data are held out of an objective that has no predictive score.
    """
    directory = Path(directory)
    objective = require_posterior(objective or given.objective, "--hold-out" if held_out is not None else None)
    options = options_from(given.options)
    kept = directory.resolve().with_name(f".{directory.resolve().name}.starts")
    with reserved(directory, force):
        found = run_fit(
            given.stack,
            data,
            transport=given.transport,
            noise=given.noise,
            scale=given.scale,
            objective=objective,
            instrument=given.instrument,
            starts=starts,
            seed=seed,
            solver=solver,
            options=options,
            progress=progress,
            checkpoint=kept,
        )
        text = given.text if objective == given.objective else None
        fitted = _written(directory, found, held_out, text, force, report, progress or silent)
        for one in (kept, discrepancy_checkpoint(kept)):
            one.unlink(missing_ok=True)
    return fitted


def write_into(directory: str | Path, found: Fit, *, force: bool = False, report: bool = True) -> Fitted:
    """Write the result directory of a fit with its report; arguments as of `fit_into`."""
    with reserved(directory, force):
        return _written(Path(directory), found, None, None, force, report, silent)


def require_posterior(objective: Objective, option: str | None) -> Objective:
    """The objective. ValueError where an option of the command line needs a likelihood, and it is none."""
    if option is not None and objective != "likelihood":
        what = "has no posterior" if option == "--sample" else "has no predictive score"
        raise ValueError(f"{option} needs the objective 'likelihood': {objective!r} {what}")
    return objective


def _written(
    directory: Path,
    found: Fit,
    held_out: Measurements | None,
    text: str | None,
    force: bool,
    report: bool,
    progress: Progress,
) -> Fitted:
    progress(DRAWING, 0, 1)
    with replacing(directory, force) as folder:
        results.write_fit(found, folder, text)
        if held_out is not None:
            write_csv(held_out, folder / HELD_OUT)
        if report:
            predicted = write_report(folder, directory.resolve().name, found)
        else:
            predicted = None if held_out is None else predict_held_out(found, None, held_out)
    progress(DRAWING, 1, 1)
    return Fitted(found, predicted)
