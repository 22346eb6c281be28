"""Wall times by interleaved repeats: every round runs each way once, so that a busy machine slows all equally."""

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np

Work = Callable[[], object]
Result = TypeVar("Result")

LONG = 1.0
"""Seconds after which work is not repeated by `cold_and_warm`."""


def interleaved(ways: Mapping[str, Work], rounds: int) -> dict[str, np.ndarray]:
    """Seconds of each way, (rounds,), after one run to warm up. A way returns when its work is done."""
    for work in ways.values():
        work()
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    order = list(ways)
    for index in range(rounds):
        turn = index % len(order)  # nobody always runs after the same neighbour, whose data would be in the cache
        for name in order[turn:] + order[:turn]:
            began = time.perf_counter()
            ways[name]()
            seconds[name].append(time.perf_counter() - began)
    return {name: np.array(times) for name, times in seconds.items()}


def once(work: Work) -> float:
    """Seconds of a single run."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def cold_and_warm(work: Callable[[], Result], rounds: int) -> tuple[Result, float, float]:
    """The result of the work, seconds of its first run, and the median of later ones (one, if it takes `LONG`)."""
    results: list[Result] = []
    cold = once(lambda: results.append(work()))
    warm = [once(work)]
    while len(warm) < rounds and sum(warm) < LONG:
        warm.append(once(work))
    return results[0], cold, float(np.median(warm))


def compiled(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, float]:
    """The program of a function for arguments like these, and the seconds that it takes to trace and compile."""
    programs: list[Any] = []
    seconds = once(lambda: programs.append(jax.jit(function).lower(*arguments).compile()))
    return programs[0], seconds


def waiting(program: Callable[..., Any], arguments: tuple[Any, ...]) -> Callable[[], Any]:
    """A way to run a program that returns when its work is done."""
    return lambda: jax.block_until_ready(program(*arguments))
