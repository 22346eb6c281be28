"""Larger maps and clusters on paper: what engines take to hand out tasks that are empty, and what follows from it."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.measuring.writing import figure, table
from benchmarks.studies.maps.engines import why_no_cluster
from benchmarks.studies.maps.fitting import PROCESSES, Report, Row, Size, finished
from benchmarks.studies.maps.work import empty
from fits.engines import run as run_tasks
from fits.progress import in_words

TEXELS = 4 << 20
CORES = (1, 16, 256)


@dataclass(frozen=True)
class Engine:
    """An engine with empty tasks: how many it hands out and takes back a second, and milliseconds of each."""

    name: str
    tasks: int
    rate: float
    milliseconds: float


@dataclass(frozen=True)
class Paper:
    """What a map of `TEXELS` costs on a cluster, by the rates of a row.

    seconds: of a chunk on a core. saturated: cores from which on the scheduler is too slow for them. times: seconds of
    the map on so many of `CORES`, the pilot, which one machine fits, among them.
    """

    name: str
    seconds: float
    saturated: float | None
    times: tuple[float, ...]


def run(rows: Sequence[Row], size: Size, report: Report) -> tuple[list[Engine], list[Paper]]:
    """Measure the engines, and reckon."""
    report(f"{size.tasks:,} empty tasks")
    engines = [_engine("threads", run_tasks(empty, None, range(size.tasks)))]
    handed: float | None = None
    if why_no_cluster() is None:
        tasks = run_tasks(empty, None, range(size.tasks), processes=PROCESSES, short=True)
        engines.append(_engine(f"dask, {PROCESSES} workers", tasks))
        handed = engines[-1].rate
    return engines, [on_paper(row, size.chunk, handed) for row in rows]


def on_paper(row: Row, chunk: int, handed: float | None, texels: int = TEXELS) -> Paper:
    """One map; handed: how often a second a scheduler hands out a chunk."""
    seconds, chunks = chunk * PROCESSES / row.rate, texels / chunk
    least = 0.0 if handed is None else chunks / handed
    times = tuple(row.pilot + max(chunks * seconds / cores, least) for cores in CORES)
    return Paper(row.name, seconds, None if handed is None else handed * seconds, times)


def _engine(name: str, results: Iterable[tuple[int, Any]]) -> Engine:
    """Rate of an engine from the end of the first task, when it has workers, to that of the last."""
    ended = sorted(task.ended for task in (task for _, task in finished(results)))
    seconds, count = max(ended[-1] - ended[0], 1e-9), len(ended) - 1
    return Engine(name, len(ended), count / seconds, 1e3 * seconds / count)


def markdown(engines: Sequence[Engine], papers: Sequence[Paper]) -> str:
    """Two tables."""
    body = [(e.name, f"{e.tasks:,}", figure(e.rate), figure(e.milliseconds)) for e in engines]
    handing = table(("engine", "empty tasks", "tasks/s", "ms a task"), body)
    header = ("map", "s a chunk and core", "scheduler full at", *(f"{cores} cores" for cores in CORES))
    lines = [
        (
            paper.name,
            figure(paper.seconds),
            "-" if paper.saturated is None else f"{figure(paper.saturated, 2)} cores",
            *(in_words(seconds) for seconds in paper.times),
        )
        for paper in papers
    ]
    return f"{handing}\n{table(header, lines)}"


def as_json(parts: Sequence[Engine] | Sequence[Paper]) -> list[dict[str, Any]]:
    """Plain data."""
    return [asdict(part) for part in parts]
