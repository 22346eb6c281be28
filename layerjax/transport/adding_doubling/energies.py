"""Directional albedo of stacks with interfaces: what the first face does in closed form, the rest from the nodes.

The energy that a face reflects or loses to masking changes within a cosine of the order of alpha, which polynomials
between nodes do not follow: they would carry the error over to all other directions. Both are integrated over the
facets instead. The nodes give what becomes of the light that continues, and of the light that masking takes, as shares
of these, which vary slowly; shares add up to 1 where nothing is lost, and so does the albedo, however coarse the nodes.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._numerics import clamp_max, clamp_min, clamp_nonnegative, horizon
from layerjax.channels import Channels, map_channels, multiply, select, total
from layerjax.directions import Vector, flip, sanitise
from layerjax.normals.widths import Widths
from layerjax.stack import Interface, Stack
from layerjax.surfaces.thin_film import films_of
from layerjax.transport.adding_doubling.anisotropic import refracted_energy
from layerjax.transport.adding_doubling.facet_scattering import Normals, refracted_rays
from layerjax.transport.adding_doubling.operators import Layer, Operator, Parts
from layerjax.transport.adding_doubling.requested_directions import requested_region
from layerjax.transport.first_order import FirstOrder, ReflectingInterface, SmoothOrder
from layerjax.transport.single_scattering import Media, SingleScattering
from layerjax.transport.specular import Window

LEAST_SHARED = 5e-5
"""Energy below which shares of it are those of light from all directions."""


class OuterFace(NamedTuple):
    """What the layer that light meets first reflects and transmits; entering: of a smooth one (or of none, where a
    smooth interface lies behind media), the share that passes."""

    reflect: Parts
    transmit: Parts
    entering: Operator = None


def outer_faces(stack: Stack, layers: list[Layer]) -> tuple[OuterFace | None, OuterFace | None]:
    """The layer that light from above meets first, and from below, where they are interfaces."""
    first, last = layers[0], layers[-1]
    above = _outer_face(stack.layers, first.reflect_top, first.transmit_down, first.direct_down)
    if stack.base is not None:
        return above, None
    return above, _outer_face(stack.layers[::-1], last.reflect_bottom, last.transmit_up, last.direct_up)


def _outer_face(layers: Sequence[Any], reflect: Parts, transmit: Parts, direct: Operator) -> OuterFace | None:
    """Layers in the order in which light meets them, and what the first does."""
    first = next((layer for layer in layers if isinstance(layer, Interface)), None)
    if first is not None and first.is_smooth:
        assert direct is not None
        return OuterFace(Parts(None), Parts(None), direct if first is layers[0] else jnp.ones_like(direct))
    return OuterFace(reflect, transmit) if first is not None and first is layers[0] else None


def node_shares(whole: OuterFace, face: OuterFace | None, weight: Array) -> Array:
    """For light along every node, (3, channels or 1, directions): of what masking takes at the first face, what does
    not enter after all; of what enters, what leaves on the same side and on the other.

    Where the first layer is a medium all enters that no single event sends back.
    """

    def energy(flux: Operator) -> Array:
        if flux is None:
            return jnp.zeros((1, weight.size), weight.dtype)
        leaving = jnp.sum(flux[:, 0], axis=-2)
        return jnp.repeat(leaving, weight.size // leaving.shape[-1], axis=-1)

    if face is not None and face.entering is not None:
        entered = jnp.repeat(face.entering[:, 0], weight.size // face.entering.shape[-1], axis=-1)
        near, far = energy(whole.reflect.total), energy(whole.transmit.total)
        rows = [jnp.zeros_like(near), _share(near, entered, weight), _share(far, entered, weight)]
        return _stack_rows(rows)
    once, again, far = energy(whole.reflect.first), energy(whole.reflect.rest), energy(whole.transmit.total)
    if face is None:
        rows = [jnp.zeros_like(once), _share(again, 1.0 - once, weight), _share(far, 1.0 - once, weight)]
    else:
        back, entered = energy(face.reflect.rest), energy(face.transmit.total)
        lost = 1.0 - once - energy(face.transmit.first)
        rows = [_share(1.0 - once - entered, lost, weight), _share(again - back, entered, weight)]
        rows.append(_share(far, entered, weight))
    return _stack_rows(rows)


def _stack_rows(rows: list[Array]) -> Array:
    return jnp.stack(jnp.broadcast_arrays(*rows))


def _share(part: Array, whole: Array, weight: Array) -> Array:
    """part / whole, where there is little of the whole the mean over directions."""
    mean = jnp.sum(part * weight, axis=-1, keepdims=True) / clamp_min(
        jnp.sum(whole * weight, axis=-1, keepdims=True), LEAST_SHARED**2 * jnp.sum(weight)
    )
    return (part * whole + LEAST_SHARED**2 * jnp.clip(mean, 0.0, 1.0)) / (whole * whole + LEAST_SHARED**2)


def directional_albedo(
    first: FirstOrder | SmoothOrder, shares: list[Channels], wi: Vector, nodes: int, multiple: bool
) -> tuple[Channels, Channels]:
    """Energy that leaves on wi's side and on the other; shares: the three of `node_shares` along wi."""
    single = SingleScattering()
    sides = [(first.upper, wi)] + ([] if first.lower is None else [(first.lower, flip(wi))])
    faces = [(media, w) for media, w in sides if isinstance(media, Media)]
    zero = jnp.zeros_like(wi[2])
    once = total([single.albedo(media, w, nodes)[0] for media, w in faces], zero)
    lost = total([_masking_loss(media, w, once, nodes) for media, w in faces], zero)
    near, far = clip_negative(*shares[1:])
    stays = map_channels(
        lambda once, lost, out: clamp_max(clamp_min(lost * out, 0.0), clamp_min(1.0 - once, 0.0)), once, lost, shares[0]
    )
    inside = map_channels(lambda once, stays: clamp_min(1.0 - once - stays, 0.0), once, stays)
    for window, w in sides:
        if isinstance(window, Window):
            # of the two sides, turned to above, one is lit
            inside = select(w[2] > 0, window.cross(w)[1], inside)
    parts = [once, multiply(inside, near)] + ([stays] if multiple else [])  # else masking absorbs it
    visible = jnp.abs(wi[2]) > horizon(wi[2].dtype)
    if first.lower is None:
        visible = visible & (wi[2] > 0)
    return select(visible, total(parts)), select(visible, multiply(inside, far))


