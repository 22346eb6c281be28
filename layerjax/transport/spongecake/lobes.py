"""The second lobe of `layerjax.transport.spongecake.transport`: single scattering with other parameters, and a level.

Single scattering of flakes depends on wi and wo by their half vector, which turns ever faster as wo comes to lie
opposite wi: the lobe of fibers has a dark seam there, and that of surface flakes nothing at all. Light that has met
several flakes knows no half vector, and continues that way: the paper's failure case (its Fig. 22). So the density of
flakes is blurred by b, with s = wi + wo in place of h,

    D_b = 1 / (pi sqrt(det S) q^2),    q = (s' S^-1 s + b) / (s' s + b),

which is D at b = 0, reciprocal, and turns into a forward lobe.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import safe_sqrt
from layerjax.channels import Channels, count, mean, per_channel, pick
from layerjax.directions import Vector, add, dot, half_vector, normalize, split
from layerjax.normals.sggx import radii, squared_lengths
from layerjax.phase import SGGX, HenyeyGreenstein, PhaseFunction
from layerjax.quadrature import gauss_legendre
from layerjax.stack import Medium
from layerjax.transport.contract import Side
from layerjax.transport.single_scattering import Media, is_valid_pair, layer_lobes
from layerjax.transport.spongecake.energy_correction import (
    EnergyCorrection,
    coefficients_of,
    correction_factors,
    correction_share,
)
from layerjax.transport.spongecake.mapping import Numbers, Weights, shape_of, weights_of

ABOVE, BELOW, THROUGH = range(3)


class BlurredSGGX(SGGX):
    """Flakes with a blurred density, see the top of the file."""

    blur: Array = eqx.field(default=0.0)

    def kernel(self, wi: Vector, wo: Vector, h: Vector | None) -> Array:
        total = add(wi, wo)
        radial, axial = radii(self.kind, self.alpha)
        across, along = squared_lengths(total, self._axis())
        stretched = across / (radial * radial) + along / (axial * axial)
        ratio = (dot(total, total) + self.blur) / (stretched + self.blur)
        return 0.25 / (jnp.pi * radial * radial * axial) * ratio * ratio  # D_b/4: Eq. (4), Eq. (7) with b

    def sharp(self, wi: Vector, wo: Vector) -> Array:
        """The kernel without the blur, which is what is drawn from."""
        return SGGX.kernel(self, wi, wo, None)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        return self.sharp(wi, wo) / self.cross_section(wi)  # Eq. (4)


class SecondLobe(eqx.Module):
    """What several collisions leave. slab: media with other parameters and no albedo of their own.

    weights: for each channel, see `layerjax.transport.spongecake.mapping.Weights`, stacked (C, ...).
    energy_correction: a factor c of either direction, see `layerjax.transport.spongecake.energy_correction`; None: 1.
    """

    slab: Media
    weights: Weights
    energy_correction: EnergyCorrection | None = None


def second_lobe(
    media: tuple[Medium, ...],
    networks: Mapping[int, eqx.nn.MLP],
    correction_networks: Mapping[int, eqx.nn.MLP] | None = None,
) -> SecondLobe:
    """The second lobe of one medium or two, by networks for so many; without `correction_networks` its energy
    is left as it is."""
    dtype = jnp.result_type(*jax.tree.leaves(media))
    net = _cast(networks[len(media)], dtype)
    channels = max(count(*(per_channel(jnp.asarray(value)) for value in _optics(medium))) for medium in media)
    numbers = [_numbers(media, c, dtype) for c in range(channels)]
    albedo = mean([number.albedo for number in numbers])
    f0 = mean([number.f0 for number in numbers])
    coloured = any(jnp.ndim(medium.thickness) for medium in media)  # else one thickness serves all channels
    # the parameters that Fig. 5 and Fig. 6 put out (Sec. 5), but f0; kind and axis stay
    shapes = [shape_of(net, number._replace(albedo=albedo, f0=f0)) for number in (numbers if coloured else numbers[:1])]
    alpha, blur = mean([shape.alpha for shape in shapes]), mean([shape.blur for shape in shapes])
    slab = []
    for k, medium in enumerate(media):
        taus = [shape.thickness[k] for shape in shapes]
        # of a medium of one thickness the mean: as exact as one for each channel, and costs less
        thickness = jnp.stack(taus) if jnp.ndim(medium.thickness) else mean(taus)
        flakes = medium.phase.flakes
        phase: PhaseFunction = HenyeyGreenstein(alpha[k])
        if flakes is not None:
            phase = BlurredSGGX(flakes.kind, alpha[k], flakes.axis, blur[k])
        plain = Medium(thickness, 1.0, phase)
        slab.append(eqx.tree_at(lambda m: m.albedo, plain, 1.0))  # known: nothing to multiply by
    weights = [weights_of(net, number, albedo, f0) for number in numbers]
    correction = None
    if correction_networks is not None:
        anisotropic, network = has_axes(media), _cast(correction_networks[len(media)], dtype)
        found = [coefficients_of(network, number, anisotropic) for number in (numbers if coloured else numbers[:1])]
        correction = EnergyCorrection(jnp.stack(found), correction_share(media).astype(dtype))
    return SecondLobe(Media(tuple(slab), None), jax.tree.map(lambda *each: jnp.stack(each), *weights), correction)


def has_learned(phase: PhaseFunction) -> bool:
    """Whether media of this phase function are among those that the networks know."""
    return phase.flakes is not None or phase.forward_lobe is not None


def has_axes(media: tuple[Medium, ...]) -> bool:
    """Whether anything may depend on the azimuth."""
    flakes = [medium.phase.flakes for medium in media]
    return any(each is not None and each.axis is not None for each in flakes)


def _cast(net: eqx.nn.MLP, dtype: Any) -> eqx.nn.MLP:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype) if eqx.is_inexact_array(leaf) else leaf, net)


def evaluate_second(second: SecondLobe, wi: Vector, wo: Vector, side: Side, opaque: bool) -> Channels:
    """BSDF of what several collisions leave. opaque: there is a base, and light from above alone is is_valid_pair."""
    terms = [_level(second, wi, wo, side, opaque), *_lobes(second, wi, wo, side, opaque).values()]
    values = tuple(sum((term[c] for term in terms[1:]), terms[0][c]) for c in range(len(terms[0])))
    if second.energy_correction is None:
        return values
    factors = correction_factors(second.energy_correction, wi, wo, opaque or side == "reflection")
    return tuple(value * pick(factors, c) for c, value in enumerate(values))


def _lobes(second: SecondLobe, wi: Vector, wo: Vector, side: Side, opaque: bool) -> dict[int, Channels]:
    """What each medium adds, by its index, for all channels."""
    _, cosine = half_vector(wi, wo)
    edge = (1.0 - cosine) ** 2
    edge = edge * edge * (1.0 - cosine)  # Schlick's term
    rises = [rise**2 for rise in _slope_variables(wi, wo)]
    rises = [rise * rise for rise in rises]
    rims = [_slope_factor(second.weights.rims[c], rises, wi, wo, side, opaque) for c in range(_channels(second))]
    found = {}
    for k, lobe in layer_lobes(second.slab, wi, wo, "reflection" if opaque else side).items():
        values = []
        for c, rim in enumerate(rims):
            plain, more = (_side_weight(second.weights.lobes[c, :, k, n], wi, wo, side, opaque) for n in (0, 1))
            values.append((plain + more * edge) * rim * pick(lobe, c))  # W_1 of Sec. 5 times Eqs. (11) and (16)
        found[k] = tuple(values)
    return found


def _level(second: SecondLobe, wi: Vector, wo: Vector, side: Side, opaque: bool) -> Channels:
    """The Lambertian term, for all channels."""
    valid = is_valid_pair(wi, wo, side, opaque)
    rises = _slope_variables(wi, wo)
    values = []
    for c in range(_channels(second)):
        level = _side_weight(second.weights.levels[c], wi, wo, side, opaque)
        slope = _slope_factor(second.weights.slopes[c], rises, wi, wo, side, opaque)
        values.append(jnp.where(valid, level * slope, 0.0))  # W_2 of Sec. 5
    return tuple(values)


def _slope_variables(wi: Vector, wo: Vector) -> tuple[Array, Array]:
    """1 - |cos| of both directions; if they are on different sides, of the upper one first."""
    into, out = (1.0 - jnp.abs(w[2]) for w in (wi, wo))
    above = wi[2] > 0
    return jnp.where(above, into, out), jnp.where(above, out, into)


def _slope_factor(slopes: Array, rises: Sequence[Array], wi: Vector, wo: Vector, side: Side, opaque: bool) -> Array:
    """(1 + slope rise) of both directions, with the slopes that hold for their sides, (2, 2) as in `Weights`."""
    high, low = slopes[1]
    if opaque or side == "reflection":
        high = low = slopes[0, 0]
    elif side == "all":
        same, both = wi[2] * wo[2] > 0, jnp.where(wi[2] > 0, slopes[0, 0], slopes[0, 1])
        high, low = jnp.where(same, both, high), jnp.where(same, both, low)
    return (1.0 + high * rises[0]) * (1.0 + low * rises[1])


def second_albedo(second: SecondLobe, wi: Vector, nodes: int, opaque: bool) -> tuple[Channels, Channels]:
    """Energy of `evaluate_second` on wi's side and on the other, by quadrature with `nodes` points a dimension."""
    spread: Vector = (wi[0][..., None], wi[1][..., None], wi[2][..., None])
    near, far = [], []
    for wo, values in flux(second, wi, nodes, opaque):
        if second.energy_correction is not None:
            factors = correction_factors(second.energy_correction, spread, wo, opaque)
            values = tuple(value * pick(factors, c) for c, value in enumerate(values))
        same = spread[2] * wo[2] > 0
        near.append(tuple(jnp.sum(jnp.where(same, value, 0.0), -1) for value in values))
        far.append(tuple(jnp.sum(jnp.where(same, 0.0, value), -1) for value in values))
    sums = [
        tuple(sum((part[c] for part in parts[1:]), parts[0][c]) for c in range(len(near[0]))) for parts in (near, far)
    ]
    return sums[0], sums[1]


