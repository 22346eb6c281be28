"""The store of a fitted map: a group of zarr that grows chunk by chunk, read by `FittedMap` and written by `Store`.

A directory of zarr version 3 with the arrays ``values/NAME``, ``errors/NAME``, ``reduced_chi_square``, ``flags``,
``at_bound`` and ``measurements``, all of the map's shape, in chunks of the same texels, uncompressed and
with zarr's checksums; and the groups ``pilot`` and, with a spatial prior, ``smoothed``. The flags of a chunk are
written last: a texel whose flags are 0 is not there yet, whatever else is. One process at a time writes (it holds a
lock); readers change nothing.
"""

import asyncio
import itertools
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec
from zarr.core.sync import sync

from fits._files import PARTIAL, given_path, named, plain, replacing, require_there, restore
from fits._lazy import shown_by
from fits.data.geometry import Booleans, Floats
from fits.engines import one_line
from fits.maps.inputs import Block
from fits.maps.options import MapOptions
from fits.store import another, differences

KEY, KIND, FORMAT = "layerjax", "fitted map", 6
PILOT, SMOOTHED = "pilot", "smoothed"

FLAGS = {
    "fitted": 1,
    "converged": 2,
    "at_bound": 4,
    "poor": 8,
    "restarted": 16,
    "masked": 32,
    "too_few_measurements": 64,
    "failed": 128,
    "unidentified": 256,
}
"""Meaning and bit of what `flags` says of a texel; 0: it is not there yet."""

CHECKSUM = (Crc32cCodec(),)

DESCRIPTIONS: dict[str, dict[str, Any]] = {
    "reduced_chi_square": {"long_name": "chi-square per degree of freedom"},
    "at_bound": {"long_name": "bit p: parameter p, in the order of the root's names, is at a bound"},
    "measurements": {"long_name": "how many measurements entered"},
    "flags": {"flag_masks": list(FLAGS.values()), "flag_meanings": " ".join(FLAGS)},
}
"""Attributes of arrays by the CF conventions."""


def arrays_of(names: Sequence[str]) -> dict[str, tuple[np.dtype, Any]]:
    """Path, type and fill value of every array of a store, the flags last."""
    number = np.dtype(np.float64)
    return {
        **{f"{group}/{name}": (number, np.nan) for group in ("values", "errors") for name in names},
        "reduced_chi_square": (number, np.nan),
        "at_bound": (np.dtype(np.uint32), 0),
        "measurements": (np.dtype(np.uint32), 0),
        "flags": (np.dtype(np.uint16), 0),
    }


def blocks_of(shape: Sequence[int], chunk: Sequence[int]) -> Iterator[Block]:
    """The parts of an array that its chunks hold, last axis fastest."""
    edges = [range(0, size, side) for size, side in zip(shape, chunk, strict=True)]
    for place in itertools.product(*edges):
        yield tuple(slice(at, min(at + side, size)) for at, side, size in zip(place, chunk, shape, strict=True))


# ---- reading ----


