"""Rough interfaces of GGX microfacets: single scattering, separable Smith masking (Walter et al. 2007)."""

from jax import Array

from layerjax import fresnel
from layerjax._parameters import Parameter, parameter
from layerjax.channels import count, per_channel, pick
from layerjax.directions import Vector, half_vector, reflect
from layerjax.distributions import ggx_density, ggx_masking, ggx_sample, radii, sggx_area
from layerjax.quadrature import Nodes, flake_rule
from layerjax.surfaces._surface import Surface


class Conductor(Surface):
    """Rough conductor.

    ========= ====== ============ ======= ===============================================================
    parameter symbol range        default meaning
    ========= ====== ============ ======= ===============================================================
    ior       n      [0.01, 10]           real part of the index relative to what lies above, per channel
    k         k      [0, 20]              extinction coefficient, per channel
    alpha     alpha  [1e-4, 1]            GGX width
    ========= ====== ============ ======= ===============================================================
    """

    ior: Parameter = parameter("Conductor.ior")
    k: Parameter = parameter("Conductor.k")
    alpha: Parameter = parameter("Conductor.alpha")

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        h, cosine = half_vector(wi, wo, same_side=True)
        # D G1(i) G1(o) / (4 cos cos) with G1 = 2 cos / (cos + sigma): no cosine is left to divide by
        area_i = sggx_area(wi, "surface", self.alpha, None)
        area_o = sggx_area(wo, "surface", self.alpha, None)
        lobe = ggx_density(h, self.alpha) / ((wi[2] + area_i) * (wo[2] + area_o))
        ior, k = per_channel(self.ior), per_channel(self.k)
        return tuple(lobe * fresnel.conductor(cosine, pick(ior, c), pick(k, c)) for c in range(count(ior, k)))

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        return reflect(wi, ggx_sample(wi, self.alpha, u1, u2))

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        h, _ = half_vector(wi, wo, same_side=True)
        return ggx_density(h, self.alpha) * ggx_masking(wi, self.alpha) / (4.0 * wi[2])

    def rule(self, wi: Vector, nodes: int) -> Nodes:
        upper, _ = flake_rule(wi, *radii("surface", self.alpha), None, nodes)
        return upper