def flux(second: SecondLobe, wi: Vector, nodes: int, opaque: bool) -> list[tuple[Vector, Channels]]:
    """What leaves on wi's side and on the other (not if `opaque`), with c = 1: nodes wo, and the energy at each.

    Where the unblurred kernel of flakes peaks, nodes follow it; the rest is taken over the hemispheres evenly.
    """
    side = jnp.where(wi[2] < 0, -1.0, 1.0)[..., None]
    spread: Vector = (wi[0][..., None], wi[1][..., None], wi[2][..., None])
    signs = [1.0] if opaque else [1.0, -1.0]
    nodes_z, weights_z = gauss_legendre(nodes)
    phi = (np.arange(2 * nodes) + 0.5) * np.pi / nodes
    turn, cosine, sign = (jnp.asarray(a.ravel(), wi[2].dtype) for a in np.meshgrid(phi, nodes_z, signs, indexing="ij"))
    weight = jnp.asarray(np.tile(np.repeat(weights_z * nodes_z * np.pi / nodes, len(signs)), 2 * nodes), wi[2].dtype)
    sine = safe_sqrt(1.0 - cosine * cosine)
    wo: Vector = (sine * jnp.cos(turn), sine * jnp.sin(turn), sign * side * cosine)
    terms, parts = [_level(second, spread, wo, "all", opaque)], []
    for k, lobe in _lobes(second, spread, wo, "all", opaque).items():
        phase = second.slab.media[k].phase
        rule = phase.rule(wi, nodes)[: len(signs)]
        x, y, z = (jnp.concatenate(axis, axis=-1) for axis in zip(*(w for w, _ in rule), strict=True))
        peaked: Vector = (x, y, z)
        solid_angle = jnp.concatenate([solid_angle for _, solid_angle in rule], axis=-1)
        share = jnp.ones_like(solid_angle)  # a Henyey-Greenstein lobe is followed whole
        if isinstance(phase, BlurredSGGX):
            share, rest = _peak_share(phase, spread, peaked), 1.0 - _peak_share(phase, spread, wo)
            terms.append(tuple(rest * value for value in lobe))
        there = _lobes(second, spread, peaked, "all", opaque)[k]
        parts.append((peaked, tuple(v * share * jnp.abs(peaked[2]) * solid_angle for v in there)))
    even = [sum((term[c] for term in terms[1:]), terms[0][c]) for c in range(_channels(second))]
    return [*parts, (wo, tuple(value * weight for value in even))]


