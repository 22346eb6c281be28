"""Measurements of a map: values of every texel, their directions, standard deviations and a mask, read block by block.

A map is an array (..., N, C): texels along the leading axes, N measurements of each, C channels; or (..., N) for one
channel. It may be far larger than memory. Arrays of numpy, .npy files, HDF5, zarr and xarray all become variables of
xarray, whose numbers are read when they are accessed.
"""

import base64
import hashlib
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from fits._files import require_there
from fits.data.formats.csv import read_directions
from fits.data.geometry import Floats, Geometry, Pairs, direction

Block = tuple[slice, ...]
"""A selection of the leading axes of a map, the first ones of an array; other axes are taken whole."""

SAMPLE, CHANNEL = "sample", "channel"
"""Names of the axes of measurements and of channels in xarray; by them they are found wherever they stand."""

VECTORS, ANGLES = ("wi", "wo"), ("theta_i", "phi_i", "theta_o", "phi_o")
DIRECTIONS = f"{' and '.join(VECTORS)}, or {', '.join(ANGLES)} in degrees"
KINDS = ".npy, .h5, .hdf5 or .zarr"
NORMAL = (0.0, 0.0, 1.0)

UNREADABLE = "?"
"""In the place of a fingerprint of what cannot be read."""

WHOLE, BLOCK, BLOCKS = 2**26, 2**20, 64
"""Bytes of an array that is fingerprinted whole, bytes of a block of it, and blocks of a longer one."""


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


@dataclass(frozen=True, eq=False)
class Array:
    """One array with names of its axes; where: as errors call it."""

    variable: xr.Variable
    where: str

    @property
    def shape(self) -> tuple[int, ...]:
        return self.variable.shape

    @property
    def dims(self) -> tuple[str, ...]:
        return tuple(map(str, self.variable.dims))

    def read(self, block: Block = ()) -> Floats:
        """A block of it, float64, a copy. ValueError, which names file and block: it cannot be read."""
        try:
            return np.array(self.variable[(*block, ...)].values, dtype=np.float64)
        except MemoryError:
            raise
        except Exception as error:  # codecs raise what they like
            part = f"block {words(block)}" if block else "it"
            raise ValueError(f"{self.where}: {part} cannot be read: {_reason(error)}") from None

    def ordered(self, dims: Sequence[str]) -> "Array":
        """The same with its named axes in this order, as far as it has them, and others last."""
        own = [name for name in dims if name in self.dims]
        return replace(self, variable=self.variable.transpose(*own, *(name for name in self.dims if name not in own)))

    def fingerprint(self, axes: int) -> str:
        """Hashes of shape, type and content, block by block; "?" for a block that cannot be read.

        Of arrays above 64 MiB (as float64) 64 blocks enter, spread evenly: what changes between them is not seen.
        axes: how many of them are the map's.
        """
        kind = self.variable.dtype
        found = [_hash(f"{self.shape} {kind.kind}{kind.itemsize}".encode())]
        for block in _blocks(self.shape, axes):
            try:
                part = self.read(block)
            except ValueError:
                found.append(UNREADABLE)
                continue
            part[np.isnan(part)] = np.nan  # one of the many, and one zero of the two
            found.append(_hash((part + 0.0).tobytes()))
        return ",".join(found)


def _array(given: Any, where: str) -> Array:
    """An array of numpy, h5py, zarr or xarray, or what numpy makes one of."""
    if isinstance(given, Array):
        return given
    if isinstance(given, xr.DataArray | xr.Variable):
        variable = given if isinstance(given, xr.Variable) else given.variable
    else:
        if isinstance(given, np.ma.MaskedArray):
            given = np.ma.filled(given.astype(np.float64), np.nan)
        array = given if hasattr(given, "dtype") and hasattr(given, "shape") else np.asarray(given)
        if array.dtype.kind not in "biuf":
            raise ValueError(f"{where} holds {array.dtype}, must hold real numbers")
        dims = [f"dim_{axis}" for axis in range(len(array.shape))]
        variable = xr.Variable(dims, indexing.LazilyIndexedArray(_Stored(array)), _packing(array))
        variable = xr.conventions.decode_cf_variable(where, variable, decode_times=False)
    if variable.dtype.kind not in "biuf":
        raise ValueError(f"{where} holds {variable.dtype}, must hold real numbers")
    return Array(variable, where)


