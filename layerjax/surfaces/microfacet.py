"""Conductors: mirrors, and rough ones of microfacets with separable Smith masking (Walter et al. 2007)."""

from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._checks import require_kind
from layerjax._parameters import Parameter, parameter
from layerjax.channels import Channels, map_channels, per_channel
from layerjax.directions import Vector, half_vector, mirror, reflect
from layerjax.normals import facets
from layerjax.normals.facets import Distribution, Facets, check_facets, reflection_pdf
from layerjax.normals.widths import Width, azimuth_of_tangent
from layerjax.quadrature import Nodes
from layerjax.surfaces.contract import Surface
from layerjax.surfaces.thin_film import ThinFilm


class Conductor(Facets, Surface):
    """Rough conductor: f = F D G / (4 cos_i cos_o), with the Fresnel term F of the index n + i k (Walter et al. 2007).

    A smooth one is a mirror, whose f is 0 but for a delta: see `layerjax.specular`; in the transports of smooth
    interfaces.

    ============ ====== ======== ==== ============ ======== ============== =============================================
    parameter    symbol shape    unit range        default  differentiable meaning
    ============ ====== ======== ==== ============ ======== ============== =============================================
    ior          n      (), (C,) 1    [0.01, 10]   required yes            real part of the index, relative to the
                                                                           surroundings of the stack
    k            k      (), (C,) 1    [0, 20]      required yes            imaginary part of the index (extinction
                                                                           coefficient), with the same reference
    alpha        alpha  ()       1    [1e-4, 1]    None     yes            width of D; [1e-4, 15] for ``"vmf"``, where
                                                                           kappa = 2 / alpha^2; None and 0: a mirror
    distribution D                    "ggx",       "ggx"    no             as of an `Interface`
                                      "beckmann",
                                      "vmf",
                                      "gtr"
    film                              `ThinFilm`   None     yes            transparent film on every facet; not in
                                                                           `Statistical` and `ENDF`
    alpha_y             ()       1    [1e-4, 1]    None     yes            width across the tangent (alpha is that along
                                                                           it), as of brushed metal; None: alpha
    tangent             ()       rad  [-pi, pi]    0        yes            azimuth of the tangent, or a vector along it
    gamma        gamma  ()       1    [1.75, 40]   None     yes            exponent of the Student-t slopes of ``"gtr"``
                                                                           (GGX at 2, Beckmann in the limit; see
                                                                           `Interface`)
    ============ ====== ======== ==== ============ ======== ============== =============================================
    """

    ior: Parameter = parameter("Conductor.ior")
    k: Parameter = parameter("Conductor.k")
    alpha: Parameter = parameter("Conductor.alpha", default=None, optional=True, ranged=False, absent_at_zero=True)
    distribution: Distribution = eqx.field(static=True, default="ggx")
    film: ThinFilm | None = None
    alpha_y: Parameter = parameter("Conductor.alpha_y", default=None, optional=True)
    tangent: Parameter = eqx.field(converter=partial(azimuth_of_tangent, "Conductor.tangent"), default=None)
    gamma: Parameter = parameter("Conductor.gamma", default=None, optional=True)

    def __check_init__(self) -> None:
        check_facets("Conductor", self.distribution, self.alpha, self.alpha_y, self.tangent, self.gamma)
        require_kind("Conductor.film", self.film, ThinFilm, None)

    @property
    def is_smooth(self) -> bool:
        """Whether it is a mirror, by structure: then all that it reflects is a delta."""
        return self.alpha is None

    def reflectance(self, cosine: Array) -> Channels:
        """Fresnel reflectance of a facet, by the cosine of incidence on it."""
        ior, k = per_channel(self.ior), per_channel(self.k)
        if self.film is None:
            return map_channels(lambda ior, k: fresnel.conductor(cosine, ior, k), ior, k)
        film = per_channel(self.film.ior), per_channel(self.film.phase)
        return map_channels(lambda *numbers: fresnel.thin_film(cosine, *numbers), ior, k, *film)

    def relative_to(self, above: Any) -> "Conductor":
        """The same conductor, its indices and wavelengths counted in a medium of this index that lies on it."""
        relative = eqx.tree_at(lambda base: (base.ior, base.k), self, (self.ior / above, self.k / above))
        if self.film is None:
            return relative
        return eqx.tree_at(lambda base: base.film, relative, self.film.relative_to(above))

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Array, ...]:
        if self.is_smooth:
            return (jnp.zeros_like(wi[2] * wo[2]),)
        h, cosine = half_vector(wi, wo, same_side=True)
        lobe = mirror_lobe(h, wi, wo, self.width, self.distribution)
        return tuple(lobe * level for level in self.reflectance(cosine))

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        if self.is_smooth:
            return mirror(wi)
        return reflect(wi, facets.sample(wi, self.width, u1, u2, self.distribution))

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        if self.is_smooth:
            return jnp.zeros_like(wi[2] * wo[2])
        h, _ = half_vector(wi, wo, same_side=True)
        return reflection_pdf(h, wi, self.width, self.distribution)

    def rule(self, wi: Vector, nodes: int) -> Nodes:
        if self.is_smooth:
            return super().rule(wi, nodes)
        return facets.rule(wi, self.width, nodes, self.distribution)


def mirror_lobe(h: Vector, wi: Vector, wo: Vector, alpha: Width, distribution: Distribution) -> Array:
    """BRDF of facets that are perfect mirrors, D G / (4 cos cos), 1/sr."""
    return facets.density(h, alpha, distribution) * visibility(wi[2], wi, wo[2], wo, alpha, distribution)


def visibility(
    cosine_i: Array, wi: Vector, cosine_o: Array, wo: Vector, alpha: Width, distribution: Distribution
) -> Array:
    """G1(i) G1(o) / (4 cos cos) of two directions and their cosines, >= 0; no cosine is left to divide by."""
    seen_i = facets.twice_projected_area(cosine_i, wi, alpha, distribution)
    seen_o = facets.twice_projected_area(cosine_o, wo, alpha, distribution)
    return 1.0 / (seen_i * seen_o)
