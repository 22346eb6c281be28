"""What processes and chunks add to the fits: ratios of rates, milliseconds a chunk, bytes a worker."""

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any
from unittest.mock import patch

import jax.numpy as jnp
import numpy as np
from jax import Array

import fits
import layerjax as lj
from benchmarks.measuring.timing import once
from benchmarks.measuring.writing import Bar, figure, table
from benchmarks.studies.maps.cases import Case, StoredMap, job_of, painted_map, stored
from benchmarks.studies.maps.fitting import PROCESSES, Report, Row, Size, finished, fitted
from benchmarks.studies.maps.work import Meeting, Timed, redo, timed
from benchmarks.suite.maps import goniometer_slices
from fits.engines import local_cluster
from fits.engines import run as run_tasks
from fits.maps import texels
from fits.maps.inputs import Block

PAIR = Bar(1.8, 1.95, rate=True)
OVERHEAD, MEMORY = Bar(50.0, 10.0), Bar(1.5, 0.7)
MILLION = 1 << 20

WARM = 2
"""Chunks before those that count."""


@dataclass(frozen=True)
class Figure:
    """Something that was measured, in `unit`; each: the rounds of which it is the median."""

    what: str
    value: float
    unit: str
    bar: str
    verdict: str
    note: str
    each: tuple[float, ...] = ()


def run(case: Case, rows: Sequence[Row], size: Size, report: Report) -> list[Figure]:
    """Figures of the engines with the chunks of one map, of overhead, and of the memory that all maps took."""
    with painted_map(case, size.side) as one:
        fitted(one, size)
        figures = by_workers(one, size, report)
    report("overhead of a chunk")
    figures += overhead(size)
    most = max(rows, key=lambda row: row.peak)
    gigabytes = most.peak / 1e9
    figures.append(_figure("memory of a worker", gigabytes, "GB", MEMORY, f"the most that one has had: {most.name}"))
    for row in rows:
        start = max(0.0, row.whole - row.texels / row.rate)
        note = (
            f"the pilot, {figure(start)} s until workers are at work, and chunks; {figure(row.whole)} s of it measured"
        )
        seconds = row.pilot + start + MILLION / row.rate
        figures.append(_figure(f"a million texels: {row.name}", seconds, "s", None, note))
        note = f"{figure(row.first)} s with what is compiled, in a map of one chunk"
        figures.append(_figure(f"the pilot: {row.name}", row.pilot, "s", None, note))
    return figures


def by_workers(one: StoredMap, size: Size, report: Report) -> list[Figure]:
    """Rates of one worker process and of two, in turns."""
    job, tasks = job_of(one, size.chunk)
    rates: dict[str, list[float]] = {"one": [], "two": []}
    if why_no_cluster() is not None:
        return []
    for index in range(size.rounds):
        for name, workers in (("one", 1), ("two", PROCESSES)):
            with local_cluster(workers) as client:
                with _meeting(tasks, workers) as first:  # all have compiled
                    list(run_tasks(timed, job, first, client=client))
                turns = tasks * (workers * size.repeats)
                rates[name].append(steady(run_tasks(timed, job, turns, client=client, short=True)))
        rates_now = ", ".join(f"{name} {values[-1]:.0f}" for name, values in rates.items() if values)
        report(f"workers, round {index + 1}: fits/s of {rates_now}")
    note = f"{figure(float(np.median(rates['one'])))} fits/s of one spawned process with one thread"
    return [_ratio("2 processes against 1", rates["two"], rates["one"], PAIR, note)]


@contextmanager
def _meeting(tasks: list[Block], workers: int) -> Iterator[list[Meeting]]:
    """A chunk for each worker, after which they wait for each other."""
    with tempfile.TemporaryDirectory(prefix="layerjax-meeting-") as folder:
        yield [Meeting(task, folder, workers) for task in (tasks * workers)[:workers]]


def steady(results: Iterable[tuple[int, Any]]) -> float:
    """Fits a second while all workers are at work, each beyond its first chunk, which compiles."""
    by_worker: dict[int, list[Timed]] = {}
    for _, task in finished(results):
        by_worker.setdefault(task.process, []).append(task)
    for tasks in by_worker.values():
        tasks.sort(key=lambda task: task.began)
    begin = max(tasks[0].ended for tasks in by_worker.values())
    end = min(tasks[-1].ended for tasks in by_worker.values())
    if end <= begin:
        raise ValueError("too few chunks: a worker has had one alone")
    count = 0.0
    for task in (task for tasks in by_worker.values() for task in tasks):
        within = max(0.0, min(task.ended, end) - max(task.began, begin))
        count += task.fits * within / max(task.ended - task.began, 1e-9)
    return count / (end - begin)