def _packing(array: Any) -> dict[str, float]:
    """What attributes of a stored array say of its numbers: factor, offset, and the number that stands for nothing."""
    said = dict(getattr(array, "attrs", {}))
    if "_ARRAY_DIMENSIONS" in said:  # as xarray writes zarr's format 2
        said["_FillValue"] = array.fill_value
    if isinstance(said.get("_FillValue"), str):  # and format 3
        said["_FillValue"] = np.frombuffer(base64.b64decode(said["_FillValue"]), "<f8")
    names = ("_FillValue", "scale_factor", "add_offset")
    return {name: np.ravel(said[name])[0] for name in names if said.get(name) is not None}


def _group(given: Any, wanted: str) -> tuple[dict[str, Array], str | None, str]:
    """Arrays by name, which of them was given (None: that is to be chosen), and what errors call them together."""
    if isinstance(given, str | os.PathLike):
        return _in_file(str(given))
    if isinstance(given, xr.DataArray):
        return _members(given.coords, f"{wanted}/") | {wanted: _array(given, wanted)}, wanted, wanted
    if isinstance(given, Mapping) or hasattr(given, "array_keys"):  # Datasets of xarray and groups are such
        coordinates = _members(given.coords, f"{wanted}/") if isinstance(given, xr.Dataset) else {}
        return coordinates | _members(given, f"{wanted}/"), None, wanted
    return {wanted: _array(given, wanted)}, wanted, wanted


def _members(group: Any, where: str) -> dict[str, Array]:
    """The arrays of numbers in a group; whatever else lies there is skipped."""
    items = group.arrays() if hasattr(group, "array_keys") else group.items()
    return {
        str(name): _array(one, f"{where}{name}")
        for name, one in items
        if not isinstance(one, Mapping) and (not hasattr(one, "dtype") or one.dtype.kind in "biuf")
    }


def _in_file(given: str) -> tuple[dict[str, Array], str | None, str]:
    """What a file holds, or the group in which an array lies that is named as ``file.h5:/name``."""
    inside = re.fullmatch(r"(.+\.(?:h5|hdf5|zarr)):/(.*)", given, re.IGNORECASE)
    path, name = (inside[1], inside[2].strip("/")) if inside else (given, "")
    require_there(path)
    suffix = Path(path).suffix.lower()
    is_zarr = suffix == ".zarr" or any((Path(path) / file).is_file() for file in ("zarr.json", ".zarray", ".zgroup"))
    if os.path.isdir(path) and not is_zarr:
        raise ValueError(
            f"{path}: is a folder, a map is one array ({KINDS}); a folder of measurement files is for layerjax fit-many"
        )
    if suffix not in (".npy", ".h5", ".hdf5") and not is_zarr:
        raise ValueError(
            f"{path}: ends in {suffix!r}, a map is read from {KINDS}; measurements of one material are for layerjax fit"
        )
    try:
        root = _open(path, suffix)
        found, (folder, _, last) = root[name] if name else root, name.rpartition("/")
        parent = root[folder or "/"] if name else None
    except KeyError:
        raise ValueError(f"{path}: holds no {name!r}") from None
    except Exception as error:  # codecs raise what they like
        raise ValueError(f"{path}: cannot be read: {_reason(error)}") from None
    if not hasattr(found, "dtype"):
        return _members(found, f"{path}:/{name}/" if name else f"{path}:/"), None, given
    if not name:
        return {"": _array(found, given)}, "", given
    return _members(parent, f"{path}:/{folder}/" if folder else f"{path}:/") | {last: _array(found, given)}, last, given


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


