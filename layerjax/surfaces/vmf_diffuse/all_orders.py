"""The rough diffuse surface with all orders of scattering between its flakes, energy conserved.

The surface is the half-space of one-sided Lambertian flakes with von Mises-Fisher normals of d'Eon & Weidlich 2024
("VMF Diffuse: A unified rough diffuse BRDF"), whose fits miss the energy by up to 14 %. Here the solution of
`layerjax.precompute.vmf_diffuse.half_space` is tabulated: with

    f = sigma_i sigma_o / (u_i e_o + u_o e_i) * sum_m G_m(u_i, u_o) (q_i q_o s_i s_o)^m cos(m phi)

the G_m are smooth in the cosines u however rough the surface is, if they are counted across the layer at grazing whose
width is that of the flakes. e and sigma resemble the flakes' areas (their mean over both sides, and that of the facing
side), s is the sine and q ~ alpha / u. Each G_m is a polynomial in both places, in the roughness, and in the albedo:
orders 1, 2 and 3 apart, and the rest in the root of 1 - c, whose branch point the roughness moves away from c = 1.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import clamp_min, safe_sqrt
from layerjax.channels import Channels
from layerjax.directions import Vector
from layerjax.surfaces.vmf_diffuse.flakes import POROUS, porous_concentration
from layerjax.tables import load

PLACES = 10
"""Chebyshev polynomials in the place of a cosine."""

MODES = (5, 3, 2)
"""Modes of the azimuth of orders 1, 2, 3; those of the first are all there are."""

REST = (8, 2)
"""Chebyshev polynomials in the albedo for the orders past the third, in modes 0 and 1."""

FORM_MODES = tuple(m for count in MODES for m in range(count)) + (0,) * REST[0] + (1,) * REST[1]
"""The mode that each tabulated form (orders 1, 2, 3, the rest by mode) belongs to."""

_WIDTH_SQUARED = 0.25 * np.pi  # where sigma(0) of narrow flakes, alpha / (2 sqrt(pi)), would reach the 1/4 of wide ones


def all_orders_brdf(wi: Vector, wo: Vector, albedo: Channels, roughness: Array) -> tuple[Array, ...]:
    """BRDF of a half-space of Lambertian flakes, 1/sr, without the cosine, one array a channel.

    Errors against the half-space, for all roughnesses and cosines down to 1e-6: directional albedo 0.25 %, so that at
    albedo 1 it lies within 0.25 % of 1; root mean square over the projected hemispheres 0.25 %; single values 3 % where
    both cosines are above 0.1. They fall with roughness, to 0.05 % at 0.1 (single values 1.6 %). Modes cancel where
    light is scattered forward at grazing, and what they leave below 0 is cut off. Reciprocal to rounding.

    At roughness 0 it is albedo / pi. Towards roughness 1 the derivative with respect to roughness would grow without
    bound; it ends within 1e-6 (see `layerjax.surfaces.vmf_diffuse.flakes.concentration`). That with respect to albedo
    is infinite where both are 1, and ends at 1e6.

    Args:
        wi, wo: unit directions with z > 0.
        albedo: scalars in [0, 1], of a flake.
        roughness: scalar in [0, 1]; the flakes' width is alpha = -log(1 - sqrt(r)). What depends on it and on the
            albedo alone is worked out once for all directions.
    """
    spread = flake_spread(roughness)
    return _evaluate(wi, wo, _modes(albedo, spread), spread)


def flake_spread(roughness: Array) -> Array:
    """t = alpha^2 / (alpha^2 + pi/4) in [0, 1]: even in alpha at 0, smooth in kappa = 2 / alpha^2 at 0."""
    root, near_one = safe_sqrt(roughness), roughness > POROUS
    small = root < 1e-3
    tame = jnp.where(small | near_one, 0.25, roughness)
    inner = jnp.sqrt(tame)
    slope = jnp.where(small, 1.0 + root * (0.5 + root / 3.0), (jnp.log1p(inner) - jnp.log1p(-tame)) / inner)
    squared = roughness * slope * slope  # alpha^2
    porous = 1.0 / (1.0 + 0.5 * _WIDTH_SQUARED * porous_concentration(roughness))
    return jnp.where(near_one, porous, squared / (squared + _WIDTH_SQUARED))


def flake_areas(cosine: Array, spread: Array) -> tuple[Array, Array]:
    """Stand-ins for (sigma(u) + sigma(-u)) / 2 and sigma(u), exact at u = 0 for narrow and wide flakes."""
    lean = 0.5 * (1.0 - spread) * cosine
    mean = jnp.sqrt(0.0625 * spread + lean * lean)
    return mean, mean + lean


def layer_place(cosine: Array, spread: Array) -> tuple[Array, Array]:
    """Place u sqrt(1 + a^2) / sqrt(u^2 + a^2) in [0, 1] across the layer at grazing, and q^2 / t, smooth at t = 0.

    a = alpha, t the spread, and q^2 = a^2 / (u^2 + a^2).
    """
    wide = _WIDTH_SQUARED * spread
    inverse = 1.0 / ((1.0 - spread) * cosine * cosine + wide)
    return cosine * jnp.sqrt((1.0 - spread + wide) * inverse), _WIDTH_SQUARED * inverse


def chebyshev(x: Array, count: int) -> Array:
    """T_0 to T_(count - 1) at 2 x - 1, along a new first axis."""
    x = 2.0 * x - 1.0
    values = [jnp.ones_like(x), x]
    for _ in range(count - 2):
        values.append(2.0 * x * values[-1] - values[-2])
    return jnp.stack(values[:count])


def albedo_place(albedo: Array, spread: Array) -> Array:
    """Place in [0, 1] of an albedo c, 0 at c = 1: linear in sqrt(1 - c + d^2)."""
    drift = albedo_drift(spread)
    squared = drift * drift
    return (jnp.sqrt((1.0 - albedo) + squared + 1e-12) - drift) / (jnp.sqrt(1.0 + squared) - drift)


def albedo_drift(spread: Array) -> Array:
    """d, where the branch point is c = 1 + d^2: near int D u dm for wide flakes, by which light drifts outwards."""
    narrow = 1.0 - spread
    return 0.849 * narrow * (1.0 + 3.2 * narrow * narrow)


def form_weights(albedo: Array, spread: Array) -> Array:
    """Weights (forms,) of the tabulated forms in the BRDF at one albedo."""
    squared = albedo * albedo
    rest = squared * squared * chebyshev(albedo_place(albedo, spread), max(REST))
    powers = [jnp.broadcast_to(c, (n,)) for c, n in zip((albedo, squared, albedo * squared), MODES, strict=True)]
    return jnp.concatenate([*powers, *(rest[:n] for n in REST)])


def _modes(albedo: Channels, spread: Array) -> Array:
    """Coefficients (channel, mode, place, place) of the G_m of a material, with pi and the 2 of modes m > 0."""
    table, select = _table()
    forms = jnp.tensordot(chebyshev(spread, len(table)), jnp.asarray(table, spread.dtype), 1, precision="highest")
    weights = jnp.stack([form_weights(c, spread) for c in albedo])
    chosen = weights[:, None] * jnp.asarray(select, weights.dtype)
    return jnp.tensordot(chosen, forms, 1, precision="highest")


@functools.cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (roughness, form, place, place), and which form belongs to which mode (mode, form)."""
    packed = load("vmf_diffuse")["forms"]
    table = np.zeros((*packed.shape[:2], PLACES, PLACES), packed.dtype)
    row, column = np.triu_indices(PLACES)
    table[..., row, column] = table[..., column, row] = packed
    return table, np.asarray(FORM_MODES) == np.arange(MODES[0])[:, None]


