"""The generator of the walk: uniform, independent between draws and between walkers, the same for the same key."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from layerjax.transport.random_walk.random_numbers import circle, key_words, pcg4d, uniforms

SIGNIFICANCE = 1e-4


def stream(seed, walkers, draws, blocks=1, dtype=np.float64):
    """Numbers of shape (draws, 4 blocks, walkers)."""
    words = key_words(jax.random.key(seed))
    walker = jnp.arange(walkers, dtype=jnp.uint32)

    def one(counter):
        return jnp.stack(uniforms(counter, walker, words, blocks, jnp.dtype(dtype)))

    return np.asarray(jax.lax.map(one, jnp.arange(draws, dtype=jnp.uint32)))


def chi_square(counts):
    return scipy.stats.chisquare(np.ravel(counts)).pvalue


def test_the_published_hash():
    # Jarzynski & Olano 2020, listing of pcg4d, in plain integers
    v = [1, 2, 3, 4]
    v = [(x * 1664525 + 1013904223) % 2**32 for x in v]
    for turn in range(2):
        for a, b, c in ((0, 1, 3), (1, 2, 0), (2, 0, 1), (3, 1, 2)):
            v[a] = (v[a] + v[b] * v[c]) % 2**32
        if turn == 0:
            v = [x ^ (x >> 16) for x in v]
    assert [int(x) for x in pcg4d(*(jnp.uint32(x) for x in (1, 2, 3, 4)))] == v


@pytest.mark.parametrize("blocks", [1, 2])
def test_uniform_and_independent(blocks):
    u = stream(3, 512, 400, blocks)
    bins = 64
    for number in np.moveaxis(u, 1, 0):
        assert chi_square(np.bincount((number.ravel() * bins).astype(int), minlength=bins)) > SIGNIFICANCE

    def pairs(a, b):
        cells = (a.ravel() * 32).astype(int) * 32 + (b.ravel() * 32).astype(int)
        assert chi_square(np.bincount(cells, minlength=1024)) > SIGNIFICANCE

    pairs(u[:, 0], u[:, 1])  # numbers of one draw
    pairs(u[:, -2], u[:, -1])
    pairs(u[:-1, -1], u[1:, 0])  # the next draw
    for shift in (1, 2, 256):  # other walkers
        pairs(u[..., :-shift], u[..., shift:])
    # every walker and every draw has the right mean: none is stuck
    for axis in (0, 2):
        mean = u.mean(axis=(axis, 1))
        z = (mean - 0.5) * np.sqrt(12 * u.shape[axis] * u.shape[1])
        assert scipy.stats.kstest(z, "norm").pvalue > SIGNIFICANCE


def test_range():
    for dtype in (np.float32, np.float64):
        u = stream(1, 1024, 200, dtype=dtype)
        assert u.dtype == dtype
        assert u.min() > 0
        assert u.max() <= 1
    # the ends of what a word can be
    words = np.asarray([0, 2**32 - 1], np.uint32)
    ends = words.astype(np.float64) * 2.0**-32 + 2.0**-33
    assert 0 < ends[0] < 1e-9
    assert 1 - 1e-9 < ends[1] < 1


def test_keys():
    assert (stream(1, 16, 4) == stream(1, 16, 4)).all()
    assert not (stream(1, 16, 4) == stream(2, 16, 4)).any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_of_the_circle(dtype):
    u = np.linspace(0, 1, 4001).astype(dtype)
    turn = 2 * np.pi * u.astype(np.float64)
    for found, expected in zip(circle(jnp.asarray(u)), (np.cos(turn), np.sin(turn)), strict=True):
        assert found.dtype == dtype
        np.testing.assert_allclose(found, expected, atol=4 * np.finfo(dtype).eps)
