"""The contract that every transport keeps."""

import abc
from typing import Any, ClassVar, Literal

import equinox as eqx
from jax import Array

from layerjax.directions import Vector
from layerjax.stack import Stack, place_of_vmf

Side = Literal["all", "reflection", "transmission"]
"""Which pairs are asked for: any; both directions above; one above and one below. Others give 0."""


class Transport(eqx.Module):
    """One way of solving a stack; its options are static fields.

    Directions come as components, already broadcast against each other; results are one array a channel. `state` is
    what `prepare` returned: a pytree of arrays that holds all that no direction is needed for.

    A transport that draws random numbers says so in `random` and offers `estimate` and `estimate_albedo`, which take a
    key and return standard errors too, in place of `evaluate` and `albedo`.
    """

    random: ClassVar[bool] = False

    @abc.abstractmethod
    def check(self, stack: Stack) -> None:
        """Raise a ValueError that names the first layer or base which this transport cannot carry."""

    @abc.abstractmethod
    def prepare(self, stack: Stack) -> Any:
        """All the work that no direction is needed for."""

    @abc.abstractmethod
    def evaluate(self, state: Any, wi: Vector, wo: Vector, side: Side) -> tuple[Array, ...]:
        """BSDF values in 1/sr, without the cosine."""

    @abc.abstractmethod
    def sample(self, state: Any, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        """Outgoing directions from three uniform numbers each."""

    @abc.abstractmethod
    def pdf(self, state: Any, wi: Vector, wo: Vector) -> Array:
        """Density of `sample` in solid angle, 1/sr."""

    @abc.abstractmethod
    def albedo(self, state: Any, wi: Vector, nodes: int) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Scattered energy that leaves on wi's side and on the other, for unit irradiance."""

    def estimate(
        self, state: Any, wi: Vector, wo: Vector, side: Side, channels: int, key: Array
    ) -> tuple[Array, Array]:
        """Values of n pairs and their standard errors, shape (n, channels) each; of a random transport."""
        raise NotImplementedError

    def estimate_albedo(self, state: Any, wi: Vector, channels: int, key: Array) -> tuple[Array, Array]:
        """Shares scattered to wi's side, then to the other, and standard errors: (n, 2 channels) each; if random."""
        raise NotImplementedError

    def coarser(self) -> "Transport | None":
        """The same transport at a lower resolution, to estimate the error from the difference; None if it has none."""
        return None


def refuse_vmf(stack: Stack, transport: str) -> None:
    """Raise a ValueError that names the first von Mises-Fisher facets, on behalf of a transport without them."""
    place = place_of_vmf(stack)
    if place is not None:
        raise ValueError(
            f'{place}: {transport} carries no "vmf" normals; AddingDoubling and RandomWalk with microfacets="single" '
            "do, and ENDF for metals, coated metals and slabs"
        )