def _evaluate(wi: Vector, wo: Vector, modes: Array, spread: Array) -> tuple[Array, ...]:
    ui, uo = jnp.broadcast_arrays(wi[2], wo[2])
    (mean_i, facing_i), (mean_o, facing_o) = flake_areas(ui, spread), flake_areas(uo, spread)
    (place_i, narrow_i), (place_o, narrow_o) = layer_place(ui, spread), layer_place(uo, spread)
    halves = jnp.einsum("cmjk,k...->cmj...", modes, chebyshev(place_o, PLACES), precision="highest")
    smooth = jnp.sum(halves * chebyshev(place_i, PLACES), axis=2)  # G_m
    # (q q s s)^m cos(m phi) without the azimuth
    narrow = spread * jnp.sqrt(narrow_i * narrow_o)
    squared = narrow * narrow * (wi[0] * wi[0] + wi[1] * wi[1]) * (wo[0] * wo[0] + wo[1] * wo[1])
    along = narrow * (wi[0] * wo[0] + wi[1] * wo[1])
    cosines = [jnp.ones_like(ui), along]
    for _ in range(MODES[0] - 2):
        cosines.append(2.0 * along * cosines[-1] - squared * cosines[-2])
    ratio = facing_i * facing_o / (ui * mean_o + uo * mean_i)
    # mode by mode: the places may have fewer azimuths than the directions
    shapes = [sum((g * turn for g, turn in zip(each, cosines, strict=True)), jnp.zeros_like(along)) for each in smooth]
    return tuple(clamp_min(ratio * shape, 0.0) for shape in shapes)
