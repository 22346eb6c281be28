"""Every file of a folder fitted by every one of several stacks: `fits.fit_files`, and `layerjax fit-many`.

OUT/FILE/STACK/       a result directory as `layerjax fit` writes it
OUT/table.csv         a row for each file and stack
OUT/batch.store       what is done, and of what it was made
"""

import csv
import io
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from fits._files import given_path, named, read_json, require_switch, require_there, text_checksum, write_text
from fits.data.formats import sniff
from fits.data.formats.csv import write_csv
from fits.data.measurements import Measurements
from fits.data.reading import ReadOptions
from fits.engines import Failure, one_line, run
from fits.optimise.fit import discrepancy_checkpoint
from fits.optimise.fit import fit as run_fit
from fits.optimise.options import options_from
from fits.problem.compilation import make_room
from fits.problem.problem import Problem
from fits.problem.stack_file import ProblemFile, read_problem
from fits.progress import Progress, given_progress, silent
from fits.reports import results, tables
from fits.reports.html import FitReport
from fits.reports.verdicts import listed
from fits.store import Store, another, differences, fingerprint, make_directory
from layerjax._checks import require_count, require_kind, require_seed

TABLE, STORE = "table.csv", "batch.store"

Row = dict[str, Any]


# ---- one file by one stack ----


def require_score(problem: ProblemFile, held_out: bool) -> None:
    """ValueError if data are held out of an objective that has no predictive score."""
    if held_out and problem.objective != "likelihood":
        raise ValueError(f"--hold-out needs the objective 'likelihood': {problem.objective!r} has no predictive score")


def fit_file(
    directory: str | Path,
    problem: ProblemFile,
    data: Measurements,
    held_out: Measurements | None = None,
    *,
    starts: int = 32,
    seed: int = 0,
    force: bool = False,
    report: bool = True,
    progress: Progress = silent,
) -> FitReport:
    """Fit what a stack file says and write the result directory, whole or not at all: what `layerjax fit` does.

    Starts are kept beside the directory until it is there. ValueError: as `fit`, `save_fit` and `require_score`.
    """
    require_score(problem, held_out is not None)
    target, stage = Path(directory).resolve(), "pictures and report"
    checkpoint = target.with_name(f".{target.name}.starts")
    with results.writing(directory, force) as folder:
        model = (problem.transport, problem.noise, problem.scale, problem.objective, problem.instrument)
        options, given = options_from(problem.options), Problem(problem.stack, data, *model)
        fit = run_fit(given, starts=starts, seed=seed, options=options, progress=progress, checkpoint=checkpoint)
        whole = FitReport(fit, name=target.name, held_out=held_out)
        progress(stage, 0, 1)
        results.write_fit(fit, folder, problem.text)
        if held_out is not None:
            write_csv(held_out, folder / results.HELD_OUT)
        if report:
            whole.write(folder)
        progress(stage, 1, 1)
    for path in (checkpoint, discrepancy_checkpoint(checkpoint)):
        path.unlink(missing_ok=True)
    return whole


# ---- all files by all stacks ----


