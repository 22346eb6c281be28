"""Time a texel of maps of stacks: value, and value with the gradient in every parameter map."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import layerjax as lj
from benchmarks.measuring import environment, timing
from benchmarks.measuring.memory import keep_within
from benchmarks.measuring.timing import interleaved, once
from benchmarks.measuring.writing import DIRECTORY, Bar, environment_lines, figure, table, write
from benchmarks.peers import functions as peers
from benchmarks.peers.mitsuba_textures import Textured
from benchmarks.studies.textured.materials import CONDUCTOR, MATERIALS, PRINCIPLED, Material, maps_of
from benchmarks.suite.scenes import pairs

NAME = "textured"
BRIGHTER = 1.1
"""The loss is the mean squared difference from the values times this."""
PROBED = 4096
"""Texels by which the time of a map is estimated; smaller maps than requested have a multiple of them."""
MANY = 500_000
"""Texels from which on bytes a texel are measured: in smaller maps what the last block holds outweighs them."""
GRADIENT, COMPILE, COMPILE_GRADIENT, TO_PRINCIPLED = Bar(5.0, 3.0), Bar(3.0, 1.5), Bar(8.0, 4.0), Bar(5.0, 2.0)
"""In times of a value; in seconds; in times of Mitsuba's principled BSDF."""

TEXT = """\
# Maps of stacks

{environment}
Every texel has its own stack, with a map for each parameter, and its own pair of directions. Medians of {rounds}
rounds, without compilation. *gradient*: time of a value with the derivatives of a mean squared difference by all
parameter maps, relative to that of a value. *memory*: bytes per texel beside inputs and results, from {many:,} texels
on. A map that would take longer than {longest:g} s has fewer *texels*. *principled* and *conductor*: time of a value
relative to Mitsuba's `principled` and `roughconductor` (`llvm_ad_rgb`, float32) with a texture for every parameter, in
the same rounds. {peers}

{rows}
## Verdicts

Required, and in brackets the aim: time of a value as in the first column; gradient {gradient} values; compilation of a
value {compile} s and of a gradient {compile_gradient} s; {principled} times Mitsuba's `principled`. The slowest of all
sizes and types counts.

{verdicts}"""


@dataclass(frozen=True)
class Size:
    """How much is measured. longest: seconds that an evaluation of a map may take."""

    texels: tuple[int, ...] = (100_000, 1_000_000)
    precisions: tuple[str, ...] = ("float32", "float64")
    rounds: int = 7
    longest: float = 10.0


QUICK = Size((10_000,), ("float32",), 3, 1.0)


@dataclass(frozen=True)
class Row:
    """One material at one size. value: microseconds a texel; gradient: in values; memory: bytes a texel, of `MANY`.

    principled, conductor: the median over rounds of our time over Mitsuba's.
    """

    material: str
    transport: str
    precision: str
    texels: int
    value: float
    gradient: float
    compile_value: float
    compile_gradient: float
    memory: float | None
    principled: float | None
    conductor: float | None


def study(
    quick: bool = False,
    with_peers: bool = True,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    size: Size | None = None,
    materials: Sequence[Material] = MATERIALS,
) -> tuple[str, tuple[Path, Path]]:
    """Measure, and write ``textured.json`` and ``textured.md``; returns the markdown and the two paths."""
    size = size or (QUICK if quick else Size())
    surroundings = environment.describe()
    missing = peers.why_not() if with_peers else "omitted on request"
    rows: list[Row] = []
    for material in materials:
        for precision in size.precisions:
            for texels in size.texels:
                keep_within()
                began = time.perf_counter()
                rows.append(measure(material, precision, texels, size, missing is None))
                report(f"{material.name}, {precision}: {rows[-1].texels:,} texels, {time.perf_counter() - began:.0f} s")
                if rows[-1].texels < texels:
                    break  # nor would there be more of them in a larger map
    text = TEXT.format(
        environment=environment_lines(surroundings),
        rounds=size.rounds,
        longest=size.longest,
        many=MANY,
        peers="" if missing is None else f"Mitsuba did not run: {missing}.",
        rows=table(HEADER, [_cells(row) for row in rows]),
        gradient=GRADIENT.words(),
        compile=COMPILE.words(),
        compile_gradient=COMPILE_GRADIENT.words(),
        principled=TO_PRINCIPLED.words(),
        verdicts=_verdicts(materials, rows),
    )
    content = {"environment": surroundings, "peers": missing or "ran", "rows": [asdict(row) for row in rows]}
    return text, write(NAME, content, text, directory)


