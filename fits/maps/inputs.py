"""Measurements of a map: values of every texel, their directions, standard deviations and a mask, read block by block.

A map is an array (..., N, C): texels along the leading axes, N measurements of each, C channels; or (..., N) for one
channel. It may be far larger than memory. Arrays of numpy, .npy files, HDF5, zarr and xarray all become variables of
xarray, whose numbers are read when they are accessed.
"""

import base64
import math
import os
import re
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from fits._files import require_there
from fits.data.formats.csv import read_directions
from fits.data.geometry import Floats, Geometry, Pairs, direction
from fits.store import fingerprint

Block = tuple[slice, ...]
"""A selection of the leading axes of a map, the first ones of an array; other axes are taken whole."""

SAMPLE, CHANNEL = "sample", "channel"
"""Names of the axes of measurements and of channels in xarray; by them they are found wherever they stand."""

VECTORS, ANGLES = ("wi", "wo"), ("theta_i", "phi_i", "theta_o", "phi_o")
KINDS = ".npy, .h5, .hdf5 or .zarr"
NORMAL = (0.0, 0.0, 1.0)

UNREADABLE = "?"
"""In the place of the fingerprint of a block that cannot be read."""

WHOLE, BLOCKS, LONGEST = 2**23, 64, 64
"""Numbers of a map that is fingerprinted whole, blocks that are of any, and texels of one of a larger map."""


# ---- arrays, wherever they are ----


class _Stored(BackendArray):
    """Anything that has a shape and takes slices, such as an array of h5py, as xarray reads it."""

    def __init__(self, array: Any):
        self.array, self.shape, self.dtype = array, tuple(array.shape), array.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        support = indexing.IndexingSupport.BASIC
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._read)

    def _read(self, key: Any) -> Any:
        if isinstance(self.array, np.memmap) and self.array.filename is not None:
            needed, there = self.array.offset + self.array.nbytes, os.path.getsize(self.array.filename)
            if there < needed:  # to read beyond the end would kill the process
                raise ValueError(f"the file has {there:,} bytes, must have {needed:,} (truncated?)")
        return np.asarray(self.array[key])


def _array(given: Any, where: str) -> xr.DataArray:
    """An array of numpy, h5py, zarr or xarray, or what numpy makes one of, under the name that errors call it."""
    if isinstance(given, xr.DataArray | xr.Variable):
        variable = given if isinstance(given, xr.Variable) else given.variable
    else:
        if isinstance(given, np.ma.MaskedArray):
            given = np.ma.filled(given.astype(np.float64), np.nan)
        array = given if hasattr(given, "dtype") and hasattr(given, "shape") else np.asarray(given)
        lazy, dims = indexing.LazilyIndexedArray(_Stored(array)), [f"dim_{axis}" for axis in range(len(array.shape))]
        variable = xr.Variable(dims, lazy, _packing(array) if array.dtype.kind in "biuf" else {})
        variable = xr.conventions.decode_cf_variable(where, variable, decode_times=False)
    if variable.dtype.kind not in "biuf":
        raise ValueError(f"{where} holds {variable.dtype}, must hold real numbers")
    return xr.DataArray(variable, name=where)


def _read(array: xr.DataArray, block: Block = ()) -> Floats:
    """A block of it, float64, a copy. ValueError, which names file and block: it cannot be read."""
    try:
        return np.array(array.variable[(*block, ...)].values, dtype=np.float64)
    except MemoryError:
        raise
    except Exception as error:  # codecs raise what they like
        part = f"block {words(block)}" if block else "it"
        raise ValueError(f"{array.name}: {part} cannot be read: {_reason(error)}") from None


def _ordered(array: xr.DataArray, dims: tuple[Hashable, ...]) -> xr.DataArray:
    """The same with its named axes in this order, as far as it has them, and others last."""
    return array.transpose(*(name for name in dims if name in array.dims), ...)


def _packing(array: Any) -> dict[str, float]:
    """What attributes of a stored array say of its numbers: factor, offset, and the number that stands for nothing."""
    said = dict(getattr(array, "attrs", {}))
    if "_ARRAY_DIMENSIONS" in said:  # as xarray writes zarr's format 2
        said["_FillValue"] = array.fill_value
    if isinstance(said.get("_FillValue"), str):  # and format 3
        said["_FillValue"] = np.frombuffer(base64.b64decode(said["_FillValue"]), "<f8")
    names = ("_FillValue", "scale_factor", "add_offset")
    return {name: np.ravel(said[name])[0] for name in names if said.get(name) is not None}


