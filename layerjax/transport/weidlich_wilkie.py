"""Arbitrarily layered micro-facet surfaces (Weidlich & Wilkie 2007): the baseline that later layered models improve on.

Light meets one and the same facet at every interface: wi and wo are refracted at the facet whose normal is their half
vector h, and what lies below is evaluated for the refracted pair. Layer by layer, from the top,

    f(wi, wo) = f_1(wi, wo) + T12 f_rest(wi', wo') a t,
    T12 = 1 - F(wi.h),  a = exp(-tau (1/cos_i' + 1/cos_o')),  t = (1 - G) + T21 G,  T21 = 1 - F(wo'.h).

wi' + wo' is again along h, so one half vector serves every layer, and T21 = T12: light that came in through a facet
leaves through it, and is never totally reflected. The factor t is an empirical one, to make up for total reflection
inside; which G is meant is left open: here it is the masking G1(wi) G1(wo) of the interface that is crossed, on its
outer side. There is no inter-reflection, no roughness is carried from one interface to the next, and no Jacobian (nor
1/ior^2) stands for the change of solid angle by refraction. So the model is reciprocal, but loses energy at slanting
angles over a mirror, returns too much from a diffuse base, and can gain energy where the index below is under 1.
"""

from collections.abc import Sequence
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax.channels import Channels, mean, multiply, total
from layerjax.directions import (
    Factor,
    Vector,
    combine,
    half_vector,
    is_above,
    sanitise,
    select,
    squared_cosine_of_refraction,
)
from layerjax.normals.ggx import ggx_area, ggx_density
from layerjax.stack import Medium, Stack, is_known, optical_depths
from layerjax.surfaces import Conductor, Surface
from layerjax.transport.contract import (
    TEXELS,
    DeterministicTransport,
    Side,
    refuse_interface_film,
    refuse_smooth,
    require_ggx,
)
from layerjax.transport.first_order import ReflectingInterface
from layerjax.transport.known_directions import DirectionLookup

LEAST_SHARE = 0.02
"""Added to the energy of every lobe before they are drawn by it: none is missed where its estimate is 0."""


