"""One file and one stack: the task of a worker."""

import shutil
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fits._files import named
from fits.batch.fitting import Fitted, fit_into, write_into
from fits.batch.inputs import SEARCH, STACKS
from fits.batch.origin import ORIGIN, Origin, fingerprint
from fits.batch.rows import Row, row_of
from fits.batch.searching import Searching, search_into
from fits.data.reading import ReadOptions
from fits.data.totals import Totals
from fits.names import Objective
from fits.problem.compilation import make_room
from fits.problem.stack_file import ProblemFile
from fits.structure_search.files import IDENTITY

_one_at_a_time = threading.Lock()
"""In a process: a fit takes all cores for its starts, pictures cannot be drawn side by side, and programs may go."""


@dataclass(frozen=True)
class Job:
    """What all tasks share: where results go, the stacks by name, and how files are read and fitted."""

    out: Path
    stacks: Mapping[str, ProblemFile]
    searching: Searching | None
    reading: ReadOptions
    objective: Objective | None
    starts: int
    seed: int
    solver: Any
    force: bool
    reports: bool

    def names(self) -> list[str]:
        """Of stacks, and of the search."""
        return [*self.stacks, *([] if self.searching is None else [SEARCH])]

    def origin(self, file: str, stack: str) -> Origin:
        """What the result is made of; file: its fingerprint."""
        reading = {name: _listed(value) for name, value in vars(self.reading).items()}
        if stack == SEARCH:
            assert self.searching is not None
            settings = {name: str(value) for name, value in vars(self.searching).items() if name != "library"}
            return Origin(file, fingerprint(repr(self.searching.library).encode()), settings | reading)
        fitting = {"objective": self.objective, "starts": self.starts, "seed": self.seed, "solver": self.solver}
        return Origin(file, fingerprint(self.stacks[stack].text.encode()), fitting | reading)


@dataclass(frozen=True)
class Task:
    """A file, by its path and fingerprint, and the name of a stack."""

    path: Path
    file: str
    stack: str

    def directory(self, out: Path) -> Path:
        """Where its result is."""
        return out / self.path.name / self.stack


def fit_one(job: Job, task: Task) -> Row:
    """Fit it, write its result, and tell.

    Raises:
        ValueError, OSError: it cannot be fitted. What is wrong with one of many ends none of the others.
    """
    with _one_at_a_time:
        make_room()
        try:
            return _fitted(job, task)
        except (ValueError, OSError):
            raise
        except Exception as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error


def _fitted(job: Job, task: Task) -> Row:
    began, directory = time.monotonic(), task.directory(job.out)
    if fingerprint(task.path.read_bytes()) != task.file:
        raise ValueError(f"{task.path}: was changed while others were fitted")
    data, held_out = job.reading.split(task.path)
    with named(directory.parent):
        directory.parent.mkdir(exist_ok=True)
    origin, structure = job.origin(task.file, task.stack), ""
    rows: list[Row] = []

    def beside(fitted: Fitted) -> dict[str, dict[str, Any]]:
        found = row_of(
            fitted,
            file=task.path.name,
            stack=task.stack,
            directory=directory.relative_to(job.out).as_posix(),
            structure=structure,
            seconds=time.monotonic() - began,
        )
        rows.append(found)
        return {ORIGIN: origin.plain(found)}

    if task.stack == SEARCH:
        assert job.searching is not None
        if isinstance(data, Totals):
            raise ValueError(f"{task.path}: holds totals; a search takes values along directions")
        stacks = directory.with_name(STACKS)
        if job.force and directory.exists() and (stacks / IDENTITY).is_file():  # of another search
            shutil.rmtree(stacks)
        best = search_into(stacks, data, job.searching).best
        structure = best.name
        write_into(directory, best.fit, force=job.force, report=job.reports, beside=beside)
    else:
        fit_into(
            directory,
            job.stacks[task.stack],
            data,
            held_out,
            objective=job.objective,
            starts=job.starts,
            seed=job.seed,
            solver=job.solver,
            force=job.force,
            report=job.reports,
            beside=beside,
        )
    return rows[-1]


def _listed(value: Any) -> Any:
    """As JSON gives it back."""
    return list(value) if isinstance(value, tuple) else value
