"""Light that meets smooth interfaces and mirrors alone, and media without a collision: the delta part of a BSDF.

Such light keeps n sin(theta) and its azimuth, whatever it crosses, so that two numbers a ray are all there is: what is
reflected along the mirror direction, and what is transmitted along the refracted one.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from layerjax import channels, fresnel
from layerjax._numerics import clamp_min, horizon, safe_div
from layerjax.channels import Channels, map_channels, multiply
from layerjax.directions import Vector, bend, flip, mirror, sanitise, select
from layerjax.stack import Interface, Medium, Stack, optical_depths
from layerjax.surfaces import Conductor, Surface, ThinFilm
from layerjax.surfaces.thin_film import films_of

BELOW_ONE = 1.0 - 1e-6

LEAST_LOSS = 1e-18
"""The least share of light between two faces that is lost in a turn: total reflection on both sides stays finite."""


class Face(eqx.Module):
    """A smooth interface as light meets it: the indices before and behind, and the film on it."""

    before: Array
    after: Array
    film: ThinFilm | None

    @property
    def ratio(self) -> Array:
        """Index behind over index before."""
        return self.after / self.before

    def reflectance(self, cosine: Array, refracted: Array, transmits: Array) -> Channels:
        """Reflectance by the cosine of incidence, that of refraction, and whether there is such light."""
        films = films_of(self.film, self.before)
        return tuple(fresnel.dielectric_towards(cosine, self.ratio, refracted, transmits, film) for film in films)


class Window(eqx.Module):
    """What a ray crosses on its way to a region, from the outside in: media, each in the index around it, and smooth
    interfaces."""

    parts: tuple[Medium | Face, ...]

    def cross(self, w: Vector) -> tuple[Vector, Channels]:
        """The direction behind, and the share of energy that passes, in or out, of light along w outside.

        Where there is no such light the direction is along the tangent plane or a stand-in, and the share is 0.
        """
        valid = jnp.abs(w[2]) > horizon(w[2].dtype)
        here = sanitise(w, valid)
        passed: Channels = (jnp.where(valid, 1.0, 0.0),)
        for part in self.parts:
            if isinstance(part, Medium):
                (depth,) = optical_depths([part], here)
                passed = multiply(passed, tuple(jnp.exp(-one) for one in depth))
                continue
            there, exists = bend(here, part.ratio)
            reflected = part.reflectance(jnp.abs(here[2]), jnp.abs(there[2]), exists)
            passed = multiply(passed, tuple(1.0 - level for level in reflected))
            here = (there[0], there[1], jnp.where(exists, there[2], jnp.where(w[2] < 0, -0.5, 0.5)))
        return here, passed


def is_smooth(part: Any) -> bool:
    """Whether a layer or a base is a smooth interface or a mirror."""
    return isinstance(part, Interface | Conductor) and part.is_smooth


def has_specular(stack: Stack) -> bool:
    """Whether the first surface that light meets from above, or from below, is smooth, in a simplified stack."""
    surfaces = [part for part in (*stack.layers, stack.base) if isinstance(part, Interface | Surface)]
    if not surfaces:
        return False
    return is_smooth(surfaces[0]) or (stack.base is None and is_smooth(surfaces[-1]))


def specular_shares(stack: Stack, w: Vector) -> tuple[Channels, Channels]:
    """Energies of the delta parts along the mirror and the refracted direction, of light along w from either side.

    Of a stack without surfaces, media alone, the second is the share that passes unscattered.
    """
    valid = jnp.abs(w[2]) > horizon(w[2].dtype)
    inside = sanitise(w, valid)
    indices = region_indices(stack)
    shares = ray_shares(crossed_layers(stack, indices), indices[0], stack.base, inside)
    if stack.base is not None:
        lit = valid & (w[2] > 0)
    else:
        lit = valid
        upward = ray_shares(crossed_layers(stack, indices)[::-1], indices[-1], None, inside, turned=True)
        above = w[2] > 0
        shares = channels.select(above, shares[0], upward[0]), channels.select(above, shares[1], upward[1])
    return channels.select(lit, shares[0]), channels.select(lit, shares[1])


def transmitted_direction(stack: Stack, w: Vector) -> Vector:
    """Where light along w, from either side, leaves on the other one by refraction alone; along the tangent plane where
    there is no such direction."""
    below = region_indices(stack)[-1]
    x, y, z = bend(w, jnp.where(w[2] > 0, below, 1.0 / below))[0]
    return -x, -y, -z


def specular_probabilities(stack: Stack, w: Vector) -> tuple[Array, Array]:
    """The probabilities with which the deltas are drawn: their energies, mean of the channels. All other light has at
    most the rest."""
    mirrored, passed = map(channels.mean, specular_shares(stack, w))
    return mirrored, passed


def sample_with_deltas(
    stack: Stack, w: Vector, uniforms: tuple[Array, Array, Array], others: Callable[..., Vector]
) -> Vector:
    """The mirror or the refracted direction of light along w by those probabilities, at the end of the first unit
    interval; else what `others` draws from three uniform numbers."""
    if not has_specular(stack):
        return others(uniforms)
    u, u1, u2 = uniforms
    mirrored, passed = specular_probabilities(stack, w)
    rest = 1.0 - mirrored - passed
    wo = others((jnp.clip(safe_div(u, rest), 0.0, BELOW_ONE), u1, u2))
    wo = select(u >= rest, mirror(w), wo)
    return select(u >= 1.0 - passed, transmitted_direction(stack, w), wo)


def density_with_deltas(stack: Stack, w: Vector, density: Array) -> Array:
    """Density of `sample_with_deltas` off the deltas, from that of the others."""
    if not has_specular(stack):
        return density
    mirrored, passed = specular_probabilities(stack, w)
    return density * (1.0 - mirrored - passed)


def specular_draws(stack: Stack, w: Vector, u: Array) -> tuple[Array, Array, Channels] | None:
    """Which draws of `sample_with_deltas` are deltas, the probability of such a draw, and the energy of the delta."""
    if not has_specular(stack):
        return None
    mirrored, passed = specular_probabilities(stack, w)
    passes = u >= 1.0 - passed
    energies = map_channels(lambda one, other: jnp.where(passes, other, one), *specular_shares(stack, w))
    return u >= 1.0 - mirrored - passed, jnp.where(passes, passed, mirrored), energies


def region_indices(stack: Stack) -> list[Array]:
    """Refractive index of every region, from top to bottom, relative to the surroundings."""
    dtype = jnp.result_type(*(leaf for leaf in jax.tree.leaves(stack) if eqx.is_array(leaf)), jnp.float32)
    faces = [jnp.asarray(layer.ior) for layer in stack.layers if isinstance(layer, Interface)]
    return [jnp.ones((), dtype), *faces]


Crossed = tuple[Any, Array, Array]
"""A layer, and the indices above and below it."""


def crossed_layers(stack: Stack, indices: Sequence[Array]) -> list[Crossed]:
    """The layers of a stack from top to bottom, with the indices of the regions around them."""
    faces = pairwise(indices)
    below = indices[0]
    crossed: list[Crossed] = []
    for layer in stack.layers:
        above = below
        if isinstance(layer, Interface):
            above, below = next(faces)
        crossed.append((layer, above, below))
    return crossed


def ray_shares(
    crossed: Sequence[Crossed], outside: Array, base: Any, w: Vector, *, turned: bool = False
) -> tuple[Channels, Channels]:
    """Shares of light along w, or along -w, that are mirrored and that pass, all turns counted; 0 at rough surfaces.

    Args:
        crossed: the layers in the order in which the light meets them.
        outside: index of the region that w is in.
        base: what lies behind the last layer; None: another region.
        turned: whether the layers are met from below.
    """
    zero: Channels = (jnp.zeros_like(w[2]),)
    one: Channels = (jnp.ones_like(w[2]),)
    last = outside if not crossed else crossed[-1][1 if turned else 2]
    reflected, passed = zero, zero if base is not None else one
    if is_smooth(base):
        direction, exists = bend(w, last / outside)
        reflected = base.relative_to(last).reflectance(jnp.where(exists, jnp.abs(direction[2]), 0.5))
    for layer, above, below in reversed(crossed):
        near, far = (below, above) if turned else (above, below)
        here, there = ((w, w[2] == w[2]) if index is outside else bend(w, index / outside) for index in (near, far))
        if isinstance(layer, Medium):
            inward = sanitise(here[0], here[1])
            (depth,), (back,) = optical_depths([layer], inward), optical_depths([layer], flip(inward))
            share, returned = (tuple(jnp.exp(-one) for one in part) for part in (depth, back))
            reflected, passed = multiply(share, returned, reflected), multiply(share, passed)
        elif layer.is_smooth:
            cosine = jnp.where(here[1], jnp.abs(here[0][2]), 0.5)
            levels = Face(near, far, layer.film).reflectance(cosine, jnp.abs(there[0][2]), there[1])
            reflected, passed = _behind_face(levels, reflected, passed)
        else:
            reflected, passed = zero, zero
    return reflected, passed


def _behind_face(levels: Channels, reflected: Channels, passed: Channels) -> tuple[Channels, Channels]:
    """A smooth face of this reflectance on what reflects and passes these shares: all turns between the two."""
    turns = map_channels(
        lambda level, part: (1.0 - level) / clamp_min(1.0 - level * part, LEAST_LOSS), levels, reflected
    )
    whole = map_channels(lambda level, part, turns: level + (1.0 - level) * turns * part, levels, reflected, turns)
    return whole, multiply(turns, passed)


class Turns(eqx.Module):
    """All the times that light which entered through a smooth interface is mirrored between that and what lies behind.

    layers: what mirrors light back, without a base; turned: see `ray_shares`.
    """

    face: Face
    layers: tuple[Crossed, ...]
    turned: bool = eqx.field(static=True)

    def count(self, w: Vector) -> Channels:
        """How often on average light along w, outside, sets off from the interface; 1 where there is no such light."""
        w = sanitise(w, jnp.abs(w[2]) > horizon(w[2].dtype))
        there, exists = bend(w, self.face.ratio)
        levels = self.face.reflectance(jnp.abs(w[2]), jnp.abs(there[2]), exists)
        reflected, _ = ray_shares(self.layers, self.face.before, None, w, turned=self.turned)
        return map_channels(
            lambda level, part: 1.0 / clamp_min(1.0 - jnp.where(exists, level, 0.0) * part, LEAST_LOSS),
            levels,
            reflected,
        )


def smooth_turns(stack: Stack, *, upward: bool) -> Turns | None:
    """The turns behind the `smooth_window`."""
    if smooth_window(stack, upward=upward) is None:
        return None
    (layer, *indices), *behind = crossed_layers(stack, region_indices(stack))[:: -1 if upward else 1]
    before, after = indices[::-1] if upward else indices
    return Turns(Face(before, after, layer.film), tuple(behind), upward)


def windows(stack: Stack) -> list[tuple[int, int, Window | None, Window | None]]:
    """The runs of layers between smooth interfaces, as (first layer, one past the last), and through what each is seen
    from above and from below; None: it is not, because a rough surface lies between."""
    places = [k for k, layer in enumerate(stack.layers) if is_smooth(layer)]
    bounds = list(zip([0, *(k + 1 for k in places)], [*places, len(stack.layers)], strict=True))
    crossed = crossed_layers(stack, region_indices(stack))
    from_above = [_window(crossed[:start], turned=False) for start, _ in bounds]
    closed = stack.base is not None
    from_below = [None if closed else _window(crossed[stop:][::-1], turned=True) for _, stop in bounds]
    return [
        (start, stop, above, below)
        for (start, stop), above, below in zip(bounds, from_above, from_below, strict=True)
        if above is not None or below is not None
    ]


def _window(crossed: Sequence[Crossed], *, turned: bool) -> Window | None:
    parts: list[Medium | Face] = []
    for layer, above, below in crossed:
        if isinstance(layer, Medium):
            parts.append(layer)
        elif layer.is_smooth:
            before, after = (below, above) if turned else (above, below)
            parts.append(Face(before, after, layer.film))
        else:
            return None
    return Window(tuple(parts))


def smooth_window(stack: Stack, *, upward: bool) -> Window | None:
    """What light from above (or below) crosses if the first layer that it meets is a smooth interface; else None."""
    if not stack.layers or (upward and stack.base is not None):
        return None
    crossed = crossed_layers(stack, region_indices(stack))
    first = crossed[-1] if upward else crossed[0]
    return _window([first], turned=upward) if is_smooth(first[0]) else None
