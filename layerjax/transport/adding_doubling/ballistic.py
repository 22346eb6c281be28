"""Light that passes a slab by two refractions, at its two interfaces, and meets nothing between: in closed form.

So is light that a mirror sends back through the rough interface that let it in: seen in the mirror, that is a slab, and
the two refractions are at the same interface. A smooth interface in the place of the mirror has a critical angle, which
the points of the facets do not resolve: what it sends back is left to the grid.

Both lobes may be narrower than the nodes are apart, which then miss where they overlap. The directions between
are integrated over along the facets that either side sees, and the two sums weighed against each other (Veach & Guibas
1995): the narrower lobe gives the points, the wider the values.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._batching import map_row_chunks
from layerjax._numerics import horizon, safe_sqrt, smooth_step
from layerjax.channels import Channels, count, map_channels, pick, total
from layerjax.directions import Vector, flip, sanitise, select
from layerjax.stack import Interface, Medium, Stack, optical_depths
from layerjax.surfaces import Surface
from layerjax.surfaces.interface import continued_transmission, is_index_matched
from layerjax.surfaces.thin_film import BARE, films_of
from layerjax.transport.adding_doubling.facet_scattering import Normals, facet_spacing, refracted_rays
from layerjax.transport.adding_doubling.operators import (
    Layer,
    Operator,
    Parts,
    add,
    add_operators,
    matmul,
    multiply,
    scale_columns,
    scale_rows,
)
from layerjax.transport.adding_doubling.requested_directions import requested_region, turn
from layerjax.transport.adding_doubling.resolution import has_tilted, mirrors_in_closed_form
from layerjax.transport.specular import Crossed, crossed_layers, is_smooth, ray_shares, region_indices

POINTS = (16, 12)
"""Points a panel, and in azimuth, of the facets of either side."""

EDGE = 7.5
"""Times the distance between rays: half the width over which the end of a lobe is rounded off, at facets that stand
upright. Else values would change by steps of up to 3e-4 as an index moves rays across it."""

BATCH_RAYS = 1 << 17
"""Rays that are followed together."""

TINY = 1e-18
"""1/sr: of two lobes that are less the weights do not matter; their squares are none in single precision."""


class Slab(eqx.Module):
    """Media between two interfaces."""

    media: tuple[Medium, ...]

    def passed(self, w: Vector) -> Channels:
        """Share of light along w, in the first region, that reaches the second interface."""
        depths = total([*optical_depths(self.media, w), (jnp.zeros_like(w[2]),)])
        return tuple(jnp.exp(-depth) for depth in depths)


class Mirror(eqx.Module):
    """Media behind an interface, and the mirror that sends light back to it: see `ray_shares`."""

    layers: tuple[Crossed, ...]
    outside: Array
    base: Surface | None

    def passed(self, w: Vector) -> Channels:
        """Share of light along -w that comes back to the interface."""
        return ray_shares(self.layers, self.outside, self.base, w)[0]


class Ballistic(eqx.Module):
    """The two interfaces, what is between them, and the media above and below.

    crosses: whether light leaves on the other side. Else the second interface is the first, as it is seen in the
    mirror, and what lies below is what lies above.
    """

    upper: Interface
    lower: Interface
    interior: Slab | Mirror
    outside: tuple[tuple[Medium, ...], tuple[Medium, ...]]
    crosses: bool = eqx.field(static=True)


class BTDFLobe(NamedTuple):
    """A BTDF, continued beyond the facets that stand upright, and ended there: only the first has smooth weights."""

    continued: Array
    ended: Array


def ballistic_paths(stack: Stack) -> tuple[Ballistic, ...]:
    """What light passes by two refractions alone."""
    found = []
    faces = _slab_faces(stack)
    if faces is not None:
        parts = (stack.layers[: faces[0]], stack.layers[faces[0] + 1 : faces[1]], stack.layers[faces[1] + 1 :])
        upper, lower = (stack.layers[k] for k in faces)
        assert isinstance(upper, Interface)
        assert isinstance(lower, Interface)
        above, between, below = map(_media, parts)
        found.append(Ballistic(upper, lower, Slab(between), (above, below), True))
    if mirrors_in_closed_form(stack):
        found.append(_mirrored_path(stack))
    return tuple(found)


def _media(layers: Sequence[Any]) -> tuple[Medium, ...]:
    return tuple(layer for layer in layers if isinstance(layer, Medium))


def _mirrored_path(stack: Stack) -> Ballistic:
    layers = crossed_layers(stack, region_indices(stack))
    place = next(k for k, (layer, _, _) in enumerate(layers) if isinstance(layer, Interface))
    upper, _, inside = layers[place]
    lower = eqx.tree_at(lambda face: face.ior, upper, jnp.ones_like(inside))
    media = _media(stack.layers[:place])
    return Ballistic(upper, lower, Mirror(tuple(layers[place + 1 :]), inside, stack.base), (media, media), False)


def _slab_faces(stack: Stack) -> tuple[int, int] | None:
    """The two interfaces of a slab, if both are rough and no other part is an interface or a base."""
    if has_tilted(stack):  # what they pass goes with the azimuth
        return None
    if any(map(is_smooth, stack.layers)):  # it is bent on its way
        return None
    faces = [place for place, layer in enumerate(stack.layers) if isinstance(layer, Interface)]
    return (faces[0], faces[1]) if stack.base is None and len(faces) == 2 else None


def subtract_ballistic(stack: Stack, layers: Sequence[Layer], whole: Layer) -> Layer:
    """The whole stack without the light that passes by two refractions alone, as its layers have it."""
    down = [(layer.transmit_down.first, layer.direct_down) for layer in layers]
    up = [(layer.transmit_up.first, layer.direct_up) for layer in layers]
    faces = _slab_faces(stack)
    if faces is not None:
        mirrored = [len(layers) - 1 - place for place in faces]
        once = _double_refraction(down, faces), _double_refraction(up[::-1], mirrored)
        whole = _subtract(whole, lambda layer: (layer.transmit_down.rest, layer.transmit_up.rest), once)
    places = [place for place, layer in enumerate(stack.layers) if isinstance(layer, Interface)]
    is_mirror = stack.base is not None and layers[-1].mirror_top is not None  # the base itself may be a stand-in
    if is_mirror and len(places) == 1 and not is_smooth(stack.layers[places[0]]) and not has_tilted(stack):
        stop = places[0] + 1
        back = _double_passage(down[:stop], up[:stop], _mirrors(layers[stop:]).mirror_top)
        whole = _subtract(whole, lambda layer: (layer.reflect_top.rest,), (back,))
    return whole


def _subtract(whole: Layer, parts: Callable[[Layer], tuple[Operator, ...]], less: Sequence[Array]) -> Layer:
    return eqx.tree_at(
        parts, whole, tuple(add_operators(part, -once) for part, once in zip(parts(whole), less, strict=True))
    )


def _mirrors(layers: Sequence[Layer]) -> Layer:
    """What mirrors and media alone do, layer on layer."""
    alone = [
        Layer(
            Parts(None),
            direct_down=layer.direct_down,
            direct_up=layer.direct_up,
            mirror_top=layer.mirror_top,
            mirror_bottom=layer.mirror_bottom,
        )
        for layer in layers
    ]
    return reduce(lambda below, above: add(above, below), reversed(alone))


def _double_passage(
    inward: Sequence[tuple[Operator, Operator]], outward: Sequence[tuple[Operator, Operator]], mirror: Operator
) -> Array:
    """Flux that passes the last of these layers, comes back from the mirror behind it, and passes it again.

    inward, outward: what each layer passes with one event, and what untouched, in the order in which light comes in.
    """
    (into, _), (out, _) = inward[-1], outward[-1]
    before: Operator = jnp.ones(1)
    after: Operator = jnp.ones(1)
    for (_, direct), (_, back) in zip(inward[:-1], outward[:-1], strict=True):
        before, after = multiply(before, direct), multiply(after, back)
    passed = scale_rows(after, matmul(out, scale_rows(mirror, scale_columns(into, before))))
    assert passed is not None
    return passed


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
    """BSDF of that light, 0 for pairs on other sides than those where it comes in and leaves."""
    shape = jnp.broadcast_shapes(wi[2].shape, wo[2].shape)
    downward = wi[2] > 0
    over, under = (select(downward, wi, wo), flip(select(downward, wo, wi))) if state.crosses else (wi, wo)
    if 0 in shape:
        return (jnp.zeros(shape, over[2].dtype),)
    edge = horizon(over[2].dtype)
    valid = (over[2] > edge) & (under[2] > edge)
    cosines = (jnp.where(valid, over[2], 0.5), jnp.where(valid, under[2], 0.5))
    rows = [jnp.broadcast_to(row, shape).ravel() for row in (valid, *cosines, turn(over, flip(under)))]
    passed = partial(_transmitted_bsdf, state)

    def nothing(*pairs: Array) -> Channels:
        return tuple(jnp.zeros(found.shape, found.dtype) for found in jax.eval_shape(passed, *pairs))

    def some(rows: list[Array]) -> Channels:  # pairs on other sides, which often lie together, are omitted
        crossing, *pairs = rows
        return jax.lax.cond(jnp.any(crossing), passed, nothing, *pairs)

    rays = rows[0].size * 8 * POINTS[0] * POINTS[1]
    found = map_row_chunks(some, rows, rays // BATCH_RAYS)
    outside = total(
        [*optical_depths(state.outside[0], over), *optical_depths(state.outside[1], flip(under)), (0.0 * over[2],)]
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
    zero = jnp.zeros_like(cosine_i)
    channels = max(count(*films), len(state.interior.passed((zero, zero, zero + 1.0))))
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
        """g_i, g_o / n_below^2 and what comes across, of travel along (x, y, -z) between the interfaces."""
        middle: Vector = (-x, -y, z)
        g_i = _lobe((x, y, z), over, ratios[0], faces[0], edges[1], of_inner[0])
        g_o = _lobe(middle, under, ratios[1], faces[1], edges[0], of_inner[1])
        return g_i, BTDFLobe(*(part / below**2 for part in g_o)), state.interior.passed(middle)

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
