"""Random numbers of the walk: a counter-based hash, stateless but for a counter.

PCG4D (Jarzynski & Olano 2020, "Hash functions for GPU rendering", JCGT 9(3)) turns four 32-bit words into four. The
words are (counter, walker, key, key): every walker has its own stream of 2^32 blocks, and no stream overlaps
another. A block of four numbers costs a dozen integer products, which is a fraction of what threefry takes.
"""

import jax
import jax.numpy as jnp
from jax import Array

Words = tuple[Array, Array, Array, Array]


def pcg4d(x: Array, y: Array, z: Array, w: Array) -> Words:
    """Four hashed words of four words, all uint32."""
    x, y, z, w = (value * jnp.uint32(1664525) + jnp.uint32(1013904223) for value in (x, y, z, w))
    x, y, z, w = _mix(x, y, z, w)
    x, y, z, w = (value ^ (value >> jnp.uint32(16)) for value in (x, y, z, w))
    return _mix(x, y, z, w)


def key_words(key: Array) -> tuple[Array, Array]:
    """The two words that stand for a JAX key."""
    words = jax.random.bits(key, (2,), jnp.uint32)
    return words[0], words[1]


def uniforms(counter: Array, walker: Array, key: tuple[Array, Array], blocks: int, dtype: jnp.dtype) -> list[Array]:
    """4 * `blocks` numbers in (0, 1) for each walker, from its counter (which the caller raises by one a call).

    They are multiples of 2^-32 plus a half of that: never 0, so that a logarithm is finite, and at most 1 (which only
    rounding to float32 can reach).
    """
    scale = jnp.asarray(2.0**-32, dtype)
    half = jnp.asarray(2.0**-33, dtype)
    numbers: list[Array] = []
    for block in range(blocks):
        words = pcg4d(counter * jnp.uint32(blocks) + jnp.uint32(block), walker, *key)
        numbers += [word.astype(dtype) * scale + half for word in words]
    return numbers


def circle(u: Array) -> tuple[Array, Array]:
    """(cos 2 pi u, sin 2 pi u) for u in [0, 1], to a few units of rounding: a quarter turn is a polynomial.

    In float32 several times as fast as the general functions, whose arguments may be anything.
    """
    quarter = jnp.round(4.0 * u)
    x = (0.5 * jnp.pi) * (4.0 * u - quarter)  # in [-pi/4, pi/4]; the difference is exact
    squared = x * x
    terms = 9 if u.dtype == jnp.float64 else 5
    cosine, sine = jnp.ones_like(u), jnp.ones_like(u)
    for n in range(terms, 0, -1):
        cosine = 1.0 - squared * (1.0 / ((2 * n - 1) * (2 * n))) * cosine
        sine = 1.0 - squared * (1.0 / ((2 * n) * (2 * n + 1))) * sine
    sine = x * sine
    odd = (quarter == 1.0) | (quarter == 3.0)
    flipped_cosine, flipped_sine = (quarter == 1.0) | (quarter == 2.0), (quarter == 2.0) | (quarter == 3.0)
    c, s = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    return jnp.where(flipped_cosine, -c, c), jnp.where(flipped_sine, -s, s)


def _mix(x: Array, y: Array, z: Array, w: Array) -> Words:
    x = x + y * w
    y = y + z * x
    z = z + x * y
    w = w + y * z
    return x, y, z, w
