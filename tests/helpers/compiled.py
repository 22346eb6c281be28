"""Functions under test as one program for each shape, whose results a test goes on with in numpy."""

import jax
import numpy as np


def compiled(function):
    """The function under jit, its results numpy arrays: JAX would compile every operation on its own."""
    program = jax.jit(function)

    def run(*arguments):
        return jax.tree.map(np.asarray, program(*arguments))

    return run
