"""A factor of either direction that puts the energy of SpongeCake's second lobe right (beyond Wang et al. 2022).

The second lobe is multiplied by c(wi) c(wo), which keeps it reciprocal, with c a power of a polynomial of the
direction on either side,

    c = r^16,   r = sum a_k z^k + terms in cos and sin of the azimuth and of twice it, in proportion to sin and sin^2,

which is next to exp(16 (r - 1)), never negative, and costs no exponential.

Media without absorption tell what c has to be (`layerjax.precompute.spongecake.energy`); a network has learned it from
them (`layerjax.precompute.spongecake.energy_correction`). Where light is absorbed less of c counts: what absorbs
has errors of its own.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from layerjax._numerics import horner
from layerjax.channels import Channels, per_channel, pick
from layerjax.directions import Vector
from layerjax.stack import Medium
from layerjax.transport.spongecake.mapping import (
    GEOMETRY_FEATURES,
    Numbers,
    features_of_pairs,
    geometry,
    medium_of,
    orders,
    pair_features,
    perceptron,
    reorder,
    scattered_share,
)

POWER = 16
"""c is this power of a polynomial. Even: c is never negative; a power of two: four products make it."""

DEGREE = 3
"""Degree of the polynomial in the cosine."""

FADING = 4
"""Power of what survives a collision (in each medium) by which c - 1 fades."""

LARGEST = 3.0
"""Bound of what the network answers, `POWER` times coefficients of Legendre's polynomials: no factor overflows."""


class EnergyCorrection(eqx.Module):
    """c: coefficients of its root, as `polynomial` takes them, for light from above and below, (C or 1, 2 or 1, terms).

    One medium looks the same from opposite directions, and has one set. share: what counts of c - 1, (C or 1,).
    """

    coefficients: Array
    share: Array


def correction_share(media: tuple[Medium, ...]) -> Array:
    """Share of c - 1 that counts where light is absorbed, (C or 1,)."""
    share = jnp.ones(1)
    for medium in media:
        f0 = 1.0 if medium.f0 is None else medium.f0
        share = share * scattered_share(jnp.asarray(medium.albedo), jnp.asarray(f0)) ** FADING
    return share


def polynomial(coefficients: Array | Sequence[Array], w: Vector, opposite: bool) -> Array:
    """The polynomial of a direction, from one set of coefficients; `opposite`: the same for opposite directions."""
    x, y, z = w[0], w[1], jnp.abs(w[2])
    anisotropic = len(coefficients) > DEGREE + 1
    if anisotropic and opposite:
        above = w[2] > 0
        x, y = jnp.where(above, x, -x), jnp.where(above, y, -y)
    factors = [None, x, y, x * x - y * y, 2.0 * x * y] if anisotropic else [None]
    found, first = jnp.zeros_like(z), 0
    for factor, degree in zip(factors, _degrees(anisotropic), strict=True):
        part = horner(coefficients[first : first + degree + 1], z)
        found, first = part if factor is None else found + factor * part, first + degree + 1
    return found


def correction_network(media: int, key: Array) -> eqx.nn.MLP:
    """A network for so many media that has learned nothing yet: c is next to 1."""
    inputs = media * GEOMETRY_FEATURES + pair_features(media)
    return perceptron(inputs, DEGREE + 1 + media * _azimuthal_count(), key)


def coefficients_of(net: eqx.nn.MLP, media: Numbers, anisotropic: bool) -> Array:
    """Coefficients of the root of c, (2 or 1, terms), by the network. `anisotropic`: any of the media has an axis.

    Azimuths enter by invariants of direction and axis a alone: (w_h . a_h) a_z, and (w_h . a_h)^2 less its mean.
    """
    count = len(media.thickness)
    sides = []
    for side, order in zip((1.0, -1.0), orders(count), strict=False):
        turned = reorder(media, order)
        raw = net(
            jnp.concatenate([*(geometry(medium_of(turned, k)) for k in range(count)), *features_of_pairs(turned)])
        )
        raw = LARGEST / POWER * jnp.tanh(raw / LARGEST)
        level, azimuthal = raw[: DEGREE + 1], raw[DEGREE + 1 :].reshape(count, -1)
        parts = [_powers(level).at[0].add(1.0)]
        if anisotropic:
            once, twice = azimuthal[:, :DEGREE], azimuthal[:, DEGREE:]
            x, y, z = turned.axis[:, 0], turned.axis[:, 1], side * turned.axis[:, 2]
            flakes = 1.0 - turned.kind[:, 2]
            for turn, each in ((x * z, once), (y * z, once), (0.5 * (x * x - y * y), twice), (x * y, twice)):
                parts.append(_powers((flakes * turn) @ each))
        sides.append(jnp.concatenate(parts))
    return jnp.stack(sides)


def correction_factors(correction: EnergyCorrection, wi: Vector, wo: Vector, from_above: bool) -> Channels:
    """c of both directions, as far as it counts. from_above: both are above."""
    gains = tuple(
        (_root(sides, wi, from_above) * _root(sides, wo, from_above)) ** POWER for sides in correction.coefficients
    )
    shares = per_channel(correction.share)
    channels = max(len(gains), len(shares))
    return tuple(1.0 - pick(shares, c) + pick(shares, c) * pick(gains, c) for c in range(channels))


def _root(sides: Array, w: Vector, from_above: bool) -> Array:
    """Root of c of a direction, from its coefficients, (2 or 1, terms)."""
    if len(sides) == 1 or from_above:
        return polynomial(sides[0], w, not from_above)
    above = w[2] > 0
    return polynomial([jnp.where(above, high, low) for high, low in zip(*sides, strict=True)], w, False)


def term_count(anisotropic: bool) -> int:
    """How many coefficients the polynomial has for light from one side; `anisotropic`: any of the media has an axis."""
    return sum(degree + 1 for degree in _degrees(anisotropic))


def _degrees(anisotropic: bool) -> tuple[int, ...]:
    """Degrees of the polynomials that multiply azimuthal terms, that of the constant one first."""
    return (DEGREE, DEGREE - 1, DEGREE - 1, DEGREE - 2, DEGREE - 2) if anisotropic else (DEGREE,)


def _azimuthal_count() -> int:
    """Numbers of one medium that azimuthal terms are made of."""
    return DEGREE + DEGREE - 1


def _powers(values: Array) -> Array:
    """Coefficients of the powers of a cosine, from those of Legendre's polynomials over it."""
    rows = np.zeros((len(values), len(values)))
    for k in range(len(values)):
        legendre = np.polynomial.Legendre.basis(k, domain=[0.0, 1.0])
        rows[k, : k + 1] = legendre.convert(domain=[-1.0, 1.0], kind=np.polynomial.Polynomial).coef
    return values @ jnp.asarray(rows, values.dtype)
