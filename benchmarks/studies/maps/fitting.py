"""Fits a second beside scipy, how good they are, and what the pilot takes."""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.measuring.writing import figure, table
from benchmarks.studies.maps.cases import Case, StoredMap, job_of, painted_map
from benchmarks.studies.maps.work import Texelwise, Timed, costs_at, rows_of, timed
from fits.engines import Failure
from fits.engines import run as run_tasks
from fits.maps.inputs import Block
from fits.maps.pilot import Job
from fits.maps.search import sigmas
from fits.maps.store import FittedMap
from fits.problem.model import predict_each

Floats = NDArray[np.float64]
Report = Callable[[str], None]

PROCESSES = 2
OTHER = 0.01
"""Difference of costs from which on ours is below scipy's because scipy is at another local minimum."""

ROUNDING = 1e-6
"""Most that a cost may be above scipy's: a fit stops where a full step is predicted to gain a hundredth of it."""


@dataclass(frozen=True)
class Size:
    """How much is measured.

    side: of the maps, in texels. chunk: texels. scipy: texels that it fits at a time, and times. checked: texels whose
    emulator is compared with a finer solution. rounds: of runs with other numbers of workers; repeats: of a map in
    each. tasks: empty ones.
    """

    side: int = 256
    chunk: int = 1024
    scipy: tuple[int, int] = (8, 24)
    checked: int = 64
    rounds: int = 5
    repeats: int = 2
    tasks: int = 2000


QUICK = Size(64, 256, (4, 6), 4, 1, 1, 200)


@dataclass(frozen=True)
class Row:
    """One map.

    rate, scipy: fits a second of `PROCESSES` processes that take turns with both; ratio: of the two. pilot: seconds of
    all that comes before the first chunk; first: of the same and compilation, in a map of one chunk. whole: seconds of
    the chunks of the map, workers' start in it. above: share of texels whose cost is above scipy's beyond rounding,
    below: well below it. width: of pulls, the one furthest from 1. emulator: largest numerical error of one at the
    optimum, in standard deviations, beside a finer solver. peak: bytes of a worker that compiles.
    """

    name: str
    texels: int
    rate: float
    scipy: float | None
    ratio: float | None
    bar: str
    verdict: str
    first: float
    pilot: float
    whole: float
    converged: float
    poor: float
    compared: int
    above: float | None
    below: float | None
    width: float
    chi_square: float
    emulator: float | None
    words: str
    peak: int


def run(cases: Sequence[Case], size: Size, with_peers: bool, report: Report) -> list[Row]:
    """Fit the maps and compare."""
    rows = []
    for case in cases:
        report(f"{case.name}: painted")
        with painted_map(case, size.side) as one:
            rows.append(measure(case, one, size, with_peers, report))
    return rows


def measure(case: Case, one: StoredMap, size: Size, with_peers: bool, report: Report) -> Row:
    """One map: fitted twice, the first time of one chunk, which compiles; then chunks by turns with scipy."""
    side = min(size.side, int(size.chunk**0.5))
    first, _, _ = fitted(one, size, np.load(one.values, mmap_mode="r")[:side, :side])
    pilot, whole, fit = fitted(one, size)
    report(f"{case.name}: {fit.values[fit.names[0]].size:,} texels, pilot {pilot:.0f} s, all others {whole:.0f} s")
    job, tasks = job_of(one, size.chunk)
    turns = by_turns(tasks, size if with_peers else replace(size, scipy=(0, size.scipy[1])))
    done = [*finished(run_tasks(timed, job, turns, processes=PROCESSES))]
    ours = rate([task for _, task in warm(done) if task.kind == "ours"])
    scipy = rate([task for _, task in warm(done) if task.kind == "scipy"]) if with_peers else None
    report(f"{case.name}: {ours:.0f} fits/s, scipy {figure(scipy)}")
    ratio = None if scipy is None else ours / scipy
    differences = _differences(job, fit, turns, done)
    return Row(
        name=case.name,
        texels=fit.flags.size,
        rate=ours,
        scipy=scipy,
        ratio=ratio,
        bar=_bar_words(case),
        verdict=_verdict(case, ours, ratio),
        first=first,
        pilot=pilot,
        whole=whole,
        converged=float(np.mean(fit.has("converged"))),
        poor=float(np.mean(fit.has("poor"))),
        compared=len(differences),
        above=float(np.mean(differences > ROUNDING)) if len(differences) else None,
        below=float(np.mean(differences < -OTHER)) if len(differences) else None,
        width=width_of_pulls(fit, one),
        chi_square=float(np.nanmean(fit.reduced_chi_square)),
        emulator=emulator_error(job, fit, size.checked),
        words=str(fit.attributes["numerical"].get("emulator", "")),
        peak=cold_peak(job, tasks),
    )


