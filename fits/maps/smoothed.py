"""Smoothed maps in the store of a fitted map: groups of values and errors that are there whole or not at all.

``smoothed`` holds ``values/NAME`` and ``errors/NAME`` as the root does. While a map is being smoothed ``smoothing_3``
is the same after three rounds, from which an interrupted run goes on.
"""

import json
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fits._files import named, plain
from fits.maps import chunk_files
from fits.maps.chunk_files import PARTIAL, block_at, grid
from fits.maps.fitted_map import ROOT, SMOOTHED, FittedMap
from fits.maps.store import KEY, dimensions

Floats = NDArray[np.float64]

STATE = "smoothing_"
"""How groups are called that hold the state after so many rounds."""

NUMBER = np.dtype(np.float64)

GIVEN = {"values": "given its neighbours", "errors": "standard error with the neighbours held where they are"}
"""What the arrays of each group say of themselves."""


def write(map: FittedMap, name: str, arrays: Mapping[str, Floats], about: Mapping[str, Any]) -> None:
    """Write a group, whole or not at all, in the place of what is there.

    Args:
        map: into whose store.
        arrays: of the map's shape, by ``"values/NAME"`` and ``"errors/NAME"``.
        about: what the group says of itself; numbers that are not finite become "nan", "inf", "-inf".

    Raises:
        OSError: it names the store.
    """
    import zarr

    new = map.path / f"{name}{PARTIAL}"
    with named(map.path):
        shutil.rmtree(new, ignore_errors=True)
        try:
            group = zarr.create_group(new, attributes={KEY: plain(about)})
            for path, array in arrays.items():
                kind, _, parameter = path.partition("/")
                group.create_array(
                    path,
                    shape=map.shape,
                    chunks=map.chunk,
                    dtype=NUMBER,
                    fill_value=np.nan,
                    compressors=chunk_files.codecs(),
                    dimension_names=dimensions(len(map.shape)),
                    attributes={"units": map.units[parameter], "long_name": f"{parameter}, {GIVEN[kind]}"},
                )
                for place in grid(map.shape, map.chunk):
                    values = np.asarray(array[block_at(place, map.shape, map.chunk)], NUMBER)
                    chunk_files.write(new / path, place, values, map.chunk, np.nan)
            put(map, new, name)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise


def put(map: FittedMap, folder: Path, name: str) -> None:
    """Give a folder of the store this name, and remove what had it."""
    place, old = map.path / name, map.path / f"{name}.old{PARTIAL}"
    shutil.rmtree(old, ignore_errors=True)
    if place.exists():
        os.rename(place, old)
    os.rename(folder, place)
    shutil.rmtree(old, ignore_errors=True)


def about_of(map: FittedMap, name: str) -> dict[str, Any]:
    """What a group says of itself; nothing where it is not there whole, or damaged."""
    folder = map.path / name
    try:
        found = json.loads((folder / ROOT).read_bytes())["attributes"][KEY]
    except (OSError, ValueError, LookupError, TypeError):
        return {}
    arrays = [folder / group / parameter for group in GIVEN for parameter in map.names]
    places = list(grid(map.shape, map.chunk))
    whole = all(chunk_files.is_whole(array, place, NUMBER, map.chunk) for array in arrays for place in places)
    return dict(found) if whole and isinstance(found, dict) else {}


def read(map: FittedMap, name: str) -> dict[str, Floats]:
    """The arrays of a group, as `write` takes them."""
    found = {f"{group}/{parameter}": np.full(map.shape, np.nan) for group in GIVEN for parameter in map.names}
    for path, array in found.items():
        for place in grid(map.shape, map.chunk):
            values, block = (
                chunk_files.read(map.path / name / path, place, NUMBER, map.chunk),
                block_at(place, map.shape, map.chunk),
            )
            if values is not None:
                array[block] = values[tuple(slice(one.stop - one.start) for one in block)]
    return found


def states(map: FittedMap) -> list[str]:
    """Names of the states that are kept, the latest last."""
    found = [name for name in os.listdir(map.path) if re.fullmatch(rf"{STATE}\d+", name)]
    return sorted(found, key=lambda name: int(name.removeprefix(STATE)))


def forget(map: FittedMap, but: str = "") -> None:
    """Remove all states but this one."""
    for name in states(map):
        if name != but:
            shutil.rmtree(map.path / name, ignore_errors=True)


def finish(map: FittedMap, name: str) -> None:
    """Make of a state the smoothed map."""
    with named(map.path):
        put(map, map.path / name, SMOOTHED)
    forget(map)
