"""What SpongeCake's evaluation costs beside that of single scattering alone, in one run."""

from collections.abc import Callable, Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import layerjax as lj
from benchmarks.measuring.operations import count
from benchmarks.measuring.timing import interleaved
from benchmarks.studies.spongecake.tables import Cost

Side = Literal["all", "reflection"]

PAIRS, QUICK_PAIRS = 100_000, 2_000
ROUNDS = 300
SIDES: tuple[Side, ...] = ("all", "reflection")
FLAKES = lj.Medium(2.0, [0.95, 0.8, 0.4], lj.SGGX("surface", 0.4, (0.3, 0.1, 0.9)), f0=0.6)
FIBERS = lj.Medium(1.5, 0.9, lj.SGGX("fiber", 0.3, (1.0, 0.2, 0.0)))
HAZE = lj.Medium([3.0, 2.0, 1.0], 1.0, lj.HenyeyGreenstein(0.5))
STACKS = {
    "gray flakes": lj.Stack([lj.Medium(2.0, 0.9, lj.SGGX("surface", 0.3))]),
    "gray fibers in the plane": lj.Stack([FIBERS]),
    "tilted flakes, three channels": lj.Stack([FLAKES]),
    "haze, three channels": lj.Stack([HAZE]),
    "fibers over haze, three channels": lj.Stack([FIBERS, HAZE]),
    "flakes over fibers, three channels": lj.Stack([FLAKES, FIBERS]),
}


def costs(quick: bool = False) -> Iterator[Cost]:
    """Least times of `SingleScattering` and `SpongeCake`, which take turns in every round, and operations a pair."""
    random = np.random.default_rng(0)
    pairs = QUICK_PAIRS if quick else PAIRS
    wi, wo = (_directions(random, pairs, sides) for sides in (1, 2))
    for name, stack in STACKS.items():
        for side in SIDES:
            for dtype in (np.float32, np.float64):
                yield _cost(name, stack, side, wi.astype(dtype), wo.astype(dtype))


def _cost(name: str, stack: lj.Stack, side: Side, wi: NDArray, wo: NDArray) -> Cost:
    if side == "reflection":
        wo = wo * np.where(wo[:, 2:] < 0, -1, 1).astype(wo.dtype)
    typed = jax.tree.map(lambda leaf: leaf.astype(wi.dtype), stack)
    states = [lj.prepare(typed, how) for how in (lj.SingleScattering(), lj.SpongeCake())]
    light, view = jnp.asarray(wi), jnp.asarray(wo)

    def work(state: Any) -> Callable[[], object]:
        return lambda: lj.evaluate(state, light, view, side=side).block_until_ready()

    def operations(state: Any) -> int:
        return sum(count(lambda wi, wo: lj.evaluate(state, wi, wo, side=side), light[:8], view[:8]).values())

    seconds = interleaved({str(k): work(state) for k, state in enumerate(states)}, ROUNDS)
    single, both = (1e9 * float(np.min(seconds[str(k)])) / len(wi) for k in range(2))
    ratio = operations(states[1]) / operations(states[0])
    return Cost(name, side, str(wi.dtype), single, both, both / single, ratio)


def _directions(random: np.random.Generator, pairs: int, sides: int) -> NDArray[np.float64]:
    cosine = np.sqrt(random.uniform(size=pairs)) * np.where(random.uniform(size=pairs) * sides < 1, 1, -1)
    return np.asarray(lj.direction(np.arccos(cosine), random.uniform(-np.pi, np.pi, pairs)), np.float64)