@dataclass(frozen=True)
class FittedFiles:
    """Results of `fits.fit_files`.

    Attributes:
        directory: directory of results and table.
        rows: one mapping per file and stack, as in the table: `file`, `stack`, `result` ("converged", "not
            converged" or "failed"), `status` (of the fit, or why there is none), `standing` among the stacks of the
            file; of a fit `criterion` and `loss`, by which stacks are ranked (-2 log predictive density of held-out
            data, else AIC, else the named objective), `reduced_chi_square`, with and without the model discrepancy,
            values and errors of the parameters, those at a bound, the number of measurements, seconds.
        skipped: files of the folders that hold no measurements.
    """

    directory: Path
    rows: tuple[Row, ...]
    skipped: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every file was fitted by every stack, and all of the fits converged."""
        return all(row["result"] == "converged" for row in self.rows)

    @property
    def best(self) -> dict[str, str]:
        """The stack of the lowest loss of each file, where losses can be compared."""
        return {row["file"]: row["stack"] for row in self.rows if row["standing"] == "best"}


def fit_files(
    files: str | Path | Sequence[str | Path],
    stacks: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    processes: int = 1,
    client: Any = None,
    read_options: ReadOptions | None = None,
    starts: int = 32,
    seed: int = 0,
    reports: bool = True,
    force: bool = False,
    progress: Progress | None = None,
) -> FittedFiles:
    """Fit every measurement file by every stack, each into a result directory ``out/FILE/STACK``, and tabulate them.

    Finished fits are not repeated, so that an interrupted run resumes. A file that cannot be read, or a fit that fails,
    is a row with the reason.

    Args:
        files: a folder, of which files that hold no measurements are skipped, or files and folders.
        stacks: stack files.
        out: directory to write, or to resume.
        processes, client: see `fits.engines.connected`; with 1, fits come one after the other, each on all cores.
            Workers of a cluster see files and `out` by these paths.
        read_options: how all files are read, see `fits.ReadOptions`.
        starts, seed: of each fit, see `fits.fit`.
        reports: whether each fit gets a report, which takes longer than a fit by a transport in closed form.
        force: replace fits of another stack, other settings or changed files.
        progress: called with ("fits", done, all, file and stack).

    Raises:
        FileNotFoundError: no such file.
        ValueError: no file or stack is given; names that are there twice; a result of another stack or settings, unless
            `force`; a directory in use, or that holds something else; as `fits.engines.connected`.
    """
    # what is fitted by what
    require_kind("read_options", read_options, ReadOptions, None)
    require_count("starts", starts, 1)
    require_seed(seed)
    require_count("processes", processes, 1)
    require_switch("reports", reports)
    require_switch("force", force)
    read_options, out, progress = read_options or ReadOptions(), given_path("out", out), given_progress(progress)
    files, stacks = _several("files", files), _several("stacks", stacks)
    paths, skipped = _measurement_files(files, read_options.format)
    given = {path.stem: read_problem(path) for path in _named_apart(stacks, lambda one: one.stem)}
    if not given:
        raise ValueError("no stack is given; there must be at least one")
    for problem in given.values():
        require_score(problem, bool(read_options.hold_out))
    how_read = {f"read {name}": value for name, value in vars(read_options).items()}
    if read_options.geometry is not None:
        how_read["read geometry"] = [read_options.geometry.wi, read_options.geometry.wo]
    job = Job(out.absolute(), given, read_options, {"starts": starts, "seed": seed, "report": reports})

    with Store.open(make_directory(out, STORE), fingerprint(of="fit-many")) as store:
        # what is done, and what is left
        rows: dict[str, Row] = {}
        tasks: list[Task] = []
        for path in paths:
            try:
                content = text_checksum(path)
            except OSError as error:
                failed = [Task(path, name, {}).failed(one_line(error)) for name in given]
                rows |= {f"{row['file']}/{row['stack']}": row for row in failed}
                continue
            for name, problem in given.items():
                whose = fingerprint(file=content, stack=problem.text, **how_read, starts=starts, seed=seed)
                # workers of a cluster have another working directory
                task = Task(path if client is None else path.absolute(), name, whose)
                row = _kept_row(out, task, store, force)
                rows[task.key] = row or task.failed("not done yet")
                tasks += [] if row else [task]
        tasks.sort(key=lambda task: list(given).index(task.stack))  # fits of a stack share programs
        # fits, each row kept as it is there; the table also of what is there when they are interrupted
        total, count = len(rows), len(rows) - len(tasks)
        progress("fits", count, total)
        try:
            # by a single thread: a fit takes all cores, and another that waits for it could not be interrupted
            for index, outcome in run(fit_one, job, tasks, processes=processes, client=client, threads=1):
                task, count = tasks[index], count + 1
                if isinstance(outcome, Failure):
                    outcome = task.failed(outcome.error)
                else:
                    store.put(task.key, {"of": task.fingerprint, "row": outcome})
                rows[task.key] = outcome
                progress("fits", count, total, f"{task.path.name} by {task.stack}")
        finally:
            result = FittedFiles(out, ranked(list(rows.values())), skipped)
            write_text(out / TABLE, table_csv(result.rows), force=True)
    return result


def _several(name: str, items: str | Path | Sequence[str | Path]) -> list[Path]:
    many = [items] if isinstance(items, str | Path) or not isinstance(items, Iterable) else items
    return [given_path(name, item) for item in many]


def _measurement_files(places: Sequence[Path], format: str | None) -> tuple[list[Path], tuple[str, ...]]:
    """Files, those of folders among them; and what folders hold that are no measurements.

    FileNotFoundError: no such file or folder. ValueError: no measurements, or a name that is there twice.
    """

    def is_known(path: Path) -> bool:
        try:
            return bool(format or sniff(path))
        except (ValueError, OSError):
            return False

    files: list[Path] = []
    skipped: list[str] = []
    for place in places:
        require_there(place, "no such file or folder")
        if place.is_dir():
            every = sorted(one for one in place.iterdir() if one.is_file() and not one.name.startswith("."))
            files += (some := [one for one in every if is_known(one)])
            skipped += [str(one) for one in every if one not in some]
        else:
            files.append(place)
    if not files:
        raise ValueError(f"{', '.join(map(str, places))}: no measurement file is given; there must be at least one")
    if of_batch := [path for path in files if path.name in (TABLE, STORE)]:
        raise ValueError(f"{of_batch[0]}: the batch has a file of this name, give it another")
    return _named_apart(files, lambda path: path.name), tuple(skipped)


def _named_apart(paths: list[Path], name: Callable[[Path], str]) -> list[Path]:
    """These paths, or ValueError for two of one name."""
    first: dict[str, Path] = {}
    for path in paths:
        if (other := first.setdefault(name(path), path)) is not path:
            raise ValueError(f"{other} and {path}: results go by this name, which must differ")
    return paths


class Task(NamedTuple):
    """A file, the name of a stack, and what a result is made of."""

    path: Path
    stack: str
    fingerprint: dict[str, str]

    @property
    def key(self) -> str:
        """Key of its row in the store, and the place of its result."""
        return f"{self.path.name}/{self.stack}"

    def failed(self, why: str) -> Row:
        """Its row where there is no result."""
        return {"file": self.path.name, "stack": self.stack, "result": "failed", "status": why}


class Job(NamedTuple):
    """What all tasks have in common: where results go, stacks by name, and how files are read and fitted."""

    out: Path
    stacks: Mapping[str, ProblemFile]
    read_options: ReadOptions
    fitting: Mapping[str, Any]


def _kept_row(out: Path, task: Task, store: Store, force: bool) -> Row | None:
    """The row of a result that is there; None: it is to be fitted, or again where it is damaged.

    ValueError: a result of another file, stack or settings is in its place, unless `force`.
    """
    if (record := store.get(task.key)) is None:
        return None
    words = differences(record["of"], task.fingerprint)
    if words and not force:
        raise ValueError(f"{another(out / task.key, words)}; --force, or force=True, fits it again")
    try:
        read_json(out / task.key / results.FIT)
    except (ValueError, OSError):
        return None
    return None if words else record["row"]


def fit_one(job: Job, task: Task) -> Row:
    """Fit one file by one stack and write the result, in whatever process; its row of the table.

    Raises:
        ValueError, OSError: it cannot be fitted. What is wrong with one of many ends none of the others.
    """
    make_room()
    began, directory = time.monotonic(), job.out / task.key
    try:
        data, held_out = job.read_options.split(task.path)
        with named(directory.parent):
            directory.parent.mkdir(exist_ok=True)
        whole = fit_file(directory, job.stacks[task.stack], data, held_out, force=True, **job.fitting)
    except (ValueError, OSError):
        raise
    except Exception as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    fit, without = whole.fit, whole.fit.without_discrepancy
    row = task.failed(fit.status) | {
        "result": "converged" if fit.converged else "not converged",
        "criterion": "AIC" if fit.is_posterior else fit.problem.objective,
        "loss": 2.0 * len(fit.vector) - 2.0 * fit.log_likelihood if fit.is_posterior else fit.chi_square,
        "reduced_chi_square": fit.reduced_chi_square,
        "without discrepancy": without.chi_square / max(without.degrees_of_freedom, 1) if without else math.nan,
    }
    if whole.predicted is not None:
        scores = whole.predicted.scores
        row |= {"criterion": "-2 elpd", "loss": -2.0 * scores.elpd * scores.count}
    for name, value in fit.values.items():
        row |= {name: value, f"{name} error": fit.standard_errors[name]}
    row |= {"at_bound": " ".join(fit.at_bound), "measurements": int(fit.problem.data.mask.sum())}
    return row | {"seconds": round(time.monotonic() - began, 2)}


# ---- what became of them ----


def ranked(rows: Sequence[Row]) -> tuple[Row, ...]:
    """The rows with the `standing` of each among the stacks of its file: "best", or by how much its loss is higher;
    empty where nothing can be said."""
    standing: dict[int, str] = {}
    for file in {row["file"] for row in rows}:
        own = [row for row in rows if row["file"] == file and math.isfinite(row.get("loss", math.nan))]
        if len({row["criterion"] for row in own}) == 1:
            best = min(own, key=lambda row: (row["result"] != "converged", row["loss"]))
            standing |= {id(row): f"{row['loss'] - best['loss']:+.1f}" for row in own} | {id(best): "best"}
    return tuple(row | {"standing": standing.get(id(row), "")} for row in rows)


def _cell(value: Any, digits: int) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.{digits}g}"
    return str(value)


def table_csv(rows: Sequence[Row]) -> str:
    """A line each; value and error of every parameter that any of them has, empty where it has none."""
    first, last = ("file", "stack", "result", "standing"), ("measurements", "seconds", "at_bound", "status")
    names = dict.fromkeys(name for row in rows for name in row if name not in last)
    out = io.StringIO()
    writer = csv.DictWriter(out, list(dict.fromkeys((*first, *names, *last))), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value, 8) for name, value in row.items()} for row in rows)
    return out.getvalue()


def overview(rows: Sequence[Row], most: int) -> tables.Table:
    """A row each, without the parameters."""
    columns = ["file", "stack", "result", "standing", "reduced_chi_square", "criterion", "loss", "seconds", "status"]
    shown = [tuple(_cell(row.get(name, ""), 4) for name in columns) for row in rows]
    note = "Standing: among the stacks of a file, by -2 log predictive density of held-out data, or else AIC."
    return tables.Table("Fits", tuple(columns), tables.shortened(shown, most), note)


def statements(result: FittedFiles) -> list[str]:
    """What became of them, in sentences; the table says more."""
    counted = [row["result"] for row in result.rows]
    there, converged = len(counted) - counted.count("failed"), counted.count("converged")
    words = [f"{there} of {len(counted)} fits are there, {converged} of them converged."]
    return words + ([f"Not taken for measurements: {listed(result.skipped)}."] if result.skipped else [])
