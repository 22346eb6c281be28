"""What both devices compute: materials, batches of them, and the programs for a value and for a gradient."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

import layerjax as lj
from benchmarks.studies.textured.materials import COAT, HAZE, MATERIALS, METAL, Maps, Material, maps_of
from benchmarks.suite.scenes import pairs

BRIGHTER = 1.1
"""The loss is the mean squared difference from the values times this."""

MEASUREMENTS = 20
"""Pairs of directions of every stack in a batch of fits."""

Batch = Literal["texels", "pairs", "fits"]
Kind = Literal["value", "gradient"]
Precision = Literal["float32", "float64"]


def _varnish(p: Mapping[str, Any]) -> lj.Stack:
    medium = lj.Medium(p["thickness"], p["albedo"], lj.HenyeyGreenstein(p["g"]))
    return lj.Stack([lj.Interface(p["ior"], p["alpha"]), medium], lj.Conductor(p["metal"], p["k"], p["metal alpha"]))


_VARNISH = COAT | HAZE | METAL
KNOWN = {
    material.name: material
    for material in (
        *MATERIALS,
        Material("hazy varnish on metal", _VARNISH, _varnish, lj.AddingDoubling()),
        Material("hazy varnish on metal, coarse", _VARNISH, _varnish, lj.AddingDoubling(nodes=6, modes=8)),
        Material("hazy varnish on metal, walked", _VARNISH, _varnish, lj.RandomWalk(paths=1024, batch_size=2**18)),
    )
}


@dataclass(frozen=True)
class Task:
    """A program for a material of `KNOWN`, whose name goes from process to process.

    An item is a texel, or ("pairs") a pair of one stack, or ("fits") a stack of a batch.
    """

    material: str
    items: int
    batch: Batch = "texels"
    kind: Kind = "value"
    precision: Precision = "float64"

    @property
    def name(self) -> str:
        """The name as it stands in the table."""
        return f"{self.material}, {self.batch}"

    @property
    def transport(self) -> lj.Transport:
        """The transport of the material."""
        return KNOWN[self.material].transport


_BATCHES: tuple[tuple[str, int, Batch], ...] = (
    ("hazy varnish on metal, coarse", 500, "fits"),
    ("hazy varnish on metal", 1_000_000, "pairs"),
    *((material.name, 1_000_000, "texels") for material in MATERIALS),
    ("hazy varnish on metal, walked", 200, "pairs"),
)
_PRECISIONS: tuple[Precision, ...] = ("float64", "float32")
_KINDS: tuple[Kind, ...] = ("value", "gradient")

TASKS = tuple(
    Task(material, items, batch, kind, precision)
    for precision in _PRECISIONS
    for material, items, batch in _BATCHES
    for kind in _KINDS
    if kind == "value" or not KNOWN[material].transport.random
)
"""What is measured, the most informative first."""


def program(task: Task) -> Callable[..., Any]:
    """The BSDF of every item, or the gradient of a loss in all parameters (none of what is drawn at random)."""
    build, transport = KNOWN[task.material].build, task.transport
    key = jax.random.key(1) if transport.random else None
    if not transport.random:
        concrete = build({name: values[0] for name, values in _maps(task, 1).items()})
        transport = lj.choose_transport(concrete, transport=transport)  # before its numbers are traced

    def values(maps: dict[str, Array], wi: Array, wo: Array) -> Array:
        return lj.evaluate(build(maps), wi, wo, transport, side="reflection", key=key)

    def loss(maps: dict[str, Array], wi: Array, wo: Array) -> Array:
        bsdf = values(maps, wi, wo)
        return jnp.mean((bsdf - BRIGHTER * jax.lax.stop_gradient(bsdf)) ** 2)

    return values if task.kind == "value" else jax.grad(loss)


def arguments(task: Task) -> tuple[Any, ...]:
    """What the program is called with."""
    maps = _maps(task, 1 if task.batch == "pairs" else task.items)
    if task.batch == "pairs":
        maps = {name: values[0] for name, values in maps.items()}
    count = MEASUREMENTS if task.batch == "fits" else task.items
    wi, wo = (jnp.asarray(w.astype(task.precision)) for w in pairs(count, "reflection"))
    if task.batch == "fits":
        wi, wo = wi[:, None], wo[:, None]
    return {name: jnp.asarray(value) for name, value in maps.items()}, wi, wo


def _maps(task: Task, items: int) -> Maps:
    return maps_of(KNOWN[task.material].ranges, items, task.precision)
