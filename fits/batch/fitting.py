"""A stack file fitted to readings, as a result directory with its report: what `layerjax fit` does."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fits._files import write_json
from fits.data.formats.csv import write_csv
from fits.data.measurements import Measurements
from fits.names import Objective
from fits.optimise.fit import again
from fits.optimise.fit import fit as run_fit
from fits.optimise.multi_start import Solver
from fits.optimise.result import Fit
from fits.problem.stack_file import ProblemFile
from fits.progress import Progress
from fits.reports import results
from fits.reports.directories import replacing, reserved
from fits.reports.html import Foretold, foretell
from fits.reports.report_files import write_report
from fits.reports.stored import HELD_OUT

DRAWING = "pictures and report"


class Fitted(NamedTuple):
    """A fit, and what it foretold of readings that were held out; None without any."""

    fit: Fit
    foretold: Foretold | None


Beside = Callable[[Fitted], Mapping[str, Mapping[str, Any]]]
"""Further JSON files of a result directory, by name."""


def fit_into(
    directory: str | Path,
    given: ProblemFile,
    data: Measurements,
    unseen: Measurements | None = None,
    *,
    objective: Objective | None = None,
    starts: int = 32,
    seed: int = 0,
    solver: Solver = "least_squares",
    force: bool = False,
    report: bool = True,
    progress: Progress | None = None,
    beside: Beside | None = None,
) -> Fitted:
    """Fit what a stack file says and write the result directory, whole or not at all.

    Args:
        directory: as of `save_fit`.
        given: the stack file.
        data, unseen: what is fitted, and readings held out whose prediction is scored.
        objective: in place of that of the stack file.
        starts, seed, solver, progress: see `fit`; starts are kept beside the directory until it is there.
        force: replace an earlier result.
        report: with it and its pictures, which take longer than a fit of a transport in closed form.
        beside: files that the directory holds as well.

    Raises:
        ValueError: as `fit` and `save_fit`; readings are held out of an objective that says nothing of readings.
    """
    directory = Path(directory)
    objective = require_posterior(objective or given.objective, "--hold-out" if unseen is not None else None)
    done = directory.resolve().with_name(f".{directory.resolve().name}.starts")
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
            progress=progress,
            checkpoint=done,
        )
        text = given.text if objective == given.objective else None
        fitted = _written(directory, found, unseen, text, force, report, progress, beside)
        for kept in (done, again(done)):
            kept.unlink(missing_ok=True)
    return fitted


def write_into(
    directory: str | Path,
    found: Fit,
    *,
    force: bool = False,
    report: bool = True,
    beside: Beside | None = None,
) -> Fitted:
    """Write the result directory of a fit with its report; arguments as of `fit_into`."""
    with reserved(directory, force):
        return _written(Path(directory), found, None, None, force, report, None, beside)


def require_posterior(objective: Objective, option: str | None) -> Objective:
    """The objective. ValueError where an option of the command line needs a likelihood, and it is none."""
    if option is not None and objective != "likelihood":
        what = "has no posterior" if option == "--sample" else "says nothing of readings"
        raise ValueError(f"{option} needs the objective 'likelihood': {objective!r} {what}")
    return objective


def _written(
    directory: Path,
    found: Fit,
    unseen: Measurements | None,
    text: str | None,
    force: bool,
    report: bool,
    progress: Progress | None,
    beside: Beside | None,
) -> Fitted:
    if progress is not None:
        progress(DRAWING, 0, 1)
    with replacing(directory, force) as folder:
        results.write_fit(found, folder, text)
        if unseen is not None:
            write_csv(unseen, folder / HELD_OUT)
        if report:
            foretold = write_report(folder, directory.resolve().name, found)
        else:
            foretold = None if unseen is None else foretell(found, None, unseen)
        fitted = Fitted(found, foretold)
        for name, content in (beside(fitted) if beside is not None else {}).items():
            write_json(folder / name, content)
    if progress is not None:
        progress(DRAWING, 1, 1)
    return fitted