def _chosen(given: Any, wanted: str) -> tuple[Array, dict[str, Array]]:
    """The array that was given, or that of the wanted name, or the only one; and all that lie beside it."""
    arrays, name, where = _group(given, wanted)
    if name is None and wanted not in arrays and len(arrays) != 1:
        there = f"there are {', '.join(sorted(arrays)[:9])}" if arrays else "there is none"
        raise ValueError(f"{where}: no array {wanted!r}, {there}; PATH:/NAME chooses another")
    return arrays[name if name is not None else wanted if wanted in arrays else next(iter(arrays))], arrays


# ---- the measurements of a map ----


@dataclass(frozen=True, eq=False)
class MapData:
    """The measurements of a map, opened and not loaded.

    values: (..., N, C) or (..., N). directions: by name, of `VECTORS` or `ANGLES`. shape: of the map. samples: N.
    channels: C. geometry: the directions, if all texels have the same. given: as `map_data` was called.
    """

    values: Array
    directions: Mapping[str, Array]
    sigma: Array | None
    mask: Array | None
    shape: tuple[int, ...]
    samples: int
    channels: int
    geometry: Geometry | None
    given: tuple[Any, Any, Any, Any]

    def read(self, block: Block) -> Floats:
        """The values of a block, (block shape, N, C), in 1/sr; NaN stays NaN. ValueError: they cannot be read."""
        return self._filled(self.values, self._whole(block))

    def read_sigma(self, block: Block) -> Floats | None:
        """Their standard deviations, (block shape, N, C), NaN where unknown, or of no use in a masked texel; None if
        there are none. ValueError: as `read`, or one of a texel that is not masked is not above 0."""
        if self.sigma is None:
            return None
        block = self._whole(block)
        found = self._filled(self.sigma, block)
        bad = (found <= 0.0) & self.read_mask(block)[..., None, None]
        if np.any(bad):
            raise ValueError(
                f"{self.sigma.where}: sigma is {found[bad][0]:g} in block {words(block)}, must be above 0, or NaN "
                "where it is unknown"
            )
        return np.where(found > 0.0, found, np.nan)

    def read_mask(self, block: Block) -> NDArray[np.bool_]:
        """Which texels of a block take part, (block shape): all if there is no mask. ValueError: as `read`."""
        block = self._whole(block)
        if self.mask is None:
            return np.ones([one.stop - one.start for one in block], bool)
        return self.mask.read(block) != 0.0

    def read_directions(self, block: Block) -> tuple[Floats, Floats]:
        """Unit vectors towards light and viewer: (N, 3) each if all texels have the same, else (block shape, N, 3).

        Raises:
            ValueError: as `read`, or one of a texel that is not masked is no direction. Those of masked texels are
                along the normal where they are none.
        """
        if self.geometry is not None:
            return self.geometry.wi, self.geometry.wo
        block, axes = self._whole(block), 2 if "wi" in self.directions else 1
        own = {name: len(one.shape) > axes for name, one in self.directions.items()}
        found = {name: one.read(block if own[name] else ()) for name, one in self.directions.items()}
        return _unit_vectors(found, self.read_mask(block), f" in block {words(block)}")

    def fingerprint(self) -> str:
        """What tells these measurements from others, see `Array.fingerprint`; names and dates of files do not enter."""
        rank, axes = len(self.shape), 2 if "wi" in self.directions else 1
        parts = [f"{self.shape} {self.samples} {self.channels}"]
        parts += [
            f"{name} {one.fingerprint(rank if len(one.shape) > axes else 0)}"
            for name, one in sorted(self.directions.items())
        ]
        for one in (self.values, self.sigma, self.mask):
            parts.append("" if one is None else one.fingerprint(rank if len(one.shape) > 1 or one is self.mask else 0))
        return ",".join(parts)

    @property
    def portable(self) -> tuple[Any, Any, Any, Any] | None:
        """What another process opens them from by `map_data`: paths, and what is small; None if that is not all."""
        values, geometry, sigma, mask = map(_absolute, self.given)
        if self.geometry is not None:
            geometry = (self.geometry.wi, self.geometry.wo)
        if self.sigma is not None and len(self.sigma.shape) == 1:
            sigma = self.sigma.read()
        if self.mask is not None and not isinstance(mask, str):
            mask = self.read_mask(())
        large = (values, sigma, *([] if self.geometry is not None or geometry is None else [geometry]))
        by_name = all(one is None or isinstance(one, str) or (one is sigma and np.ndim(one) == 1) for one in large)
        return (values, geometry, sigma, mask) if by_name else None

    def _whole(self, block: Block) -> Block:
        """The block with all its ends said, within the map."""
        if len(block) > len(self.shape) or any(one.step not in (None, 1) for one in block):
            raise ValueError(f"block is {block}, must be slices without a step along {len(self.shape)} axes")
        given = (*block, *[slice(None)] * (len(self.shape) - len(block)))
        return tuple(slice(*one.indices(size)[:2]) for one, size in zip(given, self.shape, strict=True))

    def _filled(self, one: Array, block: Block) -> Floats:
        """A block of values or their deviations at its full shape, (block shape, N, C)."""
        over = tuple(part.stop - part.start for part in block)
        if len(one.shape) > 1:
            block = tuple(slice(0, 1) if n == 1 else part for part, n in zip(block, one.shape, strict=False))
        found = one.read(block if len(one.shape) > 1 else ())
        if len(one.shape) < len(over) + 2:  # without an axis of channels
            found = found[..., None]
        shape = (*over, self.samples, self.channels)
        return found if found.shape == shape else np.broadcast_to(found, shape).copy()


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
    if isinstance(values, MapData):
        return values
    given = values, geometry, sigma, mask
    found, neighbours_in_file = _chosen(values, "values")
    if 0 in found.shape:
        raise ValueError(f"{found.where} has shape {found.shape}, must hold something along every axis")
    last = [name for name in (SAMPLE, CHANNEL) if name in found.dims]
    found = found.ordered([*(name for name in found.dims if name not in last), *last])
    along, samples, over = _directions(geometry, neighbours_in_file, [name for name in found.dims if name != CHANNEL])
    shape, channels = _split_axes(found, samples)
    if over not in ((), shape):
        raise ValueError(f"geometry has directions of its own for a map of {over}, the measurements are of {shape}")
    more = {
        name: None if one is None else _chosen(one, name)[0].ordered(found.dims)
        for name, one in (("sigma", sigma), ("mask", mask))
    }
    _require_fitting(more["sigma"], more["mask"], found, shape)
    common = None
    if not over:
        common = Geometry(*_unit_vectors({name: one.read() for name, one in along.items()}, np.ones((), bool), ""))
    whole = MapData(found, along, **more, shape=shape, samples=samples, channels=channels, geometry=common, given=given)
    if common is None and not isinstance(geometry, str | os.PathLike | None):  # what is wrong in memory is refused now
        whole.read_directions(())
    return whole


