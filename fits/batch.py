"""Every file of a folder fitted by every one of several stacks: `fits.fit_files`, and `layerjax fit-many`.

OUT/FILE/STACK/       a result directory as `layerjax fit` writes it
OUT/FILE/search/      the best that a search found, and OUT/FILE/search-stacks/ all that it fitted
OUT/table.csv         a row for each file and stack; report.html is the same to read, with links
OUT/batch.store       what is done, and of what it was made
"""

import csv
import html
import io
import math
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from fits._files import given_path, named, read_json, require_switch, require_there, text_checksum, write_text
from fits.data.formats import sniff
from fits.data.formats.csv import write_csv
from fits.data.measurements import Measurements
from fits.data.reading import ReadOptions
from fits.data.totals import Totals
from fits.engines import Failure, run
from fits.engines.failures import one_line
from fits.optimise.fit import discrepancy_checkpoint
from fits.optimise.fit import fit as run_fit
from fits.optimise.options import options_from
from fits.prediction.options import ComparisonOptions
from fits.problem.compilation import make_room
from fits.problem.problem import Problem
from fits.problem.stack_file import ProblemFile, read_problem
from fits.progress import Progress, given_progress, silent
from fits.reports import results, tables
from fits.reports.html import FitReport
from fits.reports.pages import document, section, sentences
from fits.reports.verdicts import listed
from fits.store import Store, another, differences, fingerprint, holds_other_files
from fits.structure_search import search as run_search
from fits.structure_search import write_report as write_search
from layerjax._checks import require_count, require_kind, require_seed

