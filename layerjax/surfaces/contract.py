"""What every opaque surface offers, alone or as the base of a stack."""

import abc

from jax import Array

from layerjax._repr import ReprModule
from layerjax.directions import Vector
from layerjax.quadrature import Nodes, hemisphere_rule


class Surface(ReprModule):
    """An opaque surface, lit and seen from above.

    Directions come as components (see `layerjax.directions`); callers guarantee that their z is positive. Values are
    one array a channel, so that nothing is stacked before the very end.
    """

    @abc.abstractmethod
    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        """BRDF in 1/sr, without the cosine, one array a channel."""

    @abc.abstractmethod
    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        """An outgoing direction from two uniform numbers; it may fall below the horizon."""

    @abc.abstractmethod
    def pdf(self, wi: Vector, wo: Vector) -> Array:
        """Density of `sample` in solid angle, 1/sr, for wo above the horizon."""

    def rule(self, wi: Vector, nodes: int) -> Nodes:
        """Quadrature over the upper hemisphere that resolves this surface's lobe."""
        return hemisphere_rule(wi, nodes)