class _Source(NamedTuple):
    """Arrays by name, which of them was given (None: that is to be chosen), and what errors call them together."""

    arrays: dict[str, xr.DataArray]
    name: str | None
    where: str

    def chosen(self, wanted: str) -> xr.DataArray:
        """The array that was given, or that of the wanted name, or the only one."""
        name = self.name if self.name is not None else wanted
        if name not in self.arrays and len(self.arrays) != 1:
            there = f"there are {', '.join(sorted(self.arrays)[:9])}" if self.arrays else "there is none"
            raise ValueError(f"{self.where}: no array {wanted!r}, {there}; PATH:/NAME chooses another")
        return self.arrays[name if name in self.arrays else next(iter(self.arrays))]


def _find(given: Any, wanted: str) -> _Source:
    """The arrays of a file, a group, a Dataset or a mapping; or one array, with those that stand beside it."""
    if isinstance(given, str | os.PathLike):
        return _in_file(str(given))
    beside = _members(given.coords, f"{wanted}/") if isinstance(given, xr.Dataset | xr.DataArray) else {}
    if isinstance(given, Mapping) or hasattr(given, "array_keys"):  # Datasets of xarray and groups are such
        return _Source(beside | _members(given, f"{wanted}/"), None, wanted)
    return _Source(beside | {wanted: _array(given, wanted)}, wanted, wanted)


def _members(group: Any, where: str) -> dict[str, xr.DataArray]:
    """The arrays of numbers in a group; whatever else lies there is skipped."""
    items = group.arrays() if hasattr(group, "array_keys") else group.items()
    return {
        str(name): _array(one, f"{where}{name}")
        for name, one in items
        if not isinstance(one, Mapping) and (not hasattr(one, "dtype") or one.dtype.kind in "biuf")
    }


def _in_file(given: str) -> _Source:
    """What a file holds, or the group in which an array lies that is named as ``file.h5:/name``."""
    inside = re.fullmatch(r"(.+\.(?:h5|hdf5|zarr)):/(.*)", given, re.IGNORECASE)
    path, name = (inside[1], inside[2].strip("/")) if inside else (given, "")
    require_there(path)
    suffix = Path(path).suffix.lower()
    is_zarr = suffix == ".zarr" or any((Path(path) / file).is_file() for file in ("zarr.json", ".zarray", ".zgroup"))
    if not is_zarr and (os.path.isdir(path) or suffix not in (".npy", ".h5", ".hdf5")):
        raise ValueError(
            f"{path}: a map is one array, in {KINDS}; files of measurements are for layerjax fit and layerjax fit-many"
        )
    folder, _, last = name.rpartition("/")
    try:
        root = _open(path, suffix)
        found, parent = (root[name], root[folder or "/"]) if name else (root, None)
    except KeyError:
        raise ValueError(f"{path}: holds no {name!r}") from None
    except Exception as error:  # codecs raise what they like
        raise ValueError(f"{path}: cannot be read: {_reason(error)}") from None
    if not hasattr(found, "dtype"):
        return _Source(_members(found, f"{path}:/{name}/" if name else f"{path}:/"), None, given)
    beside = _members(parent, f"{path}:/{folder}/" if folder else f"{path}:/") if name else {}
    return _Source(beside | {last: _array(found, given)}, last, given)


def _open(path: str, suffix: str) -> Any:
    if suffix == ".npy":
        with open(path, "rb") as file:
            if file.read(6) != b"\x93NUMPY":
                raise ValueError("it is no .npy file")  # numpy takes it for a pickle, and tells how to load it unsafely
        return np.load(path, mmap_mode="r", allow_pickle=False)
    if suffix in (".h5", ".hdf5"):
        import h5py

        return h5py.File(path, "r")
    import zarr

    return zarr.open(path, mode="r")


# ---- the measurements of a map ----


class Measured(NamedTuple):
    """The measurements of one block.

    values, sigma: (block shape, N, C), in 1/sr; NaN where unknown. mask: (block shape), which texels take part. wi, wo:
    (block shape, N, 3), None where all texels of the map have the same directions; sigma: None where there are none.
    """

    values: Floats
    sigma: Floats | None
    mask: NDArray[np.bool_]
    wi: Floats | None
    wo: Floats | None


