"""What is done with one chunk of a map, wherever it is done: measurements in, a chunk of the store out."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from fits.maps.descent import Texels, make_texels, with_own_directions
from fits.maps.emulator import EmulatedModel, Emulator, coarser, with_emulator
from fits.maps.inputs import Block, MapData, map_data
from fits.maps.options import MapOptions
from fits.maps.search import Fits, Starts, by_size, neighbours, reduced_chi_square, search
from fits.maps.store import FLAGS, Store, arrays_of
from fits.problem.model import Model
from fits.problem.problem import Problem

Floats = NDArray[np.float64]


class Part(NamedTuple):
    """The measurements of one block.

    values, sigma: (block shape, N, C), in 1/sr. mask: (block shape). wi, wo: (block shape, N, 3), None where all texels
    of the map have the same directions; sigma: None where nothing is known of it.
    """

    values: Floats
    sigma: Floats | None
    mask: NDArray[np.bool_]
    wi: Floats | None
    wo: Floats | None

    def texels(self, floor: float) -> Texels:
        """One after the other; floor: the least of the noise's, in 1/sr."""
        rank = self.mask.ndim
        flat = [None if one is None else one.reshape(-1, *one.shape[rank:]) for one in self]
        values, sigma, _, wi, wo = flat
        return make_texels(values, sigma, floor, wi, wo)  # type: ignore[arg-type]


def read_part(data: MapData, block: Block) -> Part:
    """The measurements of a block. ValueError: they cannot be read."""
    own = (None, None) if data.geometry is not None else data.read_directions(block)
    return Part(data.read(block), data.read_sigma(block), data.read_mask(block), *own)


def map_problem(problem: Problem, own: bool, emulator: Emulator | None) -> Problem:
    """A problem with the model of a map; own: texels have directions of their own."""
    problem = with_own_directions(problem) if own else problem
    return problem if emulator is None else problem.with_model(with_emulator(problem.model, emulator))


@dataclass(frozen=True)
class Job:
    """What all chunks of a map have in common.

    Attributes:
        path: of the store.
        problem: a prototype, whose measurements each texel's take the place of.
        starts: where fits begin.
        floor: the least of the noise's, in 1/sr.
        options: of the map; its chunk size is that of the program.
        numerical_error: of the model, in standard deviations, beside that of an emulator; None where there is none.
        source: of the measurements, or what `map_data` opens them from; None where each task brings its own.
    """

    path: str
    problem: Problem
    starts: Starts
    floor: float
    options: MapOptions
    numerical_error: float | None
    source: MapData | tuple[Any, Any, Any, Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        model = self.problem.model
        emulator = model.emulator if isinstance(model, EmulatedModel) else None
        return {one.name: getattr(self, one.name) for one in fields(self)} | {
            "emulator": emulator, "own": self.starts.known is None
        }  # fmt: skip

    def __setstate__(self, state: dict[str, Any]) -> None:
        emulator, own = state.pop("emulator"), state.pop("own")
        vars(self).update(state | {"problem": map_problem(state["problem"], own, emulator)})

    @cached_property
    def data(self) -> MapData:
        """The measurements, opened once in each process."""
        assert self.source is not None
        return self.source if isinstance(self.source, MapData) else map_data(*self.source)

    @cached_property
    def store(self) -> Store:
        """The store, opened once in each process."""
        return Store(self.path)


class Task(NamedTuple):
    """One chunk: its place, and its measurements where workers cannot read them themselves."""

    block: Block
    part: Part | None = None


def work(job: Job, task: Task) -> dict[str, int]:
    """Fit a chunk and write it, if a worker that was killed has not; returns how many texels have which flag."""
    flags = job.store.flags(task.block)
    if flags is None:
        results = fit_chunk(job, read_part(job.data, task.block) if task.part is None else task.part)
        job.store.write(task.block, results)
        flags = results["flags"]
    return {meaning: int(np.sum(flags & bit > 0)) for meaning, bit in FLAGS.items()}


def fit_chunk(job: Job, part: Part) -> dict[str, NDArray[Any]]:
    """The arrays of a store for one chunk, by their names, each of the chunk's shape."""
    names, mask = job.problem.names, part.mask.reshape(-1)
    texels = part.texels(job.floor)
    enough = texels.measurements >= len(names)
    fitted = np.flatnonzero(mask & enough)
    arrays = arrays_of(names, job.numerical_error is not None)
    results = {name: np.full(texels.number, fill, dtype) for name, (dtype, fill) in arrays.items()}
    results["measurements"][:] = texels.measurements
    results["flags"][~mask] |= FLAGS["masked"]
    results["flags"][mask & ~enough] |= FLAGS["too_few_measurements"]
    if len(fitted):
        rows = texels.rows(fitted)
        among = np.full(texels.number + 1, -1)  # places among the texels that are fitted; the last is none
        among[fitted] = np.arange(len(fitted))
        beside = among[neighbours(part.mask.shape)[fitted]]
        found, start, poor, restarted = search(
            job.problem, job.starts, rows, job.options.chunk_size, job.options, beside
        )
        finite = found.finite
        numbers = {"reduced_chi_square": reduced_chi_square(found, rows)}
        for place, name in enumerate(names):
            numbers |= {f"values/{name}": found.vector[:, place], f"errors/{name}": found.errors[:, place]}
        if job.numerical_error is not None:
            numbers["numerical_error"] = numerical_errors(job, found, rows)
        for name, array in numbers.items():
            results[name][fitted] = np.where(finite, array, np.nan)
        bits = 1 << np.arange(len(names), dtype=np.uint64)
        results["at_bound"][fitted] = np.sum(np.where(found.at_bound & finite[:, None], bits, 0), axis=1)
        results["start"][fitted] = start
        for meaning, holds in {
            "fitted": finite,
            "failed": ~finite,
            "converged": finite & found.converged,
            "at_bound": finite & found.at_bound.any(axis=1),
            "poor": finite & poor,
            "restarted": restarted,
            "unidentified": finite & found.unidentified,
        }.items():
            results["flags"][fitted[holds]] |= FLAGS[meaning]
    return {name: array.reshape(part.mask.shape) for name, array in results.items()}


def numerical_errors(job: Job, found: Fits, texels: Texels) -> Floats:
    """Of the model at the optimum, in standard deviations of the data, (M,): the pilot's, and what an emulator's last
    terms come to there."""
    assert job.numerical_error is not None
    errors = np.full(texels.number, job.numerical_error)
    if isinstance(job.problem.model, EmulatedModel):
        model = job.problem.model
        rough = job.problem.with_model(with_emulator(model, coarser(model.emulator)))
        predicted, sigma = by_size(
            lambda some, _: rough.call(_predicted, found.vector[some], found.predicted[some]),
            texels.number,
            job.options.chunk_size,
        )
        own = np.where(texels.used, np.sqrt(texels.variance), 0.0)
        apart = np.abs(predicted - found.predicted) / np.hypot(sigma, own)
        errors += np.max(np.where(texels.used, apart, 0.0), (1, 2))
    return errors


def _predicted(model: Model, vectors: Array, predicted: Array) -> tuple[Array, Array]:
    """What vectors (M, P) predict, and standard deviations about what another model `predicted`, (M, N, C) each."""
    return jax.lax.map(lambda row: (model.predict(row[0]), model.sigma_at(*row)), (vectors, predicted))