TABLE, PAGE, STORE, SEARCH, STACKS = "table.csv", "report.html", "batch.store", "search", "search-stacks"

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

    Args:
        directory, force: as of `save_fit`.
        problem: the stack file.
        data, held_out: what is fitted, and what its prediction is scored by.
        starts, seed, progress: see `fit`; starts are kept beside the directory until it is there.
        report: write it and its pictures, which take longer than a fit of a transport in closed form.

    Raises:
        ValueError: as `fit` and `save_fit`; data are held out of an objective that has no predictive score.
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
    """What became of every file and stack.

    Attributes:
        directory: where results, table and page are.
        rows: a mapping for each file and stack, as a line of the table: `file`, `stack`, `result` ("converged", "not
            converged" or "failed"), `status` (of the fit, or why there is none), `standing` among the stacks of the
            file; of a fit `criterion` and `loss`, by which stacks are ranked (-2 log predictive density of held-out
            data, else AIC, else the named objective), `reduced_chi_square`, with and without the model discrepancy,
            values and errors of the parameters, those at a bound, the number of measurements, seconds; of a search the
            `structure` that is best.
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
        """The stack of the lowest loss of each file, or the only one that was fitted."""
        fitted = [row for row in self.rows if row["result"] != "failed"]
        files = [row["file"] for row in fitted]
        return {
            row["file"]: row["stack"] for row in fitted if row["standing"] == "best" or files.count(row["file"]) == 1
        }


def fit_files(
    files: str | Path | Sequence[str | Path],
    stacks: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    processes: int = 1,
    client: Any = None,
    search: bool | Mapping[str, Any] = False,
    read_options: ReadOptions | None = None,
    starts: int = 32,
    seed: int = 0,
    reports: bool = True,
    force: bool = False,
    progress: Progress | None = None,
) -> FittedFiles:
    """Fit every measurement file by every stack, each into a result directory ``out/FILE/STACK``, and tabulate them.

    What is there already is not done again; a run that was interrupted is resumed. A file that cannot be read, or a fit
    that fails, is a row with the reason, and the others are fitted.

    Args:
        files: a folder, of which files that hold no measurements are skipped, or files and folders.
        stacks: stack files; may be none with a search.
        out: directory to write, or to resume.
        processes, client: see `fits.engines.run`; with 1, fits come one after the other, each on all cores. Workers of
            a cluster see files and `out` by these paths.
        search: look for the stack behind each file as well; a mapping has the arguments of `fits.search`.
        read_options: how all files are read, see `fits.ReadOptions`.
        starts, seed: of each fit of `stacks`, see `fits.fit`.
        reports: with a report of each, whose pictures take longer than a fit by a transport in closed form.
        force: fit again what is there of another stack, of other settings or of what a file held before.
        progress: called with ("fits", done, all, file and stack).

    Raises:
        FileNotFoundError: no such file.
        ValueError: no file can be read; names that are there twice; a result of another stack or settings, unless
            `force`; a directory in use, or that holds something else; as `fits.engines.run`.
    """
    # what is fitted by what
    require_kind("read_options", read_options, ReadOptions, None)
    require_kind("search", search, bool, Mapping)
    require_count("starts", starts, 1)
    require_seed(seed)
    require_count("processes", processes, 1)
    require_switch("reports", reports)
    require_switch("force", force)
    files, stacks = _several("files", files), _several("stacks", stacks)
    read_options, out, progress = read_options or ReadOptions(), given_path("out", out), given_progress(progress)
    paths, skipped = _measurement_files(files, read_options.format)
    stack_files = _by_name([(path, path.stem) for path in stacks], (SEARCH, STACKS))
    given = {name: read_problem(path) for name, path in stack_files.items()}
    if not given and search is False:
        raise ValueError("neither a stack nor a search is given; there must be one of them")
    for problem in given.values():
        require_score(problem, bool(read_options.hold_out))
    searching = None if search is False else {"seed": seed} | ({} if search is True else dict(search))
    job = Job(out.absolute(), given, searching, read_options, {"starts": starts, "seed": seed}, reports, force)
    if not out.resolve().parent.is_dir():
        raise ValueError(f"{out}: there is no directory {out.parent}")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is a file, must be a directory")
    if holds_other_files(out, STORE):
        raise ValueError(
            f"{out}: is not empty, and holds no fits of files (no {STORE} of theirs): choose another directory"
        )
    # what is done, and what is left
    done = Store.read(out / STORE) if (out / STORE).is_file() else None
    # workers of a cluster have another working directory
    rows, tasks = _planned(job, [path if client is None else path.absolute() for path in paths.values()], done)
    if not tasks and all(row["result"] == "failed" for row in rows.values()):
        reasons = list(dict.fromkeys(row["status"] for row in rows.values()))
        raise ValueError(f"no file can be fitted: {'; '.join(reasons[:3])}")
    # fits, each row kept as it is there; table and page also of what is there when they are interrupted
    with named(out):
        out.mkdir(exist_ok=True)
    with Store.open(out / STORE, fingerprint(of="fit-many")) as store:
        total, count = len(rows), len(rows) - len(tasks)
        progress("fits", count, total)
        try:
            # by a single thread: a fit takes all cores, and another that waits for it could not be interrupted
            for index, outcome in run(fit_one, job, tasks, processes=processes, client=client, threads=1):
                task, count = tasks[index], count + 1
                if isinstance(outcome, Failure):
                    outcome = task.failed(outcome.error)
                else:
                    store.put(task.key, {"of": job.fingerprint(task), "row": outcome})
                rows[task.key] = outcome
                progress("fits", count, total, f"{task.path.name} by {task.stack}")
        finally:
            every = [row if _is_there(out, row) else _removed(row) for row in rows.values()]
            result = FittedFiles(out, ranked(every), skipped)
            write_text(out / TABLE, table_csv(result.rows), force=True)
            write_text(out / PAGE, page(result), force=True)
    return result


def _several(name: str, items: str | Path | Sequence[str | Path]) -> list[Path]:
    many = [items] if isinstance(items, str | Path) or not isinstance(items, Iterable) else items
    return [given_path(name, item) for item in many]


def _measurement_files(places: Sequence[str | Path], format: str | None) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Files by name, those of folders among them; and what folders hold that are no measurements.

    Raises:
        FileNotFoundError: no such file or folder.
        ValueError: a folder without measurements, or a name that is there twice.
    """

    def is_known(path: Path) -> bool:
        try:
            return bool(format or sniff(path))
        except (ValueError, OSError):
            return False

    files: list[Path] = []
    skipped: list[str] = []
    for place in map(Path, places):
        require_there(place, "no such file or folder")
        if not place.is_dir():
            files.append(place)
            continue
        every = sorted(one for one in place.iterdir() if one.is_file() and not one.name.startswith("."))
        some = [one for one in every if is_known(one)]
        if not some:
            raise ValueError(f"{place}: holds no measurement file")
        files += some
        skipped += [str(one) for one in every if one not in some]
    if not files:
        raise ValueError("no file is given; there must be at least one")
    return _by_name([(path, path.name) for path in files], (TABLE, PAGE, STORE)), tuple(skipped)