@dataclass(frozen=True, eq=False)
class MapData:
    """The measurements of a map, opened and not loaded.

    values: (..., N, C) or (..., N). directions: by name, of `VECTORS` or `ANGLES`. shape: of the map. samples: N.
    channels: C. geometry: the directions, if all texels have the same. given: as `map_data` was called.
    """

    values: xr.DataArray
    directions: Mapping[str, xr.DataArray]
    sigma: xr.DataArray | None
    mask: xr.DataArray | None
    shape: tuple[int, ...]
    samples: int
    channels: int
    geometry: Geometry | None
    given: tuple[Any, Any, Any, Any]

    def read(self, block: Block = ()) -> Measured:
        """The measurements of a block; what stands in masked texels is not looked at.

        ValueError: they cannot be read, or a standard deviation or a direction of a texel that takes part is none.
        """
        over = (*block, *[slice(None)] * (len(self.shape) - len(block)))
        block = tuple(slice(*one.indices(size)[:2]) for one, size in zip(over, self.shape, strict=True))
        mask, sigma, wi, wo = self.read_mask(block), None, None, None
        if self.sigma is not None:
            sigma = self._filled(self.sigma, block)
            if np.any(bad := (sigma <= 0.0) & mask[..., None, None]):
                raise ValueError(
                    f"{self.sigma.name}: sigma is {sigma[bad][0]:g} in block {words(block)}, must be above 0, or NaN "
                    "where it is unknown"
                )
            sigma = np.where(sigma > 0.0, sigma, np.nan)
        if self.geometry is None:
            axes = 2 if "wi" in self.directions else 1
            found = {name: _read(one, block if one.ndim > axes else ()) for name, one in self.directions.items()}
            wi, wo = _unit_vectors(found, mask, f" in block {words(block)}")
        return Measured(self._filled(self.values, block), sigma, mask, wi, wo)

    def read_mask(self, block: Block) -> NDArray[np.bool_]:
        """Which texels of a block take part: all if there is no mask."""
        if self.mask is None:
            return np.ones([one.stop - one.start for one in block], bool)
        return _read(self.mask, block) != 0.0

    def _filled(self, one: xr.DataArray, block: Block) -> Floats:
        """A block of values or their deviations at its full shape, (block shape, N, C)."""
        rank, over = len(self.shape), tuple(part.stop - part.start for part in block)
        if one.ndim > 1:  # of standard deviations, axes of texels may be 1
            block = tuple(slice(0, 1) if n == 1 else part for part, n in zip(block, one.shape, strict=False))
        found = _read(one, block if one.ndim > 1 else ())
        found = found if one.ndim == rank + 2 else found[..., None]
        return np.array(np.broadcast_to(found, (*over, self.samples, self.channels)))

    def fingerprints(self) -> list[str]:
        """What distinguishes these measurements from others: of shape and directions, and of blocks from all over the
        map, the whole of it up to 64 MiB; "?" of a block that cannot be read."""
        common = () if self.geometry is None else (self.geometry.wi, self.geometry.wo)
        parts: list[Any] = [[self.shape, self.samples, self.channels, *common]]
        for block in self._blocks():
            try:
                found = self.read(block)
            except ValueError:
                parts.append(UNREADABLE)
                continue
            # one of the many NaNs, and one zero of the two
            parts.append([None if one is None else np.where(np.isnan(one), np.nan, one + 0.0) for one in found])
        return [one if one == UNREADABLE else fingerprint(part=one)["part"] for one in parts]

    def _blocks(self) -> Iterator[Block]:
        """At most 64 of them: all of a map, slab by slab, or of a larger one runs along its last axis."""
        texels = math.prod(self.shape)
        if texels * self.samples * self.channels <= WHOLE:
            ends = np.linspace(0, self.shape[0], min(BLOCKS, self.shape[0]) + 1).astype(int)
            yield from ((slice(int(low), int(high)),) for low, high in pairwise(ends))
            return
        for place in np.linspace(0, texels - 1, BLOCKS).astype(int):
            *rest, last = map(int, np.unravel_index(place, self.shape))
            yield (*(slice(at, at + 1) for at in rest), slice(last, min(last + LONGEST, self.shape[-1])))

    @property
    def portable(self) -> tuple[Any, Any, Any, Any] | None:
        """What another process opens them from by `map_data`; None where the values are not in a file."""
        values, geometry, sigma, mask = self.given
        if not isinstance(values, str | os.PathLike):
            return None
        geometry = geometry if self.geometry is None else (self.geometry.wi, self.geometry.wo)
        sigma = None if self.sigma is None else sigma  # a noise model need not have it
        values, geometry, sigma, mask = (
            os.path.abspath(one) if isinstance(one, str | os.PathLike) else one
            for one in (values, geometry, sigma, mask)
        )
        return values, geometry, sigma, mask


