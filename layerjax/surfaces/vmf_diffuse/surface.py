"""Rough and porous diffuse reflection: one-sided Lambertian flakes with von Mises-Fisher normals.

After d'Eon & Weidlich 2024, "VMF Diffuse: a unified rough diffuse BRDF", CGF 43(4). It runs from Lambertian (r = 0) by
rough surfaces, which an Oren-Nayar resembles, to a dilute cloud of Lambertian spheres (r = 1).

Corrected where the paper is misprinted or silent: the azimuthal series is f0 + 2 f1 cos(phi) + 2 f2 cos(2 phi), its
modes being plain means over azimuth; every order is bounded below by 0, without which light is lost and values are
negative near grazing; the cross-section is exact.
"""

from typing import Literal, NamedTuple, Self, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.special import erf
from jax.typing import ArrayLike

from layerjax._numerics import at_least, at_most, safe_div, safe_sqrt
from layerjax._parameters import Parameter, is_placeholder, parameter
from layerjax.channels import per_channel
from layerjax.directions import Vector, add, combine, dot, frame, normalize, scale, select
from layerjax.quadrature import gauss_legendre
from layerjax.surfaces.contract import Surface
from layerjax.surfaces.lambertian import sample_cosine
from layerjax.surfaces.vmf_diffuse.coefficients import Terms, first_order, second_order, third_order
from layerjax.surfaces.vmf_diffuse.flakes import LEAST_ROUGHNESS, areas, concentration

Form = Literal["paper", "literal", "transport"]
Orders = tuple[Array, Array, Array]

NODES = 32
"""Cosines of the albedo at normal incidence."""