def _by_name(names: Sequence[tuple[Path, str]], taken: Sequence[str]) -> dict[str, Path]:
    """The paths by name. ValueError for a name that is there twice, or taken."""
    paths: dict[str, Path] = {}
    for path, name in names:
        if name in paths:
            raise ValueError(f"{paths[name]} and {path}: results go by this name, which must differ")
        if name in taken:
            raise ValueError(f"{path}: its name must be another: fit-many writes a {name} of its own")
        paths[name] = path
    return paths


class Task(NamedTuple):
    """A file, by its path and the checksum of its content, and the name of a stack."""

    path: Path
    content: str
    stack: str

    @property
    def key(self) -> str:
        """Key of its row in the store, and the place of its result."""
        return f"{self.path.name}/{self.stack}"

    def failed(self, why: str) -> Row:
        """Its row where there is no result."""
        return {"file": self.path.name, "stack": self.stack, "result": "failed", "status": why}


@dataclass(frozen=True)
class Job:
    """What all tasks have in common: where results go, stacks or how they are searched, and how files are read."""

    out: Path
    stacks: Mapping[str, ProblemFile]
    searching: Mapping[str, Any] | None
    read_options: ReadOptions
    fitting: Mapping[str, Any]
    reports: bool
    force: bool

    def fingerprint(self, task: Task) -> dict[str, str]:
        """What a result is made of."""
        how = self.searching if task.stack == SEARCH else {"stack": self.stacks[task.stack].text, **self.fitting}
        at = self.read_options.geometry
        how_read = {f"read {name}": value for name, value in vars(self.read_options).items()}
        how_read["read geometry"] = None if at is None else [at.wi, at.wo]
        return fingerprint(file=task.content, **how_read, **(how or {}))


def _planned(job: Job, files: list[Path], done: Store | None) -> tuple[dict[str, Row], list[Task]]:
    """A row for each file and stack, in order, and the tasks that are left, stack by stack: fits share programs."""
    rows: dict[str, Row] = {}
    tasks: list[Task] = []
    names = [*job.stacks, *([] if job.searching is None else [SEARCH])]
    for path in files:
        why, content = "not done yet", ""
        try:
            content = text_checksum(path)
        except OSError as error:
            why = one_line(error)
        every = [Task(path, content, name) for name in names]
        known = {task.key: row for task in every if content and done and (row := _kept_row(job, task, done))}
        left = [task for task in every if content and task.key not in known]
        try:
            if left:
                job.read_options.split(path)  # before any is fitted
                tasks += left
        except (ValueError, OSError) as error:
            why = one_line(error)
        rows |= {task.key: known.get(task.key) or task.failed(why) for task in every}
    return rows, sorted(tasks, key=lambda task: names.index(task.stack))


def _kept_row(job: Job, task: Task, done: Store) -> Row | None:
    """The row of a result that is there; None: it is to be fitted, or again where it is damaged.

    Raises:
        ValueError: a result of another file, stack or settings is in its place.
    """
    record = done.get(task.key)
    if record is None:
        return None
    words = differences(record["of"], job.fingerprint(task))
    if words and not job.force:
        raise ValueError(f"{another(job.out / task.key, words)}; --force, or force=True, fits it again")
    try:
        read_json(job.out / task.key / results.FIT)
    except (ValueError, OSError):
        return None
    return None if words else record["row"]


def _is_there(out: Path, row: Row) -> bool:
    """Whether a row has no result, or has it still: others may remove one while the rest are fitted."""
    return row["result"] == "failed" or (out / row["file"] / row["stack"] / results.FIT).is_file()


