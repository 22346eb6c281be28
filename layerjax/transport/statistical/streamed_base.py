"""Light that has reached a Lambertian base under several interfaces or haze: the closed form, at every texel.

The same closed form as `layerjax.transport.statistical.diffuse_base`, f = T(i) T(o) rho / (pi n^2 (1 - rho R)), which
has T and R from an exact solve; here they are those of few streams (`layerjax.transport.statistical.streams`).

Behind a narrow interface light is a beam, and polynomials of the cosine ring where an interface begins to reflect
totally. So the light that enters is followed along two cosines that have its moments, to the second interface and
between the two, as far as it stays a beam; what is scattered on the way, or reflected widely, is in the streams.

Two interfaces (indices 1.2 to 2 at random, alpha .01 to .6) beside the solve, T over its mean: rms 1e-3 to 6e-3,
largest 2e-2; with an optical depth of 1 between them 5e-3 to 1.5e-2, largest 7e-2. BSDFs of light from the base,
relative L2: below 1e-2, and below 5e-2 where the index falls by a third (from 1.9 to 1.3).
"""

import abc
from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_min, horizon
from layerjax.channels import Channels, map_channels, multiply, per_channel, select, total
from layerjax.directions import Vector, sanitise
from layerjax.stack import Interface, Medium, Stack, is_known
from layerjax.surfaces import Lambertian
from layerjax.transport.lobes.statistics import precision
from layerjax.transport.statistical import stream_layers, streams
from layerjax.transport.statistical.diffuse import closed_form, indirect_energy

BEAM, TURNED = 0.01, 0.001
"""Variances of the cosine of light at which it is half a beam: to the second interface, and once that has reflected it.
"""

NARROW = 0.1
"""Width of the second interface at which, in clear media, half is left to the streams, which do not ring where it is
wide; where media absorb they have less of what errs one way on the way there and the other way on the way back."""


class SecondInterface(NamedTuple):
    """The second interface: its width, the index behind it over that before it, and of the light behind it what arrives
    at the base, by polynomials and channels; None if it lies on the base.
    """

    alpha: Array
    ior: Array
    arrival: Channels | None


class ClosedForm(eqx.Module):
    """Light that has reached a base that forgets where it came from. level: rho / (pi n^2 (1 - rho R)). energy: albedo
    over T(i).
    """

    level: Channels
    energy: Channels

    def value(self, wi: Vector, wo: Vector) -> Channels:
        """BRDF of the light that has reached the base, 0 unless both directions are above."""
        edge = horizon(wi[2].dtype)
        valid = (wi[2] > edge) & (wo[2] > edge)
        there, back = (self.transmittance(sanitise(w, valid)[2]) for w in (wi, wo))
        return select(valid, multiply(there, back, self.level))

    def albedo(self, wi: Vector) -> Channels:
        """Energy of `value` for light along wi, above."""
        return multiply(self.transmittance(wi[2]), self.energy)

    @abc.abstractmethod
    def transmittance(self, cosine: Array) -> Channels:
        """T, the share of light along a cosine that arrives at the base."""


class StreamedBase(ClosedForm):
    """What becomes of light behind the first interface. (STREAMS,) by polynomials, and by channels.

    alpha, ior: of the interface. depth: of the media behind it, optically, but for forward peaks; None if none.
    arrival: share of the light behind these that arrives at the base. second_arrival: of light that goes up there,
    passes them, and comes back from the interface. scattered: what of light just behind the interface arrives, and of
    light that goes up there, if it is scattered in the media; None if it is not.
    """

    alpha: Array
    ior: Array
    depth: Channels | None
    arrival: Channels
    second_arrival: Channels
    scattered: tuple[Channels, Channels] | None
    second: SecondInterface | None

    def transmittance(self, cosine: Array) -> Channels:
        """Share of light along a cosine that arrives at the base."""
        passed, shares = streams.entering(cosine, self.alpha, self.ior)
        there = _ballistic_arrival(self, 1.0 - passed, *streams.two_cosines(shares))
        if self.scattered is not None:
            there = map_channels(lambda t, row: t + streams.arrival_share(shares, row), there, self.scattered[0])
        return tuple(passed * clamp_min(t, 0.0) for t in there)


def is_streamed(stack: Stack) -> bool:
    """Whether a simplified stack over a Lambertian begins with an interface."""
    return isinstance(stack.base, Lambertian) and bool(stack.layers) and isinstance(stack.layers[0], Interface)


