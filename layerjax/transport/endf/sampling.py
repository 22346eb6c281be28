"""Directions to draw from extended normals, their density, and a quadrature for every lobe.

One draw a lobe (Guo et al. 2015, Sec. 5.4): a facet of the extended normals that the light sees, outside or below the
surface, reflects it. Lobes are chosen by their energy at the mean directions. Densities are those of the draws; what is
drawn and cannot leave lies in the tangent plane and carries nothing. A tenth of the draws follows the cosine, against
weights without bound where a lobe is wider than the one drawn from.
"""

import itertools
from typing import Literal, NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax import channels, fresnel
from layerjax._numerics import clamp_max, safe_sqrt
from layerjax.channels import Channels, mean, total
from layerjax.directions import Vector, flip, half_vector, is_above, reflect, refract, sanitise, select
from layerjax.normals import facets
from layerjax.normals.facet_rule import parallels, polar_angles, visible_normals
from layerjax.quadrature import Nodes
from layerjax.surfaces.interface import interface_pdf, interface_reflection, interface_sample, interface_transmission
from layerjax.surfaces.lambertian import sample_cosine
from layerjax.transport.endf.chains import (
    Coat,
    Options,
    UpperSide,
    chain_concentration,
    inner_concentration,
    masking_over_cosine,
    reflections,
    refract_in,
    smith_masking,
    transmittance,
    width,
)
from layerjax.transport.endf.slab import inner_slab_concentration, slab_concentration, transmissions

Place = Literal["outside", "inside"]

LEAST_SHARE = 0.02
"""Added to the energy of every lobe before they are drawn by it: none is missed where its estimate is 0."""

COSINE = 0.1
"""Share of the draws that follow the cosine."""

BELOW_ONE = 1.0 - 1e-6


class Proposal(NamedTuple):
    """What one lobe is drawn from: a share of the draws, normals and where they lie, and whether the light passes."""

    share: Array
    kappa: Array
    place: Place
    through: bool


def _proposals(coat: Coat, options: Options, wi: Vector, opaque: bool) -> list[Proposal]:
    """One for each of the lobes, in their order: of `reflections`, then of `transmissions`."""
    top, base = coat.top, coat.base
    if top is None:
        return [] if base is None else _normalise_shares([Proposal(jnp.ones_like(wi[2]), base.kappa, "outside", False)])
    level = fresnel.dielectric(wi[2], top.ior)
    found = [Proposal(level, top.kappa, "outside", False)]
    if base is None:
        return _normalise_shares(found)
    inner, enters = refract_in(wi, top.ior)
    through = jnp.where(enters, (1.0 - level) ** 2, 0.0)
    kept = mean(base.reflectance(inner[2])), mean(transmittance(coat, inner, (-inner[0], -inner[1], inner[2])))
    outside = options.form == "paper"
    place: Place = "outside" if outside else "inside"
    energy = through * kept[0] * kept[1]
    for k in range(1, options.bounces + 1):
        kappa = chain_concentration(k, wi[2], top, base) if outside else inner_concentration(k, inner[2], top, base)
        found.append(Proposal(energy, kappa, place, False))
        energy = energy * level * kept[0] * kept[1]
    if opaque:
        return _normalise_shares(found)
    energy = through * mean(transmittance(coat, inner, inner, 0.5))
    for j in range(options.bounces + 1):
        kappa = slab_concentration(j, wi[2], top, base)
        if not outside:
            kappa = inner_slab_concentration(j, inner[2], top, base)
        found.append(Proposal(energy, kappa, place, True))
        energy = energy * level * kept[0] * kept[1]
    return _normalise_shares(found)


def _normalise_shares(lobes: list[Proposal]) -> list[Proposal]:
    total = sum((lobe.share + LEAST_SHARE for lobe in lobes[1:]), lobes[0].share + LEAST_SHARE)
    return [lobe._replace(share=(1.0 - COSINE) * (lobe.share + LEAST_SHARE) / total) for lobe in lobes]


