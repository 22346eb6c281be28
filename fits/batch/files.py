"""Every file of a folder fitted by every one of several stacks: `fits.fit_files`, and `layerjax fit-many`.

OUT/FILE/STACK/       a result directory as `layerjax fit` writes it; origin.json says what it was made of
OUT/FILE/search/      the best that a search found, and OUT/FILE/search-stacks/ all that it fitted
OUT/table.csv         a row for each file and stack, also as table.json and, to read, as report.html
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from fits._files import locked, named, read_json, write_json, write_text
from fits.batch.fitting import require_posterior
from fits.batch.inputs import PAGE, TABLE, TABLE_JSON, measurement_files, stack_files
from fits.batch.origin import ORIGIN, Foreign, Other, done_before, fingerprint
from fits.batch.page import page
from fits.batch.rows import Row, best_of
from fits.batch.searching import Searching
from fits.batch.table import KIND, table_csv, table_json
from fits.batch.work import Job, Task, fit_one
from fits.data.reading import ReadOptions
from fits.engines import Failure, run
from fits.engines.failures import one_line
from fits.names import Objective, Strata
from fits.optimise.multi_start import Solver
from fits.progress import Progress
from fits.reports.results import FIT, REPORT

LOCK = "fit-many.lock"
NOT_YET = "not done yet"
NAMED = 3
"""Reasons that are given where no file can be fitted."""


@dataclass(frozen=True)
class FittedFiles:
    """What became of every file and stack.

    Attributes:
        directory: where results, table and page are.
        rows: one a file and stack, files as they were given, stacks within them.
        left_out: files of the folders that hold no measurements.
    """

    directory: Path
    rows: tuple[Row, ...]
    left_out: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every file was fitted by every stack, and all of the fits converged."""
        return all(row.fitted and row.converged for row in self.rows)

    @property
    def best(self) -> dict[str, str]:
        """By file, the stack that foretells what was held out best, or else has the lowest AIC."""
        return best_of(self.rows)


def fit_files(
    files: str | Path | Sequence[str | Path],
    stacks: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    processes: int = 1,
    client: Any = None,
    search: bool | Searching = False,
    format: str | None = None,
    quantity: str | None = None,
    bins: int | Literal["all"] | None = None,
    strata: Strata | None = None,
    wavelengths: tuple[float, float] | None = None,
    corrected: bool | None = None,
    min_retro_angle: float | None = None,
    max_polar_angle: float | None = None,
    select: Sequence[str] = (),
    hold_out: Sequence[str] = (),
    objective: Objective | None = None,
    starts: int = 32,
    seed: int = 0,
    solver: Solver = "least_squares",
    reports: bool = True,
    force: bool = False,
    progress: Progress | None = None,
) -> FittedFiles:
    """Fit every measurement file by every stack, each into a result directory ``out/FILE/STACK``, and tabulate them.

    What is there already is not done again; a run that was interrupted goes on. A file that cannot be read, or a fit
    that fails, is a row with the reason, and the others go on.

    Args:
        files: a folder, of which files that hold no measurements are left out, or files and folders.
        stacks: stack files; may be none where a search is asked for.
        out: directory to write, or to go on with.
        processes, client: see `fits.engines.run`; with 1, fits come one after the other, each on all cores. Workers of
            a cluster see files and `out` by these paths.
        search: look for the stack behind each file as well; a `Searching` says how.
        format to hold_out: of all files, see `fits.data.reading.ReadOptions`.
        objective, starts, seed, solver: of each fit of `stacks`, see `fits.fit`; objective: instead of the file's.
        reports: with a report of each, whose pictures take longer than a fit by a transport in closed form.
        force: fit again what is there of another stack, of other settings or of what a file held before.
        progress: called with ("fits", done, all, file and stack).

    Raises:
        FileNotFoundError: no such file.
        ValueError: no file can be read; names that are there twice; a result of another stack or settings, unless
            `force`; a directory in use, or that holds something else; as `fits.engines.run`.
    """
    parts = tuple(select), tuple(hold_out)
    reading = ReadOptions(
        format, quantity, bins, strata, wavelengths, corrected, min_retro_angle, max_polar_angle, *parts
    )
    found, left_out = measurement_files(_several(files), format)
    given = stack_files(_several(stacks))
    for problem in given.values():
        require_posterior(objective or problem.objective, "--hold-out" if hold_out else None)
    searching = Searching(seed=seed) if search is True else search or None
    out = Path(out)
    job = Job(out.absolute(), given, searching, reading, objective, starts, seed, solver, force, reports)
    _require_use(job)
    with _held(out):
        return _carried_out(job, _Plan.of(job, out, found, here=client is None), left_out, processes, client, progress)


def _require_use(job: Job) -> None:
    """ValueError where there is nothing to fit, or what is said of fits is said of none."""
    if not job.names():
        raise ValueError("no stack is given, nor a search asked for; there must be one of them")
    for name, usual in (("objective", None), ("solver", "least_squares")):
        if not job.stacks and getattr(job, name) != usual:
            raise ValueError(
                f"{name} is {getattr(job, name)!r} and no stack is given; a search fits likelihoods, by least squares"
            )


def _carried_out(
    job: Job, plan: "_Plan", left_out: tuple[str, ...], processes: int, client: Any, progress: Progress | None
) -> FittedFiles:
    """What is left of a plan is done, and all of it is told."""
    plan.require_readable()
    plan.write(left_out, pictures=False)
    try:
        _fit_all(job, plan, processes, client, progress)
    except BaseException:
        with suppress(OSError):
            plan.write(left_out, pictures=False)
        raise
    plan.require_results()
    plan.write(left_out, pictures=True)
    return FittedFiles(plan.out, plan.ordered, left_out)


