"""A small map of random values, and files that hold arrays."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import zarr

from fits.data.geometry import slices

SHAPE, N, C = (5, 4), 6, 2
VALUES = np.random.default_rng(1).uniform(0.1, 1.0, (*SHAPE, N, C))
VALUES[1, 2, 3, 0] = np.nan
SIGMA = 0.1 * np.nan_to_num(VALUES, nan=1.0)
MASK = np.random.default_rng(2).uniform(size=SHAPE) > 0.3
VIEW = slices(incidence=(10.0, 40.0), outgoing=(-20.0, 0.0, 30.0))
BLOCK = (slice(1, 4), slice(2, 4))
ANGLES = {"theta_i": VIEW.theta_i, "phi_i": VIEW.phi_i, "theta_o": VIEW.theta_o, "phi_o": VIEW.phi_o}


def zarr_group(path: Path, arrays: dict[str, np.ndarray], chunk: int = 2) -> zarr.Group:
    """A zarr store with these arrays, in chunks of so many along each axis."""
    group = zarr.create_group(path)
    for name, array in arrays.items():
        group.create_array(name, data=array, chunks=tuple(min(chunk, size) for size in array.shape))
    return group


def hdf5_file(path: Path, arrays: dict[str, np.ndarray], **options: Any) -> Path:
    """An HDF5 file with these datasets."""
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, **options)
    return path
