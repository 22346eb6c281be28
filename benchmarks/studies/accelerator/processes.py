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
    """Seconds of a run on the device and on the processor, and to compile for the device; the difference of results."""

    seconds: float
    seconds_on_processor: float
    compile_seconds: float
    difference: float


def measured(
    tasks: Sequence[Task], rounds: int, report: Callable[[str], None], collect: Callable[[Task, Measured], None]
) -> None:
    """Compile these side by side, and measure one after the other: `collect` gets each result; failures are reported.

    The devices of a process begin without the memory of all others: XLA_PYTHON_CLIENT_PREALLOCATE must be "false".
    """
    context = multiprocessing.get_context("spawn")
    began: list[tuple[Task, BaseProcess, Connection]] = []
    try:
        for task in tasks:
            ours, theirs = context.Pipe()
            process: BaseProcess = context.Process(target=_work, args=(theirs, task, rounds), daemon=True)
            process.start()
            theirs.close()  # or the end of the process would not be one of the pipe
            began.append((task, process, ours))
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
                collect(task, pipe.recv())
            except (EOFError, BrokenPipeError):
                report(f"{task.name}, {task.precision}, {task.kind}: failed to run")
    finally:
        for _, process, pipe in began:
            pipe.close()
            process.terminate()
            process.join()


def _work(pipe: Connection, task: Task, rounds: int) -> None:
    """Compile for both devices, send the longer time, and measure on request."""
    jax.config.update("jax_enable_x64", True)
    places = jax.devices()[0], jax.devices("cpu")[0]
    with ThreadPoolExecutor() as pool:
        compiled = list(pool.map(lambda place: _compiled(task, place), places))
    pipe.send(max(seconds for _, _, seconds in compiled))
    pipe.recv()
    (results, seconds), (reference, reference_seconds) = (
        _run(place, work, inputs, rounds) for place, (work, inputs, _) in zip(places, compiled, strict=True)
    )
    difference = max(map(_largest_difference, results, reference))
    pipe.send(Measured(seconds, reference_seconds, compiled[0][2], difference))


def _compiled(task: Task, place: jax.Device) -> tuple[Callable[..., Any], tuple[Any, ...], float]:
    with jax.default_device(place):
        inputs = arguments(task)
        work, seconds = timing.compiled(program(task), inputs)
        return work, inputs, seconds


def _run(
    place: jax.Device, work: Callable[..., Any], inputs: tuple[Any, ...], rounds: int
) -> tuple[list[np.ndarray], float]:
    """The results of a program, and the median time of the runs after the first."""
    with jax.default_device(place):
        results, _, seconds = timing.cold_and_warm(timing.waiting(work, inputs), rounds)
        return [np.asarray(leaf) for leaf in jax.tree.leaves(results)], seconds


def _largest_difference(values: np.ndarray, reference: np.ndarray) -> float:
    scale = np.maximum(np.abs(reference), FLOOR * np.max(np.abs(reference)))
    return float(np.max(np.abs(values - reference) / np.where(scale > 0, scale, 1.0)))
