"""Rough and porous diffuse reflection: one-sided Lambertian flakes with von Mises-Fisher normals.

After d'Eon & Weidlich 2024, "VMF Diffuse: a unified rough diffuse BRDF", CGF 43(4). It runs from Lambertian (r = 0) by
rough surfaces, which an Oren-Nayar resembles, to a dilute cloud of Lambertian spheres (r = 1).
"""

from typing import Literal, Self, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from layerjax._checks import require_choice
from layerjax._numerics import clamp_max, clamp_min, safe_div, safe_sqrt
from layerjax._parameters import Parameter, is_placeholder, parameter
from layerjax.channels import per_channel
from layerjax.directions import Vector, add, combine, dot, frame, normalize, scale, select
from layerjax.quadrature import gauss_legendre
from layerjax.surfaces.contract import Surface
from layerjax.surfaces.lambertian import sample_cosine
from layerjax.surfaces.vmf_diffuse.all_orders import all_orders_brdf
from layerjax.surfaces.vmf_diffuse.paper import flake_albedo, paper_brdf

Form = Literal["paper", "literal", "all_orders"]

NODES = 32
"""Cosines of the albedo at normal incidence."""


class VMFDiffuse(Surface):
    """Rough diffuse surface, from Lambertian to porous (d'Eon & Weidlich 2024).

    Light is scattered by Lambertian flakes whose normals follow a von Mises-Fisher distribution of concentration k =
    2 / log(1 - sqrt(r))^2. The first three orders of scattering, and the sum of all later ones, are fits of the
    paper.

    ========= ====== ======== ==== ====== ======== ============== =====================================================
    parameter symbol shape    unit range  default  differentiable meaning
    ========= ====== ======== ==== ====== ======== ============== =====================================================
    albedo    c      (), (C,) 1    [0, 1] required yes            albedo of a flake
    roughness r      ()       1    [0, 1] required yes            0: Lambertian; 1: a cloud of Lambertian spheres
    form                                  "paper"  no             "paper": later orders with the exponent atan(X
                                                                  erf(C)); "literal": with atan(X) erf(C), as printed,
                                                                  which changes values by at most 0.0017; "all_orders":
                                                                  a table of all orders, which conserves energy
    ========= ====== ======== ==== ====== ======== ============== =====================================================

    The fits follow the flakes' own reflection to 1 to 4 % (root mean square), and do not conserve energy: at albedo 1
    they reflect 0.90 to 1.14 of the light, up to albedo 0.95 less than 1 everywhere. Under layers that send nearly all
    light back a base that reflects more than 1 has no solution: use "all_orders" there.

    Not smooth at roughness 0: the value there is albedo / pi, but Eq. (9) does not vanish as r -> 0 (0.011 at albedo 1
    and normal incidence). Derivatives by roughness would diverge at 0 (as r^-1/2 near grazing) and at 1 (where alpha
    does): roughness counts from 1e-8, and within 1e-6 of 1 the flakes' concentration is linear in it, so that both are
    large and lead into the range. The derivative by albedo diverges at 1 as (1 - c)^-1/2 (the physical one does too);
    at 1 itself that term is omitted.
    """

    albedo: Parameter = parameter("VMFDiffuse.albedo")
    roughness: Parameter = parameter("VMFDiffuse.roughness")
    form: Form = eqx.field(static=True, default="paper")

    def __check_init__(self) -> None:
        require_choice("VMFDiffuse.form", self.form, get_args(Form))

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        albedos = per_channel(self.albedo)
        if self.form == "paper" or self.form == "literal":
            return paper_brdf(wi, wo, albedos, self.roughness, self.form)
        return all_orders_brdf(wi, wo, albedos, self.roughness)

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        # a cosine lobe that is tilted towards the light, as the flakes do that it meets; uniform for a share, because
        # f cos stays finite where the cosine goes to 0. A weight is below 2 times the albedo.
        share, axis = self._proposal(wi)
        uniform = u1 < share
        v1 = jnp.where(uniform, safe_div(u1, share), (u1 - share) / (1.0 - share))
        x, y, z = sample_cosine(v1, u2)
        first, second = frame(axis)
        tilted_axis = add(combine(x, first, y, second), scale(z, axis))
        flat, phi = safe_sqrt(1.0 - v1 * v1), 2.0 * jnp.pi * u2
        return select(uniform, (flat * jnp.cos(phi), flat * jnp.sin(phi), v1), tilted_axis)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        share, axis = self._proposal(wi)
        return (0.5 * share + (1.0 - share) * clamp_min(dot(axis, wo), 0.0)) / jnp.pi

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
        albedo = _solve_albedo(target) if exact else flake_albedo(target.albedo, target.roughness)
        return cls(albedo, target.roughness, form)


@eqx.filter_jit
def _solve_albedo(target: VMFDiffuse) -> Array:
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
    return clamp_max(clamp_min(found, 0.0), 1.0).reshape(target.albedo.shape)
