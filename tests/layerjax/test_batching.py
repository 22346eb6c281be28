"""Chunks of large batches: as many rows as there are, in loops that vectors of the processor divide."""

import jax.numpy as jnp
import numpy as np
import pytest

from layerjax._batching import VECTOR_WIDTH, even_chunks, map_row_chunks


@pytest.mark.parametrize("count", [0, 1, 2, 17, 255, 4_099, 500_000, 1_000_003])
@pytest.mark.parametrize("chunks", [1, 2, 7, 245])
def test_chunks_hold_all_rows_in_whole_vectors(count: int, chunks: int) -> None:
    number, rows = even_chunks(count, chunks)
    assert number <= chunks
    assert count <= number * rows < count + max(1, rows)
    if count / chunks > VECTOR_WIDTH**2:
        assert rows % VECTOR_WIDTH == 0
        assert rows < count / chunks + VECTOR_WIDTH


@pytest.mark.parametrize("count", [0, 1, 3, 1_000])
@pytest.mark.parametrize("chunks", [1, 3])
def test_rows_are_those_of_the_function(count: int, chunks: int) -> None:
    rows = {"a": jnp.arange(float(count)), "b": jnp.arange(2.0 * count).reshape(count, 2)}
    found = map_row_chunks(lambda row: row["a"][:, None] + row["b"], rows, chunks)
    np.testing.assert_array_equal(found, rows["a"][:, None] + rows["b"])
