"""A process for every program: they compile side by side, and are measured one after the other.

Threads of one process would trace them one after the other, under Python's lock.
"""

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

import jax
import numpy as np

from benchmarks.measuring import timing
from benchmarks.studies.accelerator.tasks import Task, arguments, program

FLOOR = 1e-3
"""Share of the largest value below which differences are relative to that share."""


@dataclass(frozen=True)
class Measured:
    """Seconds of a run on the device and on the processor, to compile for the device, and how far results are apart."""

    seconds: float
    seconds_on_processor: float
    compile_seconds: float
    apart: float


def measured(
    tasks: Sequence[Task], rounds: int, report: Callable[[str], None], found: Callable[[Task, Measured], None]
) -> None:
    """Compile these side by side, and give `found` what each takes, in turn; those that fail are told of and left out.

    The devices of a process begin without the memory of all others: XLA_PYTHON_CLIENT_PREALLOCATE must be "false".
    """
    context = multiprocessing.get_context("spawn")
    began: list[tuple[Task, BaseProcess, Connection]] = []
    try:
        for task in tasks:
            here, there = context.Pipe()
            process: BaseProcess = context.Process(target=_work, args=(there, task, rounds), daemon=True)
            process.start()
            there.close()  # or the end of the process would not be one of the pipe
            began.append((task, process, here))
        ready = []
        for task, _, pipe in began:
            try:
                report(f"{task.name}, {task.precision}, {task.kind}: compiled in {pipe.recv():.0f} s")
                ready.append((task, pipe))
            except EOFError:
                report(f"{task.name}, {task.precision}, {task.kind}: failed to compile")
        for task, pipe in ready:
            try:
                pipe.send("measure")
                found(task, pipe.recv())
            except (EOFError, BrokenPipeError):
                report(f"{task.name}, {task.precision}, {task.kind}: failed to run")
    finally:
        for _, process, pipe in began:
            pipe.close()
            process.terminate()
            process.join()


def _work(pipe: Connection, task: Task, rounds: int) -> None:
    """Compile for both devices, tell the longer time, and measure when told to."""
    jax.config.update("jax_enable_x64", True)
    places = jax.devices()[0], jax.devices("cpu")[0]
    with ThreadPoolExecutor() as pool:
        compiled = list(pool.map(lambda place: _compiled(task, place), places))
    pipe.send(max(seconds for _, _, seconds in compiled))
    pipe.recv()
    (here, time_here), (there, time_there) = (
        _run(place, work, given, rounds) for place, (work, given, _) in zip(places, compiled, strict=True)
    )
    apart = max(map(_apart, here, there))
    pipe.send(Measured(time_here, time_there, compiled[0][2], apart))


def _compiled(task: Task, place: jax.Device) -> tuple[Callable[..., Any], tuple[Any, ...], float]:
    with jax.default_device(place):
        given = arguments(task)
        work, seconds = timing.compiled(program(task), given)
        return work, given, seconds


def _run(
    place: jax.Device, work: Callable[..., Any], given: tuple[Any, ...], rounds: int
) -> tuple[list[np.ndarray], float]:
    """What a program finds, and the median time of the runs after the first."""
    with jax.default_device(place):
        found, _, seconds = timing.first_and_again(timing.waiting(work, given), rounds)
        return [np.asarray(leaf) for leaf in jax.tree.leaves(found)], seconds


def _apart(here: np.ndarray, there: np.ndarray) -> float:
    size = np.maximum(np.abs(there), FLOOR * np.max(np.abs(there)))
    return float(np.max(np.abs(here - there) / np.where(size > 0, size, 1.0)))
