"""What is done with one chunk of a map, wherever it is done: readings in, a chunk of the store out."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
import zarr
from jax import Array
from numpy.typing import NDArray

from fits.maps.chunk_files import Block
from fits.maps.inputs import Portable, Readings
from fits.maps.searching import Ends, Starts, neighbours, reduced_chi_square, search
from fits.maps.solving import Found, by_size
from fits.maps.store import FLAGS, arrays_of, flags_of, write_chunk
from fits.maps.tabulated import Table, Tabulated, coarser, with_table
from fits.maps.texels import Texels, texels, with_own_directions
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]


class Part(NamedTuple):
    """The readings of one block.

    values, sigma: (block shape, N, C), in 1/sr. mask: (block shape). wi, wo: (block shape, N, 3), None where all texels
    of the map have the same directions; sigma: None where nothing is known of it.
    """

    values: Floats
    sigma: Floats | None
    mask: NDArray[np.bool_]
    wi: Floats | None
    wo: Floats | None


def completed(problem: Problem, own: bool, table: Table | None) -> Problem:
    """A problem with the model of a map; own: texels have directions of their own; table: in place of a transport."""
    problem = with_own_directions(problem) if own else problem
    return problem if table is None else problem.with_model(with_table(problem.model, table))


def part_of(readings: Readings, block: Block) -> Part:
    """The readings of a block. Errors as those of `fits.maps.inputs.Readings`."""
    own = (None, None) if readings.geometry is not None else readings.read_directions(block)
    return Part(readings.read(block), readings.read_sigma(block), readings.read_mask(block), *own)


@dataclass(frozen=True)
class Job:
    """A map's work.

    Attributes:
        path: of the store.
        problem: a prototype, whose readings each texel's take the place of.
        starts: where fits begin.
        least: of the noise's floor, in 1/sr.
        size: texels of a chunk, and of the program.
        numerical_error: of the model, in standard deviations, beside that of a table; None where there is none.
        source: of the readings; None where each task brings its own.
    """

    path: str
    problem: Problem
    starts: Starts
    least: float
    size: int
    numerical_error: float | None
    source: Readings | Portable | None = None

    def __getstate__(self) -> dict[str, Any]:
        model = self.problem.model
        made = {"table": model.table if isinstance(model, Tabulated) else None, "own": self.starts.predicted is None}
        return {one.name: getattr(self, one.name) for one in fields(self)} | made

    def __setstate__(self, state: dict[str, Any]) -> None:
        table, own = state.pop("table"), state.pop("own")
        vars(self).update(state | {"problem": completed(state["problem"], own, table)})

    @cached_property
    def readings(self) -> Readings:
        """The readings, opened once in each process."""
        assert self.source is not None
        return self.source.open() if isinstance(self.source, Portable) else self.source

    @cached_property
    def store(self) -> zarr.Group:
        """The store, opened once in each process."""
        return zarr.open_group(self.path, mode="r+")


class Task(NamedTuple):
    """One chunk: its place, and its readings where workers cannot read them themselves."""

    block: Block
    part: Part | None = None


def work(job: Job, task: Task) -> dict[str, int]:
    """Fit a chunk and write it, if a worker that was killed has not; returns how many texels have which flag."""
    flags = flags_of(job.store, task.block)
    if flags is None:
        results = fit_chunk(job, part_of(job.readings, task.block) if task.part is None else task.part)
        write_chunk(job.store, task.block, results)
        flags = results["flags"]
    return {meaning: int(np.sum(flags & bit > 0)) for meaning, bit in FLAGS.items()}


def fit_chunk(job: Job, part: Part) -> dict[str, NDArray[Any]]:
    """The arrays of a store for one chunk, by their names, each of the chunk's shape."""
    shape = part.values.shape[:-2]
    rows, mask = rows_of(part, job.least), part.mask.reshape(-1)
    enough = rows.readings >= len(job.problem.names)
    fitted = np.flatnonzero(mask & enough)
    results = _empty(job, rows.number)
    results["readings"][:] = rows.readings
    results["flags"][~mask] |= FLAGS["masked"]
    results["flags"][mask & ~enough] |= FLAGS["too_few_readings"]
    if len(fitted):
        beside = _among(neighbours(shape), fitted)
        ends = search(job.problem, job.starts, rows.rows(fitted), job.size, beside)
        _fill(results, job, fitted, ends, rows.rows(fitted))
    return {name: array.reshape(shape) for name, array in results.items()}


