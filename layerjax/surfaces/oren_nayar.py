"""Rough diffuse reflection: V-shaped grooves of Lambertian facets.

``form="energy_preserving"`` is EON (Portsmouth, Kutz & Hill 2025, "EON: a practical energy-preserving rough diffuse
BRDF", JCGT 14(1)): the Fujii form of Oren-Nayar with its directional albedo in closed form, plus a term that returns
the energy lost. ``form="classic"`` is the qualitative model of Oren & Nayar 1994, which loses energy; it is here to
compare.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_min, safe_sqrt
from layerjax._parameters import Parameter, parameter
from layerjax.channels import per_channel
from layerjax.directions import Vector
from layerjax.surfaces.contract import Surface
from layerjax.surfaces.lambertian import sample_cosine

_FUJII = 0.5 - 2.0 / (3.0 * jnp.pi)
_MEAN = 2.0 / 3.0 - 28.0 / (15.0 * jnp.pi)


class OrenNayar(Surface):
    """Rough diffuse surface: V-shaped grooves of Lambertian facets.

    ``form="energy_preserving"`` is the model of Portsmouth et al. 2025, ``form="classic"`` that of Oren & Nayar
    1994, which loses energy.

    ========= ======== ======== ====== ====== =================== ============== =====================================
    parameter symbol   shape    unit   range  default             differentiable meaning
    ========= ======== ======== ====== ====== =================== ============== =====================================
    albedo    rho      (), (C,) 1      [0, 1] required            yes            albedo of a facet
    roughness r, sigma ()       1, rad [0, 1] required            yes            r of the paper; for "classic" the
                                                                                 standard deviation of the slope angle
    form                                      "energy_preserving" no             the model; or "classic"
    ========= ======== ======== ====== ====== =================== ============== =====================================

    Not smooth where the azimuths of wi and wo differ by pi/2, and where theta_i = theta_o.
    """

    albedo: Parameter = parameter("OrenNayar.albedo")
    roughness: Parameter = parameter("OrenNayar.roughness")
    form: Literal["energy_preserving", "classic"] = eqx.field(static=True, default="energy_preserving")

    def __check_init__(self) -> None:
        if self.form not in ("energy_preserving", "classic"):
            raise ValueError(f'OrenNayar.form: {self.form!r} is not one of "energy_preserving", "classic"')

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        return self._classic(wi, wo) if self.form == "classic" else self._energy_preserving(wi, wo)

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        # mostly by the cosine; uniform for a share, because f cos stays finite where the cosine goes to 0
        share = _uniform_share(self.roughness)
        uniform = u1 < share
        v1 = jnp.where(uniform, u1 / jnp.maximum(share, 1e-6), (u1 - share) / (1.0 - share))
        cosine = sample_cosine(v1, u2)
        flat = safe_sqrt(1.0 - v1 * v1)
        phi = 2.0 * jnp.pi * u2
        return (
            jnp.where(uniform, flat * jnp.cos(phi), cosine[0]),
            jnp.where(uniform, flat * jnp.sin(phi), cosine[1]),
            jnp.where(uniform, v1, cosine[2]),
        )

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        share = _uniform_share(self.roughness)
        return (0.5 * share + (1.0 - share) * wo[2]) / jnp.pi

    def _classic(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        variance = self.roughness * self.roughness
        a = 1.0 - 0.5 * variance / (variance + 0.33)
        b = 0.45 * variance / (variance + 0.09)
        s = wi[0] * wo[0] + wi[1] * wo[1]  # sin sin cos(phi_i - phi_o)
        shape = (a + b * clamp_min(s, 0.0) / clamp_min(wi[2], wo[2])) / jnp.pi
        return tuple(albedo * shape for albedo in per_channel(self.albedo))

    def _energy_preserving(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        r = self.roughness
        a = 1.0 / (1.0 + _FUJII * r)  # A_F
        s = wi[0] * wo[0] + wi[1] * wo[1]
        t = jnp.where(s > 0, clamp_min(wi[2], wo[2]), 1.0)
        single = a * (1.0 + r * s / t) / jnp.pi
        # energy lost by one bounce is a r (c1 - G/pi), and on average a r (c1 - c2): their common factor cancels
        multiple = a * r * (_FUJII - _albedo_term(wi)) * (_FUJII - _albedo_term(wo)) / (_FUJII - _MEAN) / jnp.pi
        mean_loss = a * r * (_FUJII - _MEAN)
        return tuple(
            albedo * (single + albedo * (1.0 - mean_loss) / (1.0 - albedo * mean_loss) * multiple)
            for albedo in per_channel(self.albedo)
        )


def _uniform_share(roughness: Array) -> Array:
    return 0.5 * roughness


def _albedo_term(w: Vector) -> Array:
    """G/pi of the single-bounce directional albedo A_F (1 + r G/pi), written without dividing by the cosine."""
    cosine = w[2]
    sine = safe_sqrt(w[0] * w[0] + w[1] * w[1])
    theta = jnp.arctan2(sine, cosine)
    bracket = cosine * (1.0 + sine + sine * sine) / (1.0 + sine) - 1.0
    return sine * (theta - sine * cosine + (2.0 / 3.0) * bracket) / jnp.pi
