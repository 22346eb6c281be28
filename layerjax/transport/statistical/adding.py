"""Adding of energies and variances, element by element from the top (Belcour 2018, Sec. 5).

Energies carry a leading axis of scattering orders: entry k is the energy of the paths with k collisions in media, the
last entry that of all with as many or more. Without scattering media its length is 1.

The printed equations are corrected: the factor J of Eq. 36 also multiplies the variance of the way down, and the series
is in sigma_23^R + sigma_21^R; J counts from the medium that a variance is in to the outside.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from layerjax._numerics import at_least

LEAST_ESCAPE = 1e-6
"""Of light between two elements, the share that stands for all smaller ones to leave at a turn."""

LEAST_ENERGY = 1e-12
"""Energy below which a mean of variances is not formed: squares of it are divided by in derivatives."""


class Element(NamedTuple):
    """An interface, a medium or a base. Energies (orders, C or 1, n), variances (C or 1, n), for n directions.

    r12, t12: reflected and transmitted of what comes from above; r21, t21: of what comes from below. widening: variance
    that reflection adds (either side), down and up: transmission. jacobian: J_up, the variance on its upper side of a
    unit of it below.
    """

    r12: Array
    t12: Array
    r21: Array
    t21: Array
    widening: Array
    down: Array
    up: Array
    jacobian: Array


class Above(NamedTuple):
    """What is known of all elements so far, seen as one.

    t0: energy transmitted down, ri: reflected back down, ti: transmitted up; s...: their variances, that of t0 and ri
    in the medium below, that of ti outside; jacobian: variance outside of a unit of it in the medium below.
    """

    t0: Array
    ri: Array
    ti: Array
    s_t0: Array
    s_ri: Array
    s_ti: Array
    jacobian: Array


class Lobe(NamedTuple):
    """Energy by scattering orders (orders, C or 1, n) and variance (C or 1, n), at the side where it leaves."""

    energy: Array
    variance: Array


def nothing(cosine: Array) -> Above:
    """No element at all, for directions of shape (n,)."""
    zero = jnp.zeros_like(cosine)[None]
    one = jnp.ones_like(cosine)[None]
    return Above(one[None], zero[None], one[None], zero, zero, zero, one)


def add_element(above: Above, element: Element) -> tuple[Lobe, Above]:
    """The lobe that the element sends out of the top, and what is above its lower side."""
    between = times(above.ri, element.r12)
    inverse = escapes(between)
    m = times(times(times(above.t0, element.r12), above.ti), inverse)
    # mean number of further turns between the two, and the variance of them
    turned = jnp.sum(between, axis=0)
    rr = turned / at_least(1.0 - turned, LEAST_ESCAPE)
    turns = rr * (element.widening + above.s_ri)
    lobe = Lobe(m, above.s_ti + above.jacobian * (above.s_t0 + element.widening + turns))  # Eq. (36)

    down = 1.0 / element.jacobian
    s_t0 = down * (above.s_t0 + turns) + element.down  # Eqs. (47-49)
    s_ti = above.jacobian * (element.up + turns) + above.s_ti  # Eq. (50)
    back = times(times(times(element.t21, above.ri), element.t12), inverse)
    r21, crossed = jnp.sum(element.r21, axis=0), jnp.sum(back, axis=0)
    through = element.down + down * (element.up + above.s_ri + turns)
    total = r21 + crossed
    returns = total > LEAST_ENERGY  # where hardly any light does, its width is that of the element alone
    share = jnp.where(returns, crossed / jnp.where(returns, total, 1.0), 0.0)
    mean = element.widening + share * (through - element.widening)  # Eq. (51)
    return lobe, Above(
        t0=times(times(above.t0, element.t12), inverse),  # Eq. (31)
        ri=plus(element.r21, back),  # Eq. (30)
        ti=times(times(element.t21, above.ti), inverse),  # Eq. (29)
        s_t0=s_t0,
        s_ri=mean,
        s_ti=s_ti,
        jacobian=above.jacobian * element.jacobian,
    )


def retain(above: Above, share: Array) -> Above:
    """Only this share (kappa, Eqs. 34-35) of the light from below gets out; the rest is totally reflected."""
    return above._replace(ri=plus(above.ri, (1.0 - share) * above.ti), ti=share * above.ti)


def plus(a: Array, b: Array) -> Array:
    """Sum of energies by scattering orders; what has no more than one entry has not been scattered."""
    if a.shape[0] < b.shape[0]:
        a, b = b, a
    if b.shape[0] < a.shape[0]:
        b = jnp.concatenate([b, jnp.zeros((a.shape[0] - b.shape[0], *b.shape[1:]), b.dtype)])
    return a + b


def times(a: Array, b: Array) -> Array:
    """Product of energies by scattering orders; the last entry takes all orders beyond it, so that sums multiply."""
    if a.shape[0] == 1 or b.shape[0] == 1:
        return a * b
    count = a.shape[0]
    found = []
    for k in range(count - 1):
        found.append(sum((a[j] * b[k - j] for j in range(k + 1)), jnp.zeros_like(a[0] * b[0])))
    rest = jnp.zeros_like(found[0])
    for i in range(count):
        for j in range(max(0, count - 1 - i), count):
            rest = rest + a[i] * b[j]
    return jnp.stack([*found, rest])


def escapes(x: Array) -> Array:
    """1 + x + x^2 + ... by scattering orders."""
    first = 1.0 / at_least(1.0 - x[0], LEAST_ESCAPE)
    if x.shape[0] == 1:
        return first[None]
    found = [first]
    for k in range(1, x.shape[0] - 1):
        found.append(first * sum((x[j] * found[k - j] for j in range(1, k + 1)), jnp.zeros_like(first)))
    total = 1.0 / at_least(1.0 - jnp.sum(x, axis=0), LEAST_ESCAPE)
    return jnp.stack([*found, at_least(total - sum(found[1:], first), 0.0)])