class WeidlichWilkie(DeterministicTransport):
    """One refracted half vector, no inter-reflection (Weidlich & Wilkie 2007).

    Supports any number of `Interface` layers, and `Medium` layers that only absorb, over any surface, in reflection
    from above. An albedo of 0 must be known while tracing: make the medium outside `jit`, and insert traced numbers
    with `equinox.tree_at`. The values are reciprocal.
    """

    texel_batch: ClassVar[int] = TEXELS

    def check(self, stack: Stack, names: Sequence[str]) -> None:
        refuse_smooth(stack, names, "WeidlichWilkie")
        require_ggx(stack, names, "WeidlichWilkie")
        refuse_interface_film(stack, names, "WeidlichWilkie")
        for name, layer in zip(names, stack.layers, strict=True):
            if isinstance(layer, Medium) and not is_known(layer.albedo, 0.0):
                raise ValueError(
                    f"{name}: WeidlichWilkie carries no Medium that scatters (its albedo must be known to be "
                    "0, not traced); AddingDoubling and RandomWalk do"
                )
        if stack.base is None:
            raise ValueError(
                "base: WeidlichWilkie needs an opaque base and has no transmission; AddingDoubling and RandomWalk do"
            )

    def prepare(self, stack: Stack) -> Stack:
        return stack

    def traceable_equivalent(self, stack: Stack, known: DirectionLookup) -> "WeidlichWilkie":
        """Itself: no number decides what is computed."""
        return self

    def evaluate(self, state: Stack, wi: Vector, wo: Vector, side: Side) -> Channels:
        if side == "transmission":
            return (jnp.zeros_like(wi[2] * wo[2]),)
        lobes = _lobes(state, wi, wo)
        return total(lobes)

    def sample(self, state: Stack, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
        u, u1, u2 = uniforms
        wi = sanitise(wi)
        choices = _choices(state, wi)
        wo = choices[-1][1].sample(wi, u1, u2)
        edge = jnp.zeros_like(u)
        for probability, surface in choices[:-1]:
            following = edge + probability
            wo = select((u >= edge) & (u < following), surface.sample(wi, u1, u2), wo)
            edge = following
        return wo

    def pdf(self, state: Stack, wi: Vector, wo: Vector) -> Array:
        safe_i, safe_o = sanitise(wi), sanitise(wo)
        density = jnp.zeros_like(wi[2] * wo[2])
        for probability, surface in _choices(state, safe_i):
            density = density + probability * surface.pdf(safe_i, safe_o)
        return jnp.where(is_above(wi) & is_above(wo), density, 0.0)

    def albedo(self, state: Stack, wi: Vector, nodes: int) -> tuple[Channels, Channels]:
        """By quadrature with `nodes` points, every lobe with a rule of its own: 32 give 3e-4, relative.

        Below an index under 1 total reflection cuts lobes off, which the rules do not follow: errors of 4 % there.
        """
        spread: Vector = (wi[0][..., None], wi[1][..., None], wi[2][..., None])
        energies: list[Channels] = []
        for index, (_, surface) in enumerate(_choices(state, sanitise(wi))):
            wo, weight = surface.rule(sanitise(wi), nodes)
            values = _lobes(state, spread, wo)[index]
            energies.append(tuple(jnp.sum(value * wo[2] * weight, axis=-1) for value in values))
        zero = jnp.zeros_like(wi[2])
        return total(energies, zero), (zero,)


def _lobes(stack: Stack, wi: Vector, wo: Vector) -> list[Channels]:
    """BRDF of every interface, from top to bottom, and of the base, each as seen from outside."""
    valid = is_above(wi) & is_above(wo)
    wi, wo = sanitise(wi), sanitise(wo)
    h, cosine = half_vector(wi, wo, same_side=True)
    lobes: list[Channels] = []
    above: Factor = 1.0
    through: Channels = (jnp.where(valid, 1.0, 0.0).astype(cosine.dtype),)
    for layer in stack.layers:
        if isinstance(layer, Medium):
            into, out = (optical_depths([layer], w)[0] for w in (wi, wo))
            through = multiply(through, tuple(jnp.exp(-(a + b)) for a, b in zip(into, out, strict=True)))  # a
            continue
        ior = layer.ior / above
        level = fresnel.dielectric(cosine, ior)
        lobe, masking = _facets(h, wi, wo, layer.alpha)
        lobes.append(multiply(through, (level * lobe,)))  # f_1
        refracted = 1.0 - level  # T12, T21
        wi, wo, cosine, inside = _refract_pair(wi, wo, h, cosine, ior)
        # T12 t
        through = multiply(through, (jnp.where(inside, refracted * (1.0 - masking + refracted * masking), 0.0),))
        above = layer.ior
    assert stack.base is not None
    lobes.append(multiply(through, _base_reflection(stack.base, wi, wo, h, cosine, above)))
    return lobes


def _base_reflection(base: Surface, wi: Vector, wo: Vector, h: Vector, cosine: Array, above: Factor) -> Channels:
    """BRDF of the base under a medium of that index."""
    if not isinstance(base, Conductor):
        return base.evaluate(wi, wo)
    lobe, _ = _facets(h, wi, wo, base.alpha)
    return tuple(lobe * level for level in base.relative_to(above).reflectance(cosine))


def _facets(h: Vector, wi: Vector, wo: Vector, alpha: Array) -> tuple[Array, Array]:
    """D G / (4 cos cos) and G of GGX facets, G = G1 G1: no cosine is left to divide by."""
    visible = 1.0 / ((wi[2] + ggx_area(wi, alpha)) * (wo[2] + ggx_area(wo, alpha)))
    return ggx_density(h, alpha) * visible, 4.0 * wi[2] * wo[2] * visible


def _refract_pair(wi: Vector, wo: Vector, h: Vector, cosine: Array, ior: Array) -> tuple[Vector, Vector, Array, Array]:
    """wi' and wo', both upward, their cosine with h, and whether light comes in and leaves along them at all."""
    squared = squared_cosine_of_refraction(cosine, ior)
    exists = squared > 0
    turned = jnp.sqrt(jnp.where(exists, squared, 0.25))
    along = turned - cosine / ior
    wi, wo = combine(1.0 / ior, wi, along, h), combine(1.0 / ior, wo, along, h)
    return sanitise(wi), sanitise(wo), turned, exists & is_above(wi) & is_above(wo)


def _choices(stack: Stack, wi: Vector) -> list[tuple[Array, Surface]]:
    """Lobes to draw from, in the order of `_lobes`, with their probabilities: energies, estimated at a level facet.

    A deeper lobe has the roughness of its own facets about the half vector outside: it is drawn as if it lay on top.
    """
    normal: Vector = (jnp.zeros_like(wi[2]), jnp.zeros_like(wi[2]), jnp.ones_like(wi[2]))
    reached, above = jnp.ones_like(wi[2]), jnp.ones_like(wi[2])
    energies: list[tuple[Array, Surface]] = []
    w = wi
    for layer in stack.layers:
        if isinstance(layer, Medium):
            reached = reached * mean(tuple(jnp.exp(-2.0 * depth) for depth in optical_depths([layer], w)[0]))
            continue
        ior = layer.ior / above
        level = fresnel.dielectric(w[2], ior)
        energies.append((reached * level, ReflectingInterface(ior, layer.alpha)))
        reached = reached * (1.0 - level) ** 2
        w, _, _, _ = _refract_pair(w, w, normal, w[2], ior)
        above = layer.ior
    base = stack.base
    assert base is not None
    if isinstance(base, Conductor):
        level = mean(base.relative_to(above).reflectance(w[2]))
    else:
        level = jnp.pi * mean(base.evaluate(w, normal))
    energies.append((reached * level, base))
    total = sum((energy + LEAST_SHARE for energy, _ in energies), jnp.zeros_like(wi[2]))
    return [((energy + LEAST_SHARE) / total, surface) for energy, surface in energies]
