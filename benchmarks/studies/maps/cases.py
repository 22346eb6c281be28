"""The maps that are fitted: painted, of four free numbers a texel."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.measuring.writing import Bar
from benchmarks.suite.maps import Material, painted
from fits.maps.inputs import Block, map_data
from fits.maps.options import MapOptions
from fits.maps.pilot import Job, make_prototype, pilot_texels
from fits.maps.pilot import job_of as job_of_store
from fits.maps.store import Store, blocks_of

Floats = NDArray[np.float64]

FREE: Literal[4] = 4


@dataclass(frozen=True)
class Case:
    """A material with the transport that it is simulated and fitted by.

    bar: of fits a second, in scipy's. rate: of fits a second by two processes.
    """

    name: str
    material: Material
    transport: Any
    bar: Bar | None = None
    rate: Bar | None = None


CASES = (
    Case("flakes on a diffuse base, `SingleScattering`", "flakes", lj.SingleScattering(), bar=Bar(15, 40, rate=True)),
    Case("coat over metal, `Statistical`", "metal", lj.Statistical(), bar=Bar(10, 30, rate=True)),
    Case("coat over diffuse, `AddingDoubling` by an emulator", "coat", "auto", rate=Bar(200, 1000, rate=True)),
)


@dataclass(frozen=True)
class StoredMap:
    """A map whose measurements are in a file, and where its store is to be. truth: of each parameter, (H, W)."""

    stack: lj.Stack
    geometry: fits.Geometry
    noise: fits.Noise
    transport: Any
    truth: Mapping[str, Floats]
    values: Path
    store: Path


@contextmanager
def painted_map(case: Case, side: int) -> Iterator[StoredMap]:
    """A painted map of side x side texels; its files go with the block."""
    picture = painted((side, side), case.transport, material=case.material, free=FREE)
    with stored(picture.stack, picture.geometry, picture.noise, case.transport, picture.values, picture.truth) as one:
        yield one


@contextmanager
def stored(
    stack: lj.Stack,
    geometry: fits.Geometry,
    noise: fits.Noise,
    transport: Any,
    values: Floats,
    truth: Mapping[str, Floats],
) -> Iterator[StoredMap]:
    """A map with its measurements (H, W, N, C) in a file that goes with the block."""
    with tempfile.TemporaryDirectory(prefix="layerjax-maps-") as folder:
        path = Path(folder) / "values.npy"
        np.save(path, values)
        yield StoredMap(stack, geometry, noise, transport, truth, path, Path(folder) / "map.zarr")


def job_of(one: StoredMap, chunk: int) -> tuple[Job, list[Block]]:
    """The work of a map that has been fitted, as its workers had it, and the tasks of all chunks."""
    data, store, options = map_data(one.values, one.geometry), Store(one.store), MapOptions(chunk_size=chunk)
    texels = pilot_texels(data, options.pilot_texels)
    problem = make_prototype(texels, data, one.stack, one.noise, one.transport, options)
    return job_of_store(store, problem, options, data), list(blocks_of(store.shape, store.chunk))