def draw(coat: Coat, options: Options, wi: Vector, uniforms: tuple[Array, Array, Array], opaque: bool) -> Vector:
    """Outgoing directions for wi above, from three uniform numbers each."""
    u, u1, u2 = uniforms
    wi = sanitise(wi)
    x, y, z = sample_cosine(u1, u2)
    by_cosine: Vector = (x, y, z if opaque else jnp.where(u < 1.0 - 0.5 * COSINE, z, -z))
    if _is_interface(coat):
        assert coat.top is not None
        again = clamp_max(u / (1.0 - COSINE), BELOW_ONE)
        wo, leaves = interface_sample(wi, coat.top.ior, width(coat.top.kappa), u1, u2, again, "vmf")
    else:
        lobes = _proposals(coat, options, wi, opaque)
        if not lobes:
            return by_cosine
        wo, leaves = _sample_reflection(coat, wi, lobes, u, u1, u2)
    return select(u < 1.0 - COSINE, (wo[0], wo[1], jnp.where(leaves, wo[2], 0.0)), by_cosine)


def _sample_reflection(
    coat: Coat, wi: Vector, lobes: list[Proposal], u: Array, u1: Array, u2: Array
) -> tuple[Vector, Array]:
    """Direction drawn from the lobe that u falls to, and whether light leaves along it."""
    kappa, inside, through = lobes[0].kappa, jnp.zeros_like(u, bool), jnp.zeros_like(u, bool)
    edge = jnp.zeros_like(u)
    for before, lobe in itertools.pairwise(lobes):
        edge = edge + before.share
        reached = u >= edge
        kappa = jnp.where(reached, lobe.kappa, kappa)
        inside = jnp.where(reached, lobe.place == "inside", inside)
        through = jnp.where(reached, lobe.through, through)
    below = any(lobe.place == "inside" for lobe in lobes)
    towards = wi
    if below:
        assert coat.top is not None
        inner, enters = refract_in(wi, coat.top.ior)
        towards = select(inside, inner, wi)
    out = reflect(towards, facets.sample(towards, width(kappa), u1, u2, "vmf"))
    leaves = is_above(out)
    if below:
        assert coat.top is not None
        outer, escapes = _refract_out(coat.top, sanitise(out))
        out, leaves = select(inside, outer, out), leaves & (~inside | (enters & escapes))
    return select(through, flip(out), out), leaves


def density(coat: Coat, options: Options, wi: Vector, wo: Vector, opaque: bool) -> Array:
    """Density of `draw` in solid angle, 1/sr, for wi above."""
    lit, up, down = is_above(wi), is_above(wo), is_above(flip(wo))
    wi, over = sanitise(wi), sanitise(select(down, flip(wo), wo))
    lobes = [] if _is_interface(coat) else _proposals(coat, options, wi, opaque)
    by_cosine = COSINE if lobes or _is_interface(coat) else 1.0
    total = by_cosine * (1.0 if opaque else 0.5) * over[2] / jnp.pi
    if _is_interface(coat):
        assert coat.top is not None
        ior, alpha = coat.top.ior, width(coat.top.kappa)
        reflected = interface_reflection(wi, over, ior, alpha, "vmf")
        passed = interface_transmission(wi, flip(over), ior, alpha, "vmf")
        out = select(up, over, flip(over))
        facet = interface_pdf(jnp.where(up, reflected, passed), wi, out, ior, alpha, "vmf")
        total = total + (1.0 - COSINE) * facet
    for lobe in lobes:
        total = total + jnp.where(down if lobe.through else up, lobe.share * _density(coat, lobe, wi, over), 0.0)
    return jnp.where(lit & (up if opaque else up | down), total, 0.0)


def _density(coat: Coat, lobe: Proposal, wi: Vector, wo: Vector) -> Array:
    """Density of one lobe's draws before they are mirrored down."""
    if lobe.place == "outside":
        h, _ = half_vector(wi, wo, same_side=True)
        return facets.reflection_pdf(h, wi, width(lobe.kappa), "vmf")
    assert coat.top is not None
    (inner_i, enters), (inner_o, leaves) = refract_in(wi, coat.top.ior), refract_in(wo, coat.top.ior)
    h, _ = half_vector(inner_i, inner_o, same_side=True)
    slope = wo[2] / (coat.top.ior * coat.top.ior * inner_o[2])  # of solid angle inside by outside
    return jnp.where(enters & leaves, slope * facets.reflection_pdf(h, inner_i, width(lobe.kappa), "vmf"), 0.0)


