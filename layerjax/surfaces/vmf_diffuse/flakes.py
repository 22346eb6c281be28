"""Media of one-sided flakes whose normals follow a von Mises-Fisher density over the whole sphere.

    D(m) = k / (2 pi (1 - e^(-2k))) exp(-2 k sin^2(theta_m / 2)),    k = 2 / alpha^2          (Eq. 1)

integrates to 1 over the sphere (d'Eon & Weidlich 2024, "VMF Diffuse: a unified rough diffuse BRDF", CGF 43(4)). From a
direction w a flake is seen by max(w . m, 0), and all of them together by the cross-section sigma(w). The printed
approximations of it (Eqs. 4-6) disagree by up to 7 % where they meet; here it is exact (Eq. 3), as an integral over the
flakes that face away from the normal, of which every term is positive.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.special import i0e, i1e

from layerjax._numerics import clamp_max, clamp_min, exprel, safe_sqrt
from layerjax.directions import Vector
from layerjax.normals.vmf import resultant
from layerjax.quadrature import gauss_legendre

LEAST_ROUGHNESS = 1e-8
"""Roughness below which flakes count as this rough, so that derivatives of k stay within float32."""

POROUS = 1.0 - 1e-6
"""Roughness from which k falls to 0 in a straight line: in that of Eq. (2) its slope at r = 1 would be infinite."""


class Areas(NamedTuple):
    """Projected areas of the flakes for a direction above: sigma(w), sigma(-w), and the mean of both."""

    ahead: Array
    facing_away: Array
    mean: Array


def concentration(roughness: Array) -> Array:
    """k of a roughness r in [0, 1]: alpha = -log(1 - sqrt(r)) (Eq. 2), k = 2 / alpha^2.

    Bounded at r = 0. It is 0 at r = 1, where alpha is infinite; within 1e-6 of it k is linear (off by 0.006 at most),
    so that its slope there is large, -9,500, and not infinite.
    """
    near_one = roughness > POROUS
    r = clamp_min(jnp.where(near_one, 0.5, roughness), LEAST_ROUGHNESS)
    alpha = jnp.log1p(safe_sqrt(r)) - jnp.log1p(-r)
    return jnp.where(near_one, porous_concentration(roughness), 2.0 / (alpha * alpha))


def porous_concentration(roughness: Array) -> Array:
    """k of a roughness from `POROUS` to 1."""
    alpha = math.log1p(math.sqrt(POROUS)) - math.log1p(-POROUS)
    return (2.0 / alpha**2 / (1.0 - POROUS)) * (1.0 - roughness)


def areas(w: Vector, k: Array) -> Areas:
    """Projected areas for directions above, w_z >= 0; errors below 1e-13 (float64) or 2e-7 (float32).

    Args:
        w: components of any shape.
        k: concentration in [0, 1e17], shape ().
    """
    facing_away = _facing_away(w[2], safe_sqrt(w[0] * w[0] + w[1] * w[1]), k)
    step = resultant(k)[0] * w[2]  # sigma(w) - sigma(-w) = B(k) w_z, B = coth(k) - 1/k
    return Areas(facing_away + step, facing_away, facing_away + 0.5 * step)


def _facing_away(cosine: Array, sine: Array, k: Array) -> Array:
    """sigma(-w): the flakes at an elevation t above the plane that -w is normal to, ring by ring."""
    dtype = jnp.result_type(cosine, k)
    x, weight = (jnp.asarray(a, dtype) for a in gauss_legendre(20 if jnp.finfo(dtype).bits == 64 else 16))
    # beyond the end the density is below e^-40; where the nodes lie changes nothing, so no derivative goes through them
    end = jax.lax.stop_gradient(clamp_max(9.0 / jnp.sqrt(clamp_min(k, 1.0)), 0.5 * jnp.pi))
    t = end * x
    up, across = jnp.sin(t), jnp.cos(t)
    tilt = jnp.arctan2(cosine, sine)[..., None]
    ring = jnp.exp(-2.0 * k * jnp.sin(0.5 * (tilt + t)) ** 2) * _scaled_i0(k * sine[..., None] * across)
    return end * jnp.sum(weight * up * across * ring, axis=-1) / (2.0 * exprel(2.0 * k))


@jax.custom_jvp
def _scaled_i0(x: Array) -> Array:
    """exp(-x) I0(x) for x >= 0: its slope at 0 is -1, where that of `i0e`, which is even, is given as 0."""
    return i0e(x)


@_scaled_i0.defjvp
def _scaled_i0_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    value = i0e(*primals)
    return value, (i1e(*primals) - value) * tangents[0]