def _fit_all(job: Job, plan: "_Plan", processes: int, client: Any, progress: Progress | None) -> None:
    done, total = len(plan.rows) - len(plan.tasks), len(plan.rows)
    if progress is not None:
        progress("fits", done, total)
    # by a single thread: a fit takes all cores, and another that waits for it could not be interrupted
    for index, outcome in run(fit_one, job, plan.tasks, processes=processes, client=client, threads=1):
        task = plan.tasks[index]
        row = Row(task.path.name, task.stack, failure=outcome.error) if isinstance(outcome, Failure) else outcome
        plan.rows[task.path.name, task.stack] = row
        done += 1
        if progress is not None:
            progress("fits", done, total, f"{task.path.name} by {task.stack}")


@dataclass
class _Plan:
    """A row for each file and stack, in order; and the tasks that are left, stack by stack: they share programs."""

    job: Job
    out: Path
    here: bool
    rows: dict[tuple[str, str], Row] = field(default_factory=dict)
    tasks: list[Task] = field(default_factory=list)

    @classmethod
    def of(cls, job: Job, out: Path, files: dict[str, Path], here: bool) -> "_Plan":
        """Files are read, and results that are there looked at.

        here: whether workers share this working directory.

        Raises:
            ValueError: a result of something else is there.
        """
        plan = cls(job, out, here)
        for name, path in files.items():
            plan._add(name, path)
        order = job.names()
        plan.tasks.sort(key=lambda task: order.index(task.stack))
        return plan

    def _add(self, name: str, path: Path) -> None:
        job, left = self.job, list[Task]()
        try:
            fingerprint_of = fingerprint(path.read_bytes())
        except OSError as error:
            self._fail(name, job.names(), one_line(error))
            return
        for stack in job.names():
            task = Task(path if self.here else path.absolute(), fingerprint_of, stack)
            self.rows[name, stack] = Row(name, stack, failure=NOT_YET)
            try:
                row = done_before(task.directory(self.out), job.origin(fingerprint_of, stack))
            except Foreign:
                raise
            except Other as error:
                if not job.force:
                    raise ValueError(f"{error} (--force, or force=True, fits it again)") from None
                row = None
            except ValueError as error:
                if not job.force:
                    self._fail(name, [stack], f"{one_line(error)} (--force fits it again)")
                    continue
                row = None
            if row is None:
                left.append(task)
            else:
                self.rows[name, stack] = row
        if left:
            try:
                job.reading.split(path)
            except (ValueError, OSError) as error:
                self._fail(name, [task.stack for task in left], one_line(error))
                return
        self.tasks += left

    def _fail(self, file: str, stacks: list[str], why: str) -> None:
        for stack in stacks:
            self.rows[file, stack] = Row(file, stack, failure=why)

    @property
    def ordered(self) -> tuple[Row, ...]:
        return tuple(self.rows.values())

    def require_readable(self) -> None:
        """ValueError that says why, where nothing is done nor left to be done."""
        if self.tasks or any(row.fitted for row in self.rows.values()):
            return
        reasons = list(dict.fromkeys(row.failure for row in self.rows.values()))
        more = f"; and {len(reasons) - NAMED} more" if len(reasons) > NAMED else ""
        raise ValueError(f"no file can be fitted: {'; '.join(reasons[:NAMED])}{more}")

    def require_results(self) -> None:
        """What was removed while others were fitted is not there."""
        for at, row in self.rows.items():
            if row.fitted and not all((self.out / row.directory / name).is_file() for name in (ORIGIN, FIT)):
                why = f"{row.directory}: was removed while others were fitted"
                self.rows[at] = Row(row.file, row.stack, failure=why)

    def write(self, left_out: Sequence[str], pictures: bool) -> None:
        """Table and page of what is done by now."""
        job, rows = self.job, self.ordered
        settings: dict[str, Any] = {"starts": job.starts, "seed": job.seed, "solver": job.solver}
        settings |= {"objective": job.objective, "searching": None if job.searching is None else repr(job.searching)}
        settings |= vars(job.reading)
        drawn = {row.directory for row in rows if row.fitted and (self.out / row.directory / REPORT).is_file()}
        write_json(self.out / TABLE_JSON, table_json(rows, left_out, settings), force=True)
        write_text(self.out / TABLE, table_csv(rows), force=True)
        write_text(self.out / PAGE, page(rows, left_out, pictures, drawn), force=True)


@contextmanager
def _held(out: Path) -> Iterator[None]:
    """While the block lasts no other process writes there; a new directory goes again if nothing comes into it.

    Raises:
        ValueError: it cannot be made, is in use, or holds something else.
    """
    if not out.resolve().parent.is_dir():
        raise ValueError(f"{out}: there is no directory {out.parent}")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is a file, must be a directory")
    with named(out):
        out.mkdir(exist_ok=True)
    try:
        with locked(out / LOCK, str(out)):
            others = [one for one in out.iterdir() if one.name != LOCK]
            if others and not _ours(out / TABLE_JSON):
                raise ValueError(f"{out}: is not empty, and holds no fits of files (no {TABLE_JSON} of theirs)")
            yield
    finally:
        with suppress(OSError):
            out.rmdir()


def _ours(table: Path) -> bool:
    """Whether a directory with this table, or where it should be, is one of ours; a damaged one is written again."""
    try:
        return table.is_file() and KIND in read_json(table)
    except ValueError:
        return True


def _several(given: str | Path | Sequence[str | Path]) -> list[str | Path]:
    return [given] if isinstance(given, str | Path) else list(given)