def cold_peak(job: Job, tasks: Sequence[Block]) -> int:
    """The most memory that a worker has had which compiles all programs and does a chunk, in bytes."""
    name = "jax_compilation_cache_dir"
    kept = jax.config.values[name]
    with tempfile.TemporaryDirectory(prefix="layerjax-cold-") as folder:
        jax.config.update(name, folder)  # workers use that of who starts them
        try:
            done = [*finished(run_tasks(timed, job, list(tasks[:PROCESSES]), processes=PROCESSES))]
        finally:
            jax.config.update(name, kept)
    return max(task.peak for _, task in done)


def _bar_words(case: Case) -> str:
    if case.rate is not None:
        return f"{case.rate.words()} fits/s"
    return f"{case.bar.words()} x scipy" if case.bar is not None else ""


def _verdict(case: Case, rate: float, ratio: float | None) -> str:
    if case.rate is not None:
        return case.rate.verdict(rate)
    return "no peer" if ratio is None else case.bar.verdict(ratio) if case.bar is not None else ""


def fitted(
    one: StoredMap, size: Size, values: Floats | None = None, processes: int = PROCESSES
) -> tuple[float, float, FittedMap]:
    """Seconds before the first chunk, seconds of the chunks, and the map. values: in the place of those in the file."""
    began, chunks_began = time.perf_counter(), []

    def progress(stage: str, done: int, total: int | None = None, info: str = "") -> None:
        if stage == "map" and done == 0:
            chunks_began.append(time.perf_counter())

    fit = fits.fit_map(
        one.stack,
        one.geometry,
        one.values if values is None else values,
        one.store if values is None else one.store.with_name("first.zarr"),
        one.noise,
        transport=one.transport,
        options=fits.MapOptions(chunk_size=size.chunk, processes=processes, progress=progress),
    )
    return chunks_began[0] - began, time.perf_counter() - chunks_began[0], fit


def by_turns(tasks: list[Block], size: Size) -> list[Block | Texelwise]:
    """Chunks of the map and texels for scipy, one after the other; of each kind what compiles stands in front."""
    generator = np.random.default_rng(5)
    texels, times = size.scipy
    chosen = np.linspace(0, len(tasks) - 1, times + PROCESSES).astype(int)
    turns: list[Block | Texelwise] = []
    for index in chosen:
        block = tasks[index]
        count = int(np.prod([one.stop - one.start for one in block]))
        places = np.sort(generator.choice(count, min(texels, count), replace=False))
        turns.append(tasks[index])
        if len(places):
            turns.append(Texelwise(tasks[index], tuple(int(place) for place in places)))
    return turns


def finished(results: Any) -> Any:
    """What tasks said; ValueError for one that failed."""
    for index, result in results:
        if isinstance(result, Failure):
            raise ValueError(f"a task of the benchmark failed: {result.error}")
        yield index, result