class VMFDiffuse(Surface):
    """Rough diffuse surface, from Lambertian to porous.

    ========= ======== ============ ======= ======================================================================
    parameter symbol   range        default meaning
    ========= ======== ============ ======= ======================================================================
    albedo    c        [0, 1]               albedo of a flake, per channel
    roughness r        [0, 1]               flakes have the concentration k = 2 / log(1 - sqrt(r))^2
    form               "paper"      "paper" the paper's fit; light scattered four and more times by Eq. (9) with
                       | "literal"          the exponent atan(X erf(C)) ("paper") or atan(X) erf(C) as printed
                       | "transport"        ("literal"; 3 % of that part, 0.0017 in value, at most); or a table
                                            of what such flakes reflect, all orders ("transport")
    ========= ======== ============ ======= ======================================================================

    The fits follow the flakes' own reflection to 1 to 4 % (root mean square), and do not conserve energy: at albedo 1
    they reflect 0.90 to 1.14 of the light, up to albedo 0.95 less than 1 everywhere. Under layers that send nearly all
    light back a base that reflects more than 1 has no solution: use "transport" there.

    Not smooth at roughness 0: the value there is albedo / pi, but Eq. (9) does not vanish as r -> 0 (0.011 at albedo 1
    and normal incidence). Derivatives by roughness would diverge at 0 (as r^-1/2 near grazing) and at 1 (where alpha
    does): roughness counts from 1e-8, and within 1e-6 of 1 the flakes' concentration is linear in it, so that both are
    large and lead into the range. The derivative by albedo diverges at 1 as (1 - c)^-1/2 (the physical one does too);
    at 1 itself that term is left out.
    """

    albedo: Parameter = parameter("VMFDiffuse.albedo")
    roughness: Parameter = parameter("VMFDiffuse.roughness")
    form: Form = eqx.field(static=True, default="paper")

    def __check_init__(self) -> None:
        if self.form not in get_args(Form):
            raise ValueError(f'VMFDiffuse.form: {self.form!r} is not one of "paper", "literal", "transport"')

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        albedos = per_channel(self.albedo)
        if self.form == "transport":
            from layerjax.surfaces.vmf_diffuse.all_orders import transport_brdf

            return transport_brdf(wi, wo, albedos, self.roughness)
        rough = self.roughness > 0
        r = LEAST_ROUGHNESS + (1.0 - LEAST_ROUGHNESS) * self.roughness
        orders = scattering_orders(wi, wo, r)
        shape = _direction_factor(wi[2] * wo[2], r, self.form)

        def multiple(c: Array) -> Array:
            return at_least(_albedo_factor(c, r, self.form) * shape, 0.0)

        # at roughness 0, where the value leaps to that of a Lambertian, the slope in roughness is still that of the fit
        (f1, f2, f3), (s1, s2, s3) = orders, map(_slope_alone, orders)
        values = []
        for c in albedos:
            fitted = c * (f1 + c * (f2 + c * f3)) + multiple(c)  # Eq. (7)
            flat = c / jnp.pi + c * (s1 + c * (s2 + c * s3)) + _slope_alone(multiple(jax.lax.stop_gradient(c)))
            values.append(jnp.where(rough, fitted, flat))
        return tuple(values)

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        # a cosine lobe that leans towards the light, as the flakes do that it meets; uniform for a share, because
        # f cos stays finite where the cosine goes to 0. A weight is below 2 times the albedo.
        share, axis = self._proposal(wi)
        uniform = u1 < share
        v1 = jnp.where(uniform, safe_div(u1, share), (u1 - share) / (1.0 - share))
        x, y, z = sample_cosine(v1, u2)
        first, second = frame(axis)
        leaning = add(combine(x, first, y, second), scale(z, axis))
        flat, phi = safe_sqrt(1.0 - v1 * v1), 2.0 * jnp.pi * u2
        return select(uniform, (flat * jnp.cos(phi), flat * jnp.sin(phi), v1), leaning)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        share, axis = self._proposal(wi)
        return (0.5 * share + (1.0 - share) * at_least(dot(axis, wo), 0.0)) / jnp.pi

    def _proposal(self, wi: Vector) -> tuple[Array, Vector]:
        """Share of uniform draws, and the axis of the lobe of the others."""
        root = safe_sqrt(self.roughness)
        lean = 0.5 * root * (1.0 - 0.5 * self.roughness)
        return 0.4 * root, normalize((lean * wi[0], lean * wi[1], 1.0 - lean + lean * wi[2]))

    @classmethod
    def from_diffuse_albedo(
        cls, diffuse_albedo: ArrayLike, roughness: ArrayLike, form: Form = "paper", *, exact: bool = False
    ) -> Self:
        """The surface that reflects a share k_d of light at normal incidence, whatever its roughness.

        Args:
            diffuse_albedo: k_d in [0, 1], one or one per channel.
            roughness: r in [0, 1].
            form: as in the class.
            exact: False, the paper's closed form (Section 5), smooth and cheap; the share that is in fact reflected is
                lower by up to 0.02 at r = 0.1, 0.07 at 0.5, 0.12 at 0.7 and 0.17 at 1 (up to 0.06 higher at r = 0.3).
                True, the albedo of the flakes for which this `form` reflects k_d (within 1e-4), found numerically, with
                derivatives by k_d and r; it is 1 where even that reflects less.

        Raises:
            ValueError: a value out of range, or one that is not a number (as `fits.Free`).
        """
        target = cls(diffuse_albedo, roughness, form)  # has the ranges and shapes that are wanted
        for name, value in (("diffuse_albedo", target.albedo), ("roughness", target.roughness)):
            if is_placeholder(value):
                raise ValueError(f"VMFDiffuse.from_diffuse_albedo: {name} is not given a value")
        solve = _solved if exact else _mapped
        return cls(solve(target), target.roughness, form)


def _slope_alone(x: Array) -> Array:
    """0, with the derivatives of x."""
    return x - jax.lax.stop_gradient(x)


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
    first, second, third = (at_least(order, 0.0) / jnp.pi for order in orders)
    return first, second, third