def rows_of(part: Part, least: float) -> Texels:
    """The texels of a part, one after the other; least: of the noise's floor, in 1/sr."""
    rank = part.mask.ndim

    def flat(array: Any) -> Any:
        return None if array is None else array.reshape(-1, *array.shape[rank:])

    return texels(flat(part.values), flat(part.sigma), least, flat(part.wi), flat(part.wo))


def _among(beside: NDArray[np.int64], fitted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Neighbours by their places among the texels that are fitted; -1 for those that are not."""
    places = np.full(len(beside) + 1, -1)
    places[fitted] = np.arange(len(fitted))
    return places[beside[fitted]]


def _empty(job: Job, count: int) -> dict[str, NDArray[Any]]:
    arrays = arrays_of(job.problem.names, job.numerical_error is not None)
    return {name: np.full(count, fill, dtype) for name, (dtype, fill) in arrays.items()}


def _fill(results: dict[str, NDArray[Any]], job: Job, fitted: NDArray[np.int64], ends: Ends, rows: Texels) -> None:
    found = ends.found
    finite = np.isfinite(found.cost) & np.all(np.isfinite(found.vector), axis=1)
    for place, name in enumerate(job.problem.names):
        results[f"values/{name}"][fitted] = np.where(finite, found.vector[:, place], np.nan)
        results[f"errors/{name}"][fitted] = np.where(finite, found.errors[:, place], np.nan)
    results["reduced_chi_square"][fitted] = np.where(finite, reduced_chi_square(found, rows), np.nan)
    results["start"][fitted] = ends.start
    bits = 1 << np.arange(found.at_bound.shape[1], dtype=np.uint64)
    results["at_bound"][fitted] = np.sum(np.where(found.at_bound & finite[:, None], bits, 0), axis=1)
    if job.numerical_error is not None:
        results["numerical_error"][fitted] = np.where(finite, numerical_errors(job, found, rows), np.nan)
    for meaning, holds in {
        "fitted": finite,
        "failed": ~finite,
        "converged": finite & found.converged,
        "at_bound": finite & found.at_bound.any(axis=1),
        "poor": finite & ends.poor,
        "restarted": ends.restarted,
        "unidentified": finite & found.unidentified,
    }.items():
        results["flags"][fitted[holds]] |= FLAGS[meaning]


def numerical_errors(job: Job, found: Found, rows: Texels) -> Floats:
    """Of the model at the optimum, in standard deviations of the data, (M,): the sample's, and what a table's last
    terms come to there."""
    assert job.numerical_error is not None
    errors = np.full(rows.number, job.numerical_error)
    if isinstance(job.problem.model, Tabulated):
        model = job.problem.model
        rough = job.problem.with_model(with_table(model, coarser(model.table)))
        predicted, sigma = by_size(
            lambda some, _: rough.call(_predicted, found.vector[some], found.predicted[some]), rows.number, job.size
        )
        own = np.where(rows.used, np.sqrt(rows.variance), 0.0)
        errors += np.max(np.where(rows.used, np.abs(predicted - found.predicted) / np.hypot(sigma, own), 0.0), (1, 2))
    return errors


def _predicted(model: Model, vectors: Array, predicted: Array) -> tuple[Array, Array]:
    """What vectors (M, P) predict, and standard deviations about what another model `predicted`, (M, N, C) each."""
    return jax.lax.map(lambda row: (model.predict(row[0]), model.sigma_at(*row)), (vectors, predicted))
