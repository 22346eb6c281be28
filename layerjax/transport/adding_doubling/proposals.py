"""Directions to draw for any stack.

Of a stack with a base or several interfaces: its lobes by directional statistics, those of the base and of what is
transmitted included, each by its energy, and cosine lobes for what the solution scatters besides. Of others: the lobes
of paths with one event, and cosine lobes for all that is smooth.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_max, clamp_min, horizon
from layerjax.channels import Channels, map_channels, mean
from layerjax.directions import Vector, bend, flip, mirror, sanitise, select
from layerjax.stack import Stack
from layerjax.surfaces.interface import interface_pdf, interface_reflection, interface_sample, interface_transmission
from layerjax.surfaces.lambertian import sample_cosine
from layerjax.transport.adding_doubling.tables import Tables, read_energies
from layerjax.transport.first_order import FirstOrder, ReflectingInterface, SmoothOrder
from layerjax.transport.lobes.microfacet import MicrofacetLobes, index_below, microfacet_lobes, reference_index
from layerjax.transport.lobes.sampling import draw_lobe, lobe_density
from layerjax.transport.lobes.statistics import Options, is_anisotropic
from layerjax.transport.single_scattering import SingleScattering
from layerjax.transport.specular import has_specular, is_smooth, specular_shares

BELOW_ONE = 1.0 - 1e-6

LEAST_DIFFUSE = 0.02
"""Share of the energy behind the first face that cosine lobes are given at least: lobes are approximate."""

LEAST_LOBE = 1e-4
"""Energy that every lobe is given at least."""

MEDIA_SHARE = 0.1
"""Probability of the lobes of single scattering, where media lie on the first interface."""


class LayeredState(NamedTuple):
    """What directions are drawn by of a stack with interfaces. multiple: whether faces return what masking takes."""

    stack: Stack
    first: FirstOrder | SmoothOrder
    tables: Tables
    multiple: bool


class _Mixture(NamedTuple):
    """Lobes for light from one side, their probabilities, and those of the cosine lobes on its side and the other, and
    of the deltas on either side; what energies the deltas have."""

    lobes: MicrofacetLobes
    shares: list[Array]
    near: Array
    far: Array
    mirrored: Array
    passed: Array
    specular: tuple[Channels, Channels]
    entry: Array
    exit: Array

    def first_delta(self) -> Array:
        """Where, in the unit interval that draws go by, the deltas begin."""
        return sum(self.shares, self.near) + self.far


def propose_layered(state: LayeredState, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
    """Outgoing directions from three uniform numbers each; along the tangent plane where none is."""
    u, u1, u2 = uniforms
    media = _media_share(state.first)
    above = wi[2] > 0
    lit = jnp.abs(wi[2]) > horizon(wi[2].dtype)
    inner = u if not media else jnp.clip((u - media) / (1.0 - media), 0.0, BELOW_ONE)
    wo = _draw(state, wi, (inner, u1, u2), upward=False)
    if state.first.opaque:
        lit = lit & above
    else:
        wo = select(above, wo, flip(_draw(state, flip(wi), (inner, u1, u2), upward=True)))
    if media and isinstance(state.first, FirstOrder):
        single = _single_sample(state.first, wi, (jnp.minimum(u / media, BELOW_ONE), u1, u2))
        wo = select(u < media, single, wo)
    return _tangent_unless(lit, wo)


def layered_density(state: LayeredState, wi: Vector, wo: Vector) -> Array:
    """Density of `propose_layered` in solid angle, 1/sr."""
    media = _media_share(state.first)
    above = wi[2] > 0
    lit = jnp.abs(wi[2]) > horizon(wi[2].dtype)
    density = _density(state, wi, wo, upward=False)
    if state.first.opaque:
        lit = lit & above
    else:
        density = jnp.where(above, density, _density(state, flip(wi), flip(wo), upward=True))
    if media and isinstance(state.first, FirstOrder):
        density = media * _single_density(state.first, wi, wo) + (1.0 - media) * density
    return jnp.where(lit, density, 0.0)


def layered_specular_draws(
    state: LayeredState, wi: Vector, uniforms: tuple[Array, Array, Array]
) -> tuple[Array, Array, Channels]:
    """Which draws of `propose_layered` are deltas, the probability of such a draw, and the energy of the delta."""
    lit = jnp.abs(wi[2]) > horizon(wi[2].dtype)
    found = _specular(state, wi, uniforms[0], upward=False)
    if state.first.opaque:
        lit = lit & (wi[2] > 0)
    else:
        below = _specular(state, flip(wi), uniforms[0], upward=True)
        above = wi[2] > 0
        energies = map_channels(lambda one, other: jnp.where(above, one, other), found[2], below[2])
        found = (jnp.where(above, found[0], below[0]), jnp.where(above, found[1], below[1]), energies)
    return lit & found[0], found[1], found[2]


def _specular(state: LayeredState, wi: Vector, u: Array, *, upward: bool) -> tuple[Array, Array, Channels]:
    wi = sanitise(wi, wi[2] > horizon(wi[2].dtype))
    parts = _mixture(state, wi, upward)
    start = parts.first_delta()
    passes = u >= start + parts.mirrored
    energies = map_channels(lambda one, other: jnp.where(passes, other, one), *parts.specular)
    return u >= start, jnp.where(passes, parts.passed, parts.mirrored), energies


def _draw(state: LayeredState, wi: Vector, uniforms: tuple[Array, Array, Array], *, upward: bool) -> Vector:
    """For light above, of the stack turned over if `upward`."""
    wi = sanitise(wi, wi[2] > horizon(wi[2].dtype))
    parts = _mixture(state, wi, upward)
    wo, left = draw_lobe(parts.lobes, parts.shares, wi, uniforms, parts.entry, parts.exit)
    x, y, z = sample_cosine(*uniforms[1:])
    beyond = uniforms[0] >= sum(parts.shares, parts.near)
    turned = select(beyond & (parts.far > 0), (x, y, -z), (x, y, z))
    wo = select(left, turned, wo)
    if not has_specular(state.stack):
        return wo
    start, u = parts.first_delta(), uniforms[0]
    x, y, z = bend(wi, 1.0 / index_below(state.stack) if upward else index_below(state.stack))[0]
    wo = select(u >= start, mirror(wi), wo)
    return select(u >= start + parts.mirrored, (-x, -y, -z), wo)


def _density(state: LayeredState, wi: Vector, wo: Vector, *, upward: bool) -> Array:
    wi = sanitise(wi, wi[2] > horizon(wi[2].dtype))
    parts = _mixture(state, wi, upward)
    density = lobe_density(parts.lobes, parts.shares, wi, wo, parts.entry, parts.exit)
    return density + jnp.where(wo[2] > 0, parts.near, parts.far) * jnp.abs(wo[2]) / jnp.pi


def _mixture(state: LayeredState, wi: Vector, upward: bool) -> _Mixture:
    """Energies of the lobes by statistics; of what is diffuse: what the solution has behind the face, less those."""
    stack = state.stack
    plane = wi[:2] if is_anisotropic(stack) else None
    lobes = microfacet_lobes(stack, Options(state.multiple, "orders", False, False), wi[2], upward, plane)
    zero = jnp.zeros_like(wi[2])
    outside = flip(wi) if upward else wi
    deltas = specular_shares(stack, outside) if has_specular(stack) else ((zero,), (zero,))
    entered = clamp_min(1.0 - lobes.shares()[0], 0.0)
    first_is_specular = lobes.reflected[0].specular
    lobes = lobes.without_deltas()
    energies = [clamp_min(energy, LEAST_LOBE) for energy in lobes.shares()]
    count = len(lobes.reflected)
    near, far = (mean(part) for part in read_energies(state.tables, outside)[-2:])

    def diffuse(share: Array, known: list[Array]) -> Array:
        energy = entered * clamp_max(clamp_min(share, 0.0), 1.0)
        return clamp_min(energy - sum(known, zero), LEAST_DIFFUSE * energy + LEAST_LOBE)

    near = diffuse(near, energies[0 if first_is_specular else 1 : count])
    far = zero if state.first.opaque else diffuse(far, energies[count:])
    mirrored, passed = map(mean, deltas)
    total = sum(energies, near + far) + mirrored + passed
    below, reference = index_below(stack), reference_index(stack)
    entry, exit = below / reference, 1.0 / reference
    if not upward:
        entry, exit = exit, entry
    near, far, mirrored, passed = (part / total for part in (near, far, mirrored, passed))
    return _Mixture(lobes, [energy / total for energy in energies], near, far, mirrored, passed, deltas, entry, exit)


def _media_share(first: FirstOrder | SmoothOrder) -> float:
    if isinstance(first, SmoothOrder) or is_smooth(first.upper.base):
        return 0.0
    lower = () if first.lower is None else first.lower.media
    return MEDIA_SHARE if first.upper.media or lower else 0.0


def _single_sample(first: FirstOrder, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
    """A direction of paths with one event, on the side of the light."""
    single = SingleScattering()
    lobe = single.sample(first.upper, wi, uniforms)
    if first.lower is None:
        return lobe
    lobe = select(wi[2] > 0, lobe, flip(single.sample(first.lower, flip(wi), uniforms)))
    return _tangent_unless(lobe[2] * wi[2] > 0, lobe)  # what a face sends below its horizon is masked


def _single_density(first: FirstOrder, wi: Vector, wo: Vector) -> Array:
    single = SingleScattering()
    lobe = single.pdf(first.upper, wi, wo)
    if first.lower is None:
        return lobe
    lobe = jnp.where(wi[2] > 0, lobe, single.pdf(first.lower, flip(wi), flip(wo)))
    return jnp.where(wi[2] * wo[2] > 0, lobe, 0.0)


def propose(state: FirstOrder | SmoothOrder, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
    """Outgoing directions from three uniform numbers each; where interfaces are smooth from cosine lobes alone."""
    u, u1, u2 = uniforms
    if isinstance(state, SmoothOrder):
        x, y, z = sample_cosine(u1, u2)
        return x, y, jnp.where((wi[2] > 0) ^ (u >= _near_share(state)), z, -z)
    lobes, facets, near, _ = _shares(state)
    above = wi[2] > 0
    up = select(above, wi, flip(wi))
    x, y, z = sample_cosine(u1, u2)
    wo = select(u < lobes + facets + near, (x, y, z), (x, y, -z))
    if state.crossing is not None:
        again = jnp.clip((u - lobes) / facets, 0.0, BELOW_ONE)
        face = state.crossing
        ior = _ratio(face, above)
        refracted, leaves = interface_sample(up, ior, face.alpha, u1, u2, again, face.distribution)
        wo = select(u < lobes + facets, _tangent_unless(leaves, refracted), wo)
    wo = select(above, wo, flip(wo))
    inner = (jnp.minimum(u / lobes, BELOW_ONE), u1, u2)
    return select(u < lobes, _single_sample(state, wi, inner), wo)


def proposal_density(state: FirstOrder | SmoothOrder, wi: Vector, wo: Vector) -> Array:
    """Density of `propose` in solid angle, 1/sr."""
    if isinstance(state, SmoothOrder):
        share = _near_share(state)
        return jnp.where(wi[2] * wo[2] > 0, share, 1.0 - share) * jnp.abs(wo[2]) / jnp.pi
    lobes, facets, near, far = _shares(state)
    above = wi[2] > 0
    same = wi[2] * wo[2] > 0
    density = lobes * _single_density(state, wi, wo) + jnp.where(same, near, far) * jnp.abs(wo[2]) / jnp.pi
    if state.crossing is not None:
        up, out = select(above, wi, flip(wi)), select(above, wo, flip(wo))
        face = state.crossing
        facets_of = (_ratio(face, above), face.alpha, face.distribution)
        up, out = sanitise(up, up[2] > 0), (out[0], out[1], jnp.where(out[2] == 0, 0.5, out[2]))
        reflected = interface_reflection(up, sanitise(out, out[2] > 0), *facets_of)
        passed = interface_transmission(up, flip(sanitise(flip(out), out[2] < 0)), *facets_of)
        density = density + facets * interface_pdf(jnp.where(same, reflected, passed), up, out, *facets_of)
    return density


def _near_share(state: SmoothOrder) -> float:
    """Probability of the cosine lobe on wi's side."""
    return 1.0 if state.opaque else 0.5


def _shares(state: FirstOrder) -> tuple[float, float, float, float]:
    """Probabilities of lobes of media and faces, of a single interface, and of two cosine lobes, wi's side first."""
    if state.opaque:
        return 0.6, 0.0, 0.4, 0.0
    if state.crossing is None:
        return 0.5, 0.0, 0.25, 0.25
    # an interface alone is drawn as it scatters; what it returns of the light lost to masking is smooth
    return (0.3, 0.4, 0.15, 0.15) if _media_share(state) else (0.02, 0.94, 0.02, 0.02)


def _tangent_unless(leaves: Array, w: Vector) -> Vector:
    """w, or a direction in the tangent plane, where nothing is scattered to."""
    return (w[0], w[1], jnp.where(leaves, w[2], 0.0))


def _ratio(face: ReflectingInterface, above: Array) -> Array:
    return jnp.where(above, face.ior, 1.0 / face.ior)
