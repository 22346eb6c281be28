"""Progress of long steps: a bar on a terminal, an occasional plain line elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, TextIO

SECONDS_BETWEEN_LINES = 10.0


class Progress(Protocol):
    """Callback of long steps: the stage, steps done, total steps (None: unknown), a note."""

    def __call__(self, stage: str, done: int, total: int | None = None, info: str = "") -> None: ...


def silent(stage: str, done: int, total: int | None = None, info: str = "") -> None:
    """Show nothing."""


def given_progress(progress: Progress | None) -> Progress:
    """The callback that an argument is; None shows nothing. ValueError for what cannot be called."""
    if progress is not None and not callable(progress):
        raise ValueError(f"progress: {progress!r:.60} is not a function, such as progress(stage, done, total, note)")
    return progress or silent


def named(name: str, progress: Progress) -> Progress:
    """The same progress, with a name before each stage."""

    def report(stage: str, done: int, total: int | None = None, info: str = "") -> None:
        progress(f"{name}: {stage}", done, total, info)

    return report


class _Pace:
    """Adds the time left of a stage to its note: at its pace so far, without the first step, which compiles."""

    def __init__(self) -> None:
        self.marks: dict[str, list[tuple[float, int]]] = {}
        self.last: dict[str, int] = {}

    def noted(self, stage: str, done: int, total: int | None, info: str) -> str:
        now = time.monotonic()
        if done < self.last.get(stage, done + 1):  # it starts, or starts again
            self.marks[stage] = [(now, done)]
        marks, self.last[stage] = self.marks[stage], done
        if total is None or not marks[0][1] < done < total:
            return info
        start, first = marks[-1] if done > marks[-1][1] else marks[0]
        if len(marks) == 1:
            marks.append((now, done))
        left = f"about {in_words((now - start) / (done - first) * (total - done))} left"
        return f"{left}; {info}" if info else left


class _Lines:
    """At most one line per `SECONDS_BETWEEN_LINES`, plus one when a stage begins and one when it is complete."""

    def __init__(self, stream: TextIO):
        self.stream = stream
        self.stage, self.written, self.pace = "", 0.0, _Pace()

    def __call__(self, stage: str, done: int, total: int | None = None, info: str = "") -> None:
        now = time.monotonic()
        complete, info = total is not None and done >= total, self.pace.noted(stage, done, total, info)
        if stage == self.stage and not complete and now - self.written < SECONDS_BETWEEN_LINES:
            return
        self.stage, self.written = stage, now
        count = f"{done}/{total}" if total is not None else str(done)
        print(f"layerjax: {stage} {count}{f' ({info})' if info else ''}", file=self.stream, flush=True)


@contextmanager
def show_progress(stream: TextIO | None = None) -> Iterator[Progress]:
    """Yield the callback for `progress=`; the bar is drawn on `stream` (stderr) and removed when the block ends."""
    stream = sys.stderr if stream is None else stream
    if not stream.isatty():
        yield _Lines(stream)
        return

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[info]}"),
    )
    with Bars(*columns, console=Console(file=stream), transient=True) as bars:
        tasks: dict[str, TaskID] = {}
        pace = _Pace()

        def update(stage: str, done: int, total: int | None = None, info: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total, info=info)
            bars.update(tasks[stage], completed=done, total=total, info=pace.noted(stage, done, total, info))

        yield update


def in_words(seconds: float) -> str:
    """A time in whole hours, minutes or seconds, at least 1 s."""
    for length, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(seconds, 1.0):.0f} s"
