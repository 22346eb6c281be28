"""The lobes of a stack: one for each interface and base that reflects, and one that passes through all.

Statistics of the atomic operators (Belcour 2018, Sec. 4) for light along given cosines, put together by
`layerjax.transport.lobes.adding`.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import channels, fresnel
from layerjax._numerics import clamp_max, clamp_min, unstack
from layerjax.channels import Channels, map_channels, per_channel
from layerjax.microsurface.directional_albedo import is_narrowest
from layerjax.microsurface.energy_tables import conductor_energies, escape_cone_share, interface_energies
from layerjax.normals.width_matrix import LEAST_WIDTH, WidthMatrix, width_matrix
from layerjax.normals.widths import Widths
from layerjax.stack import Interface, Medium, Stack, is_known
from layerjax.surfaces import Conductor
from layerjax.transport.lobes.adding import Element, Lobe, add_element, identity, limit_escape
from layerjax.transport.lobes.variance import (
    bounded_refracted_cosine,
    phase_variance,
    roughness,
    transmission_scale,
    variance,
)
from layerjax.transport.lobes.variance_tensor import (
    Variance,
    VarianceTensor,
    facet_variance,
    roughness_matrix,
    scale_width,
)

Scattering = Literal["orders", "single"]

Plane = tuple[Array, Array]
"""Components x and y of the direction of light, by which it sees facets of two widths."""

STEEPEST = 0.999
"""Sine of refraction that stands in where no refracted direction exists (rough interfaces pass some light there)."""

LEAST_DEPTH = 1e-9
"""Optical depth that a mean over media is divided by at least."""


class Options(NamedTuple):
    """How the statistics are taken: see `Statistical`."""

    multiple: bool
    scattering: Scattering
    angles: bool
    own_side: bool
    smooth: tuple[bool, ...] | None = None
    """Of the layers and the base, which are known to be as narrow as can be; None: those that are not traced."""


class Reflection(NamedTuple):
    """A lobe that leaves on the side of the light.

    spread: variance that each order of scattering adds, None where nothing scatters. facet: the interface or base that
    reflects, if it is the first one, the ratio of the indices behind and before it (of a conductor: the index of what
    it is in), and whether it is smooth; else None. specular: whether what no medium has scattered is a delta.
    """

    lobe: Lobe
    spread: Channels | None
    facet: tuple[Interface | Conductor, Array, bool] | None
    specular: bool


class Statistics(NamedTuple):
    """Lobes of light along some cosines: those reflected, and the one transmitted (None over a base).

    transmitted_spread, transmitted_specular: as those of `Reflection`, behind the stack.
    """

    reflected: tuple[Reflection, ...]
    transmitted: Lobe | None
    transmitted_spread: Channels | None
    transmitted_specular: bool


class Part(NamedTuple):
    """A layer or base, with the refractive indices above and below it, as the light meets them.

    smooth: whether its energies are Fresnel's.
    """

    what: Any
    above: Array
    below: Array
    smooth: bool


def precision(stack: Stack) -> Any:
    """Floating type of the parameters of a stack."""
    return jnp.result_type(*(leaf for leaf in jax.tree.leaves(stack) if eqx.is_array(leaf)), jnp.float32)


def is_anisotropic(stack: Stack) -> bool:
    """Whether any facets have two widths, by structure."""
    return any(isinstance(part, Interface | Conductor) and part.is_anisotropic for part in (*stack.layers, stack.base))


def smooth_parts(stack: Stack) -> tuple[bool, ...]:
    """Of the layers and a base, which are known while tracing to be as narrow as can be: `Options.smooth`."""
    return tuple(
        isinstance(part, Interface | Conductor) and (part.is_smooth or all(map(is_narrowest, _widths(part))))
        for part in (*stack.layers, stack.base)
    )


def _widths(surface: Interface | Conductor) -> list[Any]:
    return [surface.alpha, surface.alpha_y] if surface.is_anisotropic else [surface.alpha]


def facet_width(surface: Interface | Conductor) -> Array | Widths:
    """Width of the normals, or their two widths; 0 of a smooth surface."""
    if surface.is_anisotropic:
        return Widths(surface.alpha, surface.alpha_y, surface.tangent)
    return jnp.zeros((), jnp.result_type(surface.ior)) if surface.is_smooth else jnp.asarray(surface.alpha)


def refract_plane(plane: Plane | None, outside: Array, inside: Array) -> Plane | None:
    """Components of the direction of light in a medium, from those outside; those outside where it has a lower index,
    beyond whose critical angle there are none."""
    if plane is None:
        return None
    x, y = plane
    factor = clamp_max(outside / inside, 1.0) / jnp.sqrt(clamp_min(x * x + y * y, 1.0))
    return factor * x, factor * y


def width_seen(width: Array | Widths | WidthMatrix, plane: Plane | None) -> Array:
    """Width whose energies stand for those of facets, or of a lobe, that may have two.

    Interfaces reflect and let pass what they mask along the azimuth of the light; energies at widths (.02, .1) to (.3,
    .9), seven angles and three azimuths, were off by 0.004 (rms; 0.02 at most) in reflection, 0.024 (0.12) in
    transmission, and 0.05 (0.2) from inside.

    Args:
        plane: of the direction of the light, where it meets the facets; None: the mean over azimuths.
    """
    if isinstance(width, Widths):
        width = width_matrix(width)
    if not isinstance(width, WidthMatrix):
        return width
    return width.mean_width if plane is None else width.width_seen(*plane)


def mean_width(width: Array | Widths | WidthMatrix) -> Array:
    """Width of mirrors that reflect as much as those of two widths, which lose what leaves along all azimuths.

    At the same widths and angles energies were off by 0.03 (rms; 0.11 at most).
    """
    if isinstance(width, Widths):
        width = width_matrix(width)
    return width.mean_width if isinstance(width, WidthMatrix) else width


def parts(stack: Stack, upward: bool, smooth: tuple[bool, ...] | None = None) -> list[Part]:
    """The layers and a conductor below, in the order in which light from above (or from below: `upward`) meets them."""
    found = []
    index = jnp.ones((), precision(stack))
    smooth = smooth_parts(stack) if smooth is None else smooth
    for layer, narrow in zip(stack.layers, smooth, strict=False):
        below = jnp.asarray(layer.ior) if isinstance(layer, Interface) else index
        found.append(Part(layer, index, below, narrow))
        index = below
    if upward:
        return [Part(part.what, part.below, part.above, part.smooth) for part in reversed(found)]
    if isinstance(stack.base, Conductor):
        found.append(Part(stack.base, index, index, smooth[-1]))
    return found


def statistics(
    stack: Stack, cosine: Array, options: Options, upward: bool = False, plane: Plane | None = None
) -> Statistics:
    """Lobes of a simplified stack, lit along cosines > 0, from below if `upward`. Diffuse bases are omitted.

    plane: of the direction of the light outside, see `width_seen`.
    """
    met = parts(stack, upward, options.smooth)
    above = identity(cosine)
    reflected: list[Reflection] = []
    spread: Channels | None = None
    depth: Channels = (jnp.zeros_like(cosine),)
    over: Array | None = None  # index above the nearest interface so far
    cosines = [bounded_refracted_cosine(cosine, part.above / met[0].above, STEEPEST)[0] for part in met]
    interfaces = iter(_interfaces(met, cosines, options, plane))
    specular = True
    for (what, index, below, smooth), here in zip(met, cosines, strict=True):
        if isinstance(what, Medium):
            element, scattered = _medium(what, here, options)
            if scattered is not None and options.scattering == "orders":
                optical, width = scattered
                mean = channels.multiply(above.jacobian, (width,))
                spread = mean if spread is None else map_channels(_mean_spread, depth, spread, optical, mean)
                depth = channels.total([depth, optical])
            _, above = add_element(above, element)
            continue
        specular = specular and what.is_smooth
        if over is not None:  # some of the light on its way up is totally reflected: Eqs. (32-35)
            own, inside = facet_variance(facet_width(what)), refract_plane(plane, met[0].above, index)
            width = jnp.stack([width_seen(_width(sigma + own), inside) for sigma in above.s_t0])
            above = limit_escape(above, tuple(escape_cone_share(here, width, over / index)))
        element = _conductor(what, here, index, options, smooth) if isinstance(what, Conductor) else next(interfaces)
        lobe, above = add_element(above, element)
        relative = index if isinstance(what, Conductor) else below / index
        reflected.append(Reflection(lobe, spread, None if reflected else (what, relative, smooth), specular))
        over = index
    if stack.base is not None:
        return Statistics(tuple(reflected), None, None, False)
    # what is transmitted is described behind the stack
    behind = None if spread is None else map_channels(jnp.divide, spread, above.jacobian)
    return Statistics(tuple(reflected), Lobe(above.t0, above.s_t0), behind, specular)


def _mean_spread(depth: Array, spread: Array, optical: Array, mean: Array) -> Array:
    return (depth * spread + optical * mean) / clamp_min(depth + optical, LEAST_DEPTH)


def _width(sigma: Variance) -> Array | WidthMatrix:
    return roughness_matrix(sigma) if isinstance(sigma, VarianceTensor) else roughness(sigma)


def _interfaces(met: Sequence[Part], cosines: Sequence[Array], options: Options, plane: Plane | None) -> list[Element]:
    """Elements of all interfaces: the energies of the rough ones together, at one look."""
    chosen = [k for k, part in enumerate(met) if isinstance(part.what, Interface)]
    if not chosen:
        return []
    cosine = jnp.stack([cosines[k] for k in chosen])
    widths = [facet_width(met[k].what) for k in chosen]
    planes = [refract_plane(plane, met[0].above, met[k].above) for k in chosen]
    alpha = _rows(list(map(width_seen, widths, planes)), cosine)
    ior = _rows([jnp.asarray(met[k].below / met[k].above) for k in chosen], cosine)
    smooth = [met[k].smooth for k in chosen]
    refracted, exists = bounded_refracted_cosine(cosine, ior, STEEPEST)
    r12, t12 = _dielectric(cosine, alpha, ior, smooth, options)
    r21, t21 = r12, t12  # Helmholtz: exact where the interface is smooth
    if options.own_side:
        inside = _dielectric(refracted, alpha, 1.0 / ior, smooth, options)
        r21, t21 = (jnp.where(exists, own, other) for own, other in zip(inside, (r12, t12), strict=True))
    one = jnp.ones_like(cosine)
    steep_i, steep_t = (cosine, refracted) if options.angles else (one, one)
    jacobian = ior * refracted / cosine
    down_scale, up_scale = transmission_scale(steep_i, ior, steep_t), transmission_scale(steep_t, 1.0 / ior, steep_i)
    variances: list[Any]
    if any(isinstance(width, Widths) for width in widths):
        variances = [
            [facet_variance(scale_width(*row)) for row in zip(widths, unstack(scale), strict=True)]
            for scale in (one, down_scale, up_scale)
        ]
    else:
        variances = [
            unstack(x) for x in (variance(alpha) * one, variance(down_scale * alpha), variance(up_scale * alpha))
        ]
    rows = zip(*map(unstack, (r12, t12, r21, t21)), *variances, unstack(jacobian), strict=True)
    return [
        Element(
            r12=((above_r,),),
            t12=((above_t,),),
            r21=((below_r,),),
            t21=((below_t,),),
            widening=(wider,),
            down=(going_down,),
            up=(going_up,),
            jacobian=(outside,),
        )
        for above_r, above_t, below_r, below_t, wider, going_down, going_up, outside in rows
    ]


def _rows(values: Sequence[Array], like: Array) -> Array:
    """Numbers, one for each row of an array; or rows."""
    if any(jnp.ndim(value) for value in values):
        return jnp.stack([jnp.broadcast_to(value, like.shape[1:]) for value in values])
    return jnp.stack(values).reshape(-1, *(1,) * (like.ndim - 1))


def _dielectric(
    cosine: Array, alpha: Array, ior: Array, smooth: Sequence[bool], options: Options
) -> tuple[Array, Array]:
    """Reflected and transmitted energy of interfaces, one a row."""
    if not any(smooth):
        return interface_energies(cosine, alpha, ior, options.multiple)
    exact = fresnel.dielectric(cosine, ior)
    rough = np.flatnonzero(~np.asarray(smooth))
    if not rough.size:
        return exact, 1.0 - exact
    r, t = interface_energies(cosine[rough], alpha[rough], ior[rough], options.multiple)
    return exact.at[rough].set(r), (1.0 - exact).at[rough].set(t)


def _conductor(base: Conductor, cosine: Array, index: Array, options: Options, smooth: bool) -> Element:
    levels = metal_levels(base, cosine, index, options.multiple, smooth)
    zero, one = (jnp.zeros_like(cosine),), (jnp.ones_like(cosine),)
    dark = (zero,)  # nothing passes
    return Element((levels,), dark, dark, dark, (facet_variance(facet_width(base)) * one[0],), zero, zero, one)


def metal_levels(base: Conductor, cosine: Array, index: Array, multiple: bool, smooth: bool) -> Channels:
    """Reflectance of a metal in a medium of this index."""
    ior, k = (tuple(x / index for x in per_channel(jnp.asarray(value))) for value in (base.ior, base.k))
    if smooth:
        return map_channels(lambda ior, k: fresnel.conductor(cosine, ior, k), ior, k)
    return conductor_energies(cosine, mean_width(facet_width(base)), ior, k, multiple)


def _medium(medium: Medium, cosine: Array, options: Options) -> tuple[Element, tuple[Channels, Array] | None]:
    """Element of a medium; and the optical depth that scatters with the variance of a collision, None if none does."""
    depth = tuple(thickness / cosine for thickness in per_channel(jnp.asarray(medium.thickness)))
    zero, one = (jnp.zeros_like(cosine),), (jnp.ones_like(cosine),)
    dark = (zero,)
    ballistic = tuple(jnp.exp(-t) for t in depth)
    g = medium.phase.forward_lobe
    if g is None or is_known(medium.albedo, 0.0):
        return Element(dark, (ballistic,), dark, (ballistic,), zero, zero, zero, one), None
    scattered = channels.multiply(per_channel(jnp.asarray(medium.albedo)), depth)
    width = phase_variance(jnp.asarray(g))
    if options.scattering == "single":
        passed = map_channels(lambda s, t: jnp.exp(jnp.log1p(s) - t), scattered, depth)  # (1 + t) exp(-t)
        added = tuple(s / (1.0 + s) * width for s in scattered)
        return Element(dark, (passed,), dark, (passed,), zero, added, added, one), None
    once = channels.multiply(ballistic, scattered)
    more = map_channels(lambda s, t, e, o: clamp_min(jnp.exp(s - t) - e - o, 0.0), scattered, depth, ballistic, once)
    orders = (ballistic, once, more)
    return Element(dark, orders, dark, orders, zero, zero, zero, one), (scattered, width)


def lobe_roughness(sigma: Array) -> Array:
    """GGX width of a lobe of this variance, within the range that lobes are evaluated in."""
    return bound_alpha(roughness(sigma))


def bound_alpha(alpha: Array) -> Array:
    """A GGX width kept within the range that lobes are evaluated in."""
    return clamp_max(clamp_min(alpha, LEAST_WIDTH), 1.0)
