"""Adding of energies and variances, element by element from the top (Belcour 2018, Sec. 5).

Energies are tuples by scattering order: entry k is the energy of the paths with k collisions in media, the last entry
that of all with as many or more; without scattering media there is one. Each entry has an array for every channel, or
one for all, as variances have: at one texel or cosine these are a few numbers, and side by side they stay in registers.
Variances are numbers, or tensors where facets have two widths (`variance_tensor`).

The printed equations are corrected: the factor J of Eq. 36 also multiplies the variance of the way down, and the series
is in sigma_23^R + sigma_21^R; J counts from the medium that a variance is in to the outside.
"""

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax import channels
from layerjax._numerics import clamp_max, clamp_min
from layerjax.channels import Channels, map_channels
from layerjax.transport.lobes.variance_tensor import Variance, Variances, limit_variance

Orders = tuple[Channels, ...]

LEAST_ESCAPE = 1e-6
"""Least share of the light between two elements that leaves at a turn."""

LEAST_ENERGY = 1e-12
"""Energy below which a mean of variances is not formed: squares of it are divided by in derivatives."""

MOST_VARIANCE = 1e8
"""Stands for all larger variances outside: a roughness of 1 but for 1e-8. Grazing light multiplies them without end."""

MOST_JACOBIAN = 1e15
"""Stands for all larger ones: the narrowest lobe inside has become the widest outside."""


class Element(NamedTuple):
    """An interface, a medium or a base.

    r12, t12: reflected and transmitted of what comes from above; r21, t21: of what comes from below. widening: variance
    that reflection adds (either side), down and up: transmission. jacobian: J_up, the variance on its upper side of a
    unit of it below.
    """

    r12: Orders
    t12: Orders
    r21: Orders
    t21: Orders
    widening: Variances
    down: Variances
    up: Variances
    jacobian: Channels


class UpperStatistics(NamedTuple):
    """What is known of all elements so far, seen as one.

    t0: energy transmitted down, ri: reflected back down, ti: transmitted up; s...: their variances, that of t0 and ri
    in the medium below, that of ti outside; jacobian: variance outside of a unit of it in the medium below.
    """

    t0: Orders
    ri: Orders
    ti: Orders
    s_t0: Variances
    s_ri: Variances
    s_ti: Variances
    jacobian: Channels


class Lobe(NamedTuple):
    """Energy and variance at the side where it leaves."""

    energy: Orders
    variance: Variances


def identity(cosine: Array) -> UpperStatistics:
    """No element at all."""
    zero, one = (jnp.zeros_like(cosine),), (jnp.ones_like(cosine),)
    return UpperStatistics((one,), (zero,), (one,), zero, zero, zero, one)


def add_element(above: UpperStatistics, element: Element) -> tuple[Lobe, UpperStatistics]:
    """The lobe that the element sends out of the top, and what is above its lower side."""
    between = multiply_orders(above.ri, element.r12)
    inverse = geometric_series(between)
    m = multiply_orders(above.t0, element.r12, above.ti, inverse)
    # mean number of further turns between the two, and the variance of them
    rr = map_channels(lambda turned: turned / clamp_min(1.0 - turned, LEAST_ESCAPE), sum_orders(between))
    turns = map_channels(lambda rr, w, s: rr * (w + s), rr, element.widening, above.s_ri)
    variance = map_channels(  # Eq. (36)
        lambda s_ti, j, s_t0, w, turns: limit_variance(s_ti + j * (s_t0 + w + turns), MOST_VARIANCE),
        above.s_ti, above.jacobian, above.s_t0, element.widening, turns,
    )  # fmt: skip
    s_t0 = map_channels(  # Eqs. (47-49)
        lambda j, s, turns, d: (s + turns) / j + d, element.jacobian, above.s_t0, turns, element.down
    )
    s_ti = map_channels(  # Eq. (50)
        lambda j, up, turns, s: limit_variance(j * (up + turns) + s, MOST_VARIANCE),
        above.jacobian, element.up, turns, above.s_ti,
    )  # fmt: skip
    back = multiply_orders(element.t21, above.ri, element.t12, inverse)
    through = map_channels(
        lambda d, j, up, s, turns: d + (up + s + turns) / j,
        element.down, element.jacobian, element.up, above.s_ri, turns,
    )  # fmt: skip
    s_ri = map_channels(_mean_variance, sum_orders(element.r21), sum_orders(back), element.widening, through)
    return Lobe(m, variance), UpperStatistics(
        t0=multiply_orders(above.t0, element.t12, inverse),  # Eq. (31)
        ri=add_orders(element.r21, back),  # Eq. (30)
        ti=multiply_orders(element.t21, above.ti, inverse),  # Eq. (29)
        s_t0=s_t0,
        s_ri=s_ri,
        s_ti=s_ti,
        jacobian=map_channels(lambda j, factor: clamp_max(j * factor, MOST_JACOBIAN), above.jacobian, element.jacobian),
    )


def _mean_variance(reflected: Array, crossed: Array, widening: Variance, through: Variance) -> Variance:
    """Eq. (51): of what the element itself reflects and of what comes back from above it."""
    total = reflected + crossed
    returns = total > LEAST_ENERGY  # where hardly any light does, its width is that of the element alone
    share = jnp.where(returns, crossed / jnp.where(returns, total, 1.0), 0.0)
    return widening + share * (through - widening)


def limit_escape(above: UpperStatistics, share: Channels) -> UpperStatistics:
    """Only this share (kappa, Eqs. 34-35) of the light from below gets out; the rest is totally reflected."""
    kept = tuple(map_channels(lambda energy, share: (1.0 - share) * energy, energy, share) for energy in above.ti)
    return above._replace(
        ri=add_orders(above.ri, kept), ti=tuple(channels.multiply(share, energy) for energy in above.ti)
    )


def sum_orders(energy: Orders) -> Channels:
    """The statistics of all orders together."""
    return channels.total(energy)


def add_orders(a: Orders, b: Orders) -> Orders:
    """Sum of energies by scattering orders; what has no more than one entry has not been scattered."""
    longer, shorter = (a, b) if len(a) >= len(b) else (b, a)
    return (*(channels.total(pair) for pair in zip(longer, shorter, strict=False)), *longer[len(shorter) :])


def multiply_orders(*factors: Orders) -> Orders:
    """Product of energies by scattering orders; the last entry takes all orders beyond it, so that sums multiply."""
    return reduce(_product, factors)


def _product(a: Orders, b: Orders) -> Orders:
    if len(a) == 1 or len(b) == 1:
        return tuple(channels.multiply(x, y) for x in a for y in b)
    last = len(a) - 1
    sums: list[list[Channels]] = [[] for _ in a]
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            sums[min(i + j, last)].append(channels.multiply(x, y))
    return tuple(channels.total(parts) for parts in sums)


def geometric_series(x: Orders) -> Orders:
    """1 + x + x^2 + ... by scattering orders."""
    first = map_channels(lambda x: 1.0 / clamp_min(1.0 - x, LEAST_ESCAPE), x[0])
    if len(x) == 1:
        return (first,)
    found = [first]
    for k in range(1, len(x) - 1):
        again = channels.total([channels.multiply(x[j], found[k - j]) for j in range(1, k + 1)])
        found.append(channels.multiply(first, again))
    rest = map_channels(
        lambda x, known: clamp_min(1.0 / clamp_min(1.0 - x, LEAST_ESCAPE) - known, 0.0),
        sum_orders(x),
        channels.total(found),
    )
    return (*found, rest)
