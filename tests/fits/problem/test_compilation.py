"""Compiled programs run by themselves, whatever other libraries do with threads."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg  # noqa: F401 (what JAX's matrices are solved by)
from jax.experimental import io_callback
from threadpoolctl import threadpool_info, threadpool_limits

from fits.problem import compilation
from fits.problem.compilation import Static, one_thread, run


def threads() -> set[int]:
    """Of the libraries by which matrices are solved."""
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def most(model: tuple[()]) -> jax.Array:
    return io_callback(lambda: np.int32(max(threads())), jax.ShapeDtypeStruct((), jnp.int32))


def test_matrices_are_solved_by_one_thread_and_the_others_come_back_after_the_last_call() -> None:
    arrays, static = eqx.partition((), eqx.is_array)
    with threadpool_limits(2), ThreadPoolExecutor(2) as pool:
        program = (arrays, Static(static))
        assert int(run(most, program)) == 1
        assert [int(seen) for seen in pool.map(lambda _: run(most, program), range(4))] == [1] * 4
        assert threads() == {2}
    first, second = one_thread(), one_thread()
    with threadpool_limits(2):
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert threads() == {1}
        second.__exit__(None, None, None)
        assert threads() == {2}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="counts maps")
@pytest.mark.parametrize(("full", "traced"), [(0.0, 2), (1.0, 1)])
def test_programs_go_where_a_process_has_no_room_for_more(monkeypatch, full: float, traced: int) -> None:
    monkeypatch.setattr(compilation, "FULL", full)
    seen = []

    @jax.jit
    def program(x):
        seen.append(x)
        return 2.0 * x

    program(1.0)
    compilation.make_room()
    program(1.0)
    assert len(seen) == traced