def warm(done: Sequence[tuple[int, Timed]]) -> list[tuple[int, Timed]]:
    """Without the first of its kind in each process, which compiles; all of them if there is nothing else."""
    compiled: set[tuple[int, str]] = set()
    counted = []
    for index, task in sorted(done, key=lambda entry: entry[1].began):
        if (task.process, task.kind) in compiled:
            counted.append((index, task))
        compiled.add((task.process, task.kind))
    others = {task.kind for _, task in done} - {task.kind for _, task in counted}
    return counted + [entry for entry in done if entry[1].kind in others]


def rate(tasks: Sequence[Timed]) -> float:
    """Fits a second of `PROCESSES` processes that are always at work."""
    return PROCESSES * sum(task.fits for task in tasks) / sum(task.ended - task.began for task in tasks)


def _differences(
    job: Job, fit: FittedMap, turns: Sequence[Block | Texelwise], done: Sequence[tuple[int, Timed]]
) -> Floats:
    """Our costs less scipy's, of the texels that it fitted."""
    parts = []
    for index, result in done:
        task = turns[index]
        if isinstance(task, Texelwise):
            rows, vectors = rows_of(job, task), vectors_of(fit, task)
            parts.append(costs_at(job, rows, vectors) - np.array(result.costs))
    return np.concatenate([np.empty(0), *parts])


def vectors_of(fit: FittedMap, task: Texelwise) -> Floats:
    """The fitted numbers of those texels, (M, P)."""
    places, block = list(task.places), task.task
    return np.stack([np.asarray(fit[f"values/{name}"][block]).ravel()[places] for name in fit.names], axis=1)


def width_of_pulls(fit: FittedMap, one: StoredMap) -> float:
    """Half of what the middle 68 % of the pulls span, of the parameter that is furthest from 1.

    Texels with an unidentified parameter or one at a bound do not count.
    """
    good = fit.has("converged") & ~fit.has("at_bound") & ~fit.has("unidentified")
    widths = []
    for name, truth in one.truth.items():
        pulls = ((fit.values[name] - truth) / fit.errors[name])[good]
        low, high = np.quantile(pulls, [0.158655, 0.841345])
        widths.append(0.5 * (high - low))
    return float(max(widths, key=lambda width: abs(width - 1.0)))


def emulator_error(job: Job, fit: FittedMap, checked: int) -> float | None:
    """Largest error of the model at the optimum, from the next finer resolution, in standard deviations."""
    problem = job.problem
    transport = problem.transport
    if not isinstance(transport, lj.AddingDoubling):
        return None
    at = np.linspace(0, fit.flags.size - 1, checked).astype(int)
    vectors = np.stack([fit.values[name].ravel()[at] for name in fit.names], axis=1)
    mine = np.asarray(problem.call(predict_each, vectors))
    fine = np.asarray(replace(problem, transport=transport.finer()).call(predict_each, vectors))
    sigma = sigmas(problem, vectors, fine)
    return float(np.max(np.abs(mine - fine) / sigma))


def markdown(rows: Sequence[Row]) -> str:
    """Rates, and under them how good the fits are."""
    rates = [
        (r.name, f"{r.texels:,}", figure(r.rate), figure(r.scipy), figure(r.ratio), r.bar, r.verdict) for r in rows
    ]
    header = ("map", "texels", "fits/s", "scipy's", "ratio", "bar (aim)", "verdict")
    good = [
        (
            r.name,
            f"{100 * r.converged:.2f} %",
            f"{100 * r.poor:.2f} %",
            f"{r.compared}",
            "-" if r.above is None else f"{100 * r.above:.1f} %",
            "-" if r.below is None else f"{100 * r.below:.1f} %",
            figure(r.width),
            figure(r.chi_square),
            figure(r.emulator),
        )
        for r in rows
    ]
    words = ("map", "converged", "poor", "compared", "above scipy's", "below", "pulls", "chi-square", "error, sd")
    words_of_emulators = "".join(f"- {r.name}: {r.words}.\n" for r in rows if r.words)
    return f"{table(header, rates)}\n{table(words, good)}\n{words_of_emulators}"


def as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows as plain data."""
    return [asdict(row) for row in rows]
