"""Media whose phase function depends on the angle of deflection alone: on the grid by Legendre moments.

By the addition theorem the kernel of the Fourier mode m is a sum over associated Legendre functions Y, normalised to 1,
of the cosines of travel,

    K_m(mu_o, mu_i) = 1 / (2 pi) sum_(l >= m) chi_l Y_l^m(mu_o) Y_l^m(mu_i),

a sign (-1)^(l + m) separates reflection from transmission. Sums over nodes are exact to twice their number a
hemisphere, so that collisions scatter what they should. What a forward peak has beyond the moments of l < L, it has as
narrow as the grid is fine: a share chi_L of it is ballistic (delta-M, Wiscombe 1977). In other words the moments are
chi_l - chi_L, and the extinction is less by albedo times chi_L. Light scattered once is known in closed form, with the
whole phase function in a medium of that extinction (TMS, Nakajima & Tanaka 1988).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._numerics import clamp_min
from layerjax.directions import Vector, half_vector
from layerjax.phase import PhaseFunction
from layerjax.phase.moments import moments_by_quadrature
from layerjax.stack import Interface, Medium, Stack, is_known

LEAST_TERMS = 4
"""Moments of any grid: sums over two nodes are exact to their degree."""

NARROW = 6
"""Times the moments that a grid carries of it: those that a backward peak has if the grid shows no width of it."""


class MomentCounts(NamedTuple):
    """L of forward peaks, and of backward ones.

    Values between as many nodes follow as many moments. Under an interface there are two panels of nodes. Of a backward
    peak no grid may carry more: see `truncate`.
    """

    forward: int
    backward: int

    @property
    def most(self) -> int:
        """Moments that are carried, with those in which a backward peak fades out."""
        return max(self.forward, self.backward + self.backward // 2)


def terms(nodes: int, layered: bool) -> MomentCounts:
    """For a grid of so many nodes a panel; layered: whether the stack has interfaces."""
    least = max(LEAST_TERMS, nodes)
    return MomentCounts(max(LEAST_TERMS, 2 * nodes) if layered else least, least)


def delta_scale(stack: Stack, nodes: int) -> Stack | None:
    """The stack with the media that the grid carries, their phase functions whole; None if these are its own."""
    carried = terms(nodes, any(isinstance(layer, Interface) for layer in stack.layers))
    return _delta_scale(stack, carried) if any(_has_peak(layer, carried) for layer in stack.layers) else None


def _has_peak(layer: Interface | Medium, carried: MomentCounts) -> bool:
    """Whether some of what it scatters may be ballistic, as far as is known while tracing."""
    if not isinstance(layer, Medium) or is_known(layer.albedo, 0.0):
        return False
    chi = layer.phase.moments(carried.forward + 1)
    return chi is not None and (layer.f0 is not None or not isinstance(chi, np.ndarray) or bool(chi[-1] != 0.0))


@eqx.filter_jit
def _delta_scale(stack: Stack, carried: MomentCounts) -> Stack:
    layers = [_scale_medium(layer, carried) if _has_peak(layer, carried) else layer for layer in stack.layers]
    return eqx.tree_at(lambda s: s.layers, stack, tuple(layers))


def _scale_medium(medium: Interface | Medium, carried: MomentCounts) -> Medium:
    assert isinstance(medium, Medium)
    dtype = jnp.result_type(*(leaf for leaf in jax.tree.leaves(medium) if eqx.is_array(leaf)), jnp.float32)
    _, onward, _ = truncate(medium.phase, False, carried, dtype)
    if medium.f0 is not None:
        _, fifth, _ = truncate(medium.phase, True, carried, dtype)
        onward = medium.f0 * onward + (1.0 - medium.f0) * fifth
    left = 1.0 - medium.albedo * onward
    return eqx.tree_at(lambda m: (m.thickness, m.albedo), medium, (medium.thickness * left, medium.albedo / left))


def kernel_of_moments(chi: Array, cosine: Array, sine: Array, modes: int) -> tuple[Array, Array]:
    """The kernel of these moments between directions: reflection and transmission, (modes, out, in)."""
    functions = jnp.moveaxis(_legendre_functions(cosine, sine, modes, chi.size), 0, -1)
    even, odd = (
        jnp.einsum("mil,mjl->mij", functions[..., part] * chi[part], functions[..., part]) / (2.0 * jnp.pi)
        for part in (slice(0, None, 2), slice(1, None, 2))
    )
    sign = jnp.asarray((-1.0) ** np.arange(modes), chi.dtype)[:, None, None]
    return sign * (even - odd), even + odd


def _legendre_functions(cosine: Array, sine: Array, modes: int, count: int) -> Array:
    """Associated Legendre functions of degrees below `count` and orders below `modes`, (degree, order, direction).

    Their squares integrate to 1 over the cosine; upward in degree from l = m, where they are a power of the sine. Half
    of that power is multiplied in at the end, so that neither it nor what grows from it leaves the range of numbers.
    """
    dtype = cosine.dtype
    degree, order = np.arange(count)[:, None], np.arange(modes)
    up, within = degree == order, degree > order
    square = np.where(within, degree**2 - order**2, 1)
    rise = np.where(within, np.sqrt(np.abs(4.0 * degree**2 - 1.0) / square), 0.0)
    before = np.where(within, (degree - 1) ** 2 - order**2, 0)
    fall = rise * np.sqrt(before / np.maximum(4.0 * (degree - 1) ** 2 - 1.0, 1.0))
    factor = np.cumsum(np.log1p(0.5 / np.maximum(order, 1)) * (order > 0)) - np.log(2.0)
    half = jnp.exp(
        0.5 * (jnp.asarray(order, dtype)[:, None] * jnp.log(sine) + jnp.asarray(0.5 * factor, dtype)[:, None])
    )

    def step(pair: tuple[Array, Array], factors: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        last, current = pair
        starts, rise, fall = (part[:, None] for part in factors)
        found = starts * half + rise * cosine * current - fall * last
        return (current, found), found

    zero = jnp.zeros_like(half)
    factors = tuple(jnp.asarray(part, dtype) for part in (up, rise, fall))
    return jax.lax.scan(step, (zero, zero), factors)[1] * half


def truncate(phase: PhaseFunction, is_schlick: bool, carried: MomentCounts, dtype: Any) -> tuple[Array, Array, Array]:
    """Moments that a grid carries, and the shares of a collision that count as ballistic and as retroreflected.

    A backward peak is cut off, and smoothly, so that slabs do not gain energy (see `slab`): what it has beyond counts
    from the second collision on, and less with each. One that is far narrower than nodes are apart is retroreflected.

    Args:
        phase: one that has moments.
        is_schlick: with the factor (1 - |wi . h|)^5.
        carried: which moments.
        dtype: of the numbers.
    """
    if is_schlick:
        chi = moments_by_quadrature(lambda wi, wo: _fifth(wi, wo) * phase.pdf(wi, wo), carried.most + 1, dtype)
    else:
        found = phase.moments(NARROW * carried.backward + 1)
        assert found is not None
        chi = jnp.asarray(found, dtype)
    before, last = chi[carried.forward - 1], chi[carried.forward]
    points_back = before * last < 0.0
    onward = clamp_min(jnp.minimum(before, last), 0.0)
    back = jnp.where(
        points_back & (not is_schlick), jnp.abs(chi[-1]), 0.0
    )  # that factor is 0 in the backward direction
    degree = np.arange(carried.most)
    beyond = np.clip((degree - carried.backward) / (carried.backward // 2), 0.0, 1.0)
    kept = jnp.where(points_back, jnp.asarray(np.cos(0.5 * np.pi * beyond) ** 2, dtype), degree < carried.forward)
    return kept * (chi[: carried.most] - onward - jnp.asarray((-1.0) ** degree, dtype) * back), onward, back


def _fifth(wi: Vector, wo: Vector) -> Array:
    return fresnel.schlick(half_vector(wi, wo)[1], 0.0)
