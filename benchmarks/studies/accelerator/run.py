"""The table of a GPU beside the processor."""

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax

from benchmarks.measuring import environment, timing
from benchmarks.measuring.writing import DIRECTORY, environment_lines, figure, table, write
from benchmarks.studies.accelerator.processes import FLOOR, Measured, measured
from benchmarks.studies.accelerator.tasks import MEASUREMENTS, TASKS, Task
from fits.problem.compilation import cores

NAME = "accelerator"

TEXT = """\
# A GPU beside the processor

{environment}
The same programs on the device and on the processor of its machine, as one device of JAX (one core, where work runs in
chunks), medians of up to {rounds} rounds (one, where it takes {long:g} s), everything compiled, results left on the
device that computes them. The line above describes the run on {device}; rows of other devices are of runs of their own.
An *item* is a texel with a stack and a pair of directions of its own, a pair of directions of one stack, or a stack at
{measurements} pairs that are the same for all (a batch of fits). *gradient*: a value with the derivatives of a mean
squared difference in all parameters. *compile*: seconds on the device, others compiling beside it. *difference*: the
largest of device and processor, relative to the value or to {floor:g} of the largest.

{rows}"""


@dataclass(frozen=True)
class Row:
    """A program on both devices: microseconds an item, and the difference of results."""

    device: str
    task: str
    transport: str
    precision: str
    kind: str
    items: int
    microseconds: float
    microseconds_on_processor: float
    compile_seconds: float | None
    difference: float

    @property
    def what(self) -> tuple[str, ...]:
        """What another row is a newer measurement of."""
        return self.device, self.task, self.transport, self.precision, self.kind


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    tasks: Sequence[Task] = TASKS,
    rounds: int = 5,
    together: int | None = None,
) -> tuple[str, tuple[Path, Path]]:
    """Measure, and write ``accelerator.json`` and ``.md`` anew after every program; returns markdown and the two paths.

    Rows that the directory holds stay where they are not measured anew: those of other devices, and of other tasks.

    Args:
        together: programs that compile side by side; as many as there are cores if None.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # the first process would take the whole device
    device = jax.devices()[0].device_kind
    surroundings = environment.describe()
    rows = _stored(directory)

    def written() -> tuple[str, tuple[Path, Path]]:
        text = TEXT.format(
            environment=environment_lines(surroundings),
            device=device,
            rounds=rounds,
            long=timing.LONG,
            measurements=MEASUREMENTS,
            floor=FLOOR,
            rows=table(HEADER, [_cells(row) for row in rows.values()]),
        )
        return text, write(
            NAME, {"environment": surroundings, "rows": [asdict(row) for row in rows.values()]}, text, directory
        )

    def collect(task: Task, times: Measured) -> None:
        row = _row(device, task, times)
        rows[row.what] = row
        report(
            f"{task.name}, {task.precision}, {task.kind}: {figure(row.microseconds)} us, "
            f"difference {row.difference:.1e}"
        )
        written()

    if quick:
        tasks = [replace(task, items=max(1, task.items // 100)) for task in tasks]
    together = together or cores()
    for first in range(0, len(tasks), together):
        measured(tasks[first : first + together], rounds, report, collect)
    return written()


def _stored(directory: Path) -> dict[tuple[str, ...], Row]:
    """The rows of the file, by what they measure."""
    path = directory / f"{NAME}.json"
    rows = [Row(**entry) for entry in json.loads(path.read_text())["rows"]] if path.exists() else []
    return {row.what: row for row in rows}


def _row(device: str, task: Task, times: Measured) -> Row:
    return Row(
        device=device,
        task=task.name,
        transport=type(task.transport).__name__,
        precision=task.precision,
        kind=task.kind,
        items=task.items,
        microseconds=1e6 * times.seconds / task.items,
        microseconds_on_processor=1e6 * times.seconds_on_processor / task.items,
        compile_seconds=times.compile_seconds,
        difference=times.difference,
    )


HEADER = ("task", "transport", "type", "program", "device", "items", "us", "processor, us", "ratio", "compile, s",
          "difference")  # fmt: skip


def _cells(row: Row) -> tuple[Any, ...]:
    return (
        row.task,
        row.transport,
        row.precision,
        row.kind,
        row.device,
        f"{row.items:,}",
        figure(row.microseconds),
        figure(row.microseconds_on_processor),
        figure(row.microseconds_on_processor / row.microseconds),
        "-" if row.compile_seconds is None else f"{row.compile_seconds:.0f}",
        f"{row.difference:.1e}",
    )
