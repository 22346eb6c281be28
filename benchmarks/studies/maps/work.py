"""What workers do here, and say of it: when it began and ended, in which process, and how much memory that has had."""

import os
import resource
import sys
import time
import uuid
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fits.maps.fit_map import fit_chunk
from fits.maps.inputs import Block
from fits.maps.pilot import Job
from fits.maps.search import likeliest
from fits.maps.store import FLAGS
from fits.maps.texels import Texels, model_of
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]

INSIDE = 1e-6
"""scipy begins at least so far from a face of the unit box."""


PATIENCE = 60.0
"""Seconds that a worker waits for the others."""


class Timed(NamedTuple):
    """A task that has been done.

    kind: "ours", "scipy" or "empty". fits: how many. began, ended: in seconds of the machine's clock. peak: bytes that
    the process has had in memory. costs: of scipy's fits.
    """

    kind: str
    fits: int
    began: float
    ended: float
    process: int
    peak: int
    costs: list[float] | None = None


class Texelwise(NamedTuple):
    """A task for scipy: a chunk, and places of texels in it."""

    task: Block
    places: tuple[int, ...]


class Meeting(NamedTuple):
    """A chunk, after which a worker waits in this folder until so many have come."""

    task: Block
    folder: str
    workers: int


def timed(job: Job, task: Block | Texelwise | Meeting) -> Timed:
    """Fit a chunk of a map, or some texels by scipy."""
    began, costs = time.monotonic(), None
    if isinstance(task, Meeting):
        count = redo(job, task.task)
        meet(Path(task.folder), task.workers)
        return Timed("ours", count, began, time.monotonic(), os.getpid(), peak())
    if isinstance(task, Texelwise):
        kind, rows = "scipy", rows_of(job, task)
        costs = [scipy_fit(job, rows.rows(place), unit) for place, unit in enumerate(first_starts(job, rows))]
        count = len(costs)
    else:
        kind, count = "ours", redo(job, task)
    return Timed(kind, count, began, time.monotonic(), os.getpid(), peak(), costs)


def redo(job: Job, task: Block) -> int:
    """A chunk as `fits.maps.fit_map.work` does it, also where it is done already; how many texels were fitted."""
    results = fit_chunk(job, task)
    job.store.write(task, results)
    return int(np.sum(results["flags"] & FLAGS["fitted"] > 0))


def meet(folder: Path, workers: int) -> None:
    """Wait until so many have come; or no longer, if some have not even begun by then."""
    (folder / uuid.uuid4().hex).touch()
    end = time.monotonic() + PATIENCE
    while len(os.listdir(folder)) < workers and time.monotonic() < end:
        time.sleep(0.01)


def empty(shared: Any, task: Any) -> Timed:
    """Nothing."""
    now = time.monotonic()
    return Timed("empty", 1, now, now, os.getpid(), 0)


def rows_of(job: Job, task: Texelwise) -> Texels:
    """The measurements of those texels."""
    return job.texels(task.task)[1].rows(list(task.places))


def first_starts(job: Job, rows: Texels) -> Floats:
    """Where `fits.fit_map` begins, in the unit box."""
    chosen = likeliest(job.problem, job.starts, rows, job.options.chunk_size, 1)[:, 0]
    return np.clip(job.starts.units[chosen], INSIDE, 1.0 - INSIDE)


def scipy_fit(job: Job, row: Texels, unit: Floats) -> float:
    """The cost of scipy's minimum, with compiled residuals and Jacobian, in the unit box, which suits it best."""
    arrays, (residuals, jacobian) = jax.tree.map(jnp.asarray, row), _compiled(job.problem)
    return float(
        least_squares(
            lambda at: np.asarray(residuals(at, arrays)),
            unit,
            jac=lambda at: np.asarray(jacobian(at, arrays)),
            bounds=(0.0, 1.0),
        ).cost
    )


def costs_at(job: Job, rows: Texels, vectors: Floats) -> Floats:
    """Half sums of squared residuals of texels at their vectors (M, P)."""
    return np.asarray(job.problem.call(_costs, vectors, rows), float)


def _costs(model: Model, vectors: Array, rows: Texels) -> Array:
    def one(row: tuple[Array, Texels]) -> Array:
        own = model_of(model, row[1])
        return own.cost_at(row[0], own.predict(row[0]))

    return jax.lax.map(one, (vectors, rows))


@cache
def _compiled(problem: Problem) -> tuple[Any, Any]:
    model = problem.model

    def residuals(unit: Array, row: Texels) -> Array:
        parts = model_of(model, row).residuals(model.box.from_unit(unit))
        return jnp.concatenate([part.reshape(-1) for part in parts])

    return jax.jit(residuals), jax.jit(jax.jacfwd(residuals))


def peak() -> int:
    """The most bytes that this process has had in memory."""
    status = Path("/proc/self/status")  # what the system counts for a process begins before its program does
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM"):
                return 1024 * int(line.split()[1])
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
