"""Reflection and transmission of a homogeneous slab by one symmetric eigenproblem, with its derivative in closed form.

With flux scaled by the root of solid angle times cosine, light going down and light going up obey the same pair of
equations, A = diag(sigma / mu) - G_t and B = G_r being symmetric (Stamnes & Swanson 1981; Nakajima & Tanaka 1986):
P = A + B and Q = A - B are positive, for |G| of any mode is at most G of the mean, which scatters no more than sigma.
With P = L L', L' Q L = V diag(lambda^2) V', U = L'^-1 V and H half the thickness,

    Y = U diag(lambda tanh(lambda H)) U',  Z = U diag(lambda coth(lambda H)) U',
    R = (1 + Y)^-1 + (1 + Z)^-1 - 1,  T = (1 + Y)^-1 - (1 + Z)^-1, the beam that passes untouched in it.

Y and Z are functions of Q P and P; their derivatives are divided differences of these functions, which need no
differences of eigenvalues (Daleckii & Krein 1965), so that equal eigenvalues do no harm.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import sequential_vmap

from layerjax._batching import chunk_factor
from layerjax._numerics import allow_broadcasting, clamp_min, horner
from layerjax.transport.adding_doubling.inverse import inverse

SMALL, TINY = 0.2, 1e-4
"""Below the first (both arguments) or the second (one of them) differences become series."""


class _Spectrum(NamedTuple):
    """What value and derivative are made of; x = lambda H, (..., n).

    even: (1 + Y)^-1. less: 1 - even, formed by itself. odd: (1 + Z)^-1, and divided by H.
    """

    half: Array
    root: Array
    x: Array
    vectors: Array
    inverse: Array
    even: Array
    less: Array
    odd_by_half: Array

    @property
    def both(self) -> tuple[Array, Array]:
        odd = self.half[..., None, None] * self.odd_by_half
        return odd - self.less, self.even - odd


@jax.custom_jvp
def slab(p: Array, q: Array, half: Array) -> tuple[Array, Array]:
    """R and T, (..., n, n), of a slab. To be differentiated once: second derivatives may be NaN.

    Args:
        p, q: sum and difference of A and B, (..., n, n): symmetric, p positive definite, q at least semidefinite.
        half: half the thickness, at least 0, of the same leading axes.
    """
    return _spectrum(p, q, half).both


@slab.defjvp
@allow_broadcasting
def _slab_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    found = _spectrum(*primals)
    dp, dq, dhalf = tangents
    in_p = _sandwich(_transpose(found.vectors), dp)
    in_q = _sandwich(found.inverse, dq)
    half, rate = found.half[..., None, None], dhalf[..., None]
    plus, minus, excess = _differences(found.x[..., :, None], found.x[..., None, :])
    mean, apart = 0.5 * half * (plus + minus), 0.5 * half * (minus - plus)
    coth = _x_coth(found.x)
    change_y = mean * in_q + _outer(found.root) * apart * in_p + _diagonal(found.root**2 * _sech2(found.x) * rate)
    change_z = half**3 * excess * in_q - _outer(coth) * mean * in_p - _diagonal(_x_csch(found.x) ** 2 * rate)
    even = -_sandwich(found.even @ found.vectors, change_y)
    odd = -_sandwich(found.odd_by_half @ found.vectors, change_z)
    return found.both, (even + odd, even - odd)


def _spectrum(p: Array, q: Array, half: Array) -> _Spectrum:
    lower, square, basis = _decompose(p, q)
    root = jnp.sqrt(clamp_min(square, 0.0))
    x = root * half[..., None]
    vectors = _transpose(inverse(lower)) @ basis
    one = jnp.eye(p.shape[-1], dtype=p.dtype)
    y = _scaled_square(vectors, root * jnp.tanh(x))
    even = inverse(one + y)
    odd_by_half = inverse(half[..., None, None] * one + _scaled_square(vectors, _x_coth(x)))
    return _Spectrum(half, root, x, vectors, _transpose(lower @ basis), even, y @ even, odd_by_half)


def _decompose(p: Array, q: Array) -> tuple[Array, Array, Array]:
    """L, lambda^2 and V for every matrix: on a processor one after the other, on a GPU all at once.

    Batched LAPACK kernels of jaxlib share the threads that XLA runs on, and two at a time may wait for each other for
    ever (seen with jaxlib 0.10.2 on two cores). On a GPU each took 0.4 ms by itself (H100).
    """
    if chunk_factor() > 1:
        return _decompose_batch(p, q)
    batch = jnp.broadcast_shapes(p.shape, q.shape)
    flat = [jnp.broadcast_to(part, batch).reshape(-1, *batch[-2:]) for part in (p, q)]
    found = jax.vmap(_decompose_one)(*flat)
    return tuple(part.reshape(*batch[:-2], *part.shape[1:]) for part in found)


def _decompose_batch(p: Array, q: Array) -> tuple[Array, Array, Array]:
    lower = jnp.linalg.cholesky(p)
    return lower, *jnp.linalg.eigh(_transpose(lower) @ q @ lower)


_decompose_one = sequential_vmap(_decompose_batch)


def _differences(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Divided differences of x tanh x and x coth x between a and b, both at least 0.

    (tanh a +- tanh b) / (a +- b); and (plus - minus) / (2 tanh a tanh b), which is 1/3 where both are 0.
    """
    sum_, difference = _tanhc(a + b), _tanhc(jnp.abs(a - b))
    ta, tb = jnp.tanh(a), jnp.tanh(b)
    product = ta * tb
    ea, eb = jnp.exp(-2.0 * a), jnp.exp(-2.0 * b)
    plus, minus = sum_ * (1.0 + product), difference * (2.0 * (ea + eb) / ((1.0 + ea) * (1.0 + eb)))
    # (tanhc(a + b) - tanhc(a - b)) / (tanh a tanh b)
    large, small = jnp.where(a > b, a, b), jnp.where(a > b, b, a)
    both, one = large < SMALL, small < TINY
    tame = jnp.where(both, 1.0, large)
    sloped = 2.0 * _tanhc_slope(tame) / jnp.tanh(tame)
    direct = (sum_ - difference) / jnp.where(one | both, 1.0, product)
    a2, b2 = (jnp.where(both, part, 0.0) ** 2 for part in (a, b))
    norm = _tanhc(jnp.sqrt(a2)) * _tanhc(jnp.sqrt(b2))
    terms = (
        -4.0 / 3.0
        + (16.0 / 15.0) * (a2 + b2)
        - (68.0 / 315.0) * (3.0 * a2 * a2 + 10.0 * a2 * b2 + 3.0 * b2 * b2)
        + (992.0 / 2835.0) * (a2 + b2) * (a2 * a2 + 6.0 * a2 * b2 + b2 * b2)
    )
    quotient = jnp.where(both, terms / norm, jnp.where(one, sloped, direct))
    return plus, minus, 0.5 * (quotient + sum_ + difference)


