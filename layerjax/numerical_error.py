"""The error of a finite resolution, estimated from a coarser and a finer one.

The difference of two resolutions changes its sign from direction to direction, and where it does it says nothing. So
neighbouring pairs of directions are looked at as well, and none counts as more exact, relative to its value, than they
are. Values that are cut off at 0 agree at any resolution: what was cut off counts (`Transport.common_error`).
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._devices import compile_for_devices
from layerjax._numerics import safe_div
from layerjax.directions import angles, direction
from layerjax.preparation import Prepared
from layerjax.transport import Side

POLAR, AZIMUTH = np.radians(3.0), np.radians(12.0)
"""How far away neighbours are, polar angles and the azimuth between the two directions."""

STEPS = ((0.0, 0.0, 0.0), (POLAR, 0.0, 0.0), (-POLAR, 0.0, 0.0), (0.0, POLAR, AZIMUTH), (0.0, -POLAR, -AZIMUTH))
"""The pair itself and its neighbours: steps of theta_i, theta_o and phi_o."""


def neighbours(wi: Array, wo: Array) -> tuple[Array, Array]:
    """Pairs (5, ...) around each: the pair itself comes first; all stay on their sides of the tangent plane."""
    wi, wo = jnp.broadcast_arrays(wi, wo)
    (theta_i, phi_i), (theta_o, phi_o) = angles(wi), angles(wo)
    found = [(wi, wo)]
    for step_i, step_o, turn in STEPS[1:]:
        found.append((direction(_shift(theta_i, step_i), phi_i), direction(_shift(theta_o, step_o), phi_o + turn)))
    first, second = zip(*found, strict=True)
    return jnp.stack(first).astype(wi.dtype), jnp.stack(second).astype(wi.dtype)


def _shift(theta: Array, step: float) -> Array:
    """A polar angle moved towards or away from its pole, back from the tangent plane where it would cross it."""
    below = theta > 0.5 * jnp.pi
    polar = jnp.where(below, jnp.pi - theta, theta)
    edge = 0.5 * jnp.pi - 0.5 * POLAR
    moved = jnp.abs(polar + jnp.where(polar + step > edge, -abs(step), step))
    return jnp.where(below, jnp.pi - moved, moved)


@compile_for_devices
def numerical_error(
    prepared: Prepared, others: Sequence[Prepared], wi: Array, wo: Array, side: Side
) -> tuple[Array, Array]:
    """Values (..., C) and their errors, of pairs (k, ..., 3) with their k - 1 neighbours, from other resolutions."""
    found, *compared = (_values(one, wi, wo, side) for one in (prepared, *others))
    errors = jnp.zeros_like(found[0][0])
    for values, doubt in compared:
        change = jnp.abs(found[0] - values) + found[1] + doubt
        # a neighbour on a peak tells of this pair by its share alone
        share = jnp.max(jnp.minimum(safe_div(change, found[0] + values), 1.0), axis=0)
        errors = jnp.maximum(errors, jnp.maximum(change[0], share * (found[0][0] + values[0])))
    return found[0][0], errors


def _values(prepared: Prepared, wi: Array, wo: Array, side: Side) -> tuple[Array, Array | float]:
    """Values, and the error of them in which resolutions may agree."""
    arguments = prepared.state, wi, wo, side, prepared.channels
    return prepared.transport.evaluate_batch(*arguments, None)[0], prepared.transport.common_error(*arguments)
