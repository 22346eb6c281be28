"""Walkers that stay busy: every walker takes a fixed number of paths and starts the next as soon as one ends.

All paths that are started are finished. Stopping after a number of steps and counting what is done by then would favour
short paths, by 3 % in a slab of optical depth 10.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from layerjax.channels import Channels
from layerjax.directions import Vector, select
from layerjax.transport.random_walk.random_numbers import key_words, uniforms
from layerjax.transport.random_walk.state import Step
from layerjax.transport.random_walk.walk import Walk

Tally = Callable[[Step], Channels]
"""What a step adds to its path's result, one number for each output."""

Record = Callable[[Any, Step, Array], Any]
"""Result with a step added, for the walkers that still have paths to take."""


def average(
    walk: Callable[..., Walk],
    tally: Tally,
    outputs: int,
    directions: tuple[Vector, ...],
    valid: Array,
    paths: int,
    batch_size: int,
    key: Array,
) -> tuple[Array, Array]:
    """Mean over paths of what is tallied, and its standard error, for each of n questions: shape (n, outputs) each.

    Args:
        walk: makes the walk from directions, one a walker.
        tally: what a step brings.
        directions: what the questions ask for.
        valid: questions of which the answer is not known to be 0.
        paths: number of paths for each question.
        batch_size: number of paths under way at a time, shared among the questions.
        key: JAX random key.
    """
    dtype, (n,) = directions[0][2].dtype, valid.shape
    if n == 0:
        return jnp.zeros((0, outputs), dtype), jnp.zeros((0, outputs), dtype)
    width = max(1, min(paths, batch_size // n))  # walkers for each question
    together = min(n, max(1, batch_size // width))  # questions at a time
    groups = math.ceil(n / together)
    padding = groups * together - n
    quota = quotas(paths, width)
    words = key_words(key)
    padded, valid_rows = jax.tree.map(lambda x: jnp.pad(x, (0, padding)), (directions, valid))
    known = tuple(replace_invalid(w, valid_rows) for w in padded)
    grouped = jax.tree.map(lambda x: x.reshape(groups, together), (known, valid_rows))

    def group(question: tuple[Array, Any]) -> tuple[Array, Array]:
        index, (vectors, is_valid) = question
        spread = jax.tree.map(lambda x: jnp.repeat(x, width), vectors)
        count = together * width
        walker = index.astype(jnp.uint32) * jnp.uint32(count) + jnp.arange(count, dtype=jnp.uint32)
        remaining = jnp.where(is_valid[:, None], quota, 0).reshape(-1)
        totals = _sums(walk(*spread), tally, outputs, walker, remaining, words, dtype)
        first, second = (jnp.stack(x, axis=-1).reshape(together, width, outputs).sum(axis=1) for x in totals)
        return first, second

    sums, squares = jax.lax.map(group, (jnp.arange(groups), grouped))
    mean = sums.reshape(-1, outputs)[:n] / paths
    return mean, standard_error(mean, squares.reshape(-1, outputs)[:n], paths)


def standard_error(mean: Array, squares: Array, paths: int) -> Array:
    """Standard error of a mean over paths, from it and the sum of squares."""
    return jnp.sqrt(jnp.maximum(squares / paths - mean * mean, 0.0) / (paths - 1))


def quotas(paths: int, batch_size: int) -> Array:
    """Paths that each walker takes, as even as can be."""
    return jnp.asarray([paths // batch_size + (j < paths % batch_size) for j in range(batch_size)], jnp.int32)


def replace_invalid(w: Vector, valid: Array) -> Vector:
    """w, with the normal standing in where it is not valid."""
    zero, one = jnp.zeros_like(w[2]), jnp.ones_like(w[2])
    return select(valid, w, (zero, zero, one))


def follow(
    walk: Walk,
    record: Record,
    result: Any,
    walker: Array,
    remaining: Array,
    words: tuple[Array, Array],
    dtype: jnp.dtype,
) -> Any:
    """Walk until all paths are taken; `result` with every step of each of them recorded.

    Args:
        walker: number of each walker, which no other walker of the key may have.
        remaining: paths that each has to take.
        words: the key, see `layerjax.transport.random_walk.random_numbers.key_words`.
    """

    def draw(counter: Array) -> list[Array]:
        # fusions would hash anew for every result that they make of the numbers
        return jax.lax.optimization_barrier(uniforms(counter, walker, words, walk.blocks, dtype))

    def step(carry: Any) -> Any:
        counter, state, remaining, result = carry
        u = draw(counter)
        state, outcome = walk.step(state, u)
        result = record(result, outcome, remaining > 0)
        state = jax.tree.map(lambda new, old: jnp.where(outcome.ends, new, old), walk.start(u[-1]), state)
        return counter + jnp.uint32(1), state, remaining - outcome.ends, result

    start = (jnp.uint32(1), walk.start(draw(jnp.uint32(0))[-1]), remaining, result)
    return jax.lax.while_loop(lambda carry: jnp.any(carry[2] > 0), step, start)[-1]


def kahan_add(running: tuple[Array, Array], more: Array) -> tuple[Array, Array]:
    """A running sum with more added, and what rounding has put too much into it (Kahan 1965), first (0, 0).

    Millions of terms are no more than a rounding off, where a plain sum in single precision stops growing. One in
    double precision, which is plain, does not.
    """
    total, excess = running
    if total.dtype == jnp.float64:
        return total + more, excess
    more = more - excess
    after = total + more
    return after, (after - total) - more


def _sums(
    walk: Walk,
    tally: Tally,
    outputs: int,
    walker: Array,
    remaining: Array,
    words: tuple[Array, Array],
    dtype: jnp.dtype,
) -> tuple[Channels, Channels]:
    """Sums over each walker's paths of what a path brings, and of its square."""

    def record(result: Any, step: Step, active: Array) -> Any:
        path, sums, squares = result
        path = tuple(a + b for a, b in zip(path, tally(step), strict=True))
        done = step.ends & active
        sums = tuple(kahan_add(s, jnp.where(done, p, 0.0)) for s, p in zip(sums, path, strict=True))
        squares = tuple(kahan_add(s, jnp.where(done, p * p, 0.0)) for s, p in zip(squares, path, strict=True))
        return tuple(jnp.where(step.ends, 0.0, p) for p in path), sums, squares

    zero = jnp.zeros(walker.shape, dtype)
    paths, none = (zero,) * outputs, ((zero, zero),) * outputs
    _, sums, squares = follow(walk, record, (paths, none, none), walker, remaining, words, dtype)
    return tuple(s for s, _ in sums), tuple(s for s, _ in squares)
