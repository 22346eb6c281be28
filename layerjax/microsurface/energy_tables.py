"""Directional energies of rough GGX surfaces from tables: what `directional_albedo` finds by quadrature, at a look.

Splines (`layerjax.microsurface.splines`) over variables in which energies are smooth: the cosine is dense where they
rise within the roughness (at grazing, or about the critical cosine), the index is a cube root about 1. Roots are stored
where energies vanish. The tables are made by ``python -m layerjax.precompute energies``.

Cosines are those of incidence, in (0, 1]; alpha is in [1e-4, 1], indices in [0.25, 4]; all arguments broadcast. Errors
beside the quadratures at random points, half of them in the layers where energies rise, are below (rms, largest):

=================================== ================
quantity                            rms, largest
=================================== ================
mirrors                             1e-4, 6e-4
share within a cone                 1.5e-3, 1.2e-2
interfaces, "single"                2e-3, 3e-2
interfaces, "multiple", alpha > .01 2e-3, 3e-2
conductors, "single", k > 0.3       1e-3, 7e-3
conductors, "multiple", k > 0.3     2e-3, 3e-2
=================================== ================

The largest errors are those of cosines that are as small as alpha. Beside walks of 16,384 paths interfaces with alpha >
.01 ("multiple") are off by 1.5e-3 (index above 1) and 2e-3 (below), by 1.7e-2 at most.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax import channels, fresnel
from layerjax._numerics import clamp_max, clamp_min, safe_sqrt
from layerjax.channels import Channels, map_channels
from layerjax.microsurface.splines import read
from layerjax.tables import load

LARGEST_INDEX = 4.0
"""Ratio of the index on the far side to that on the near one, or its inverse."""

ENERGY_OFFSET = 1e-5
"""Added to energies before their root is taken: below it they are as good as 0."""

SLICES = (0.05, 0.15, 0.3, 0.3, 0.15, 0.05)
"""Shares of the facets of a metal, by how far they face the light, each of which its mean facing cosine stands for."""

REST = (0.2, 0.6, 0.2)
"""The same for the light that facets send on to other facets."""

RETURNS = 3
"""Numbers that say what a metal gives back of the rest: see `multiple_reflectance`."""

DIFFUSE = (
    (0.212340538239, 0.590533135559, 0.911412040487),
    (0.139653959803, 0.458482212719, 0.401863827478),
)
"""Cosines and weights of the mean over diffuse light, 2 u du (Gauss and Jacobi, three points)."""

LEAST_ALPHA = 1e-4

STEEPEST = 0.9685
"""The largest critical cosine: that of the largest index."""

LARGEST_ATANH = 6.0
"""Bound of the inverse hyperbolic tangent of twice a share less 1."""


class Warp(NamedTuple):
    """How the axes of a table are stretched.

    cosine: width of the dense part of the cosine, at alpha 0 and by alpha. grain: of alpha, even below it, in the
    logarithm above; 0: even in the logarithm.
    """

    cosine: tuple[float, float]
    grain: float


DENSER = Warp((0.012, 0.4), 0.02)
"""Tables of interfaces with the higher index below."""

THINNER = Warp((5e-4, 0.5), 1e-3)
"""Of those behind which it is lower: the width goes with alpha times the index."""

MIRROR = Warp((0.0, 1.0), 0.0)

ESCAPE_CONE = Warp((0.0, 0.5), 0.0)


def interface_energies(cosine: Array, alpha: Array, ior: Array, multiple: bool) -> tuple[Array, Array]:
    """Reflectance and transmittance of a rough interface.

    Args:
        ior: index on the far side over that on the side of incidence.
        multiple: whether light that a facet sends into another is followed, where the two add up
            to 1; else it is lost (Walter 2007).
    """
    if multiple:
        reflected = _from_root(_dielectric(cosine, alpha, ior, 0, 1)[0])
        return reflected, 1.0 - reflected
    root, passed = _dielectric(cosine, alpha, ior, 1, 2)
    reflected = _from_root(root) * mirror_energy(cosine, alpha)
    return reflected, clamp_max(clamp_min(passed, 0.0), 1.0 - reflected)


def single_reflectance(cosine: Array, alpha: Array, ior: Array) -> Array:
    """Reflectance of a rough interface, single scattering."""
    return _from_root(_dielectric(cosine, alpha, ior, 1, 1)[0]) * mirror_energy(cosine, alpha)


def mirror_energy(cosine: Array, alpha: Array) -> Array:
    """Reflectance of rough facets that reflect all, single scattering."""
    return clamp_max(_read_plane(cosine, alpha, "mirror", 1)[0], 1.0)


def conductor_energies(cosine: Array, alpha: Array, ior: Channels, k: Channels, multiple: bool) -> Channels:
    """Reflectance of a rough conductor, by channels.

    Args:
        ior, k: over the index of the medium above.
        multiple: whether light is followed from facet to facet, and loses its Fresnel share at each.
    """
    if not multiple:
        total, *facing = _read_plane(cosine, alpha, "mirror", 1 + len(SLICES))
        (levels,) = _means_of_facets(facing, (SLICES,), ior, k)
        return channels.multiply((clamp_max(total, 1.0),), levels)
    total, *rest = _read_plane(cosine, alpha, "first", 1 + len(SLICES) + len(REST) + RETURNS)
    facing, returns = rest[:-RETURNS], rest[-RETURNS:]
    first, sent_on = _means_of_facets(facing, (SLICES, REST), ior, k)
    cosines, weights = DIFFUSE
    # by itself: of one metal it is the same in all directions
    smooth = [jnp.asarray(u, total.dtype) for u in (*cosines, 1.0)]
    mean, normal = _means_of_facets(smooth, (weights, (1.0,)), ior, k)
    total = clamp_max(total, 1.0)

    def reflected(first: Array, sent_on: Array, mean: Array, normal: Array) -> Array:
        more = (1.0 - total) * sent_on * multiple_reflectance(returns, mean, normal)
        return clamp_max(clamp_min(total * first + more, 0.0), 1.0)

    return map_channels(reflected, first, sent_on, mean, normal)


def multiple_reflectance(returns: Sequence[Array], mean: Array, normal: Array) -> Array:
    """Share that a metal gives back of the light that its first facets have sent on to others.

    A geometric series: at every facet `returns[0]` of it leaves. What these reflect is the mean over all directions,
    changed by so much of what more the metal reflects along the normal: at the second facet, and at all further ones.

    Args:
        mean, normal: reflectance of the smooth metal in diffuse light, and along the normal.
    """
    leaves, second, further = returns
    slope = normal - mean
    return (mean + second * slope) * leaves / (1.0 - (mean + further * slope) * (1.0 - leaves))


def escape_cone_share(cosine: Array, alpha: Array, ratio: Array) -> Array:
    """Share of the lobe of `mirror_energy` that lies in sin(theta_o) < ratio; 1 for a ratio of 1 and above."""
    cosine, alpha, ratio = jnp.broadcast_arrays(cosine, alpha, ratio)
    below = ratio < 1.0
    tame = jnp.where(below, ratio, 0.5)
    places = escape_cone_places(cosine, alpha, safe_sqrt((1.0 - tame) * (1.0 + tame)))
    table = load("energies")
    (found,) = read(table["retained"], 0, SHAPES["retained"], places)
    return jnp.where(below, 0.5 * (1.0 + jnp.tanh(found)), 1.0)


def escape_cone_places(cosine: Array, alpha: Array, critical: Array) -> tuple[Array, Array, Array]:
    """Where directions, widths and critical cosines lie on the axes of the table of `escape_cone_share`.

    The cosine counts from the critical one, in what the width of the lobe is there, and extends beyond 1.
    """
    width = ESCAPE_CONE.cosine[1] * alpha * jnp.sqrt((1.0 - critical) * (1.0 + critical) + alpha * alpha)
    inverse = 1.0 / width
    low, high = jnp.arcsinh(critical * inverse), jnp.arcsinh(inverse)
    along = (jnp.arcsinh((cosine - critical) * inverse) + low) / (low + high)
    narrow = 1.0 / (ESCAPE_CONE.cosine[1] * alpha)
    last = jnp.arcsinh(STEEPEST * narrow)
    return along, _alpha_place(alpha, ESCAPE_CONE.grain), jnp.arcsinh(critical * narrow) / last


def dielectric_places(cosine: Array, alpha: Array, ior: Array) -> tuple[Array, Array, Array]:
    """Where interfaces lie on the axes of their table, in [0, 1]; the side of 1 that the index is on has its own."""
    below = ior < 1.0
    critical = safe_sqrt((1.0 - ior) * (1.0 + ior))
    width = jnp.where(below, _width(THINNER, alpha * ior), _width(DENSER, alpha))
    rough = jnp.where(below, _alpha_place(alpha, THINNER.grain), _alpha_place(alpha, DENSER.grain))
    return _cosine_place(cosine, critical, width), rough, index_variable(ior)


def mirror_places(cosine: Array, alpha: Array) -> tuple[Array, Array]:
    """Where directions and widths lie on the axes of tables of mirrors and metals."""
    return _cosine_place(cosine, jnp.zeros_like(cosine), _width(MIRROR, alpha)), _alpha_place(alpha, MIRROR.grain)


def index_variable(ior: Array) -> Array:
    """Where an index lies on the axis of its side of 1, in [0, 1]: dense near 1, where it matters to grazing light."""
    squared = (jnp.log(ior) * (1.0 / math.log(LARGEST_INDEX))) ** 2
    some = squared > 0
    return jnp.where(some, jnp.exp(jnp.log(jnp.where(some, squared, 1.0)) * (1.0 / 6.0)), 0.0)


def _dielectric(cosine: Array, alpha: Array, ior: Array, column: int, columns: int) -> list[Array]:
    """Columns of the table of interfaces, one for each side of an index of 1, in one array: one look serves either."""
    cosine, alpha, ior = jnp.broadcast_arrays(cosine, alpha, ior)
    denser, thinner = SHAPES["denser"], SHAPES["thinner"]
    below = ior < 1.0
    counts = [jnp.where(below, t, d) for d, t in zip(denser, thinner, strict=True)]
    sizes = [int(np.prod(shape)) for shape in (denser, thinner)]
    start = jnp.where(below, sizes[0], 0) + column * sum(sizes)
    return read(
        load("energies")["dielectric"], start, counts, dielectric_places(cosine, alpha, ior), columns, sum(sizes)
    )


def _read_plane(cosine: Array, alpha: Array, name: str, columns: int) -> list[Array]:
    """The first columns of a table over cosine and width."""
    cosine, alpha = jnp.broadcast_arrays(cosine, alpha)
    shape = SHAPES["mirror"]
    return read(load("energies")[name], 0, shape, mirror_places(cosine, alpha), columns, int(np.prod(shape)))


def _means_of_facets(
    facing: Sequence[Array], sets: Sequence[Sequence[float]], ior: Channels, k: Channels
) -> list[Channels]:
    """Mean reflectance of facets by their cosines, by channels: of the first ones with the shares of the first set,
    of the next with those of the next; in a loop, that XLA compiles a facet once."""

    def add(sums: list[Channels], tabulated: tuple[Array, Array]) -> tuple[list[Channels], None]:
        u, shares = tabulated
        levels = map_channels(lambda ior, k: fresnel.conductor(clamp_max(clamp_min(u, 0.0), 1.0), ior, k), ior, k)
        after = []
        for total, share in zip(sums, shares, strict=True):
            after.append(tuple(before + share * level for before, level in zip(total, levels, strict=True)))
        return after, None

    shape = jnp.broadcast_shapes(facing[0].shape, *(value.shape for value in (*ior, *k)))
    zero = (jnp.zeros(shape, facing[0].dtype),) * channels.count(ior, k)
    own = np.repeat(np.eye(len(sets)), [len(shares) for shares in sets], axis=0)  # (facets, sets)
    shares = jnp.asarray(own * np.concatenate(sets)[:, None], facing[0].dtype)
    return jax.lax.scan(jax.checkpoint(add), [zero] * len(sets), (jnp.stack(facing), shares))[0]


def _from_root(root: Array) -> Array:
    return clamp_max(clamp_min(root * root - ENERGY_OFFSET, 0.0), 1.0)


def _width(warp: Warp, alpha: Array) -> Array:
    return warp.cosine[0] + warp.cosine[1] * alpha


def _cosine_place(cosine: Array, critical: Array, width: Array) -> Array:
    inverse = 1.0 / width
    low, high = jnp.arcsinh(critical * inverse), jnp.arcsinh((1.0 - critical) * inverse)
    return (jnp.arcsinh((cosine - critical) * inverse) + low) / (low + high)


def _alpha_place(alpha: Array, grain: float) -> Array:
    if grain:
        return jnp.arcsinh(alpha * (1.0 / grain)) * (1.0 / math.asinh(1.0 / grain))
    return 1.0 - jnp.log(clamp_min(alpha, LEAST_ALPHA)) * (1.0 / math.log(LEAST_ALPHA))


def cosine_of_place(place: np.ndarray, critical: np.ndarray, width: np.ndarray) -> np.ndarray:
    """The cosine at a place on its axis."""
    low, high = np.arcsinh(critical / width), np.arcsinh((1.0 - critical) / width)
    return critical + width * np.sinh(place * (low + high) - low)


def alpha_of_place(place: np.ndarray, grain: float) -> np.ndarray:
    """The width alpha at a place on its axis."""
    return grain * np.sinh(place * math.asinh(1.0 / grain)) if grain else LEAST_ALPHA ** (1.0 - place)


SHAPES: dict[str, Sequence[int]] = {
    "denser": (28, 16, 20),
    "thinner": (56, 24, 20),
    "mirror": (48, 24),
    "retained": (34, 20, 24),
}
"""Coefficients along the axes of each table: cosine, alpha, and index or critical cosine."""
