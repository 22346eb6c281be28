"""Light that has reached a Lambertian base under dielectric coats, as one lobe (de Dinechin & Belcour 2022).

The paper's form, from its tables; `layerjax.transport.statistical.diffuse_base` has the closed form beside it.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._devices import exact_products
from layerjax._numerics import clamp_min, horizon, safe_sqrt
from layerjax.channels import Channels, per_channel, pick
from layerjax.directions import Vector, sanitise
from layerjax.stack import Interface, Medium, Stack, is_known
from layerjax.surfaces import Lambertian
from layerjax.transport.adding_doubling.interpolate import cubic
from layerjax.transport.lobes.microfacet import GRAZING
from layerjax.transport.lobes.statistics import precision
from layerjax.transport.statistical.diffuse import Coat, indirect_lobe, stack_lobe

POINTS = 97
"""Cosines of a table, uniform in the angle above the horizon."""


class DiffuseLobe(eqx.Module):
    """energy: at the points of a table, (POINTS, C or 1). alpha: GGX width of the lobe, (C or 1,)."""

    energy: Array
    alpha: Array

    def value(self, wi: Vector, wo: Vector) -> Channels:
        """BRDF of the lobe, 0 unless both directions are above."""
        edge = horizon(wi[2].dtype)
        valid = (wi[2] > edge) & (wo[2] > edge)
        energies, seen = self.albedo(sanitise(wi, valid)), sanitise(wo, valid)
        return tuple(
            jnp.where(valid, indirect_lobe(seen, alpha, energy), 0.0)
            for alpha, energy in zip(self.alpha, energies, strict=True)
        )

    def albedo(self, wi: Vector) -> Channels:
        """Energy of `value` for light along wi, above."""
        place = jnp.arctan2(wi[2], safe_sqrt(wi[0] * wi[0] + wi[1] * wi[1])) * (2.0 * (POINTS - 1) / np.pi)
        first = jnp.clip(jnp.floor(place) - 1.0, 0.0, POINTS - 4.0).astype(jnp.int32)
        taps = [weight[..., None] * self.energy[first + j] for j, weight in enumerate(cubic(place - first))]
        rows = sum(taps[1:], taps[0])
        return tuple(clamp_min(rows[..., c], 0.0) for c in range(rows.shape[-1]))  # a cubic may fall below its points


def why_no_lobe(stack: Stack, names: Sequence[str]) -> str | None:
    """What keeps a simplified stack with layers of these names from having this lobe; None if nothing does."""
    if not isinstance(stack.base, Lambertian):
        return "base: the lobe of a diffuse base is that of a Lambertian"
    if not stack.layers or not isinstance(stack.layers[0], Interface):
        return "layers: the lobe of a diffuse base needs an Interface on top"
    for name, layer in zip(names, stack.layers, strict=True):
        if isinstance(layer, Interface) and layer.is_smooth:
            return f"{name}: the lobe of a diffuse base needs a rough Interface"
        if isinstance(layer, Medium) and not is_known(layer.albedo, 0.0):
            return f"{name}: the lobe of a diffuse base needs media that only absorb (albedo known to be 0)"
    return None


@eqx.filter_jit
@exact_products
def make_diffuse_lobe(stack: Stack) -> DiffuseLobe:
    """The lobe of a simplified stack for which `why_no_lobe` finds nothing."""
    assert isinstance(stack.base, Lambertian)
    dtype = precision(stack)
    points = np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, POINTS))
    cosine = jnp.asarray(np.maximum(points, GRAZING), dtype)
    albedos = per_channel(jnp.asarray(stack.base.albedo))
    depths: list[list[Array]] = []
    faces: list[Interface] = []
    for layer in stack.layers:
        if isinstance(layer, Interface):
            faces.append(layer)
            depths.append([jnp.zeros((1,), dtype)])
        else:
            depths[-1].append(jnp.stack(per_channel(layer.thickness)))
    channels = max(len(albedos), *(depth.shape[0] for below in depths for depth in below))
    through = [jnp.broadcast_to(jnp.exp(-sum(below[1:], below[0])), (channels,)) for below in depths]

    def lobe(albedo: Array, through: list[Array]) -> tuple[Array, Array]:
        coats = [
            Coat(jnp.asarray(face.alpha), jnp.asarray(face.ior), tau) for face, tau in zip(faces, through, strict=True)
        ]
        return stack_lobe(coats, albedo, cosine)

    energy, alpha = jax.vmap(lobe, out_axes=(1, 0))(jnp.stack([pick(albedos, c) for c in range(channels)]), through)
    return DiffuseLobe(energy, alpha)