def energies(coat: Coat, options: Options, wi: Vector, nodes: int, opaque: bool) -> tuple[Channels, Channels]:
    """Energy that leaves above and below, for one wi above: every lobe by a rule of its own."""
    lit = is_above(wi)
    wi = sanitise(wi)
    near: list[Channels] = [(jnp.zeros_like(wi[2]),)]
    far: list[Channels] = [(jnp.zeros_like(wi[2]),)]
    lobes = _proposals(coat, options, wi, opaque)
    if lobes:
        wo, weight = _rules(coat, lobes, wi, nodes)
        weight, wo = jnp.where(is_above(wo), weight, 0.0), sanitise(wo)
        split = sum(not lobe.through for lobe in lobes)
        above, below = ((wo[0][rows], wo[1][rows], wo[2][rows]) for rows in (slice(split), slice(split, None)))
        for j, values in enumerate(reflections(coat, options, wi, above)):
            near.append(tuple(jnp.sum(weight[j] * value[j]) for value in values))
        if split < len(lobes):
            for j, values in enumerate(transmissions(coat, options, wi, below)):
                far.append(tuple(jnp.sum(weight[split + j] * value[j]) for value in values))
    if _is_interface(coat):
        assert coat.top is not None
        far.append((_refracted_energy(coat.top, options, wi, nodes),))
    return channels.select(lit, total(near)), channels.select(lit, total(far))


def _rules(coat: Coat, lobes: list[Proposal], wi: Vector, nodes: int) -> Nodes:
    """For every lobe, a row of directions above and weights that have the cosine in them.

    Lobes below the surface get theirs on the thinner side of it: on the other one transmittance ends at an edge.
    """
    towards, widths = [], []
    for lobe in lobes:
        kappa, start = lobe.kappa, wi
        if lobe.place == "inside":
            assert coat.top is not None
            inner, _ = refract_in(wi, coat.top.ior)
            stretch = wi[2] / (coat.top.ior * inner[2])
            start = select(coat.top.ior < 1.0, inner, wi)
            kappa = jnp.where(coat.top.ior < 1.0, kappa, kappa * stretch * stretch)
        towards.append(start)
        widths.append(width(0.5 * kappa))  # normals may be wider than those at the mean direction
    x, y, z = (jnp.stack([w[axis] for w in towards]) for axis in range(3))
    wo, weight = facets.rule((x, y, z), jnp.stack(widths), nodes, "vmf")
    weight = weight * wo[2]
    if not any(lobe.place == "inside" for lobe in lobes):
        return wo, weight
    assert coat.top is not None
    outer, leaves = _refract_out(coat.top, wo)
    inside = jnp.asarray([lobe.place == "inside" for lobe in lobes])[:, None] & (coat.top.ior < 1.0)
    slope = jnp.where(leaves, coat.top.ior * coat.top.ior, 0.0)
    return select(inside, outer, wo), weight * jnp.where(inside, slope, 1.0)


def _refracted_energy(top: UpperSide, options: Options, wi: Vector, nodes: int) -> Array:
    """Energy through one interface, over the facets that wi sees."""
    planar, upright = safe_sqrt(wi[0] * wi[0] + wi[1] * wi[1]).reshape(1), wi[2].reshape(1)
    flat: Vector = (-planar[:, None], jnp.zeros((1, 1), planar.dtype), upright[:, None])
    alpha = width(top.kappa)
    polar = polar_angles(upright, planar, alpha, "vmf", top.ior, "refracted", nodes)
    at = parallels(upright, planar, polar, alpha, "vmf", top.ior, "refracted")
    m, cosine, weight = visible_normals(upright, planar, at, alpha, "vmf", nodes)
    wo, exists = refract(flat, m, top.ior)
    passes = exists & is_above(flip(wo))
    share = (1.0 - fresnel.dielectric(cosine, top.ior)) * smith_masking(sanitise(flip(wo)), top.kappa, options.masking)
    lit = masking_over_cosine(wi, top.kappa, options.masking) / masking_over_cosine(
        wi, top.kappa, "normal"
    )  # as the weights have it
    return lit * jnp.sum(jnp.where(passes, weight * share, 0.0))


def _is_interface(coat: Coat) -> bool:
    """Whether one interface is all that is there."""
    return coat.top is not None and coat.base is None


def _refract_out(top: UpperSide, inner: Vector) -> tuple[Vector, Array]:
    """Where light inside goes outside a level facet (both upward), and whether it does."""
    x, y = top.ior * inner[0], top.ior * inner[1]
    squared = 1.0 - x * x - y * y
    leaves = squared > 0
    return (x, y, jnp.sqrt(jnp.where(leaves, squared, 0.25))), leaves
