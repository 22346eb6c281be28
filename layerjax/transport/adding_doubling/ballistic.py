"""Light that passes a slab by two refractions, at its two interfaces, and meets nothing between: in closed form.

Both lobes may be narrower than the nodes are apart, which then miss where they overlap. The directions between
are integrated over along the facets that either side sees, and the two sums weighed against each other (Veach & Guibas
1995): the narrower lobe gives the points, the wider the values.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._batching import map_row_chunks
from layerjax._numerics import horizon, safe_sqrt, smooth_step
from layerjax.channels import Channels, count, map_channels, per_channel, pick, total
from layerjax.directions import Vector, flip, sanitise, select
from layerjax.stack import Interface, Medium, Stack, optical_depths
from layerjax.surfaces.interface import continued_transmission, is_index_matched
from layerjax.surfaces.thin_film import BARE, films_of
from layerjax.transport.adding_doubling.facet_scattering import Normals, facet_spacing, refracted_rays
from layerjax.transport.adding_doubling.operators import (
    Layer,
    Operator,
    add_operators,
    matmul,
    multiply,
    scale_columns,
    scale_rows,
)
from layerjax.transport.adding_doubling.requested_directions import requested_region, turn
from layerjax.transport.adding_doubling.resolution import has_tilted
from layerjax.transport.specular import is_smooth

POINTS = (16, 12)
"""Points a panel, and in azimuth, of the facets of either side."""

EDGE = 7.5
"""Times the distance between rays: half the width over which the end of a lobe is rounded off, at facets that stand
upright. Else values would change by steps of up to 3e-4 as an index moves rays across it."""

BATCH_RAYS = 1 << 17
"""Rays that are followed together."""

TINY = 1e-18
"""1/sr: of two lobes that are less the weights do not matter; their squares are none in single precision."""


class Ballistic(eqx.Module):
    """The two interfaces, and the media above, between and below them."""

    upper: Interface
    lower: Interface
    media: tuple[tuple[Medium, ...], tuple[Medium, ...], tuple[Medium, ...]]


class BTDFLobe(NamedTuple):
    """A BTDF, continued beyond the facets that stand upright, and ended there: only the first has smooth weights."""

    continued: Array
    ended: Array


def ballistic_paths(stack: Stack) -> Ballistic | None:
    """What light passes by two refractions alone; None, if none does."""
    faces = _faces(stack)
    if faces is None:
        return None
    parts = (stack.layers[: faces[0]], stack.layers[faces[0] + 1 : faces[1]], stack.layers[faces[1] + 1 :])
    upper, lower = (stack.layers[k] for k in faces)
    assert isinstance(upper, Interface)
    assert isinstance(lower, Interface)
    above, between, below = (tuple(layer for layer in part if isinstance(layer, Medium)) for part in parts)
    return Ballistic(upper, lower, (above, between, below))


def _faces(stack: Stack) -> tuple[int, int] | None:
    if has_tilted(stack):  # what they pass goes with the azimuth
        return None
    if any(map(is_smooth, stack.layers)):  # it is bent on its way
        return None
    faces = [place for place, layer in enumerate(stack.layers) if isinstance(layer, Interface)]
    return (faces[0], faces[1]) if stack.base is None and len(faces) == 2 else None


def subtract_ballistic(stack: Stack, layers: Sequence[Layer], whole: Layer) -> Layer:
    """The whole stack without the light that passes by two refractions alone, as its layers have it."""
    faces = _faces(stack)
    if faces is None:
        return whole
    down = _double_refraction([(layer.transmit_down.first, layer.direct_down) for layer in layers], faces)
    upward = [(layer.transmit_up.first, layer.direct_up) for layer in reversed(layers)]
    up = _double_refraction(upward, [len(layers) - 1 - place for place in faces])

    def rest(layer: Layer) -> tuple[Operator, Operator]:
        return layer.transmit_down.rest, layer.transmit_up.rest

    return eqx.tree_at(
        rest, whole, tuple(add_operators(part, -once) for part, once in zip(rest(whole), (down, up), strict=True))
    )


def _double_refraction(layers: Sequence[tuple[Operator, Operator]], faces: Sequence[int]) -> Array:
    """Flux that meets the two faces alone, of layers in the order in which light comes through them.

    layers: what each passes with one event, and what untouched.
    """
    before: Operator = jnp.ones(1)
    passed: Operator = None
    for place, (through, direct) in enumerate(layers):
        if place in faces:
            passed = scale_columns(through, before) if passed is None else matmul(through, passed)
        elif passed is None:
            before = multiply(before, direct)
        else:
            passed = scale_rows(direct, passed)
    assert passed is not None
    return passed


def evaluate_ballistic(state: Ballistic, wi: Vector, wo: Vector) -> Channels:
    """BSDF of that light; wi and wo on either side, 0 for pairs on one side."""
    shape = jnp.broadcast_shapes(wi[2].shape, wo[2].shape)
    downward = wi[2] > 0
    over, under = select(downward, wi, wo), flip(select(downward, wo, wi))
    if 0 in shape:
        return (jnp.zeros(shape, over[2].dtype),)
    edge = horizon(over[2].dtype)
    valid = (over[2] > edge) & (under[2] > edge)
    cosines = (jnp.where(valid, over[2], 0.5), jnp.where(valid, under[2], 0.5))
    rows = [jnp.broadcast_to(row, shape).ravel() for row in (valid, *cosines, turn(over, flip(under)))]
    passed = partial(_transmitted_bsdf, state)

    def nothing(*pairs: Array) -> Channels:
        return tuple(jnp.zeros(found.shape, found.dtype) for found in jax.eval_shape(passed, *pairs))

    def some(rows: list[Array]) -> Channels:  # pairs on one side, which often lie together, are omitted
        crossing, *pairs = rows
        return jax.lax.cond(jnp.any(crossing), passed, nothing, *pairs)

    rays = rows[0].size * 8 * POINTS[0] * POINTS[1]
    found = map_row_chunks(some, rows, rays // BATCH_RAYS)
    outside = total(
        [*optical_depths(state.media[0], over), *optical_depths(state.media[2], flip(under)), (0.0 * over[2],)]
    )
    level = jnp.where(downward, 1.0, 1.0 / state.lower.ior**2)  # f / ior_o^2 is reciprocal

    def value(passed: Array, depth: Array) -> Array:
        return jnp.where(valid, passed.reshape(shape) * level * jnp.exp(-depth), 0.0)

    return map_channels(value, found, outside)


def _transmitted_bsdf(state: Ballistic, cosine_i: Array, cosine_o: Array, azimuth: Array) -> Channels:
    """BSDF of pairs, see `_film_transmitted`; once for each channel that films distinguish."""
    films = [films_of(face.film) for face in (state.upper, state.lower)]
    if films == [BARE, BARE]:
        return _film_transmitted(state, (None, None), cosine_i, cosine_o, azimuth)
    channels = max(count(*films), *(count(per_channel(medium.thickness)) for medium in state.media[1]), 1)
    found = []
    for c in range(channels):
        values = _film_transmitted(state, (pick(films[0], c), pick(films[1], c)), cosine_i, cosine_o, azimuth)
        found.append(pick(values, c))
    return tuple(found)


def _film_transmitted(
    state: Ballistic,
    films: tuple[fresnel.Film | None, fresnel.Film | None],
    cosine_i: Array,
    cosine_o: Array,
    azimuth: Array,
) -> Channels:
    """f from above to below for light along (-sin, 0, cos) that leaves turned by an azimuth: arrays (pairs,) each.

    With m between, g_i and g_o the BTDFs from m out along either direction, f = n^2 * integral of g_i g_o cos(m). Rays
    from above have the density n^2 g_i cos(m) of m, those from below n^2 g_o cos(m) / n_below^2.
    """
    inner, below = state.upper.ior, state.lower.ior
    faces = [Normals(face.width, face.distribution) for face in (state.upper, state.lower)]
    sine_i, sine_o = (safe_sqrt((1.0 - c) * (1.0 + c)) for c in (cosine_i, cosine_o))
    cos_phi, sin_phi = jnp.cos(azimuth)[:, None], jnp.sin(azimuth)[:, None]
    over: Vector = (-sine_i[:, None], jnp.zeros_like(cos_phi), -cosine_i[:, None])
    under: Vector = (sine_o[:, None] * cos_phi, sine_o[:, None] * sin_phi, -cosine_o[:, None])

    ratios = 1.0 / inner, below / inner
    of_inner = [None if film is None else film.seen_from(inner) for film in films]
    edges = [
        EDGE * facet_spacing(POINTS[0], facets) * jnp.abs(1.0 - n) for n, facets in zip(ratios, faces, strict=True)
    ]

    def parts(x: Array, y: Array, z: Array) -> tuple[BTDFLobe, BTDFLobe, Channels]:
        """g_i, g_o / n_below^2 and what media pass, of travel along (x, y, -z) between the interfaces."""
        middle: Vector = (-x, -y, z)
        g_i = _lobe((x, y, z), over, ratios[0], faces[0], edges[1], of_inner[0])
        g_o = _lobe(middle, under, ratios[1], faces[1], edges[0], of_inner[1])
        depths = total([*optical_depths(state.media[1], middle), (jnp.zeros_like(z),)])
        return g_i, BTDFLobe(*(part / below**2 for part in g_o)), tuple(jnp.exp(-depth) for depth in depths)

    # a BTDF at equal indices is a delta: then the rays of that side are the whole
    delta_i, delta_o = is_index_matched(inner), is_index_matched(inner / below)
    (x, y, z), share = _rays(cosine_i, inner, faces[0], films[0])
    g_i, g_o, passed = parts(x, y, z)
    counted = jnp.where(delta_i, 1.0, jnp.where(delta_o, 0.0, _weight(g_i, g_o)))
    from_above = [jnp.sum(share * below**2 * g_o.ended * counted * level, axis=-1) for level in passed]
    from_outside = None if films[1] is None else films[1].seen_from(below)
    (x, y, z), share = _rays(cosine_o, inner / below, faces[1], from_outside)
    # followed backwards, from where it leaves
    g_i, g_o, passed = parts(x * cos_phi - y * sin_phi, x * sin_phi + y * cos_phi, z)
    counted = jnp.where(delta_i, 0.0, jnp.where(delta_o, 1.0, _weight(g_o, g_i)))
    from_below = [jnp.sum(share * below**2 * g_i.ended * counted * level, axis=-1) for level in passed]
    return total([from_above, from_below])


def _lobe(wi: Vector, wo: Vector, ratio: Array, facets: Normals, edge: Array, film: fresnel.Film | None) -> BTDFLobe:
    (value,), height = continued_transmission(wi, wo, ratio, *facets, (film,))
    return BTDFLobe(value, value * smooth_step(height / (edge + TINY)))


def _weight(one: BTDFLobe, other: BTDFLobe) -> Array:
    return one.continued / (one.continued + other.continued + TINY)


def _rays(cosine: Array, ratio: Array, normals: Normals, film: fresnel.Film | None) -> tuple[Vector, Array]:
    """Where facets refract light along (-sin, 0, cos) to, z counted on the far side, and its shares."""
    rays, share = refracted_rays(requested_region(cosine, jnp.ones_like(ratio)), ratio, normals, POINTS, film)
    x, y, z = sanitise(rays, rays[2] > 0)  # of rays back up, whose share is 0, masking has no meaning

    def both(part: Array, mirrored: Array) -> Array:  # shares stand for mirror images too
        return jnp.concatenate([part, mirrored], axis=-1)

    return (both(x, x), both(y, -y), both(z, z)), 0.5 * both(share, share)
