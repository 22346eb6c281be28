"""The lobes of a stack: one for each interface and base that reflects, and one that passes through all.

Statistics of the atomic operators (Belcour 2018, Sec. 4) for light along given cosines, put together by
`layerjax.transport.statistical.adding`.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import fresnel
from layerjax._numerics import at_least, at_most
from layerjax.channels import per_channel
from layerjax.microsurface.directional_albedo import conductor_energy, interface_energies, is_smooth, retained
from layerjax.stack import Interface, Medium, Stack, is_known
from layerjax.surfaces import Conductor
from layerjax.transport.statistical.adding import Element, Lobe, add_element, nothing, retain
from layerjax.transport.statistical.variance import (
    bounded_refracted_cosine,
    phase_variance,
    roughness,
    transmission_scale,
    variance,
)

Scattering = Literal["orders", "single"]

STEEPEST = 0.999
"""Sine of refraction that stands in where no refracted direction exists (rough interfaces pass some light there)."""

POINTS = 8
"""Of the quadrature of interfaces: energies to 1e-3, which is far below what the model can tell."""

LEAST_DEPTH = 1e-9
"""Optical depth that a mean over media is divided by at least."""


class Options(NamedTuple):
    """How the statistics are taken: see `Statistical`."""

    microfacets: Literal["single", "multiple"]
    scattering: Scattering
    angles: bool
    own_side: bool


class Reflection(NamedTuple):
    """A lobe that leaves on the side of the light.

    spread: variance that each order of scattering adds, None where nothing scatters. facet: the interface or base that
    reflects, if it is the first one, and the ratio of the indices behind and before it (of a conductor: the index of
    what it is in); else None.
    """

    lobe: Lobe
    spread: Array | None
    facet: tuple[Interface | Conductor, Array] | None


class Statistics(NamedTuple):
    """Lobes of light along n cosines: those reflected, and the one transmitted (None over a base)."""

    reflected: tuple[Reflection, ...]
    transmitted: Lobe | None
    transmitted_spread: Array | None


class Part(NamedTuple):
    """A layer or base, with the refractive indices above and below it, as the light meets them."""

    what: Any
    above: Array
    below: Array


def precision(stack: Stack) -> Any:
    """Floating type of the parameters of a stack."""
    return jnp.result_type(*(leaf for leaf in jax.tree.leaves(stack) if eqx.is_array(leaf)), jnp.float32)


def parts(stack: Stack, upward: bool) -> list[Part]:
    """The layers and a conductor below, in the order in which light from above (or from below: `upward`) meets them."""
    found = []
    index = jnp.ones((), precision(stack))
    for layer in stack.layers:
        below = jnp.asarray(layer.ior) if isinstance(layer, Interface) else index
        found.append(Part(layer, index, below))
        index = below
    if upward:
        return [Part(part.what, part.below, part.above) for part in reversed(found)]
    if isinstance(stack.base, Conductor):
        found.append(Part(stack.base, index, index))
    return found


def statistics(stack: Stack, cosine: Array, options: Options, upward: bool = False) -> Statistics:
    """Lobes of a simplified stack, lit along cosines (n,) > 0, from below if `upward`. Diffuse bases are left out."""
    met = parts(stack, upward)
    above = nothing(cosine)
    reflected: list[Reflection] = []
    spread: Array | None = None
    depth = jnp.zeros_like(cosine)[None]
    over: Array | None = None  # index above the nearest interface so far
    cosines = [bounded_refracted_cosine(cosine, part.above / met[0].above, STEEPEST)[0] for part in met]
    interfaces = iter(_interfaces(met, cosines, options))
    for (what, index, below), here in zip(met, cosines, strict=True):
        if isinstance(what, Medium):
            element, scattered = _medium(what, here, options)
            if scattered is not None and options.scattering == "orders":
                optical, width = scattered
                mean = above.jacobian * width * jnp.ones_like(optical)
                total = depth + optical
                spread = mean if spread is None else (depth * spread + optical * mean) / at_least(total, LEAST_DEPTH)
                depth = total
            _, above = add_element(above, element)
            continue
        alpha = jnp.asarray(what.alpha)
        if over is not None:  # some of the light on its way up is totally reflected: Eqs. (32-35)
            above = retain(above, retained(here, roughness(above.s_t0 + variance(alpha)), over / index))
        element = _conductor(what, here, index, options) if isinstance(what, Conductor) else next(interfaces)
        lobe, above = add_element(above, element)
        relative = index if isinstance(what, Conductor) else below / index
        reflected.append(Reflection(lobe, spread, None if reflected else (what, relative)))
        over = index
    if stack.base is not None:
        return Statistics(tuple(reflected), None, None)
    return Statistics(tuple(reflected), Lobe(above.t0, above.s_t0), spread)


def _interfaces(met: Sequence[Part], cosines: Sequence[Array], options: Options) -> list[Element]:
    """Elements of all interfaces: the energies of the rough ones together, as one quadrature."""
    chosen = [k for k, part in enumerate(met) if isinstance(part.what, Interface)]
    if not chosen:
        return []
    cosine = jnp.stack([cosines[k] for k in chosen])
    alpha = jnp.stack([jnp.asarray(met[k].what.alpha) for k in chosen])[:, None]
    ior = jnp.stack([jnp.asarray(met[k].below / met[k].above) for k in chosen])[:, None]
    smooth = [is_smooth(met[k].what.alpha) for k in chosen]
    refracted, exists = bounded_refracted_cosine(cosine, ior, STEEPEST)
    r12, t12 = _dielectric(cosine, alpha, ior, smooth, options)
    r21, t21 = r12, t12  # Helmholtz: exact where the interface is smooth
    if options.own_side:
        inside = _dielectric(refracted, alpha, 1.0 / ior, smooth, options)
        r21, t21 = (jnp.where(exists, own, other) for own, other in zip(inside, (r12, t12), strict=True))
    one = jnp.ones_like(cosine)
    steep_i, steep_t = (cosine, refracted) if options.angles else (one, one)
    jacobian = ior * refracted / cosine
    widening = variance(alpha) * one
    down = variance(transmission_scale(steep_i, ior, steep_t) * alpha)
    up = variance(transmission_scale(steep_t, 1.0 / ior, steep_i) * alpha)
    return [
        Element(
            *(energy[k][None, None] for energy in (r12, t12, r21, t21)),
            *(width[k][None] for width in (widening, down, up, jacobian)),
        )
        for k in range(len(chosen))
    ]


def _dielectric(
    cosine: Array, alpha: Array, ior: Array, smooth: Sequence[bool], options: Options
) -> tuple[Array, Array]:
    """Reflected and transmitted energy of interfaces, one a row."""
    if not any(smooth):
        return interface_energies(cosine, alpha, ior, options.microfacets, points=POINTS)
    exact = fresnel.dielectric(cosine, ior)
    rough = np.flatnonzero(~np.asarray(smooth))
    if not rough.size:
        return exact, 1.0 - exact
    r, t = interface_energies(cosine[rough], alpha[rough], ior[rough], options.microfacets, points=POINTS)
    return exact.at[rough].set(r), (1.0 - exact).at[rough].set(t)


def _conductor(base: Conductor, cosine: Array, index: Array, options: Options) -> Element:
    alpha = jnp.asarray(base.alpha)
    ior, k = (jnp.reshape(value, (-1, 1)) / index for value in (base.ior, base.k))
    if is_smooth(base.alpha):
        levels = fresnel.conductor(cosine, ior, k)[None]
    else:
        levels = conductor_energy(cosine, alpha, ior, k, options.microfacets)[None]
    zero = jnp.zeros_like(cosine)[None]
    nothing_passes = zero[None]
    width = variance(alpha) * jnp.ones_like(zero)
    return Element(levels, nothing_passes, nothing_passes, nothing_passes, width, zero, zero, jnp.ones_like(zero))


def _medium(medium: Medium, cosine: Array, options: Options) -> tuple[Element, tuple[Array, Array] | None]:
    """Element of a medium; and the optical depth that scatters with the variance of a collision, None if none does."""
    depth = jnp.stack(per_channel(medium.thickness))[:, None] / cosine
    zero = jnp.zeros_like(cosine)[None]
    g = medium.phase.forward_lobe
    if g is None or is_known(medium.albedo, 0.0):
        t = jnp.exp(-depth)[None]
        return Element(zero[None], t, zero[None], t, zero, zero, zero, jnp.ones_like(zero)), None
    albedo = jnp.asarray(medium.albedo)
    scattered = (albedo[:, None] if albedo.ndim else albedo) * depth
    width = phase_variance(jnp.asarray(g))
    if options.scattering == "single":
        t = jnp.exp(jnp.log1p(scattered) - depth)[None]  # (1 + t) exp(-t)
        added = scattered / (1.0 + scattered) * width
        return Element(zero[None], t, zero[None], t, zero, added, added, jnp.ones_like(zero)), None
    straight = jnp.exp(-depth)
    once = straight * scattered
    more = at_least(jnp.exp(-depth + scattered) - straight - once, 0.0)
    t = jnp.stack(jnp.broadcast_arrays(straight, once, more))
    return Element(zero[None], t, zero[None], t, zero, zero, zero, jnp.ones_like(zero)), (scattered, width)


def lobe_roughness(sigma: Array) -> Array:
    """GGX width of a lobe of this variance, within the range that lobes are evaluated in."""
    return bounded(roughness(sigma))


def bounded(alpha: Array) -> Array:
    """A GGX width kept within the range that lobes are evaluated in."""
    return at_most(at_least(alpha, 1e-4), 1.0)