def make_streamed(stack: Stack) -> StreamedBase:
    """The diffuse part of a stack for which `is_streamed`."""
    assert isinstance(stack.base, Lambertian)
    dtype = precision(stack)
    interfaces = [layer for layer in stack.layers if isinstance(layer, Interface)]
    indices = [jnp.ones((), dtype), *(jnp.asarray(layer.ior, dtype) for layer in interfaces)]
    alphas = [jnp.asarray(layer.alpha, dtype) for layer in interfaces]
    ratios = [behind / before for before, behind in pairwise(indices)]
    together = streams.interface_matrices(jnp.stack(alphas), jnp.stack(ratios))  # at one look
    faces = [streams.InterfaceMatrices(*(part[k] for part in together)) for k in range(len(alphas))]
    end = next((k for k, layer in enumerate(stack.layers) if k and isinstance(layer, Interface)), len(stack.layers))
    bottom = below = stream_layers.black_base(dtype)
    second, k = None, len(faces)
    for layer in reversed(stack.layers[end:]):
        if isinstance(layer, Medium):
            below = stream_layers.add_medium(below, layer)
            continue
        k -= 1
        onward = None if below is bottom else per_channel(streams.polynomial_coefficients(below.arrival))
        second = SecondInterface(alphas[k], ratios[k], onward)
        below = stream_layers.add_interface(below, faces[k], ratios[k])
    media = [layer for layer in stack.layers[1:end] if isinstance(layer, Medium)]
    upper = stream_layers.first_interface(faces[0])
    for medium in media:
        upper = stream_layers.append_medium(upper, medium)
    met = stream_layers.inter_reflection(below, upper.bottom)
    depth = _depth(media, dtype)
    behind = streams.matvec(jnp.swapaxes(upper.inside, -1, -2), met.arrival)
    second_arrival, scattered = met.second_arrival, None
    if not all(map(absorbs, media)):
        assert depth is not None
        ballistic = stream_layers.ballistic(jnp.stack(depth))
        once = met.arrival * ballistic
        second_arrival = ballistic * streams.matvec(jnp.swapaxes(faces[0].bottom, -1, -2), once)
        down, up = (
            streams.polynomial_coefficients(part) for part in (behind - once, met.second_arrival - second_arrival)
        )
        scattered = per_channel(down), per_channel(up)
    out = streams.matvec(jnp.swapaxes(faces[0].down, -1, -2), behind)
    leaving = per_channel(streams.dot(out, jnp.asarray(streams.DIFFUSE, dtype)) / indices[-1] ** 2)  # by reciprocity
    albedo, returned, one = per_channel(jnp.asarray(stack.base.albedo)), per_channel(met.returned), jnp.ones((), dtype)
    return StreamedBase(
        alpha=alphas[0],
        ior=indices[1],
        depth=depth,
        arrival=per_channel(streams.polynomial_coefficients(met.arrival)),
        second_arrival=per_channel(streams.polynomial_coefficients(second_arrival)),
        scattered=scattered,
        second=second,
        level=map_channels(lambda r, rho: closed_form(one, one, r, rho, indices[-1]), returned, albedo),
        energy=map_channels(lambda out, r, rho: indirect_energy(one, out, r, rho), leaving, returned, albedo),
    )


def _depth(media: list[Medium], dtype: np.dtype) -> Channels | None:
    """The same of light that collides in media."""
    return total([per_channel(stream_layers.collisions(medium, dtype)) for medium in media]) if media else None


def _ballistic_arrival(
    part: StreamedBase, reflectance: Array, cosines: Array, weights: Array, spread: Array
) -> Channels:
    """Share of light behind the first interface, along cosines (2, ...), that arrives without a collision.

    reflectance: of that interface, from outside and, of a beam, from inside.
    """
    values = streams.polynomials(cosines)
    arriving: Channels = tuple(streams.arrival_share(values, row) for row in part.arrival)
    through = (jnp.ones_like(spread),) if part.depth is None else tuple(jnp.exp(-d / cosines) for d in part.depth)
    if part.second is not None:
        passed, shares = streams.entering(cosines, part.second.alpha, part.second.ior)
        once: Channels = (passed,)
        if part.second.arrival is not None:
            once = tuple(passed * streams.arrival_share(shares, row) for row in part.second.arrival)
        narrow = 1.0 / (1.0 + (spread / TURNED) ** 2)
        back: Channels = tuple((1.0 - narrow) * streams.arrival_share(values, row) for row in part.second_arrival)
        if part.scattered is not None:
            back = map_channels(lambda b, row: b + streams.arrival_share(values, row), back, part.scattered[1])
        turns = tuple(1.0 - narrow * reflectance * (1.0 - passed) * t * t for t in through)
        beam = map_channels(lambda o, b, turns: (o + (1.0 - passed) * b) / turns, once, back, turns)
        wide = part.second.alpha**4 / (part.second.alpha**4 + NARROW**4)
        share = tuple((1.0 - wide * t * t) / (1.0 + (spread / BEAM) ** 2) for t in through)
        arriving = map_channels(lambda f, b, s: f + s * (b - f), arriving, beam, share)
    return tuple(jnp.sum(weights * f, axis=0) for f in multiply(arriving, through))


def absorbs(layer: Interface | Medium) -> bool:
    """Whether it is a medium that is known to scatter nothing."""
    return isinstance(layer, Medium) and is_known(layer.albedo, 0.0)
