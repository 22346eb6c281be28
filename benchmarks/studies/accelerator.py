"""A GPU beside the processor: the same programs on both, their times and how far what they find is apart."""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import layerjax as lj
from benchmarks.measuring import environment, timing
from benchmarks.measuring.writing import DIRECTORY, environment_lines, figure, table, write
from benchmarks.studies.textured.materials import COAT, HAZE, MATERIALS, METAL, Maps, Material, maps_of
from benchmarks.suite.scenes import pairs

NAME = "accelerator"
BRIGHTER = 1.1
"""The loss is the mean squared difference from the values times this."""
FLOOR = 1e-3
"""Share of the largest value below which differences are relative to that share."""
READINGS = 20
"""Pairs of directions that every stack of a batch of fits is asked for."""

TEXT = """\
# A GPU beside the processor

{environment}
Device: {device}. The same programs on the device and on the processor of that machine, as one device of JAX (one
core, where work runs in chunks), medians of {rounds} rounds, everything compiled, results left where they were found.
An *item* is a texel with a stack and a pair of directions of its own, a pair of directions of one stack, or a stack at
{readings} pairs that all share (a batch of fits). *gradient*: a value with the derivatives of a mean squared difference
in all parameters. *apart*: the largest difference of device and processor, relative to the value or to {floor:g} of the
largest.

{rows}"""


@dataclass(frozen=True)
class Task:
    """A material of which each item is a texel, or ("pairs") a pair of one stack, or ("fits") a stack of a batch."""

    material: Material
    items: int
    kind: Literal["texels", "pairs", "fits"] = "texels"

    @property
    def name(self) -> str:
        """As it stands in the table."""
        return f"{self.material.name}, {self.kind}"


_VARNISH = COAT | HAZE | METAL


def _varnish(p: Any) -> lj.Stack:
    medium = lj.Medium(p["thickness"], p["albedo"], lj.HenyeyGreenstein(p["g"]))
    return lj.Stack([lj.Interface(p["ior"], p["alpha"]), medium], lj.Conductor(p["metal"], p["k"], p["metal alpha"]))


HAZY_VARNISH = Material("interface, haze, metal", _VARNISH, _varnish, lj.AddingDoubling())
FITTED = Material("interface, haze, metal", _VARNISH, _varnish, lj.AddingDoubling(nodes=6, modes=8))
WALKED = Material("interface, haze, metal", _VARNISH, _varnish, lj.RandomWalk(paths=1024, lanes=2**18))

TASKS = (
    *(Task(material, 1_000_000) for material in MATERIALS),
    Task(HAZY_VARNISH, 1_000_000, "pairs"),
    Task(FITTED, 500, "fits"),
    Task(WALKED, 1_000, "pairs"),
)


