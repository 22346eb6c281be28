"""Requested directions as directions of the grid: light along them is followed exactly, nothing is read off.

Where a stack begins (and, if light passes it, ends) with an interface, all that such directions need is what the
interface lets in from each: columns of its operators, of nodes that carry no weight in any sum. What lies behind does
not know of them.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import horizon, safe_sqrt
from layerjax.channels import Channels
from layerjax.directions import Vector
from layerjax.transport.adding_doubling.grid import Region
from layerjax.transport.adding_doubling.operators import Layer, Operator
from layerjax.transport.contract import Side
from layerjax.transport.known_directions import KnownDirections


class RequestedValues(eqx.Module):
    """f of the paths with more than one event between known directions.

    values: (out, in, channels, modes), over the cosines above, and if light passes those below. wi_index, wo_index: see
    `KnownDirections`.
    """

    values: Array
    wi_index: Array
    wo_index: Array
    opaque: bool = eqx.field(static=True)


def requested_region(cosine: Array, ior: Array) -> Region:
    """The directions as nodes without weight."""
    zero = jnp.zeros_like(cosine)
    return Region(ior, cosine, safe_sqrt((1.0 - cosine) * (1.0 + cosine)), zero, zero, zero == 0)


def requested_values(whole: Layer, known: KnownDirections, bottom: Array, opaque: bool) -> RequestedValues:
    """Values from the operators of a stack solved at the known directions; bottom: index below the stack."""
    above, below = known.above.size, 0 if opaque else known.below.size
    rows = [(whole.reflect_top.rest, whole.transmit_up.rest), (whole.transmit_down.rest, whole.reflect_bottom.rest)]
    present = [block for row in rows for block in row if block is not None]
    channels = max(block.shape[0] for block in present)

    def whole_block(block: Operator, out: int, into: int) -> Array:
        shape = (channels, present[0].shape[1], out, into)
        return jnp.zeros(shape, present[0].dtype) if block is None else jnp.broadcast_to(block, shape)

    full = jnp.concatenate([whole_block(rows[0][0], above, above), whole_block(rows[0][1], above, below)], axis=-1)
    if below:
        lower = [whole_block(block, below, size) for block, size in zip(rows[1], (above, below), strict=True)]
        full = jnp.concatenate([full, bottom**2 * jnp.concatenate(lower, axis=-1)], axis=-2)
    values = jnp.transpose(full, (2, 3, 0, 1)) / (2.0 * jnp.pi)
    return RequestedValues(values, known.wi_index, known.wo_index, opaque)


def read_requested(solved: RequestedValues, wi: Vector, wo: Vector, side: Side) -> Channels:
    """BSDF of the paths with more than one event, which ringing may take below 0."""
    edge, (z_i, z_o) = horizon(wi[2].dtype), (wi[2], wo[2])
    if solved.opaque or side == "reflection":
        valid = (z_i > edge) & (z_o > edge)
    else:
        valid = (jnp.abs(z_i) > edge) & (jnp.abs(z_o) > edge)
        if side == "transmission":
            valid = valid & (z_i * z_o < 0)
    last = solved.values.shape[0] - 1
    out, into = jnp.minimum(solved.wo_index, last), jnp.minimum(solved.wi_index, last)
    modes = np.arange(solved.values.shape[-1])
    series = solved.values[out, into]
    waves = jnp.where(modes == 0, 1.0, 2.0) * jnp.cos(turn(wi, wo)[..., None] * modes)
    total = jnp.sum(series * waves[..., None, :], axis=-1)
    return tuple(jnp.where(valid, total[..., c], 0.0) for c in range(total.shape[-1]))


def turn(wi: Vector, wo: Vector) -> Array:
    """Azimuth between the directions of travel."""
    sine, cosine = wi[1] * wo[0] - wi[0] * wo[1], -(wi[0] * wo[0] + wi[1] * wo[1])
    return azimuth(cosine, sine)


def azimuth(x: Array, y: Array) -> Array:
    """Azimuth of a vector; along the normal 0, without a derivative."""
    at_pole = (y == 0) & (x == 0)
    return jnp.arctan2(jnp.where(at_pole, 0.0, y), jnp.where(at_pole, 1.0, x))
