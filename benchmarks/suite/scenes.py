"""The materials and direction pairs that the throughput benchmark evaluates; parameters are plain numbers by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

import layerjax as lj

Side = Literal["all", "reflection"]
Parameters = Mapping[str, Any]
"""Names to scalars or to RGB triples (arrays of shape (3,))."""

COPPER = {"ior": [0.20, 0.92, 1.10], "k": [3.91, 2.45, 2.14], "alpha": 0.2}
TWO_LAYERS = {
    "thickness_0": [0.6, 0.8, 1.1],
    "albedo_0": [0.95, 0.8, 0.6],
    "f0_0": [0.04, 0.1, 0.3],
    "alpha_0": 0.3,
    "thickness_1": [1.5, 1.2, 0.7],
    "albedo_1": [0.5, 0.7, 0.9],
    "f0_1": [0.5, 0.3, 0.2],
    "alpha_1": 0.4,
}
"""Twenty parameters: SGGX surface flakes over SGGX fibers, both upright."""


@dataclass(frozen=True)
class Scene:
    """A material and the pairs at which it is evaluated. build: parameters (traced or not) to a stack."""

    name: str
    parameters: Parameters
    build: Callable[[Parameters], lj.Stack]
    side: Side

    def arrays(self, dtype: str) -> dict[str, Array]:
        """The parameters as arrays of this type."""
        return {name: jnp.asarray(value, dtype) for name, value in self.parameters.items()}

    @property
    def count(self) -> int:
        """Number of parameters."""
        return sum(np.size(value) for value in self.parameters.values())


def _conductor(p: Parameters) -> lj.Stack:
    return lj.Stack([], lj.Conductor(p["ior"], p["k"], p["alpha"]))


def _spongecake(p: Parameters) -> lj.Stack:
    kinds: tuple[Literal["surface", "fiber"], ...] = ("surface", "fiber")
    return lj.Stack(
        [
            lj.Medium(p[f"thickness_{i}"], p[f"albedo_{i}"], lj.SGGX(kind, p[f"alpha_{i}"]), p[f"f0_{i}"])
            for i, kind in enumerate(kinds)
        ]
    )


CONDUCTOR = Scene("GGX conductor", COPPER, _conductor, "reflection")
REFLECTION = Scene("SpongeCake, 2 SGGX layers, reflection", TWO_LAYERS, _spongecake, "reflection")
ALL_SIDES = Scene("SpongeCake, 2 SGGX layers, all sides", TWO_LAYERS, _spongecake, "all")
SCENES = (CONDUCTOR, REFLECTION, ALL_SIDES)


def pairs(count: int, side: Side, seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`count` random pairs wi, wo of shape (count, 3) with |cosine| in [0.05, 1], above only or on any side."""
    generator = np.random.default_rng(seed)
    found = []
    for _ in range(2):
        cosine, azimuth = generator.uniform(0.05, 1.0, count), generator.uniform(0.0, 2 * np.pi, count)
        sine = np.sqrt(1 - cosine**2)
        sign = generator.choice([-1.0, 1.0], count) if side == "all" else 1.0
        found.append(np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), sign * cosine], axis=-1))
    return found[0], found[1]
