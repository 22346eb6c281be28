"""The phase function of Henyey & Greenstein (1941): haze, pigment and tissue."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._concrete import concrete_values
from layerjax._parameters import Parameter, parameter
from layerjax.directions import Vector, add, combine, dot
from layerjax.phase.contract import PhaseFunction, deflect
from layerjax.quadrature import Rule, henyey_greenstein_inverse, henyey_greenstein_rule

ASSUMED_FORWARD, ASSUMED_BACKWARD = 0.9, 0.75
"""|g| of a peak on either side, where nothing is known while tracing; materials rarely have the second."""


class HenyeyGreenstein(PhaseFunction):
    """Phase function of Henyey & Greenstein 1941, by the deflection angle.

    p = (1 - g^2) / (4 pi (1 + g^2 - 2 g cos)^1.5).

    ========= ====== ===== ==== =============== ======== ============== ===========================================
    parameter symbol shape unit range           default  differentiable meaning
    ========= ====== ===== ==== =============== ======== ============== ===========================================
    g         g      ()    1    [-0.999, 0.999] required yes            mean cosine of the deflection; above 0 most
                                                                        light is scattered forward
    ========= ====== ===== ==== =============== ======== ============== ===========================================
    """

    g: Parameter = parameter("HenyeyGreenstein.g")

    def kernel(self, wi: Vector, wo: Vector, h: Vector | None) -> Array:
        return self.pdf(wi, wo)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        g = self.g
        # 1 + g^2 + 2 g wi.wo with both vectors outward, as a sum of positive terms
        total = add(wi, wo)
        difference = combine(1.0, wi, -1.0, wo)
        forward = (1.0 - g) ** 2 + g * dot(total, total)
        backward = (1.0 + g) ** 2 - g * dot(difference, difference)
        denominator = jnp.where(g > 0, forward, backward)
        return (1.0 - g * g) / (4.0 * jnp.pi * denominator * jnp.sqrt(denominator))

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        return deflect(wi, *self.deflection(u1), 2.0 * jnp.pi * u2)

    def deflection(self, u: Array) -> tuple[Array, Array]:
        return henyey_greenstein_inverse(self.g, 2.0 * u - 1.0)

    def rule(self, wi: Vector, nodes: int) -> Rule:
        return henyey_greenstein_rule(wi, self.g, nodes)

    def moments(self, count: int) -> Array:
        return jnp.asarray(self.g) ** np.arange(count)

    @property
    def width(self) -> Parameter:
        return _width(self.g, -1.0)

    @property
    def ballistic_width(self) -> Parameter:
        return _width(self.g, 1.0)

    @property
    def forward_lobe(self) -> Parameter:
        return self.g


def _width(g: Parameter, side: float) -> Parameter:
    """Of the peak on the side that the sign tells: where p has fallen to about a third."""
    values, assumed = concrete_values(g), ASSUMED_FORWARD if side > 0.0 else ASSUMED_BACKWARD
    peaked = np.maximum(assumed if values is None else side * values, 1e-9)
    return np.minimum((1.0 - peaked) / np.sqrt(peaked), 1.0)
