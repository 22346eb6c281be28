"""Numbers that are known before a program is compiled, though they are traced."""

from typing import Any

import jax
import numpy as np


def concrete_values(value: Any) -> np.ndarray | None:
    """The numbers that a leaf holds; None if it is traced and nothing is known of it yet, as under ``jit``.

    Of what `grad` and its like differentiate outside of ``jit``, the primal; under `vmap` the whole batch.
    """
    while isinstance(value, jax.core.Tracer):
        inner = getattr(value, "primal", None)
        value = getattr(value, "val", None) if inner is None else inner
    # what holds the value of a tracer under jit is a variable, no array
    return np.asarray(value) if isinstance(value, jax.Array | np.ndarray | np.generic | float | int) else None
