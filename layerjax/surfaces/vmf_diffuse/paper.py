"""The fit of "VMF Diffuse: a unified rough diffuse BRDF" (d'Eon & Weidlich 2024) to what its flakes reflect.

Corrected where the paper is misprinted or silent: the azimuthal series is f0 + 2 f1 cos(phi) + 2 f2 cos(2 phi), its
modes being plain means over azimuth; every order is bounded below by 0, without which light is lost and values are
negative near grazing; the cross-section is exact.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.special import erf

from layerjax._numerics import clamp_max, clamp_min, safe_sqrt
from layerjax.channels import Channels
from layerjax.directions import Vector
from layerjax.surfaces.vmf_diffuse.coefficients import Terms, first_order, second_order, third_order
from layerjax.surfaces.vmf_diffuse.flakes import LEAST_ROUGHNESS, areas, concentration

PaperForm = Literal["paper", "literal"]
"""Eq. (9) as printed ("literal"), or as implementations have it ("paper"): see `layerjax.VMFDiffuse`."""

Orders = tuple[Array, Array, Array]


def paper_brdf(wi: Vector, wo: Vector, albedos: Channels, roughness: Array, form: PaperForm) -> tuple[Array, ...]:
    """BRDF of Eq. (7), 1/sr, without the cosine, one array a channel; albedo / pi at roughness 0."""
    rough = roughness > 0
    r = LEAST_ROUGHNESS + (1.0 - LEAST_ROUGHNESS) * roughness
    orders = scattering_orders(wi, wo, r)
    shape = _direction_factor(wi[2] * wo[2], r, form)

    def multiple(c: Array) -> Array:
        return clamp_min(_albedo_factor(c, r, form) * shape, 0.0)

    # at roughness 0, where the value leaps to that of a Lambertian, the slope in roughness is still that of the fit
    (f1, f2, f3), (s1, s2, s3) = orders, map(_zero_with_slope, orders)
    values = []
    for c in albedos:
        fitted = c * (f1 + c * (f2 + c * f3)) + multiple(c)  # Eq. (7)
        flat = c / jnp.pi + c * (s1 + c * (s2 + c * s3)) + _zero_with_slope(multiple(jax.lax.stop_gradient(c)))
        values.append(jnp.where(rough, fitted, flat))
    return tuple(values)


def scattering_orders(wi: Vector, wo: Vector, r: Array) -> Orders:
    """f1, f2, f3 of Eq. (7), 1/sr, without their powers of the albedo, each at least 0; roughness r in (0, 1]."""
    k = concentration(r)
    seen_i, seen_o = areas(wi, k), areas(wo, k)
    ui, uo = wi[2], wo[2]
    product, total, squares = ui * uo, ui + uo, ui * ui + uo * uo
    # with phi the azimuth between wi and wo: sin sin cos(phi), and sin^2 sin^2 cos(2 phi)
    x = wi[0] * wo[0] + wi[1] * wo[1]
    y = 2.0 * x * x - (wi[0] * wi[0] + wi[1] * wi[1]) * (wo[0] * wo[0] + wo[1] * wo[1])

    # u_i sigma(-u_o) + u_o sigma(u_i) in the form that is symmetric, as sigma(u) - sigma(-u) is linear in u
    attenuation = ui * seen_o.mean + uo * seen_i.mean
    ahead = seen_i.ahead * seen_o.ahead
    (c0, c1, c2, c3), (d0, d1, exponent), (e0, e1) = first_order(r)
    single = (
        ahead * (c0 + c1 * product + c2 * product * product + c3 * squares)
        + 2.0 * x * ahead**exponent * (d0 + d1 * product)
    ) / attenuation + 2.0 * y * (e0 + e1 * ui) * (e0 + e1 * uo) / total

    def later(mean: Terms, once: Terms) -> Array:
        steady = mean[0] + mean[1] * product + mean[2] * total + mean[3] * product * product + mean[4] * squares
        return (steady + 2.0 * x * (once[0] + once[1] * product + once[2] * total)) / total

    orders = single, later(*second_order(r)), later(*third_order(r))
    first, second, third = (clamp_min(order, 0.0) / jnp.pi for order in orders)
    return first, second, third


class FitConstants(NamedTuple):
    """Constants of Eq. (9): of the exponent's X, of the powers' base, of C_k, and of the rest."""

    x: tuple[float, float]
    base: tuple[float, float]
    losses: tuple[float, float, float]
    scale: float
    offset: float
    shape: tuple[float, float, float]


FITS: dict[PaperForm, FitConstants] = {
    "paper": FitConstants(
        (0.264641, 0.0225272),
        (1.0075, 1.16942),
        (0.5441615108674713, 0.45302863761693374, 1.4293127703064865),
        0.384016,
        0.341969,
        (0.0898863, 0.0578978, 0.287663),
    ),
    "literal": FitConstants((0.265, 0.0225), (1.0, 1.169), (0.544, 0.453, 1.429), 0.384, 0.342, (0.09, 0.0579, 0.288)),
}
"""Eq. (9) as printed ("literal"), and with the digits that implementations of it carry ("paper")."""


def _albedo_factor(c: Array, r: Array, form: PaperForm) -> Array:
    """The part of Eq. (9) that knows the albedo: the rest is the same for all channels."""
    fit = FITS[form]
    loss = safe_sqrt(1.0 - c)
    x, missing = (r - fit.x[0]) * r + fit.x[1], erf(loss)
    power = jnp.arctan(x) * missing if form == "literal" else jnp.arctan(x * missing)
    kept = c * (fit.base[0] + fit.base[1] * loss) ** -power  # C_a
    linear, square, below = fit.losses
    return fit.scale * (1.0 - linear * loss - square * loss * loss) / (1.0 + below * loss) * (kept - fit.offset) * kept


def _direction_factor(cosines: Array, r: Array, form: PaperForm) -> Array:
    """The part of Eq. (9) that knows directions, by u_i u_o."""
    low, step, shift = FITS[form].shape
    return jnp.abs(jnp.tanh(r) - low) - step / (cosines + shift)


def flake_albedo(k: Array, r: Array) -> Array:
    """Albedo of the flakes of a surface that reflects k_d = k at normal incidence, by the closed form of Section 5.

    In a form that neither cancels nor divides by 0: k_d = x / (x + s (1 - x^2)), solved for x.
    """
    strength = 0.64985 + 0.631112 * r + 1.38922 * r * r  # s
    x = 2.0 * strength * k / (1.0 - k + jnp.hypot(1.0 - k, 2.0 * strength * k))
    root = safe_sqrt(r)
    return clamp_max(x * root + (1.0 - root) * k, 1.0)


def _zero_with_slope(x: Array) -> Array:
    """0, with the derivatives of x."""
    return x - jax.lax.stop_gradient(x)
