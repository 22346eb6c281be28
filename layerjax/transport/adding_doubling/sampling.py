"""Kernels known at points only: their Fourier modes at the nodes, and what they scatter put right.

A lobe as narrow as the spacing of the nodes has the wrong energy when sampled at them. The energy is known otherwise (a
collision scatters sigma, a face its albedo), so the kernel is scaled to it. A mirror sends nodes to nodes, and becomes
just that in the limit of a narrow lobe.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._batching import map_row_chunks
from layerjax._numerics import clamp_min, safe_div
from layerjax.directions import Vector
from layerjax.transport.adding_doubling.grid import Region

LEAST_SAMPLES = 96
"""Azimuths, over half a turn, at which a kernel is sampled at least."""

GRADING = 3
"""Power of the place, from 0 to 1, that azimuths go with where they are dense about the plane of incidence."""

SQUEEZE, GRAZING_SAMPLES = 4.0, 3
"""Of azimuths behind a smooth interface: how many times denser they are about the plane of incidence than on average,
and how many there are at least for each mode.

Facets of width alpha mirror light into azimuths of 2 alpha cot(theta): at grazing light a lobe is narrower than any
azimuths are apart, and behind a smooth interface all of this light is totally reflected, and meets the metal again.
Index 1.64 over alpha 0.12, 32 modes: 96 azimuths at equal distances, 3e-4 at any number of nodes; squeezed, 2e-6. Index
1.5 over alpha 0.05, 96 modes: 192 at equal distances, 9e-3; 288 squeezed, 4e-5.
"""

MOST_ENTRIES = 1 << 18
"""Numbers that an array of kernels at azimuths holds at most."""

UNROLLED = 8
"""Up to so many modes in a row, more in a loop."""

BALANCING = 5
"""Rounds of `balance`; what is left after them is ballistic."""


def azimuths(modes: int) -> int:
    """Over half a turn, at which a kernel is sampled."""
    return max(2 * modes, LEAST_SAMPLES)


def modes_at_nodes(
    function: Callable[[Vector, Vector], Sequence[Array]],
    into: Region,
    out: Region,
    modes: int,
    *,
    has_mirror_lobe: bool = False,
    grazing: bool = False,
) -> list[Array]:
    """Mean over azimuth of values(wi, wo) cos(m phi), (modes, out, in), for each array that the function returns.

    phi is the azimuth between the directions of travel. wi and wo are given above the horizon.

    has_mirror_lobe: the mean alone is taken at azimuths that are dense about the plane of incidence. At equal distances
    a narrow lobe would be met beside its middle alone, and would send light of one node to others that are closer than
    azimuths are: by a metal under a coat of alpha 1e-4 past the critical angle, a tenth of what comes in at 80 degrees.
    grazing: so are the other modes, see `SQUEEZE`.
    """
    if has_mirror_lobe and modes == 1:
        phi, weight = _graded_azimuths()
    elif grazing:
        phi, weight = _squeezed_azimuths(modes)
    else:
        phi, weight = _equal_azimuths(azimuths(modes))
    samples = phi.size
    dtype = into.cosine.dtype
    cosines = jnp.asarray(np.cos(np.outer(phi, np.arange(modes))) * weight[:, None], dtype)
    mu_i, sin_i = into.cosine[None, :, None], into.sine[None, :, None]
    wi: Vector = (-sin_i, jnp.zeros_like(mu_i), mu_i)

    def of_rows(rows: tuple[Array, Array]) -> list[Array]:
        mu_o, sin_o = (row[:, None, None] for row in rows)
        wo: Vector = (sin_o * jnp.asarray(np.cos(phi), dtype), sin_o * jnp.asarray(np.sin(phi), dtype), mu_o)
        shape = (mu_o.shape[0], mu_i.shape[1], samples)
        return [jnp.broadcast_to(value, shape) @ cosines for value in function(wi, wo)]

    chunks = out.cosine.size * into.cosine.size * samples // MOST_ENTRIES
    rows = out.cosine, out.sine
    return [
        jnp.moveaxis(found, -1, 0) for found in (map_row_chunks(of_rows, rows, chunks) if chunks > 1 else of_rows(rows))
    ]


def _equal_azimuths(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths over half a turn, and their weights, whose sum is 1."""
    return np.pi * ((np.arange(samples) + 0.5) / samples), np.full(samples, 1.0 / samples)


