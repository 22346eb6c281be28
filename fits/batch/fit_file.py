"""A stack file fitted to measurements, as a result directory with its report: what `layerjax fit` does."""

from pathlib import Path
from typing import NamedTuple

from fits.data.formats.csv import write_csv
from fits.data.measurements import Measurements
from fits.optimise.fit import discrepancy_checkpoint
from fits.optimise.fit import fit as run_fit
from fits.optimise.options import options_from
from fits.optimise.result import Fit
from fits.problem.stack_file import ProblemFile
from fits.progress import Progress, silent
from fits.reports import results
from fits.reports.html import HeldOut, predict_held_out, write_report

DRAWING = "pictures and report"


class Fitted(NamedTuple):
    """A fit, and its prediction of held-out data; None without any."""

    fit: Fit
    held_out: HeldOut | None


def fit_into(
    directory: str | Path,
    problem: ProblemFile,
    data: Measurements,
    held_out: Measurements | None = None,
    *,
    starts: int = 32,
    seed: int = 0,
    force: bool = False,
    report: bool = True,
    progress: Progress | None = None,
) -> Fitted:
    """Fit what a stack file says and write the result directory, whole or not at all.

    Args:
        directory: as of `save_fit`.
        problem: the stack file.
        data, held_out: what is fitted, and what its prediction is scored by.
        starts, seed, progress: see `fit`; starts are kept beside the directory until it is there.
        force: replace an earlier result.
        report: with it and its pictures, which take longer than a fit of a transport in closed form.

    Raises:
        ValueError: as `fit` and `save_fit`; data are held out of an objective that has no predictive score.
    """
    require_score(problem, held_out is not None)
    target, progress = Path(directory).resolve(), progress or silent
    kept = target.with_name(f".{target.name}.starts")
    with results.writing(directory, force) as folder:
        fit = run_fit(
            problem.stack,
            data,
            transport=problem.transport,
            noise=problem.noise,
            scale=problem.scale,
            objective=problem.objective,
            instrument=problem.instrument,
            starts=starts,
            seed=seed,
            options=options_from(problem.options),
            progress=progress,
            checkpoint=kept,
        )
        progress(DRAWING, 0, 1)
        results.write_fit(fit, folder, problem.text)
        if held_out is not None:
            write_csv(held_out, folder / results.HELD_OUT)
        if report:
            predicted = write_report(folder, target.name, fit)
        else:
            predicted = None if held_out is None else predict_held_out(fit, None, held_out)
        progress(DRAWING, 1, 1)
    for one in (kept, discrepancy_checkpoint(kept)):
        one.unlink(missing_ok=True)
    return Fitted(fit, predicted)


def require_score(problem: ProblemFile, held_out: bool) -> None:
    """ValueError if data are held out of an objective that has no predictive score."""
    if held_out and problem.objective != "likelihood":
        raise ValueError(f"--hold-out needs the objective 'likelihood': {problem.objective!r} has no predictive score")