def why_no_cluster() -> str | None:
    """Why there can be none, if there cannot."""
    try:
        import distributed  # noqa: F401
    except ImportError:
        return "distributed is not installed"
    return None


def nothing(stack: lj.Stack, wi: Array, wo: Array) -> Array:
    """A transport that costs nothing: a sum of four numbers, each with a shape of its own."""
    layer: Any = stack.layers[0]
    base: Any = stack.base
    ci, co = wi[:, 2], wo[:, 2]
    total = base.albedo + layer.albedo * ci + jnp.ravel(layer.thickness) * co + layer.phase.alpha * ci * co
    return total[:, None]


def overhead(size: Size) -> list[Figure]:
    """Milliseconds of a chunk of 1,024 texels beside its solution, with a model that costs nothing."""
    numbers = [fits.Free(0.5, 0.0, 2.0), fits.Free(0.5, 0.0, 1.0), fits.Free(0.5, 0.01, 1.0), fits.Free(0.5, 0.0, 1.0)]
    stack = lj.Stack([lj.Medium(numbers[0], numbers[1], lj.SGGX("surface", numbers[2]))], lj.Lambertian(numbers[3]))
    geometry, side, noise = goniometer_slices(), int(size.chunk**0.5), fits.Noise(relative=0.02)
    ci, co = geometry.wi[:, 2], geometry.wo[:, 2]
    exact = 0.5 * (1.0 + ci + co + ci * co)
    values = exact * (1.0 + 0.02 * np.random.default_rng(1).standard_normal((side, side, len(exact))))
    whole, solved = [], []
    with stored(stack, geometry, noise, nothing, values[..., None], {}) as one:
        fits.fit_map(
            stack,
            geometry,
            one.values,
            one.store,
            noise,
            transport=nothing,
            options=fits.MapOptions(chunk_size=size.chunk),
        )
        job, (task, *_) = job_of(one, size.chunk)
        for _ in range(WARM + 5 * size.rounds):
            with _solving() as spent:
                whole.append(1e3 * once(lambda: redo(job, task)))
            solved.append(1e3 * sum(spent))
    beside = (np.array(whole) - np.array(solved))[WARM:]
    note = f"{figure(float(np.median(whole[WARM:])))} ms with the solution of a model that costs nothing"
    name, each = f"a chunk of {side * side:,} texels beside its solution", tuple(map(float, beside))
    return [_figure(name, float(np.median(beside)), "ms", OVERHEAD, note, each)]


@contextmanager
def _solving() -> Iterator[list[float]]:
    """Seconds of each call that solves texels, as they come."""
    spent: list[float] = []

    call = texels._run

    def measured(*arguments: Any, **options: Any) -> Any:
        results: list[Any] = []
        spent.append(once(lambda: results.append(call(*arguments, **options))))
        return results[0]

    with patch.object(texels, "_run", measured):
        yield spent


def _figure(what: str, value: float, unit: str, bar: Bar | None, note: str, each: tuple[float, ...] = ()) -> Figure:
    words, verdict = (f"{bar.words()} {unit}".strip(), bar.verdict(value)) if bar else ("", "")
    return Figure(what, value, unit, words, verdict, note, each)


def _ratio(what: str, ours: Sequence[float], theirs: Sequence[float], bar: Bar, note: str) -> Figure:
    each = np.array(ours) / np.array(theirs)
    return _figure(what, float(np.median(each)), "", bar, note, tuple(map(float, each)))


def markdown(figures: Sequence[Figure]) -> str:
    """A table, with the notes in its last column."""
    header = ("what", "figure", "bar (aim)", "verdict", "of that")
    body = [(one.what, f"{figure(one.value)} {one.unit}".strip(), one.bar, one.verdict, one.note) for one in figures]
    return table(header, body)


def as_json(figures: Sequence[Figure]) -> list[dict[str, Any]]:
    """The figures as plain data."""
    return [asdict(one) for one in figures]
