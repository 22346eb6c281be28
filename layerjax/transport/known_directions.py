"""What is known of the directions of a batch before anything is compiled: which cosines occur, and where.

Measurements come along few directions, of which many share a cosine. A transport that knows them can follow light along
just these.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._batching import CHUNK_BYTES
from layerjax._numerics import clamp_max, horizon

MOST_COSINES = 256
"""Nothing is gained by knowing more distinct cosines than these on a side."""

MOST_PAIRS = 20_000
"""Larger batches are not looked at."""

MOST_PAIRS_AT_ONCE = 2 * CHUNK_BYTES // 8
"""Pairs that `map_direction_chunks` evaluates together in either precision, so that places among them hold."""

ROUNDED = 64
"""Cosines that differ by less, in units of the rounding of 1, count as one."""

STAND_IN = 0.5
"""For directions in the tangent plane, whose values are 0, and for a side without directions."""


class KnownDirections(eqx.Module):
    """The distinct cosines among the directions of a batch.

    above, below: |cosine|, (cosines,) each. wi_index, wo_index: for every direction the place of its cosine among
    those above and then those below; the shapes of wi and wo without the last axis. all_above: whether it is known that
    none lies below.
    """

    above: Array
    below: Array
    wi_index: Array
    wo_index: Array
    all_above: bool = eqx.field(static=True, default=False)


class KnownPairs(eqx.Module):
    """The distinct angles between light and half vector among the pairs of a batch.

    cosines: of these angles, (cosines,). index: for every pair the place of its own, in the shape of the batch.
    """

    cosines: Array
    index: Array


DirectionLookup = Callable[[], KnownDirections | None]
"""Looks at the directions of a batch when it is called: whom they are of no use need not pay for it."""


def known_directions(wi: Any, wo: Any) -> KnownDirections | None:
    """What is known of the directions wi and wo, (..., 3) each; None if they are traced, or too many."""
    if any(isinstance(w, jax.core.Tracer) for w in (wi, wo)):
        return None
    cosines = [np.asarray(w)[..., 2] for w in (wi, wo)]
    if not 0 < np.broadcast(*cosines).size <= MOST_PAIRS:
        return None
    z = np.concatenate([part.ravel() for part in cosines])
    size = np.where(np.abs(z) > horizon(z.dtype), np.minimum(np.abs(z), 1.0), STAND_IN).astype(z.dtype)
    places = np.zeros(z.shape, np.int32)
    sides: list[np.ndarray] = []
    for side in (z > 0, z <= 0):
        values, found = np.unique(size[side], return_inverse=True)
        places[side] = found + (sides[0].size if sides else 0)
        sides.append(values if values.size else np.asarray([STAND_IN], z.dtype))
    if max(values.size for values in sides) > MOST_COSINES:
        return None
    split = cosines[0].size
    wi_index, wo_index = places[:split].reshape(cosines[0].shape), places[split:].reshape(cosines[1].shape)
    above, below, i, o = map(jnp.asarray, (*sides, wi_index, wo_index))
    return KnownDirections(above, below, i, o, all_above=bool(np.all(z > 0)))


def known_pairs(wi: np.ndarray, wo: np.ndarray) -> KnownPairs | None:
    """What is known of pairs of directions (n, 3) each above the tangent plane; None where it does not pay.

    In scans in a plane with even steps many pairs have the same angle. Cosines that differ by rounding count as one.
    """
    if len(wi) > MOST_PAIRS_AT_ONCE or not len(wi) or min(wi[:, 2].min(), wo[:, 2].min()) <= 0.0:
        return None
    dtype = jnp.result_type(float)
    cosines = np.sqrt(np.maximum(0.5 + 0.5 * np.sum(wi * wo, axis=-1, dtype=np.float64), 0.0))
    _, first, index = np.unique(
        np.round(cosines / (ROUNDED * jnp.finfo(dtype).eps)), return_index=True, return_inverse=True
    )
    if 2 * first.size > len(wi):
        return None
    return KnownPairs(jnp.asarray(cosines[first], dtype), jnp.asarray(index.reshape(len(wi)), np.int32))


def known_above(*directions: Any) -> bool:
    """Whether it is known that none of these, (..., 3) each, lies below."""
    return all(not isinstance(w, jax.core.Tracer) and bool(np.all(np.asarray(w)[..., 2] > 0)) for w in directions)


def separate_cosines(wi: Array, wo: Array, all_above: bool) -> KnownDirections:
    """Directions (n, 3) each, known or traced, as if each had a cosine of its own: of few pairs that is as good."""
    z = jnp.concatenate([wi[:, 2], wo[:, 2]])
    size = jnp.where(jnp.abs(z) > horizon(z.dtype), clamp_max(jnp.abs(z), 1.0), STAND_IN)
    place = jnp.arange(z.size) + jnp.where(z > 0, 0, z.size)
    above, below = (jnp.where(side, size, STAND_IN) for side in (z > 0, z <= 0))
    return KnownDirections(above, below, place[: z.size // 2], place[z.size // 2 :], all_above)
