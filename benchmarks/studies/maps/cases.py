"""The maps that are fitted: painted, of four free numbers a texel."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray

import fits
import layerjax as lj
from benchmarks.measuring.writing import Bar
from benchmarks.suite.maps import Material, painted
from fits.maps.chunk_files import block_at, grid
from fits.maps.fit_map import tile
from fits.maps.inputs import readings
from fits.maps.job import Job, Task
from fits.maps.prepared import load

Floats = NDArray[np.float64]

FREE: Literal[4] = 4


@dataclass(frozen=True)
class Case:
    """A material with the transport that it is read and fitted by.

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
    Case("coat over diffuse, `AddingDoubling` in a table", "coat", "auto", rate=Bar(200, 1000, rate=True)),
)


@dataclass(frozen=True)
class Given:
    """A map whose readings are in a file, and where its store is to be. truth: of each parameter, (H, W)."""

    stack: lj.Stack
    geometry: fits.Geometry
    noise: fits.Noise
    transport: Any
    truth: Mapping[str, Floats]
    values: Path
    store: Path


@contextmanager
def given(case: Case, side: int) -> Iterator[Given]:
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
) -> Iterator[Given]:
    """A map with its readings (H, W, N, C) in a file that goes with the block."""
    with tempfile.TemporaryDirectory(prefix="layerjax-maps-") as folder:
        path = Path(folder) / "values.npy"
        np.save(path, values)
        yield Given(stack, geometry, noise, transport, truth, path, Path(folder) / "map.zarr")


def job_of(one: Given, chunk: int) -> tuple[Job, list[Task]]:
    """The work of a map that has been fitted, as its workers had it, and the tasks of all chunks."""
    found = readings(one.values, one.geometry)
    rest = {"transport": one.transport, "scale": None, "objective": "likelihood", "instrument": None}
    prepared = load(zarr.open_group(one.store, mode="r"), found, one.stack, one.noise, chunk, **rest)
    error, least = prepared.numerical_error, prepared.least
    job = Job(str(one.store), prepared.problem, prepared.starts, least, chunk, error, found.portable)
    sides = tile(found.shape, chunk)
    return job, [Task(block_at(place, found.shape, sides)) for place in grid(found.shape, sides)]
