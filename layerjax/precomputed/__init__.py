"""Tables made once and shipped: each an .npz beside the module that makes it.

``python -m layerjax.precomputed NAME`` makes one again.
"""

import functools
from pathlib import Path

import numpy as np

NAMES = ("microsurface", "diffuse_interface", "spongecake", "vmf_diffuse")


@functools.cache
def load(name: str) -> dict[str, np.ndarray]:
    """The arrays of a table, read at the first call."""
    with np.load(Path(__file__).with_name(f"{name}.npz")) as archive:
        return dict(archive)