@dataclass(frozen=True)
class Row:
    """A task on both devices: microseconds an item, and how far results are apart (None: no gradient is taken)."""

    task: str
    transport: str
    precision: str
    items: int
    value: float
    value_on_processor: float
    gradient: float | None
    gradient_on_processor: float | None
    apart: float
    gradient_apart: float | None


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    tasks: Sequence[Task] = TASKS,
    precisions: Sequence[str] = ("float32", "float64"),
    rounds: int = 5,
) -> tuple[str, tuple[Path, Path]]:
    """Measure, and write ``accelerator.json`` and ``.md`` anew after every task; returns markdown and the two paths."""
    device, processor = jax.devices()[0], jax.devices("cpu")[0]
    surroundings = environment.describe()
    rows: list[Row] = []

    def written() -> tuple[str, tuple[Path, Path]]:
        text = TEXT.format(
            environment=environment_lines(surroundings),
            device=device.device_kind,
            rounds=rounds,
            readings=READINGS,
            floor=FLOOR,
            rows=table(HEADER, [_cells(row) for row in rows]),
        )
        content = {"environment": surroundings, "device": device.device_kind, "rows": [asdict(row) for row in rows]}
        return text, write(NAME, content, text, directory)

    if quick:
        tasks = [replace(task, items=max(1, task.items // 100)) for task in tasks]
    for precision in precisions:
        with ThreadPoolExecutor() as pool:  # to compile takes most of the time, and every program takes one core
            began = time.perf_counter()
            programs = {
                (index, place): pool.submit(compiled, task, precision, place)
                for index, task in enumerate(tasks)
                for place in {device, processor}
            }
            wait(programs.values())
            report(f"{precision}: {len(programs)} programs compiled, {time.perf_counter() - began:.0f} s")
        for index, task in enumerate(tasks):
            here, there = (measure(programs[index, place].result(), place, rounds) for place in (device, processor))
            rows.append(_row(task, precision, here, there))
            report(f"{task.name}, {precision}: apart by {rows[-1].apart:.1e}")
            written()
    return written()


Kind = Literal["value", "gradient"]
Programs = tuple[Mapping[Kind, Callable[..., Any]], tuple[Any, ...]]
"""Compiled programs, and what they are called with."""


def compiled(task: Task, precision: str, place: jax.Device) -> Programs:
    """The programs of a task for a device."""
    with jax.default_device(place):
        arguments = _arguments(task, precision)
        return {
            kind: timing.compiled(program, arguments)[0] for kind, program in _programs(task, precision).items()
        }, arguments


def measure(programs: Programs, place: jax.Device, rounds: int) -> dict[Kind, tuple[list[np.ndarray], float]]:
    """What programs find, and their median time in seconds."""
    functions, arguments = programs
    measured = {}
    with jax.default_device(place):
        for kind, program in functions.items():
            work = timing.waiting(program, arguments)
            found = [np.asarray(leaf) for leaf in jax.tree.leaves(work())]
            measured[kind] = found, float(np.median([timing.once(work) for _ in range(rounds)]))
    return measured


def _row(task: Task, precision: str, here: dict[Kind, Any], there: dict[Kind, Any]) -> Row:
    def both(kind: Kind) -> tuple[float | None, float | None, float | None]:
        if kind not in here:
            return None, None, None
        (found, seconds), (expected, seconds_there) = here[kind], there[kind]
        per_item = 1e6 / task.items
        return per_item * seconds, per_item * seconds_there, max(map(_apart, found, expected))

    (value, value_there, apart), (gradient, gradient_there, gradient_apart) = both("value"), both("gradient")
    assert value is not None
    assert value_there is not None
    assert apart is not None
    return Row(
        task=task.name,
        transport=type(task.material.transport).__name__,
        precision=precision,
        items=task.items,
        value=value,
        value_on_processor=value_there,
        gradient=gradient,
        gradient_on_processor=gradient_there,
        apart=apart,
        gradient_apart=gradient_apart,
    )


def _arguments(task: Task, precision: str) -> tuple[Any, ...]:
    items = task.items
    maps: Maps = maps_of(task.material.ranges, 1 if task.kind == "pairs" else items, precision)
    if task.kind == "pairs":
        maps = {name: values[0] for name, values in maps.items()}
    wi, wo = (w.astype(precision) for w in pairs(READINGS if task.kind == "fits" else items, "reflection"))
    if task.kind == "fits":
        wi, wo = wi[:, None], wo[:, None]
    return {name: jnp.asarray(value) for name, value in maps.items()}, jnp.asarray(wi), jnp.asarray(wo)


def _programs(task: Task, precision: str) -> dict[Kind, Callable[..., Any]]:
    """The BSDF of every item, and the gradient of a loss in all parameters (none of what is drawn at random)."""
    transport = task.material.transport
    if not transport.random:
        concrete = task.material.build(
            {name: values[0] for name, values in maps_of(task.material.ranges, 1, precision).items()}
        )
        transport = lj.choose_transport(concrete, transport)  # before its numbers are traced
    key = jax.random.key(1) if transport.random else None

    def values(maps: dict[str, Array], wi: Array, wo: Array) -> Array:
        return lj.evaluate(task.material.build(maps), wi, wo, transport, side="reflection", key=key)

    def loss(maps: dict[str, Array], wi: Array, wo: Array) -> Array:
        found = values(maps, wi, wo)
        return jnp.mean((found - BRIGHTER * jax.lax.stop_gradient(found)) ** 2)

    return {"value": values} if transport.random else {"value": values, "gradient": jax.grad(loss)}


def _apart(here: np.ndarray, there: np.ndarray) -> float:
    size = np.maximum(np.abs(there), FLOOR * np.max(np.abs(there)))
    return float(np.max(np.abs(here - there) / np.where(size > 0, size, 1.0)))


HEADER = ("task", "transport", "type", "items", "us", "processor", "gradient, us", "processor", "apart",
          "gradient apart")  # fmt: skip


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.task,
        row.transport,
        row.precision,
        f"{row.items:,}",
        figure(row.value),
        figure(row.value_on_processor),
        figure(row.gradient),
        figure(row.gradient_on_processor),
        f"{row.apart:.1e}",
        "-" if row.gradient_apart is None else f"{row.gradient_apart:.1e}",
    )