def _graded_azimuths() -> tuple[np.ndarray, np.ndarray]:
    """The same with a power of the place."""
    place = (np.arange(LEAST_SAMPLES) + 0.5) / LEAST_SAMPLES
    return np.pi * place**GRADING, GRADING * place ** (GRADING - 1) / LEAST_SAMPLES


def _squeezed_azimuths(modes: int) -> tuple[np.ndarray, np.ndarray]:
    """The same by a Moebius map, which squeezes tan(phi / 2): sums of periodic functions stay as exact."""
    samples = max(GRAZING_SAMPLES * modes, LEAST_SAMPLES)
    even, weight = _equal_azimuths(samples)
    sine, cosine = np.sin(0.5 * even) / SQUEEZE, np.cos(0.5 * even)
    return 2.0 * np.arctan2(sine, cosine), weight / SQUEEZE / (sine**2 + cosine**2)


def cosines(x: Array, count: int) -> Array:
    """cos(m phi) for m below `count`, along a new first axis, from x = cos(phi) (Chebyshev polynomials)."""

    def step(pair: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        before, last = pair
        return (last, 2.0 * x * last - before), before

    if count <= UNROLLED:
        waves = [jnp.ones_like(x), x]
        while len(waves) < count:
            waves.append(2.0 * x * waves[-1] - waves[-2])
        return jnp.stack(waves[:count])
    return jax.lax.scan(step, (jnp.ones_like(x), x), None, length=count)[1]


def balance(
    kernels: Sequence[tuple[Array, Callable[[Array], Array]]], weight: Array, energy: Array
) -> tuple[Array, Array]:
    """Factors d, (nodes,), for which sum d_i K_ij d_j scatters `energy` when summed with `weight`; and what is missing.

    Scaling both sides by the same factors keeps a kernel reciprocal and its lobes where they are. With each kernel goes
    the function that takes d to the factors of its outgoing directions.
    """

    def scattered(scale: Array) -> Array:
        parts = [(weight * out(scale)) @ kernel for kernel, out in kernels]
        return scale * sum(parts[1:], parts[0])

    exists = (energy > 0) & (weight > 0)

    def better(scale: Array, _: None) -> tuple[Array, None]:
        ratio = safe_div(energy, clamp_min(scattered(scale), 1e-3 * energy))
        return jnp.where(exists, scale * jnp.sqrt(jnp.where(exists, ratio, 1.0)), 1.0), None

    scale, _ = jax.lax.scan(better, jnp.ones_like(energy), None, length=BALANCING)
    return scale, jnp.where(exists, energy - scattered(scale), 0.0)


def ballistic_share(missing: Array, weight: Array) -> Array:
    """The kernel that sends this energy on at the same angles: a delta, the same in all modes."""
    return jnp.diag(safe_div(missing, weight))


def scale_to_energy(region: Region, kernel: Array, energy: Array) -> Array:
    """Flux operator of a face from its BRDF at the nodes and its albedo, which decides."""
    weight = projected_weight(region)
    scale, missing = balance([(kernel[0], lambda d: d)], weight, jnp.where(region.weight > 0, energy, 0.0))
    return weight[:, None] * (scale[:, None] * kernel * scale + ballistic_share(missing, weight))


def projected_weight(region: Region) -> Array:
    """Weight of the measure cos dw over nodes and azimuth, in the region's own solid angle."""
    return 2.0 * jnp.pi * region.solid * region.cosine
