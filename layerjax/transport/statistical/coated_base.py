"""Light that has reached a Lambertian base under one dielectric coat, from tables: the closed form at every texel.

The same closed form as `layerjax.transport.statistical.diffuse_base`, f = T(i) T(o) rho / (pi n^2 (1 - rho R)), which
has T and R from an exact solve. Of a coat that absorbs nothing T is what its interface lets in.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax._numerics import horizon
from layerjax.channels import Channels, map_channels, multiply, per_channel, select, total
from layerjax.directions import Vector, sanitise
from layerjax.microsurface.energy_tables import interface_energies
from layerjax.stack import Interface, Medium, Stack, is_known
from layerjax.surfaces import Lambertian
from layerjax.tables import load
from layerjax.transport.statistical.diffuse import (
    closed_form,
    coat_means,
    coated_transmission,
    indirect_energy,
    reflection,
)


class CoatedBase(eqx.Module):
    """A coat on a Lambertian base. tau: transmittance along the normal by channels; None: it absorbs nothing.
    reflectance: of the base.
    """

    alpha: Array
    ior: Array
    tau: Channels | None
    reflectance: Channels

    def value(self, wi: Vector, wo: Vector) -> Channels:
        """BRDF of the light that has reached the base, 0 unless both directions are above."""
        edge = horizon(wi[2].dtype)
        valid = (wi[2] > edge) & (wo[2] > edge)
        there, back = (self.transmittance(sanitise(w, valid)[2]) for w in (wi, wo))
        returned = tuple(reflection(load("diffuse_interface"), self.alpha, self.ior, t) for t in _taus(self))
        one = jnp.ones_like(wi[2])
        level = map_channels(lambda r, rho: closed_form(one, one, r, rho, self.ior), returned, self.reflectance)
        return select(valid, multiply(there, back, level))

    def albedo(self, wi: Vector) -> Channels:
        """Energy of `value` for light along wi, above."""
        means = [coat_means(self.alpha, self.ior, t) for t in _taus(self)]
        leaving, returned = tuple(mean.leaving for mean in means), tuple(mean.returned for mean in means)
        return map_channels(indirect_energy, self.transmittance(wi[2]), leaving, returned, self.reflectance)

    def transmittance(self, cosine: Array) -> Channels:
        """Share of light along a cosine that arrives at the base."""
        if self.tau is None:
            return (interface_energies(cosine, self.alpha, self.ior, multiple=True)[1],)
        return tuple(coated_transmission(cosine, self.alpha, self.ior, tau) for tau in self.tau)


def is_coated(stack: Stack) -> bool:
    """Whether a simplified stack is one interface, and below it nothing but what absorbs, on a Lambertian base."""
    if not isinstance(stack.base, Lambertian) or not stack.layers or not isinstance(stack.layers[0], Interface):
        return False
    return all(isinstance(layer, Medium) and is_known(layer.albedo, 0.0) for layer in stack.layers[1:])


def make_coated(stack: Stack) -> CoatedBase:
    """The diffuse part of a stack for which `is_coated`."""
    face, base = stack.layers[0], stack.base
    assert isinstance(face, Interface)
    assert isinstance(base, Lambertian)
    depths = [per_channel(jnp.asarray(layer.thickness)) for layer in stack.layers[1:] if isinstance(layer, Medium)]
    tau = tuple(jnp.exp(-depth) for depth in total(depths)) if depths else None
    return CoatedBase(jnp.asarray(face.alpha), jnp.asarray(face.ior), tau, per_channel(jnp.asarray(base.albedo)))


def _taus(part: CoatedBase) -> Sequence[Array]:
    return (jnp.ones_like(part.alpha),) if part.tau is None else part.tau