class Fit(NamedTuple):
    """Constants of Eq. (9): of the exponent's X, of the powers' base, of C_k, and of the rest."""

    x: tuple[float, float]
    base: tuple[float, float]
    losses: tuple[float, float, float]
    scale: float
    offset: float
    shape: tuple[float, float, float]


FITS = {
    "paper": Fit(
        (0.264641, 0.0225272),
        (1.0075, 1.16942),
        (0.5441615108674713, 0.45302863761693374, 1.4293127703064865),
        0.384016,
        0.341969,
        (0.0898863, 0.0578978, 0.287663),
    ),
    "literal": Fit((0.265, 0.0225), (1.0, 1.169), (0.544, 0.453, 1.429), 0.384, 0.342, (0.09, 0.0579, 0.288)),
}
"""Eq. (9) as printed ("literal"), and with the digits that implementations of it carry ("paper")."""


def _albedo_factor(c: Array, r: Array, form: Form) -> Array:
    """The part of Eq. (9) that knows the albedo: the rest is the same for all channels."""
    fit = FITS[form]
    loss = safe_sqrt(1.0 - c)
    x, missing = (r - fit.x[0]) * r + fit.x[1], erf(loss)
    power = jnp.arctan(x) * missing if form == "literal" else jnp.arctan(x * missing)
    kept = c * (fit.base[0] + fit.base[1] * loss) ** -power  # C_a
    linear, square, below = fit.losses
    return fit.scale * (1.0 - linear * loss - square * loss * loss) / (1.0 + below * loss) * (kept - fit.offset) * kept


def _direction_factor(cosines: Array, r: Array, form: Form) -> Array:
    """The part of Eq. (9) that knows directions, by u_i u_o."""
    low, step, shift = FITS[form].shape
    return jnp.abs(jnp.tanh(r) - low) - step / (cosines + shift)


def _mapped(target: VMFDiffuse) -> Array:
    """Section 5 in a form that neither cancels nor divides by 0: k_d = x / (x + s (1 - x^2)), solved for x."""
    k, r = target.albedo, target.roughness
    strength = 0.64985 + 0.631112 * r + 1.38922 * r * r  # s
    lifted = 2.0 * strength * k / (1.0 - k + jnp.hypot(1.0 - k, 2.0 * strength * k))
    root = safe_sqrt(r)
    return at_most(lifted * root + (1.0 - root) * k, 1.0)


@eqx.filter_jit
def _solved(target: VMFDiffuse) -> Array:
    """Albedo of the flakes with which the surface has the target's albedo at normal incidence, by bisection."""
    wanted, r = jnp.broadcast_arrays(jnp.atleast_1d(target.albedo), target.roughness)[0], target.roughness
    x, w = (jnp.asarray(array, wanted.dtype) for array in gauss_legendre(NODES))
    up: Vector = (jnp.zeros_like(x), jnp.zeros_like(x), jnp.ones_like(x))
    wo: Vector = (safe_sqrt(1.0 - x * x), jnp.zeros_like(x), x)

    def energy(albedo: Array, roughness: Array) -> Array:
        values = VMFDiffuse(albedo, roughness, target.form).evaluate(up, wo)
        return 2.0 * jnp.pi * jnp.stack([jnp.sum(w * x * value) for value in values])

    def halved(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        enough = energy(middle, jax.lax.stop_gradient(r)) >= jax.lax.stop_gradient(wanted)
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    steps = jnp.finfo(wanted.dtype).nmant
    low, high = jax.lax.fori_loop(0, steps, halved, (jnp.zeros_like(wanted), jnp.ones_like(wanted)))
    near = jax.lax.stop_gradient(0.5 * (low + high))
    # one step of Newton's method carries the derivatives
    slope = jax.jvp(lambda c: energy(c, r), (near,), (jnp.ones_like(near),))[1]
    found = near + (wanted - energy(near, r)) / jax.lax.stop_gradient(slope)
    return at_most(at_least(found, 0.0), 1.0).reshape(target.albedo.shape)