def _masking_loss(media: Media, w: Vector, reflected: Channels, nodes: int) -> Channels:
    """Energy that masking takes at a face which is the first that light along w meets; else 0."""
    face = media.base
    if media.media or not isinstance(face, ReflectingInterface):
        return (jnp.zeros_like(w[2]),)
    above = w[2] > horizon(w[2].dtype)
    normals = Normals(face.alpha, face.distribution)

    def refracted(film: fresnel.Film | None) -> Array:
        if isinstance(face.alpha, Widths):
            return refracted_energy(sanitise(w, above), face.ior, normals, (nodes, 2 * nodes), film)
        region = requested_region(jnp.where(above, w[2], 0.5).ravel(), jnp.ones_like(face.ior))
        _, passed = refracted_rays(region, face.ior, normals, (nodes, max(2, nodes // 2)), film)
        return jnp.sum(passed, axis=-1).reshape(w[2].shape)

    films = films_of(face.film)
    return map_channels(
        lambda reflected, passed: jnp.where(above, clamp_min(1.0 - reflected - passed, 0.0), 0.0),
        reflected[: len(films)],
        tuple(map(refracted, films)),
    )


def clip_negative(near: Channels, far: Channels) -> tuple[Channels, Channels]:
    """Two energies, none below 0: what interpolation takes one below it is the other's, and their sum is kept."""

    def balanced(one: Array, other: Array) -> Array:
        return clamp_nonnegative(clamp_nonnegative(one) + (other - clamp_nonnegative(other)))

    return map_channels(balanced, near, far), map_channels(balanced, far, near)