def map_data(values: Any, geometry: Any = None, sigma: Any = None, mask: Any = None) -> MapData:
    """Open the measurements of a map.

    Each array may be one of numpy (mapped or not), h5py, zarr or xarray, or a path: of a .npy file, of an HDF5 file or
    zarr store that holds one array, or one of the argument's name, or ``file.h5:/name``, ``store.zarr:/name``. Axes of
    xarray that are called "sample" and "channel" are found wherever they stand; others are taken in their order.

    Args:
        values: (..., N, C), or (..., N) for one channel, BSDF in 1/sr. Where both fit it is (..., N, C). A value that
            is NaN is skipped.
        geometry: `fits.Geometry` (or measurements, for where they were taken), a pair (wi, wo) of arrays, (N, 3) or
            (..., N, 3), a csv of directions, or a mapping or file with the arrays `wi`, `wo`, or `theta_i`, `phi_i`,
            `theta_o`, `phi_o`, (N,) or (..., N), in degrees; None: these stand beside the values.
        sigma: standard deviations in 1/sr, above 0, (..., N, C) or (..., N), where axes of texels may be 1, or (N,).
            NaN leaves a value out.
        mask: (...), truth values or whole numbers: which texels take part, others being 0.

    Raises:
        ValueError: an array is not there or no such array, or shapes do not fit together.
    """
    every = _find(values, "values")
    found = every.chosen("values")
    if 0 in found.shape:
        raise ValueError(f"{found.name} has shape {found.shape}, must hold something along every axis")
    last = [name for name in (SAMPLE, CHANNEL) if name in found.dims]
    found = found.transpose(..., *last)
    along = tuple(name for name in found.dims if name != CHANNEL)
    directions, samples, over = _directions(geometry, every.arrays, along)
    shape, channels = _split_axes(found, samples)
    if over not in ((), shape):
        raise ValueError(f"geometry has directions of its own for a map of {over}, the measurements are of {shape}")
    deviations = None if sigma is None else _ordered(_find(sigma, "sigma").chosen("sigma"), found.dims)
    part = None if mask is None else _ordered(_find(mask, "mask").chosen("mask"), found.dims)
    _require_fitting(deviations, part, (*shape, samples, channels))
    common = None
    if not over:
        read = {name: _read(one) for name, one in directions.items()}
        common = Geometry(*_unit_vectors(read, np.ones((), bool), ""))
    given = values, geometry, sigma, mask
    whole = MapData(found, directions, deviations, part, shape, samples, channels, common, given)
    if common is None and not isinstance(geometry, str | os.PathLike | None):  # what is wrong in memory is refused now
        whole.read()
    return whole


def _directions(
    given: Any, beside: dict[str, xr.DataArray], dims: tuple[Hashable, ...]
) -> tuple[dict[str, xr.DataArray], int, tuple[int, ...]]:
    """Arrays of directions by name, how many there are, and the shape of the map if texels have their own, else ()."""
    wanted = f"{' and '.join(VECTORS)}, or {', '.join(ANGLES)} in degrees"
    is_path = isinstance(given, str | Path) and Path(given).is_file()
    if is_path and Path(given).suffix.lower() not in (".npy", ".h5", ".hdf5"):
        given = read_directions(Path(given))
    if isinstance(given, Pairs):
        given = (given.wi, given.wo)
    if isinstance(given, tuple | list):
        if len(given) != 2:
            raise ValueError(f"geometry has {len(given)} entries, must be two: wi and wo")
        given = dict(zip(VECTORS, given, strict=True))
    where = "geometry is not given, and there is nothing beside the values that"
    arrays, _, where = (beside, None, where) if given is None else _find(given, "geometry")
    names = next((names for names in (VECTORS, ANGLES) if all(name in arrays for name in names)), None)
    if names is None:
        raise ValueError(f"{where} has no directions, must hold {wanted}")
    found, axes = {name: _ordered(arrays[name], dims) for name in names}, 2 if "wi" in names else 1
    for name, one in found.items():
        if len(one.shape) < axes or (axes == 2 and one.shape[-1] != 3):
            must = "(N, 3) or (..., N, 3), the map's axes in front" if axes == 2 else "(N,) or (..., N)"
            raise ValueError(f"{one.name} ({name}) has shape {one.shape}, must be {must}")
    counts = {one.shape[-axes] for one in found.values()}
    over = {one.shape[:-axes] for one in found.values()} - {()}
    if len(counts) > 1 or len(over) > 1 or 0 in counts:
        listed = ", ".join(f"{name} {one.shape}" for name, one in found.items())
        raise ValueError(f"geometry: shapes {listed} do not fit together, N and the map's axes must be the same")
    return found, counts.pop(), next(iter(over), ())


