"""Light that has reached a Lambertian base under media that lie on top, and what is below them: the closed form.

The same closed form as `layerjax.transport.statistical.diffuse_base`, f = T(i) T(o) rho / (pi n^2 (1 - rho R)). Light
that passes the media without a collision arrives as it does without them (`streamed_base`, `coated_base`). Of what
meets something on its way, scattered there once or often or reflected by it, few streams say how much arrives: between
these it is a polynomial of the cosine times the share that meets anything, which is all that is steep at grazing.
"""

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import clamp_min, exprel
from layerjax.channels import Channels, map_channels, multiply, per_channel
from layerjax.stack import Interface, Medium, Stack
from layerjax.surfaces import Lambertian
from layerjax.transport.lobes.statistics import precision
from layerjax.transport.statistical import stream_layers, streams
from layerjax.transport.statistical.coated_base import CoatedBase, is_coated, make_coated
from layerjax.transport.statistical.diffuse import closed_form, indirect_energy
from layerjax.transport.statistical.streamed_base import ClosedForm, StreamedBase, absorbs, make_streamed


class HazyBase(ClosedForm):
    """depth: optical depth of the media on top, but for forward peaks. scattered: what of the light that collides there
    arrives, a unit of depth, by polynomials and channels; None if they only absorb. inner: what becomes of light that
    passes; None: the base itself.
    """

    depth: Channels
    scattered: Channels | None
    inner: StreamedBase | CoatedBase | None

    def transmittance(self, cosine: Array) -> Channels:
        """Share of light along a cosine that arrives at the base."""
        ballistic: Channels = tuple(jnp.exp(-depth / cosine) for depth in self.depth)
        there = ballistic if self.inner is None else multiply(ballistic, self.inner.transmittance(cosine))
        if self.scattered is None:
            return there
        found = streams.polynomials(cosine)
        share = tuple(exprel(depth / cosine) / cosine for depth in self.depth)
        met = map_channels(lambda s, row: s * clamp_min(streams.arrival_share(found, row), 0.0), share, self.scattered)
        return map_channels(jnp.add, there, met)


def is_hazy(stack: Stack) -> bool:
    """Whether a simplified stack over a Lambertian begins with a medium."""
    return isinstance(stack.base, Lambertian) and bool(stack.layers) and isinstance(stack.layers[0], Medium)


def make_hazy(stack: Stack) -> HazyBase:
    """The diffuse part of a stack for which `is_hazy`."""
    assert isinstance(stack.base, Lambertian)
    dtype = precision(stack)
    first = next((k for k, layer in enumerate(stack.layers) if isinstance(layer, Interface)), len(stack.layers))
    top = [layer for layer in stack.layers[:first] if isinstance(layer, Medium)]
    under = Stack(stack.layers[first:], stack.base)
    index = jnp.ones((), dtype)
    below = under_interfaces = stream_layers.black_base(dtype)
    inner: StreamedBase | CoatedBase | None = None
    if under.layers:
        inner = make_coated(under) if is_coated(under) else make_streamed(under)
        below, index = stream_layers.add_layers(below, under.layers)
        under_interfaces = below
    for medium in reversed(top):
        below = stream_layers.add_medium(below, medium)
    depth = sum(
        (stream_layers.collisions(medium, dtype) for medium in top[1:]), stream_layers.collisions(top[0], dtype)
    )
    scattered = None
    if not all(map(absorbs, top)):
        met = below.arrival - under_interfaces.arrival * stream_layers.ballistic(depth)
        nodes = jnp.asarray(streams.NODES, dtype)
        share = exprel(depth[:, None] / nodes) / nodes
        scattered = per_channel(streams.polynomial_coefficients(met / share))
    leaving = per_channel(streams.dot(below.arrival, jnp.asarray(streams.DIFFUSE, dtype)) / index**2)  # by reciprocity
    albedo, returned, one = (
        per_channel(jnp.asarray(stack.base.albedo)),
        per_channel(below.returned),
        jnp.ones((), dtype),
    )
    return HazyBase(
        depth=per_channel(depth),
        scattered=scattered,
        inner=inner,
        level=map_channels(lambda r, rho: closed_form(one, one, r, rho, index), returned, albedo),
        energy=map_channels(lambda out, r, rho: indirect_energy(one, out, r, rho), leaving, returned, albedo),
    )