def _tanhc(x: Array) -> Array:
    """tanh(x) / x."""
    small = x < SMALL
    tame = jnp.where(small, 1.0, x)
    return jnp.where(small, _tanhc_series(jnp.where(small, x, 0.0) ** 2), jnp.tanh(tame) / tame)


def _tanhc_series(x2: Array) -> Array:
    return horner([1.0, -1 / 3, 2 / 15, -17 / 315, 62 / 2835, -1382 / 155925, 21844 / 6081075], x2)


def _tanhc_slope(x: Array) -> Array:
    """Derivative of tanh(x) / x, away from 0."""
    return (_sech2(x) - jnp.tanh(x) / x) / x


def _x_coth(x: Array) -> Array:
    return 1.0 / _tanhc(x)


def _sech2(x: Array) -> Array:
    decay = jnp.exp(-2.0 * x)
    return 4.0 * decay / (1.0 + decay) ** 2


def _x_csch(x: Array) -> Array:
    """x / sinh(x)."""
    small = x < SMALL
    tame = jnp.where(small, 1.0, x)
    series = 1.0 / horner([1.0, 1 / 6, 1 / 120, 1 / 5040, 1 / 362880], jnp.where(small, x, 0.0) ** 2)
    return jnp.where(small, series, 2.0 * tame * jnp.exp(-tame) / -jnp.expm1(-2.0 * tame))


def _sandwich(outer: Array, inner: Array) -> Array:
    return outer @ inner @ _transpose(outer)


def _scaled_square(vectors: Array, scale: Array) -> Array:
    return (vectors * scale[..., None, :]) @ _transpose(vectors)


def _outer(values: Array) -> Array:
    return values[..., :, None] * values[..., None, :]


def _diagonal(values: Array) -> Array:
    return values[..., None] * jnp.eye(values.shape[-1], dtype=values.dtype)


def _transpose(matrix: Array) -> Array:
    return jnp.swapaxes(matrix, -1, -2)