def _unit_vectors(found: Mapping[str, Floats], given: NDArray[np.bool_], where: str) -> tuple[Floats, Floats]:
    """`wi` and `wo`, (block shape, N, 3), refused where one of a `given` texel is none, along the normal elsewhere."""
    if "wi" not in found:
        polar = {}
        for name in ("theta_i", "theta_o"):
            out = (found[name] < 0.0) | (found[name] > 180.0)
            if (wrong := out & given[..., None]).any():
                first = np.broadcast_to(found[name], wrong.shape)[wrong][0]
                raise ValueError(f"geometry: {name} is {first:g}, must be in [0, 180] degrees")
            polar[name] = np.where(out, np.nan, found[name])
        found = {"wi": direction(polar["theta_i"], found["phi_i"]), "wo": direction(polar["theta_o"], found["phi_o"])}
    checked = []
    for name in VECTORS:
        w = np.broadcast_to(found[name], (*given.shape, *found[name].shape[-2:]))
        bad = ~(np.abs(np.linalg.norm(w, axis=-1) - 1.0) <= 1e-6)
        if np.any(wrong := bad & given[..., None]):
            raise ValueError(f"geometry: {name} is {w[wrong][0].tolist()}{where}, must be finite and of length 1")
        checked.append(np.where(bad[..., None], NORMAL, w))
    return checked[0], checked[1]


def _split_axes(values: xr.DataArray, samples: int) -> tuple[tuple[int, ...], int]:
    """The shape of the map, and how many channels it has."""
    shape, named = values.shape, values.dims
    if len(shape) > 2 and shape[-2] == samples and (CHANNEL in named or SAMPLE not in named):
        return shape[:-2], shape[-1]
    if len(shape) > 1 and shape[-1] == samples and CHANNEL not in named:
        return shape[:-1], 1
    raise ValueError(
        f"{values.name} has shape {shape}, the geometry {samples} pairs of directions: values must be "
        f"(..., {samples}, C), or (..., {samples}) for one channel, with an axis or more of texels"
    )


def _require_fitting(sigma: xr.DataArray | None, mask: xr.DataArray | None, full: tuple[int, ...]) -> None:
    """Refuse deviations and a mask whose shapes are not those of the values (..., N, C) and of the map."""
    shape = full[:-2]
    if sigma is not None:
        own = sigma.shape if sigma.ndim == len(full) else (*sigma.shape, full[-1])
        over = own[:-2] if sigma.ndim > 1 else shape
        texels = len(over) == len(shape) and all(one in (1, size) for one, size in zip(over, shape, strict=True))
        if own[-2:] != full[-2:] or not texels:
            raise ValueError(
                f"{sigma.name} has shape {sigma.shape}, sigma must be {full}, {full[:-1]}, the same with 1 for axes of "
                f"texels, or {full[-2:-1]}"
            )
    if mask is not None and mask.shape != shape:
        raise ValueError(f"{mask.name} has shape {mask.shape}, a mask must have that of the map, {shape}")
    if mask is not None and mask.dtype.kind == "f":
        raise ValueError(f"{mask.name} holds {mask.dtype}, a mask must hold truth values or whole numbers")


def words(block: Block) -> str:
    """A block as errors name it: [0:32, 64:96]."""
    return f"[{', '.join(f'{one.start}:{one.stop}' for one in block)}]"


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