def _directions(
    given: Any, neighbours_in_file: dict[str, Array], dims: list[str]
) -> tuple[dict[str, Array], int, tuple[int, ...]]:
    """Arrays of directions by name, how many there are, and the shape of the map if texels have their own, else ()."""
    if (
        isinstance(given, str | Path)
        and Path(given).is_file()
        and Path(given).suffix.lower() not in (".npy", ".h5", ".hdf5")
    ):
        given = read_directions(Path(given))
    if isinstance(given, Pairs):
        given = (given.wi, given.wo)
    if isinstance(given, tuple | list):
        if len(given) != 2:
            raise ValueError(f"geometry has {len(given)} entries, must be two: wi and wo")
        given = dict(zip(VECTORS, given, strict=True))
    arrays, _, where = (
        (neighbours_in_file, None, "what is beside the values") if given is None else _group(given, "geometry")
    )
    names = next((names for names in (VECTORS, ANGLES) if all(name in arrays for name in names)), None)
    if names is None:
        missing = "geometry is not given, and there is nothing beside the values" if given is None else where
        raise ValueError(f"{missing} has no directions, must hold {DIRECTIONS}")
    found, axes = {name: arrays[name].ordered(dims) for name in names}, 2 if "wi" in names else 1
    for name, one in found.items():
        if len(one.shape) < axes or (axes == 2 and one.shape[-1] != 3):
            wanted = "(N, 3) or (..., N, 3), the map's axes in front" if axes == 2 else "(N,) or (..., N)"
            raise ValueError(f"{one.where} ({name}) has shape {one.shape}, must be {wanted}")
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