def measure(material: Material, precision: str, texels: int, size: Size, with_peers: bool) -> Row:
    """One row; of fewer texels than requested where these would take too long."""
    probed = min(PROBED, texels)
    few = _Problem(material, precision, probed)
    seconds = min(once(few.compiled_value()[0]) for _ in range(2))
    count = min(texels, probed * max(1, int(size.longest / seconds)))
    problem = _Problem(material, precision, count)
    value, compile_value, memory = problem.compiled_value()
    gradient, compile_gradient = problem.compiled_gradient()
    ways: dict[str, Callable[[], Any]] = {"value": value, "gradient": gradient}
    if with_peers and precision == "float32":
        ways |= {"principled": problem.principled().value, "conductor": problem.conductor().value}
    times = interleaved(ways, size.rounds)
    ratios = {name: float(np.median(times["value"] / times[name])) for name in times}
    return Row(
        material=material.name,
        transport=type(material.transport).__name__,
        precision=precision,
        texels=count,
        value=1e6 * float(np.median(times["value"])) / count,
        gradient=1.0 / ratios["gradient"],
        compile_value=compile_value,
        compile_gradient=compile_gradient,
        memory=_memory_of_a_texel(problem, memory) if count >= MANY else None,
        principled=ratios.get("principled"),
        conductor=ratios.get("conductor"),
    )


def _memory_of_a_texel(problem: "_Problem", memory: float) -> float:
    """Bytes that each texel adds, by a map of half as many."""
    half = _Problem(problem.material, problem.precision, problem.texels // 2)
    return (memory - half.compiled_value()[2]) / (problem.texels - half.texels)


class _Problem:
    """A material of so many texels, with a pair of directions for each."""

    def __init__(self, material: Material, precision: str, texels: int) -> None:
        self.material, self.precision, self.texels = material, precision, texels
        self.plain = material.maps(texels, precision)
        self.directions = [w.astype(precision) for w in pairs(texels, "reflection")]
        self._arguments: tuple[Any, ...] = ({name: jnp.asarray(value) for name, value in self.plain.items()},)
        self._arguments += tuple(map(jnp.asarray, self.directions))

    def values(self, maps: dict[str, Array], wi: Array, wo: Array) -> Array:
        """The BSDF of every texel."""
        return lj.evaluate(self.material.build(maps), wi, wo, self.material.transport, side="reflection")

    def compiled_value(self) -> tuple[Callable[[], Any], float, float]:
        """A value, the seconds that it took to compile, and the bytes that it holds beside inputs and results."""
        program, seconds = timing.compiled(self.values, self._arguments)
        return timing.waiting(program, self._arguments), seconds, float(program.memory_analysis().temp_size_in_bytes)

    def compiled_gradient(self) -> tuple[Callable[[], Any], float]:
        """A value with its gradient, and the seconds that it took to compile."""

        def loss(maps: dict[str, Array], wi: Array, wo: Array, target: Array) -> Array:
            return jnp.mean((self.values(maps, wi, wo) - target) ** 2)

        target = BRIGHTER * jax.jit(self.values)(*self._arguments)
        arguments = (*self._arguments, target)
        program, seconds = timing.compiled(jax.value_and_grad(loss), arguments)
        return timing.waiting(program, arguments), seconds

    def principled(self) -> Textured:
        """Mitsuba's, of as many texels."""
        return Textured("principled", maps_of(PRINCIPLED, self.texels, "float32"), *self.directions)

    def conductor(self) -> Textured:
        """Mitsuba's rough metal, of as many texels."""
        return Textured("roughconductor", maps_of(CONDUCTOR, self.texels, "float32"), *self.directions)


HEADER = ("material", "transport", "type", "texels", "us a texel", "gradient", "compile s", "its gradient s",
          "memory, B", "principled", "conductor")  # fmt: skip


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.material,
        row.transport,
        row.precision,
        f"{row.texels:,}",
        figure(row.value),
        figure(row.gradient, 2),
        figure(row.compile_value, 2),
        figure(row.compile_gradient, 2),
        figure(row.memory, 2),
        figure(row.principled, 2),
        figure(row.conductor, 2),
    )


def _verdicts(materials: Sequence[Material], rows: Sequence[Row]) -> str:
    lines = []
    for material in materials:
        if material.least is None:
            continue
        bar = Bar(material.least, material.least if material.aim is None else material.aim)
        of_material = [row for row in rows if row.material == material.name]

        def slowest(bar: Bar, name: str, rows: Sequence[Row] = of_material) -> str:
            values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
            return bar.verdict(max(values)) if values else "no peer"

        lines.append(
            (
                f"{material.name}: {bar.words()} us",
                slowest(bar, "value"),
                slowest(GRADIENT, "gradient"),
                slowest(COMPILE, "compile_value"),
                slowest(COMPILE_GRADIENT, "compile_gradient"),
                slowest(TO_PRINCIPLED, "principled"),
            )
        )
    return table(("material", "value", "gradient", "compile", "its gradient", "principled"), lines)
