"""Ideal diffuse reflection (Lambert 1760)."""

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import safe_sqrt
from layerjax._parameters import Parameter, parameter
from layerjax.channels import per_channel
from layerjax.directions import Vector
from layerjax.surfaces.contract import Surface


class Lambertian(Surface):
    """Diffuse surface, with the same radiance in every direction: f = albedo / pi.

    ========= ====== ======== ==== ====== ======== ============== ============================
    parameter symbol shape    unit range  default  differentiable meaning
    ========= ====== ======== ==== ====== ======== ============== ============================
    albedo    rho    (), (C,) 1    [0, 1] required yes            reflected share of the light
    ========= ====== ======== ==== ====== ======== ============== ============================
    """

    albedo: Parameter = parameter("Lambertian.albedo")

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        return tuple(albedo / jnp.pi for albedo in per_channel(self.albedo))

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        return sample_cosine(u1, u2)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        return wo[2] / jnp.pi


def sample_cosine(u1: Array, u2: Array) -> Vector:
    """Cosine-weighted direction of the upper hemisphere."""
    radius, phi = safe_sqrt(u1), 2.0 * jnp.pi * u2
    return radius * jnp.cos(phi), radius * jnp.sin(phi), safe_sqrt(1.0 - u1)