class FittedMap:
    """Parameters of every texel of a map, with errors and flags; arrays are read when they are accessed.

    Texels that are not fitted yet have flags of 0. `map["values/base.albedo"]` is the zarr array, which can be read in
    parts.

    Attributes:
        path: of the store.
        names: of the parameters, as in `Problem.names`.
        units: of each parameter by name; "1" for plain ratios.
        shape: of the map.
        chunk: texels along each axis of what is written at once.
        attributes: what the store says of how it was made.
    """

    def __init__(self, path: str | Path, mode: Any = "r"):
        self.path = given_path("path", path)
        self.attributes = about = _attributes(self.path)
        if about.get("format") != FORMAT:
            raise ValueError(f"{path}: is version {about.get('format')} of the format, must be {FORMAT}")
        try:
            self.names, self.units = tuple(about["names"]), dict(about["units"])
            self.shape, self.chunk = tuple(about["shape"]), tuple(about["chunk"])
            self.root = zarr.open_group(self.path, mode=mode)
            for name, array in self.arrays.items():
                if array.shape != self.shape:
                    raise ValueError(f"the shape {array.shape} of {name}, which must be {self.shape}")
        except Exception as error:  # whatever a description that is none leads to
            raise ValueError(f"{path}: damaged, its description lacks or misstates {one_line(error)}") from None

    @cached_property
    def arrays(self) -> dict[str, Any]:
        """Arrays of zarr by their paths, all but those of a spatial prior."""
        return {name: self.root[name] for name in arrays_of(self.names)}

    @property
    def values(self) -> Mapping[str, Floats]:
        """Fitted values by name, each of the map's shape, in the parameter's unit; NaN where nothing is fitted."""
        return _Arrays(self, "values")

    @property
    def errors(self) -> Mapping[str, Floats]:
        """Standard errors by name; NaN at a bound, infinite where nothing holds a parameter."""
        return _Arrays(self, "errors")

    @property
    def smoothed(self) -> Mapping[str, Floats] | None:
        """Values of the map with a spatial prior, by name; None if there was none."""
        return None if self.smoothing is None else _Arrays(self, f"{SMOOTHED}/values")

    @property
    def smoothed_errors(self) -> Mapping[str, Floats] | None:
        """Their standard errors by name, with the neighbours of a texel held where they are; None as `smoothed`."""
        return None if self.smoothing is None else _Arrays(self, f"{SMOOTHED}/errors")

    @property
    def smoothing(self) -> dict[str, Any] | None:
        """Record of the spatial prior (prior, rounds, largest moves, whether it settled), or None without one."""
        about = self.about(SMOOTHED)
        return about["smoothing"] if about and about["finished"] else None

    @property
    def reduced_chi_square(self) -> Floats:
        """Chi-square per degree of freedom of every texel."""
        return self.read("reduced_chi_square")

    @property
    def flags(self) -> NDArray[np.uint16]:
        """State of every texel as bits (see `has`), 0 for a texel that is not fitted yet."""
        return self.read("flags")

    @property
    def at_bound(self) -> NDArray[np.uint32]:
        """Parameters at a bound, as bit p for `names[p]`."""
        return self.read("at_bound")

    @property
    def measurements(self) -> NDArray[np.uint32]:
        """How many measurements entered."""
        return self.read("measurements")

    @property
    def numerical_error(self) -> float | None:
        """Largest numerical error of the model, in standard deviations of the data, over the texels of the pilot; None
        for transports that have none."""
        error = self.attributes["numerical"].get("error")
        return None if error is None else float(error)

    @property
    def done(self) -> float:
        """The share of texels that are there."""
        return float(np.mean(self.flags != 0))

    def has(self, meaning: str) -> Booleans:
        """Which texels have a flag.

        Args:
            meaning: "fitted", "converged", "at_bound", "poor" (chi-square above what noise and the pilot explain),
                "restarted", "masked", "too_few_measurements", "failed" (no finite value) or "unidentified".
        """
        if meaning not in FLAGS:
            raise ValueError(f"meaning: {meaning!r} given, must be one of {', '.join(FLAGS)}")
        return (self.flags & FLAGS[meaning]) != 0

    def option(self, name: str) -> Any:
        """A number of the `MapOptions` that the map was fitted with."""
        return self.attributes["options"].get(name, getattr(MapOptions, name))

    def __getitem__(self, path: str) -> "zarr.Array[Any]":
        if path.removeprefix(f"{SMOOTHED}/") not in self.arrays or path not in self.root:
            raise KeyError(f"{path!r} is not one of {', '.join(self.arrays)}")
        return self.root[path]  # type: ignore[return-value]

    def read(self, path: str) -> Any:
        """A whole array. ValueError, on one line, that names it: a chunk is damaged."""
        with _damage_named(f"{self.path}/{path}"):
            return np.asarray(self.root[path][...])  # type: ignore[index]

    def about(self, group: str) -> dict[str, Any] | None:
        """What the group of the pilot or of a spatial prior says of itself; None where it is not there."""
        with _damage_named(f"{self.path}/{group}"):
            return self.root[group].attrs[KEY] if group in self.root else None  # type: ignore[return-value]

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.shape))
        return f"<FittedMap of {size} texels, {100.0 * self.done:.4g} % done: {', '.join(self.names)}; {self.path}>"

    def _repr_html_(self) -> str:
        return str(shown_by("fits.maps.report:fragment", self))


class _Arrays(Mapping[str, Floats]):
    """Arrays of a group by the names of parameters, each read when it is accessed."""

    def __init__(self, map: FittedMap, group: str):
        self._map, self._group = map, group

    def __getitem__(self, name: str) -> Floats:
        if name not in self._map.names:
            raise KeyError(f"{name!r} is not one of {', '.join(self._map.names)}")
        array: Floats = self._map.read(f"{self._group}/{name}")
        return array

    def __iter__(self) -> Iterator[str]:
        return iter(self._map.names)

    def __len__(self) -> int:
        return len(self._map.names)