def _split_axes(values: Array, samples: int) -> tuple[tuple[int, ...], int]:
    """The shape of the map, and how many channels it has."""
    shape, named = values.shape, values.dims
    if len(shape) > 2 and shape[-2] == samples and (CHANNEL in named or SAMPLE not in named):
        return shape[:-2], shape[-1]
    if len(shape) > 1 and shape[-1] == samples and CHANNEL not in named:
        return shape[:-1], 1
    raise ValueError(
        f"{values.where} has shape {shape}, the geometry {samples} pairs of directions: values must be "
        f"(..., {samples}, C), or (..., {samples}) for one channel, with an axis or more of texels"
    )


def _require_fitting(sigma: Array | None, mask: Array | None, values: Array, shape: tuple[int, ...]) -> None:
    """Refuse deviations and a mask whose shapes are not those of the values and of the map."""
    rank = len(shape)
    same, alone = values.shape[: rank + 1], values.shape[rank : rank + 1]
    if sigma is not None and sigma.shape != alone:
        fits = [
            len(sigma.shape) == len(full) and sigma.shape[rank:] == full[rank:]
            and all(one in (1, size) for one, size in zip(sigma.shape, full, strict=True))
            for full in (values.shape, same)
        ]  # fmt: skip
        if not any(fits):
            raise ValueError(
                f"{sigma.where} has shape {sigma.shape}, sigma must be {values.shape}, {same}, the same with 1 for "
                f"axes of texels, or {alone}"
            )
    if mask is not None and mask.shape != shape:
        raise ValueError(f"{mask.where} has shape {mask.shape}, a mask must have that of the map, {shape}")
    if mask is not None and mask.variable.dtype.kind == "f":
        raise ValueError(f"{mask.where} holds {mask.variable.dtype}, a mask must hold truth values or whole numbers")


def words(block: Block) -> str:
    """A block as errors name it: [0:32, 64:96]."""
    return f"[{', '.join(f'{one.start}:{one.stop}' for one in block)}]"


def _blocks(shape: tuple[int, ...], axes: int) -> Iterator[Block]:
    """All of an array, slab by slab, or where it is too long for that some blocks from all over it."""
    over = shape[:axes]
    texels, each = math.prod(over), 8 * math.prod(shape[axes:])
    if not over:
        yield ()
    elif texels * each <= WHOLE:
        rows = max(1, min(BLOCK // max(1, each * math.prod(over[1:])), over[0] // 8))
        yield from ((slice(row, min(row + rows, over[0])),) for row in range(0, over[0], rows))
    else:
        run = max(1, min(64, BLOCK // max(1, each)))
        for number in range(BLOCKS):
            *rest, last = np.unravel_index(number * (texels - 1) // (BLOCKS - 1), over)
            yield (*(slice(int(k), int(k) + 1) for k in rest), slice(int(last), min(int(last) + run, over[-1])))


def _absolute(given: Any) -> Any:
    return os.path.abspath(given) if isinstance(given, str | os.PathLike) else given


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