def _peak_share(phase: BlurredSGGX, wi: Vector, wo: Vector) -> Array:
    """Share of the kernel that nodes which follow its peak account for."""
    sharp = phase.sharp(wi, wo)
    return sharp / (sharp + 1.0 / jnp.pi)


class Hemisphere(eqx.Module):
    """Directions in proportion to their cosine, on wi's side or on the other."""

    through: bool = eqx.field(static=True)

    def sample(self, wi: Vector, u1: Array, u2: Array) -> Vector:
        side = jnp.where((wi[2] < 0) != self.through, -1.0, 1.0)
        radius, phi = safe_sqrt(u1), 2.0 * jnp.pi * u2
        return radius * jnp.cos(phi), radius * jnp.sin(phi), side * safe_sqrt(1.0 - u1)

    def pdf(self, wi: Vector, wo: Vector) -> Array:
        there = (wi[2] * wo[2] < 0) if self.through else (wi[2] * wo[2] > 0)
        return jnp.where(there, jnp.abs(wo[2]) / jnp.pi, 0.0)


def _channels(second: SecondLobe) -> int:
    return second.weights.levels.shape[0]


def _side_weight(weights: Array, wi: Vector, wo: Vector, side: Side, opaque: bool) -> Array:
    """The weight that holds for the pair."""
    if opaque or side == "reflection":
        return weights[ABOVE]
    if side == "transmission":
        return weights[THROUGH]
    same = wi[2] * wo[2] > 0
    return jnp.where(same, jnp.where(wi[2] > 0, weights[ABOVE], weights[BELOW]), weights[THROUGH])


def _optics(medium: Medium) -> tuple:
    return medium.thickness, medium.albedo, 1.0 if medium.f0 is None else medium.f0


def _numbers(media: tuple[Medium, ...], c: int, dtype: Any) -> Numbers:
    """The numbers of one channel."""
    rows = []
    for medium in media:
        thickness, albedo, f0 = (pick(per_channel(jnp.asarray(value, dtype)), c) for value in _optics(medium))
        flakes = medium.phase.flakes
        one, zero = jnp.ones_like(thickness), jnp.zeros_like(thickness)
        axis = jnp.stack([zero, zero, one])
        if flakes is None:
            rows.append((jnp.stack([zero, zero, one]), one, medium.phase.forward_lobe, thickness, albedo, f0, axis))
            continue
        kind = jnp.stack([one, zero, zero] if flakes.kind == "surface" else [zero, one, zero])
        if flakes.axis is not None:
            axis = jnp.stack(normalize(split(flakes.axis)))
        rows.append((kind, flakes.alpha, zero, thickness, albedo, f0, axis))
    return Numbers(*(jnp.stack([jnp.asarray(row[n], dtype) for row in rows]) for n in range(len(Numbers._fields))))
