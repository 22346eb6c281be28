"""Rough interfaces of GGX microfacets: single scattering, separable Smith masking (Walter et al. 2007).

`Conductor` is a base; a dielectric is an `Interface` of a stack, and its BSDF is given here as plain functions of
directions, seen from either side by turning z round.
"""

import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._parameters import Parameter, parameter
from layerjax.channels import count, per_channel, pick
from layerjax.directions import Vector, add, combine, dot, half_vector, reflect, refract, select
from layerjax.distributions import ggx_density, ggx_masking, ggx_sample, radii, sggx_area
from layerjax.quadrature import Nodes, flake_rule
from layerjax.surfaces._surface import Surface


class Conductor(Surface):
    """Rough conductor.

    ========= ====== ============ ======= ===============================================================
    parameter symbol range        default meaning
    ========= ====== ============ ======= ===============================================================
    ior       n      [0.01, 10]           real part of the index relative to what surrounds the stack, per
                                          channel
    k         k      [0, 20]              extinction coefficient, per channel
    alpha     alpha  [1e-4, 1]            GGX width
    ========= ====== ============ ======= ===============================================================
    """

    ior: Parameter = parameter("Conductor.ior")
    k: Parameter = parameter("Conductor.k")
    alpha: Parameter = parameter("Conductor.alpha")

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        h, cosine = half_vector(wi, wo, same_side=True)
        lobe = ggx_density(h, self.alpha) * _masking_over_cosines(wi[2], wi, wo[2], wo, self.alpha)
        ior, k = per_channel(self.ior), per_channel(self.k)
        return tuple(lobe * fresnel.conductor(cosine, pick(ior, c), pick(k, c)) for c in range(count(ior, k)))

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        return reflect(wi, ggx_sample(wi, self.alpha, u1, u2))

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        h, _ = half_vector(wi, wo, same_side=True)
        return facet_density(h, wi, self.alpha)

    def rule(self, wi: Vector, nodes: int) -> Nodes:
        upper, _ = flake_rule(wi, *radii("surface", self.alpha), None, nodes)
        return upper


def facet_density(h: Vector, wi: Vector, alpha: Array) -> Array:
    """Density, 1/sr, of directions reflected at GGX facets that are seen from wi, by their half vector with wi."""
    return ggx_density(h, alpha) * ggx_masking(wi, alpha) / (4.0 * wi[2])


def interface_reflection(wi: Vector, wo: Vector, ior: Array, alpha: Array) -> Array:
    """BRDF of a rough dielectric interface, 1/sr, without the cosine (Walter 2007, Eq. 20).

    Args:
        wi, wo: unit directions on the +z side.
        ior: index on the far side over index on the side of wi, > 0.
        alpha: GGX width.
    """
    h, cosine = half_vector(wi, wo, same_side=True)
    lobe = ggx_density(h, alpha) * _masking_over_cosines(wi[2], wi, wo[2], wo, alpha)
    return fresnel.dielectric(cosine, ior) * lobe


def interface_transmission(wi: Vector, wo: Vector, ior: Array, alpha: Array) -> Array:
    """BTDF of a rough dielectric interface, 1/sr, without the cosine (Walter 2007, Eq. 21, with its eta_o^2).

    Radiance is carried: f / ior_o^2 is symmetric, and the integral of f |cos_o| over wo is the energy that passes.

    Args:
        wi: unit directions on the +z side.
        wo: unit directions on the -z side.
        ior: index on the far side over index on the side of wi, > 0. At 1 the BTDF is a delta, and 0 is returned.
        alpha: GGX width.
    """
    lobe, transmitted = refraction_lobe(wi, wo, ior, alpha)
    return 4.0 * _masking_over_cosines(wi[2], wi, -wo[2], wo, alpha) * lobe * transmitted


def refraction_lobe(wi: Vector, wo: Vector, ior: Array, alpha: Array) -> tuple[Array, Array]:
    """Facets that refract wi to wo: D <wi, m> <wo, m> ior^2 / (<wi, m> + ior <wo, m>)^2, and their transmittance 1 - F.

    The first is 0 where no facet whose normal lies on the +z side does; wo.z < 0 is not checked.
    """
    v = combine(1.0, wi, ior, wo)  # along the facet normal; its length cancels from the result
    total = add(wi, wo)
    squared = dot(total, total)
    step = ior - 1.0
    # (wi.v, wo.v) as sums that keep their digits where wo is near -wi
    towards_i, towards_o = 0.5 * ior * squared - step, 0.5 * squared + step
    exists = (towards_i * towards_o < 0) & (towards_i * v[2] > 0)
    exists = exists & (jnp.abs(step) > 64.0 * jnp.finfo(squared.dtype).eps)
    a = jnp.where(exists, jnp.abs(towards_i), 1.0)
    b = jnp.where(exists, jnp.abs(towards_o), 1.0)
    x, y, z = jnp.where(exists, v[0], 0.0), jnp.where(exists, v[1], 0.0), jnp.where(exists, v[2], 1.0)
    q = x * x + y * y + (alpha * z) ** 2
    # 1 - F with both cosines known: no difference, and no angle of total reflection
    transmitted = 2.0 * ior * a * b * (1.0 / (a + ior * b) ** 2 + 1.0 / (ior * a + b) ** 2)
    lobe = (ior * alpha * a / q) * (ior * alpha * b / q) / jnp.pi
    return jnp.where(exists, lobe, 0.0), transmitted


def interface_sample(wi: Vector, ior: Array, alpha: Array, u1: Array, u2: Array, u3: Array) -> tuple[Vector, Array]:
    """Direction that a facet seen from wi reflects or refracts to, chosen by its Fresnel reflectance.

    Returns the direction and whether it leaves on the side that its kind allows (reflection: above); one that does not
    is masked light, and is lost. The density of those that do is f |cos_o| / G1(wo), see `interface_pdf`.
    """
    m = ggx_sample(wi, alpha, u1, u2)
    refracted, exists = refract(wi, m, ior)
    reflects = (u3 < fresnel.dielectric(dot(wi, m), ior)) | ~exists
    wo = select(reflects, reflect(wi, m), refracted)
    return wo, (wo[2] > 0) == reflects


def interface_pdf(f: Array, wo: Vector, alpha: Array) -> Array:
    """Density of `interface_sample`, 1/sr, from the BSDF f of the pair: f |cos_o| / G1(wo)."""
    return 0.5 * f * (jnp.abs(wo[2]) + sggx_area(wo, "surface", alpha, None))


def _masking_over_cosines(cosine_i: Array, wi: Vector, cosine_o: Array, wo: Vector, alpha: Array) -> Array:
    """G1(i) G1(o) / (4 cos cos) with G1 = 2 cos / (cos + sigma): no cosine is left to divide by."""
    area_i, area_o = sggx_area(wi, "surface", alpha, None), sggx_area(wo, "surface", alpha, None)
    return 1.0 / ((cosine_i + area_i) * (cosine_o + area_o))
