"""Rayleigh scattering (Rayleigh 1871): particles much smaller than the wavelength, unpolarised light."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import safe_sqrt
from layerjax.directions import Vector, dot
from layerjax.phase.contract import PhaseFunction, deflect


class Rayleigh(PhaseFunction):
    """Rayleigh scattering: p = 3 / (16 pi) (1 + cos^2), by the deflection angle; it has no parameters."""

    def kernel(self, wi: Vector, wo: Vector, h: Vector | None) -> Array:
        return self.pdf(wi, wo)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        cosine = dot(wi, wo)
        return 3.0 / (16.0 * jnp.pi) * (1.0 + cosine * cosine)

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        return deflect(wi, *self.deflection(u1), 2.0 * jnp.pi * u2)

    def deflection(self, u: Array) -> tuple[Array, Array]:
        # the root of cos^3 + 3 cos = 8 u - 4, which the cumulative distribution asks for
        cosine = 2.0 * jnp.sinh(jnp.arcsinh(4.0 * u - 2.0) / 3.0)
        return cosine, safe_sqrt((1.0 - cosine) * (1.0 + cosine))

    def moments(self, count: int) -> np.ndarray:
        return np.array([1.0, 0.0, 0.1, *[0.0] * count][:count])