@contextmanager
def _damage_named(place: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # codecs raise what they like
        raise ValueError(f"{place}: damaged, {one_line(error)}") from None


def open_map(path: str | Path) -> FittedMap:
    """Open the store of a fitted map, finished or not.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: it is none, or its description is damaged.
    """
    return FittedMap(path)


def _attributes(path: Path) -> dict[str, Any]:
    """What the root of a store says under our key; ValueError for what is no such store."""
    require_there(path, "no such file or directory")
    with suppress(Exception):  # whatever else stands there
        about: Any = zarr.open_group(path, mode="r").attrs[KEY]
        if about["kind"] == KIND:
            return about
    raise ValueError(f"{path}: is no store of a {KIND}, as `layerjax fit-map` writes it")


# ---- writing ----


class Store(FittedMap):
    """A fitted map that is written; opened once in each process."""

    def __init__(self, path: str | Path):
        super().__init__(path, "r+")

    def write(self, block: Block, results: Mapping[str, np.ndarray]) -> None:
        """Write one chunk, its flags last. OSError: it names the store.

        results: by path, such as ``"values/base.albedo"``, the block's numbers of every array.
        """

        async def write(names: Iterable[str]) -> None:  # at once, which takes half the time
            parts = {name: np.asarray(results[name], self.arrays[name].dtype) for name in names}
            await asyncio.gather(*(self.arrays[name].async_array.setitem(block, part) for name, part in parts.items()))

        with named(self.path):
            os.stat(self.path)  # one that was removed is not made again
            sync(write(self.arrays.keys() - {"flags"}))
            sync(write(["flags"]))

    def is_whole(self, block: Block = ()) -> bool:
        """Whether a part of the map is there: no flag is 0, no array is damaged or lacks values."""
        try:
            parts = {name: np.asarray(array[block]) for name, array in self.arrays.items()}
        except Exception:  # codecs raise what they like
            return False
        fitted = (parts["flags"] & FLAGS["fitted"]) != 0
        return bool(parts["flags"].all()) and all(np.isfinite(parts[f"values/{n}"][fitted]).all() for n in self.names)

    def unfinished(self) -> list[Block]:
        """The chunks that are not there whole, in their order."""
        if self.is_whole():  # at once, much faster than one by one
            return []
        return [block for block in blocks_of(self.shape, self.chunk) if not self.is_whole(block)]

    def clean(self) -> None:
        """Remove what writers that were killed left of files; none may be writing."""
        for path in list(self.path.rglob(f"*{PARTIAL}")):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)

    def save_group(self, name: str, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any], **options: Any) -> None:
        """Write a group of arrays with what it says of itself, whole or not at all, in place of what is there; options:
        of the arrays, as zarr takes them. OSError: named."""
        with named(self.path), replacing(self.path / name) as new:
            _write_group(zarr.create_group(new), arrays, about, **options)

    def load_group(self, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """The arrays of a group and what it says of itself; None where it is not there. ValueError: it is damaged."""
        about = self.about(name)
        return None if about is None else ({path: self.read(f"{name}/{path}") for path in about["arrays"]}, about)


def _write_group(group: zarr.Group, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any], **options: Any) -> None:
    for path, array in arrays.items():
        group.create_array(path, data=np.ascontiguousarray(array), compressors=CHECKSUM, **options)
    group.attrs.update({KEY: {"arrays": list(arrays), **plain(about)}})


def create(path: Path, attributes: Mapping[str, Any], pilot: Mapping[str, np.ndarray]) -> Store:
    """Make a store without texels, whole or not at all, in place of what is there.

    attributes: what the root says under the key "layerjax": names and units of the parameters, shape and chunk (texels
    along each axis) of the map, and how it was fitted. pilot: arrays that all chunks are fitted with.
    """
    names, units, shape = attributes["names"], attributes["units"], tuple(attributes["shape"])
    axes = {1: ["texel"], 2: ["row", "column"]}.get(len(shape), [f"axis_{axis}" for axis in range(len(shape))])
    with named(path), replacing(path) as new:
        root = zarr.create_group(new, attributes={KEY: plain({**attributes, "kind": KIND, "format": FORMAT})})
        for name, (dtype, fill) in arrays_of(names).items():
            root.create_array(
                name,
                shape=shape,
                chunks=tuple(attributes["chunk"]),
                dtype=dtype,
                fill_value=fill,
                compressors=CHECKSUM,
                dimension_names=axes,
                attributes=DESCRIPTIONS.get(name) or {"units": units[name.partition("/")[2]]},
            )
        _write_group(root.create_group(PILOT), pilot, {})
    return Store(path)


def resume(path: Path, identity: Mapping[str, str], force: bool) -> Store | None:
    """The store that is there, if it is of the fit with these fingerprints; None: there is none, or one that `force`
    replaces. ValueError: a map of another fit (it names what differs), a damaged one, or something else."""
    restore(path)
    if not os.path.lexists(path):
        return None
    _attributes(path)  # what is not ours is never touched
    try:
        store = Store(path)
        if words := differences(store.attributes["fingerprints"], identity):
            raise ValueError(another(path, words))
        if store.load_group(PILOT) is None:
            raise ValueError(f"{path}/{PILOT}: damaged, it is not there")
    except ValueError as error:
        if force:
            return None
        raise ValueError(f"{error}; --force, or force=True, throws it away and begins anew") from None
    store.clean()
    return store