def _removed(row: Row) -> Row:
    return Task(Path(row["file"]), "", row["stack"]).failed("its result was removed during the run; run it again")


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
        structure = ""
        if task.stack == SEARCH:
            structure, whole = _searched(job, task, data, directory)
        else:
            options = {"force": True, "report": job.reports, **job.fitting}
            whole = fit_file(directory, job.stacks[task.stack], data, held_out, **options)
    except (ValueError, OSError):
        raise
    except Exception as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error
    fit, without = whole.fit, whole.fit.without_discrepancy
    row = task.failed(fit.status) | {
        "result": "converged" if fit.converged else "not converged",
        "structure": structure,
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


def _searched(job: Job, task: Task, data: Measurements, directory: Path) -> tuple[str, FitReport]:
    """The structure that a search found, and its fit as a result like others."""
    if isinstance(data, Totals):
        raise ValueError(f"{task.path}: holds totals; a search takes values along directions")
    stacks = directory.with_name(STACKS)
    if job.force and directory.exists() and stacks.exists():  # of another search
        shutil.rmtree(stacks)
    found = run_search(data, **(job.searching or {}), directory=stacks)
    write_search(found, stacks)
    whole = FitReport(found.best.fit, name=SEARCH)
    results.save_fit(whole.fit, directory, force=True)
    if job.reports:
        whole.write(directory)
    return found.best.name, whole


# ---- what became of them ----


def ranked(rows: Sequence[Row]) -> tuple[Row, ...]:
    """The rows with the `standing` of each among the stacks of its file: "best", "as good" as the best, or by how much
    its loss is higher; empty where nothing can be said.

    A best fit that misses the data by more than their noise says that the noise is larger than stated: differences in
    AIC are divided by its reduced chi-square, as in `fits.compare`.
    """
    standing: dict[int, str] = {}
    for file in {row["file"] for row in rows}:
        own = [row for row in rows if row["file"] == file and math.isfinite(row.get("loss", math.nan))]
        if len(own) < 2 or len({row["criterion"] for row in own}) > 1:
            continue
        best = min(own, key=lambda row: (row["result"] != "converged", row["loss"]))
        likelihood, ratio = best["criterion"] in ("AIC", "-2 elpd"), best["reduced_chi_square"]
        excess = ratio if best["criterion"] == "AIC" and ratio > 1.0 else 1.0
        for row in own:
            difference = (row["loss"] - best["loss"]) / excess
            close = likelihood and row["result"] == "converged" and difference < ComparisonOptions().slight_difference
            standing[id(row)] = "best" if row is best else "as good" if close else f"{difference:+.1f}"
    return tuple(row | {"standing": standing.get(id(row), "")} for row in rows)


def _cell(value: Any, digits: int) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.{digits}g}"
    return str(value)


def table_csv(rows: Sequence[Row]) -> str:
    """A line each; value and error of every parameter that any of them has, empty where it has none."""
    first = ("file", "stack", "structure", "result", "standing")
    last = ("measurements", "seconds", "at_bound", "status")
    names = dict.fromkeys(name for row in rows for name in row if name not in last)
    out = io.StringIO()
    writer = csv.DictWriter(out, list(dict.fromkeys((*first, *names, *last))), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value, 8) for name, value in row.items()} for row in rows)
    return out.getvalue()


def overview(rows: Sequence[Row], most: int | None = None) -> tables.Table:
    """A row each, without the parameters."""
    columns = ["file", "stack", "result", "standing", "reduced_chi_square", "criterion", "loss", "seconds", "structure"]
    columns = [*(name for name in columns if any(row.get(name, "") != "" for row in rows)), "status"]
    # all of the status is in the table and in the report of the fit
    shown = [tuple("; ".join(_cell(row.get(name, ""), 4).split("; ")[:2]) for name in columns) for row in rows]
    note = (
        "Standing: among the stacks of a file, by -2 log predictive density of held-out data, or else AIC: as good as "
        "the best, or the difference; where the best misses the data, the scatter that it leaves counts as noise."
    )
    return tables.Table("Fits", tuple(columns), tables.shortened(shown, most or len(shown)), note)


def statements(result: FittedFiles) -> list[str]:
    """What became of them, in sentences; the table says more."""
    counted = [row["result"] for row in result.rows]
    there, converged = len(counted) - counted.count("failed"), counted.count("converged")
    words = [f"{there} of {len(counted)} fits are there, {converged} of them converged."]
    if result.skipped:
        more = [f"{len(result.skipped) - 5} more"] if len(result.skipped) > 5 else []
        words.append(f"Not taken for measurements: {listed([*result.skipped[:5], *more])}.")
    return words


def page(result: FittedFiles) -> str:
    """The table with a link to each report, as one HTML file that stands beside the results."""
    title = f"Fits of {len({row['file'] for row in result.rows})} files"
    places = [f"{row['file']}/{row['stack']}/{results.REPORT}" for row in result.rows if row["result"] != "failed"]
    links = [
        f'<li><a href="{quote(place)}">{html.escape(place)}</a></li>'
        for place in places
        if (result.directory / place).is_file()
    ]
    reports = [section("Reports", f"<ul>{''.join(links)}</ul>")] if links else []
    body = [f"<h1>{html.escape(title)}</h1>", sentences(statements(result))]
    return document(title, [*body, section("All fits", overview(result.rows)), *reports])
