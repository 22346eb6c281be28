"""What the energy of SpongeCake's second lobe has to be (beyond Wang et al. 2022).

How much light several collisions leave is known of media that absorb nothing: 1 less what passes untouched and what one
collision scatters. The same media without absorption therefore tell by how much the second lobe is off. The factor c of
`layerjax.transport.spongecake.energy_correction` is found by scaling again and again (Sinkhorn) at a few
directions, each against all directions of the other end.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_min
from layerjax.directions import Vector
from layerjax.phase import SGGX
from layerjax.quadrature import gauss_legendre
from layerjax.stack import Medium, optical_depths
from layerjax.transport.single_scattering import Media, SingleScattering
from layerjax.transport.spongecake.energy_correction import polynomial, term_count
from layerjax.transport.spongecake.lobes import flux, has_axes, second_lobe
from layerjax.transport.spongecake.mapping import LEAST_ALPHA


class Rule(NamedTuple):
    """How finely energies are balanced.

    nodes: of the quadrature over the other end. cosines, azimuths: directions at which energies are balanced, on each
    side; one azimuth where nothing depends on it. rounds: each halves the logarithm of what is off, as far as the
    polynomial can follow.
    """

    nodes: int
    cosines: int
    azimuths: int
    rounds: int


BATCH = 8
"""Directions at a time."""

LEAST = 1e-3
"""Energies much smaller are not put right."""

STIFFNESS = 1e-4
"""Ridge, relative to the mean of the others, for coefficients that the directions do not determine."""


class Balance(NamedTuple):
    """log c of media without absorption at directions wi, and the energy that several collisions leave, (n,) each."""

    wi: Vector
    energy: Array
    log: Array


def balance(media: tuple[Medium, ...], networks: Mapping[int, eqx.nn.MLP], rule: Rule) -> Balance:
    """Find log c of one medium or two, whatever they absorb."""
    white = tuple(_white(medium) for medium in media)
    first, second = Media(white, None), second_lobe(white, networks)
    anisotropic, opposite = has_axes(white), len(white) == 1
    dtype = second.weights.levels.dtype
    wi, weight = _directions(rule, _azimuth(white) if anisotropic else None, opposite, dtype)

    def one(wi: Vector) -> tuple[Array, list[tuple[Array, Array]]]:
        near, far = SingleScattering().albedo(first, wi, rule.nodes)
        depths = [depth for (depth,) in optical_depths(white, wi)]
        wanted = 1.0 - near[0] - far[0] - jnp.exp(-sum(depths[1:], depths[0]))
        there = [
            (_terms(wo, anisotropic, opposite), value) for wo, (value,) in flux(second, wi, rule.nodes, opaque=False)
        ]
        return clamp_min(wanted, 0.0), there

    wanted, there = jax.lax.map(one, wi, batch_size=BATCH)
    here = _terms(wi, anisotropic, opposite)
    sure = (weight * wanted)[:, None] * here
    normal = sure.T @ here
    stiffness = STIFFNESS * (jnp.trace(normal) / normal.shape[0] + LEAST)
    solution = jnp.linalg.inv(normal + stiffness * jnp.eye(normal.shape[0], dtype=dtype)) @ sure.T

    def step(coefficients: Array, _: None) -> tuple[Array, None]:
        found = sum(jnp.sum(value * jnp.exp(terms @ coefficients), axis=-1) for terms, value in there)
        found = found * jnp.exp(here @ coefficients)
        apart = jnp.tanh(jnp.log((wanted + LEAST) / (found + LEAST)))
        return coefficients + 0.5 * solution @ apart, None

    coefficients, _ = jax.lax.scan(step, jnp.zeros(here.shape[-1], dtype), length=rule.rounds)
    return Balance(wi, wanted, here @ coefficients)


def _white(medium: Medium) -> Medium:
    """The medium without absorption, and with lobes no narrower than any that the networks know."""
    phase, flakes = medium.phase, medium.phase.flakes
    if flakes is not None:
        phase = SGGX(flakes.kind, clamp_min(jnp.asarray(flakes.alpha), LEAST_ALPHA), flakes.axis)
    white = Medium(medium.thickness, 1.0, phase)
    return eqx.tree_at(lambda m: m.albedo, white, 1.0)  # known: nothing to multiply by


def _azimuth(media: tuple[Medium, ...]) -> Array:
    """Azimuth of the axes, modulo half a turn: what turns with them gives the same wherever they point."""
    across, along = jnp.zeros(()), jnp.zeros(())
    for k, medium in enumerate(media):
        flakes = medium.phase.flakes
        if flakes is not None and flakes.axis is not None:
            x, y, _ = flakes.axis
            share = 0.5**k  # so that two at right angles do not cancel
            across, along = across + share * 2.0 * x * y, along + share * (x * x - y * y)
    return 0.5 * jnp.arctan2(across, along)


def _directions(rule: Rule, azimuth: Array | None, opposite: bool, dtype: Any) -> tuple[Vector, Array]:
    """Where energies are balanced, above and (unless the same there) below, with weights of their cosine."""
    x, w = gauss_legendre(rule.cosines)
    count = 1 if azimuth is None else rule.azimuths
    sides = [1.0] if opposite else [1.0, -1.0]
    turns = (np.arange(count) + 0.5) * (2.0 * np.pi / count)
    side, z, turn = (array.ravel() for array in np.meshgrid(sides, x, turns, indexing="ij"))
    phi = turn + (0.0 if azimuth is None else azimuth)
    sine = np.sqrt(1.0 - z * z)
    wi = [jnp.asarray(part, dtype) for part in (sine * jnp.cos(phi), sine * jnp.sin(phi), side * z)]
    return (wi[0], wi[1], wi[2]), jnp.asarray(np.tile(np.repeat(w * x, count), len(sides)), dtype)


def _terms(w: Vector, anisotropic: bool, opposite: bool) -> Array:
    """What log c is a sum of, (..., terms); where sides differ, for above and below, 0 on the side where w is not."""
    each = jnp.eye(term_count(anisotropic), dtype=w[2].dtype)
    terms = jax.vmap(lambda coefficients: polynomial(coefficients, w, opposite), out_axes=-1)(each)
    if opposite:
        return terms
    above = (w[2] > 0)[..., None]
    return jnp.concatenate([jnp.where(above, terms, 0.0), jnp.where(above, 0.0, terms)], axis=-1)
