"""Tables made once by `layerjax.precompute` and shipped: the .npz files, and what reads them."""

import functools
from pathlib import Path

import numpy as np


@functools.cache
def load(name: str) -> dict[str, np.ndarray]:
    """The arrays of a table, read at the first call."""
    with np.load(Path(__file__).with_name(f"{name}.npz")) as archive:
        return dict(archive)
