"""Inverses of batches of small matrices, by products alone.

LAPACK's triangular solves start threads for matrices of any size, and then spend most of the time on that (up to forty
times as long where other work runs on the machine). None of these needs pivoting: 1 - A, where A is a round trip of
light between two layers, is an M-matrix or bounded by one; others are triangular or positive definite.
"""

import jax
import jax.numpy as jnp
from jax import Array

from layerjax._numerics import allow_broadcasting

BLOCK = 8
"""Rows that are eliminated together: the rest is a matrix product."""


def inverse_of_one_minus(a: Array) -> Array:
    """(1 - A)^-1 for A of shape (..., n, n)."""
    return inverse(jnp.eye(a.shape[-1], dtype=a.dtype) - a)


@jax.custom_jvp
def inverse(matrix: Array) -> Array:
    """Inverse of (..., n, n) matrices that need no pivoting: M-matrices, positive definite or triangular ones."""
    n = matrix.shape[-1]
    missing = -n % BLOCK
    batch = matrix.shape[:-2]
    padded = jnp.pad(matrix.reshape(-1, n, n), ((0, 0), (0, missing), (0, missing)))
    padded = padded + jnp.diag((jnp.arange(n + missing) >= n).astype(matrix.dtype))
    result = jax.lax.fori_loop(0, (n + missing) // BLOCK, _eliminate_block, padded)
    return result[:, :n, :n].reshape(*batch, n, n)


@inverse.defjvp
@allow_broadcasting
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    result = inverse(*primals)
    return result, -result @ tangents[0] @ result


def _eliminate_block(index: Array, matrix: Array) -> Array:
    """One round of Gauss-Jordan: the block's rows and columns become those of the inverse."""
    start = index * BLOCK
    slice_of = jax.lax.dynamic_slice_in_dim
    here = jnp.arange(matrix.shape[-1]) // BLOCK == index
    rows, columns = slice_of(matrix, start, BLOCK, axis=1), slice_of(matrix, start, BLOCK, axis=2)
    pivot = _inverse_of_block(slice_of(rows, start, BLOCK, axis=2))
    spread = jnp.tile(pivot, (1, 1, matrix.shape[-1] // BLOCK))  # the pivot, where its columns are
    rows = jnp.where(here, spread, pivot @ rows)
    rest = jnp.where(here, 0.0, matrix) - columns @ rows
    return jnp.where(here[:, None], jnp.tile(rows, (1, matrix.shape[-1] // BLOCK, 1)), rest)


def _inverse_of_block(matrix: Array) -> Array:
    def eliminate(k: Array, matrix: Array) -> Array:
        row = jax.lax.dynamic_slice_in_dim(matrix, k, 1, axis=1)
        column = jax.lax.dynamic_slice_in_dim(matrix, k, 1, axis=2)
        pivot = 1.0 / jax.lax.dynamic_slice_in_dim(row, k, 1, axis=2)
        here = jnp.arange(BLOCK) == k
        row = jnp.where(here, pivot, pivot * row)
        matrix = jnp.where(here, 0.0, matrix) - column * row
        return jnp.where(here[:, None], row, matrix)

    return jax.lax.fori_loop(0, BLOCK, eliminate, matrix)
