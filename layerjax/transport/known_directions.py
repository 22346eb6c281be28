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

from layerjax._numerics import clamp_max, horizon

MOST_COSINES = 256
"""Nothing is gained by knowing more distinct cosines than these on a side."""

MOST_PAIRS = 20_000
"""Larger batches are not looked at."""

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
