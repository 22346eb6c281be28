"""Directions to draw for any stack: the lobes of paths with one event, and cosine lobes for all that is smooth."""

import jax.numpy as jnp
from jax import Array

from layerjax.directions import Vector, flip, sanitise, select
from layerjax.surfaces.interface import interface_pdf, interface_reflection, interface_sample, interface_transmission
from layerjax.surfaces.lambertian import sample_cosine
from layerjax.transport.first_order import FirstOrder, ReflectingInterface
from layerjax.transport.single_scattering import SingleScattering

BELOW_ONE = 1.0 - 1e-6


def propose(state: FirstOrder, wi: Vector, uniforms: tuple[Array, Array, Array]) -> Vector:
    """Outgoing directions from three uniform numbers each."""
    u, u1, u2 = uniforms
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
    single = SingleScattering()
    lobe = single.sample(state.upper, wi, inner)
    if state.lower is not None:
        lobe = select(above, lobe, flip(single.sample(state.lower, flip(wi), inner)))
        lobe = _tangent_unless(lobe[2] * wi[2] > 0, lobe)  # what a face sends below its horizon is masked
    return select(u < lobes, lobe, wo)


def proposal_density(state: FirstOrder, wi: Vector, wo: Vector) -> Array:
    """Density of `propose` in solid angle, 1/sr."""
    lobes, facets, near, far = _shares(state)
    above = wi[2] > 0
    same = wi[2] * wo[2] > 0
    single = SingleScattering()
    lobe = single.pdf(state.upper, wi, wo)
    if state.lower is not None:
        lobe = jnp.where(above, lobe, single.pdf(state.lower, flip(wi), flip(wo)))
        lobe = jnp.where(same, lobe, 0.0)
    density = lobes * lobe + jnp.where(same, near, far) * jnp.abs(wo[2]) / jnp.pi
    if state.crossing is not None:
        up, out = select(above, wi, flip(wi)), select(above, wo, flip(wo))
        face = state.crossing
        facets_of = (_ratio(face, above), face.alpha, face.distribution)
        up, out = sanitise(up, up[2] > 0), (out[0], out[1], jnp.where(out[2] == 0, 0.5, out[2]))
        reflected = interface_reflection(up, sanitise(out, out[2] > 0), *facets_of)
        passed = interface_transmission(up, flip(sanitise(flip(out), out[2] < 0)), *facets_of)
        density = density + facets * interface_pdf(jnp.where(same, reflected, passed), up, out, *facets_of)
    return density


def _shares(state: FirstOrder) -> tuple[float, float, float, float]:
    """Probabilities of lobes of media and faces, of a single interface, and of two cosine lobes, wi's side first."""
    if state.opaque:
        return 0.6, 0.0, 0.4, 0.0
    return (0.5, 0.0, 0.25, 0.25) if state.crossing is None else (0.3, 0.4, 0.15, 0.15)


def _tangent_unless(leaves: Array, w: Vector) -> Vector:
    """w, or a direction in the tangent plane, where nothing is scattered to."""
    return (w[0], w[1], jnp.where(leaves, w[2], 0.0))


def _ratio(face: ReflectingInterface, above: Array) -> Array:
    return jnp.where(above, face.ior, 1.0 / face.ior)
