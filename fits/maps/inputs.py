"""Measurements of a map: values of every texel, their directions, standard deviations and a mask, read block by block.

A map is an array (..., N, C): texels along the leading axes, N measurements of each, C channels; or (..., N) for one
channel. It may be far larger than memory: of arrays of numpy, .npy files, HDF5, zarr and xarray blocks are read.
"""

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import xarray as xr
import zarr

from fits._files import require_there
from fits.data.formats.csv import read_directions
from fits.data.geometry import Booleans, Floats, Geometry, Pairs, direction
from fits.engines import one_line
from fits.store import fingerprint

Block = tuple[slice, ...]
"""A selection of the leading axes of a map, the first ones of an array; other axes are taken whole."""

SAMPLE, CHANNEL = "sample", "channel"  # names of the axes of measurements and of channels in xarray

VECTORS, ANGLES = ("wi", "wo"), ("theta_i", "phi_i", "theta_o", "phi_o")
FILES = (".npy", ".h5", ".hdf5", ".zarr")
NORMAL = (0.0, 0.0, 1.0)

WHOLE, SOME = 2**23, 64  # numbers of a map that is fingerprinted as a whole; and texels that are of a larger one


# ---- arrays, wherever they are ----


class Array(NamedTuple):
    """An array that is read in parts.

    name: as errors call it. source: of numpy, h5py, zarr, or a variable of xarray. by_texel: whether its first axes are
    those of the map.
    """

    name: str
    source: Any
    by_texel: bool = True

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.source.shape)

    def read(self, block: Block = ()) -> Floats:
        """A block of it, float64, a copy. ValueError, which names file and block: it cannot be read."""
        try:
            return np.array(self.source[(*block, ...) if self.by_texel else ...], dtype=np.float64)
        except MemoryError:
            raise
        except Exception as error:  # codecs raise what they like
            part = f"block {block_words(block)}" if block else "it"
            raise ValueError(f"{self.name}: {part} cannot be read: {one_line(error)}") from None

    def checked(self, *shapes: tuple[int, ...], common: tuple[int, ...] = ()) -> "Array":
        """The array, of one of these shapes, or ValueError; common: that of one which is the same for all texels."""
        if self.shape not in shapes:
            allowed = " or ".join(map(str, shapes))
            raise ValueError(f"{self.name} has shape {self.shape}, must be {allowed} for these values and directions")
        return self._replace(by_texel=self.shape != common)


Arrays = dict[str, Array]


def _array(source: Any, name: str) -> Array:
    """An array of numpy, h5py, zarr or xarray, or what numpy makes one of."""
    array = source.variable if isinstance(source, xr.DataArray) else source
    if not (hasattr(array, "dtype") and hasattr(array, "shape")):
        array = np.asarray(array)
    if isinstance(array, np.ma.MaskedArray):
        array = np.ma.filled(array.astype(np.float64), np.nan)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {array.dtype}, must hold real numbers")
    return Array(name, array)


def _arrays(source: Any, wanted: str) -> Arrays:
    """The arrays of numbers of a file, a Dataset or a mapping; or one array by the wanted name, and those beside it."""
    if isinstance(source, str | os.PathLike):
        return _arrays_of_file(str(source), wanted)
    if isinstance(source, Mapping):
        return _numbers(source.variables if isinstance(source, xr.Dataset) else source, wanted)
    return {wanted: _array(source, wanted)}


def _numbers(members: Mapping[Any, Any], where: str) -> Arrays:
    """Those of these arrays that hold numbers; whatever else lies there is skipped."""
    found = {str(name): one for name, one in members.items() if getattr(one, "dtype", np.dtype(float)).kind in "biuf"}
    return {name: _array(one, f"{where}/{name}") for name, one in found.items()}


def _arrays_of_file(source: str, wanted: str) -> Arrays:
    """The arrays of a file, or of the group that is named as ``file.h5:/group``; an array that is named so by the
    wanted name, beside the others of its group."""
    inside = re.fullmatch(r"(.+\.(?:h5|hdf5|zarr)):/(.*)", source, re.IGNORECASE)
    path, name = (inside[1], inside[2].strip("/")) if inside else (source, "")
    require_there(path)
    suffix = Path(path).suffix.lower()
    if any((Path(path) / file).is_file() for file in ("zarr.json", ".zarray", ".zgroup")):
        suffix = ".zarr"
    if suffix not in FILES or (suffix != ".zarr" and os.path.isdir(path)):
        raise ValueError(
            f"{path}: a map is one array, in one of {', '.join(FILES)}; files of measurements are for layerjax fit and "
            "layerjax fit-many"
        )
    try:
        if suffix == ".npy":
            root = np.load(path, mmap_mode="r", allow_pickle=False)
        else:
            root = zarr.open(path, mode="r") if suffix == ".zarr" else h5py.File(path, "r")
        node = root[name] if name else root
        if is_array := hasattr(node, "dtype"):
            group, _, last = name.rpartition("/")
        else:
            group, last = name, ""
        members = {} if is_array and not name else _group(path, suffix, group, root)
    except KeyError:
        raise ValueError(f"{path}: holds no {name!r}") from None
    except Exception as error:  # codecs raise what they like
        raise ValueError(f"{path}: cannot be read: {one_line(error)}") from None
    arrays = _numbers(members, f"{path}:/{group}".rstrip("/"))
    if is_array:
        arrays[wanted] = arrays.get(last) or _array(node, source)
    return arrays


def _group(path: str, suffix: str, name: str, root: Any) -> Mapping[Any, Any]:
    """The arrays of a group as xarray reads them: with factor, offset and the number that stands for nothing."""
    options: dict[str, Any] = {"group": name or None, "decode_times": False}
    if suffix != ".zarr":
        return xr.open_dataset(path, engine="h5netcdf", phony_dims="access", **options).variables
    try:
        return xr.open_zarr(path, consolidated=False, chunks=None, **options).variables
    except (KeyError, ValueError):  # axes without names
        return dict((root[name] if name else root).arrays())


def _choose(source: Any, wanted: str, arrays: Arrays) -> Array:
    """The array of the wanted name, or the only one."""
    if wanted not in arrays and len(arrays) != 1:
        where = source if isinstance(source, str | os.PathLike) else wanted
        names = f"there are {', '.join(sorted(arrays)[:9])}" if arrays else "there is none"
        raise ValueError(f"{where}: no array {wanted!r} of numbers, {names}; PATH:/NAME chooses another")
    return arrays[wanted] if wanted in arrays else next(iter(arrays.values()))


# ---- the measurements of a map ----


class Measured(NamedTuple):
    """The measurements of one block.

    values, sigma: (block shape, N, C), in 1/sr; NaN where unknown. mask: (block shape), which texels take part. wi, wo:
    (block shape, N, 3), None where all texels of the map have the same directions; sigma: None where there are none.
    """

    values: Floats
    sigma: Floats | None
    mask: Booleans
    wi: Floats | None
    wo: Floats | None


@dataclass(frozen=True, eq=False)
class MapData:
    """The measurements of a map, opened and not loaded.

    directions: by name, of `VECTORS` or `ANGLES`. shape: of the map. samples: N. channels: C. geometry: the directions,
    if all texels have the same. arguments: of `map_data`.
    """

    values: Array
    directions: Arrays
    sigma: Array | None
    mask: Array | None
    shape: tuple[int, ...]
    samples: int
    channels: int
    geometry: Geometry | None
    arguments: tuple[Any, Any, Any, Any]

    def __reduce__(self) -> Any:  # open files do not outlive their process, another one opens them again
        values, geometry, sigma, mask = self.arguments
        geometry = geometry if self.geometry is None else (self.geometry.wi, self.geometry.wo)
        sigma = None if self.sigma is None else sigma  # a noise model need not have it
        arguments = (values, geometry, sigma, mask)
        return map_data, tuple(os.path.abspath(one) if isinstance(one, str | os.PathLike) else one for one in arguments)

    def read(self, block: Block = ()) -> Measured:
        """The measurements of a block; what stands in masked texels is not looked at.

        ValueError: they cannot be read, or a standard deviation or a direction of a texel that takes part is none.
        """
        whole = (*block, *[slice(None)] * (len(self.shape) - len(block)))
        block = tuple(slice(*one.indices(size)[:2]) for one, size in zip(whole, self.shape, strict=True))
        mask, sigma, wi, wo = self.read_mask(block), None, None, None
        if self.sigma is not None:
            sigma = self._expanded(self.sigma, block)
            if np.any(bad := (sigma <= 0.0) & mask[..., None, None]):
                raise ValueError(
                    f"{self.sigma.name}: sigma is {sigma[bad][0]:g} in block {block_words(block)}, must be above 0, or "
                    "NaN where it is unknown"
                )
            sigma = np.where(sigma > 0.0, sigma, np.nan)
        if self.geometry is None:
            directions = {name: one.read(block) for name, one in self.directions.items()}
            wi, wo = _unit_vectors(directions, mask, f" in block {block_words(block)}")
        return Measured(self._expanded(self.values, block), sigma, mask, wi, wo)

    def read_mask(self, block: Block) -> Booleans:
        """Which texels of a block take part: all if there is no mask."""
        if self.mask is None:
            return np.ones([one.stop - one.start for one in block], bool)
        return self.mask.read(block) != 0.0

    def _expanded(self, array: Array, block: Block) -> Floats:
        """A block of values or their deviations at its full shape, (block shape, N, C)."""
        part = array.read(block)
        if part.ndim in (1, len(block) + 1):  # the same for all channels
            part = part[..., None]
        return np.broadcast_to(part, (*(one.stop - one.start for one in block), self.samples, self.channels)).copy()

    def fingerprint(self) -> str:
        """What distinguishes these measurements from others: of shape and directions, and of all numbers up to 64 MiB,
        or else of texels from all over the map. ValueError: a block cannot be read."""
        common, texels = () if self.geometry is None else (self.geometry.wi, self.geometry.wo), math.prod(self.shape)
        blocks: list[Block] = [()]
        if texels * self.samples * self.channels > WHOLE:
            places = np.unravel_index(np.linspace(0, texels - 1, SOME).astype(int), self.shape)
            blocks = [tuple(slice(at, at + 1) for at in place) for place in np.transpose(places).tolist()]
        parts = [fingerprint(part=list(self.read(block))) for block in blocks]
        return fingerprint(measurements=[[self.shape, self.samples, self.channels, *common], parts])["measurements"]


def map_data(values: Any, geometry: Any = None, sigma: Any = None, mask: Any = None) -> MapData:
    """Open the measurements of a map.

    Each array may be one of numpy (mapped or not), h5py, zarr or xarray, or a path: of a .npy file, of an HDF5 file or
    zarr store that holds one array, or one of the argument's name, or ``file.h5:/name``, ``store.zarr:/name``. Axes
    count by their order, but those of values that xarray calls "sample" and "channel", which may stand anywhere.

    Args:
        values: (..., N, C), or (..., N) for one channel, BSDF in 1/sr. Where both fit it is (..., N, C). A value that
            is NaN is skipped.
        geometry: `fits.Geometry` (or measurements, for where they were taken), a pair (wi, wo) of arrays, (N, 3) or
            (..., N, 3), a csv of directions, or a mapping or file with the arrays `wi`, `wo`, or `theta_i`, `phi_i`,
            `theta_o`, `phi_o`, (N,) or (..., N), in degrees; None: these stand beside the values.
        sigma: standard deviations in 1/sr, above 0, (..., N, C), (..., N) or (N,). NaN leaves a value out.
        mask: (...), truth values or whole numbers: which texels take part, others being 0.

    Raises:
        ValueError: an array is not there or no such array, or shapes do not fit together.
    """
    arrays = _arrays(values, "values")
    array = _choose(values, "values", arrays)
    if 0 in array.shape:
        raise ValueError(f"{array.name} has shape {array.shape}, must hold something along every axis")
    names = getattr(array.source, "dims", ())
    if named := [name for name in (SAMPLE, CHANNEL) if name in names]:
        array = array._replace(source=array.source.transpose(..., *named))
    directions = _directions(geometry, arrays)
    components = (3,) if "wi" in directions else ()
    samples = next(iter(directions.values())).shape[-1 - len(components)]

    # the last axes are those of measurements and channels, or of measurements
    if len(array.shape) > 2 and array.shape[-2] == samples and named[-1:] != [SAMPLE]:
        shape, channels = array.shape[:-2], array.shape[-1]
    elif len(array.shape) > 1 and array.shape[-1] == samples:
        shape, channels = array.shape[:-1], 1
    else:
        raise ValueError(
            f"{array.name} has shape {array.shape}, the geometry {samples} pairs of directions: values must be "
            f"(..., {samples}, C), or (..., {samples}) for one channel, with an axis or more of texels"
        )
    common = (samples, *components)
    directions = {name: one.checked(common, (*shape, *common), common=common) for name, one in directions.items()}
    deviations = part = None
    if sigma is not None:
        shapes = (*shape, samples, channels), (*shape, samples), (samples,)
        deviations = _choose(sigma, "sigma", _arrays(sigma, "sigma")).checked(*shapes, common=(samples,))
    if mask is not None:
        part = _choose(mask, "mask", _arrays(mask, "mask")).checked(shape)
        if part.source.dtype.kind == "f":
            raise ValueError(f"{part.name} holds {part.source.dtype}, a mask must hold truth values or whole numbers")
    view = None
    if not any(one.by_texel for one in directions.values()):
        vectors = {name: one.read() for name, one in directions.items()}
        view = Geometry(*_unit_vectors(vectors, np.ones((), bool), ""))
    data = MapData(array, directions, deviations, part, shape, samples, channels, view, (values, geometry, sigma, mask))
    if view is None and not isinstance(geometry, str | os.PathLike | None):  # what is wrong in memory is refused now
        data.read()
    return data


def _directions(geometry: Any, arrays: Arrays) -> Arrays:
    """The arrays of directions by name; arrays: those beside the values."""
    missing = "geometry (--geometry) is not given, and there are no directions beside the values"
    if geometry is not None:
        if isinstance(geometry, str | Path) and Path(geometry).is_file() and Path(geometry).suffix.lower() not in FILES:
            geometry = read_directions(Path(geometry))
        if isinstance(geometry, Pairs):
            geometry = (geometry.wi, geometry.wo)
        if isinstance(geometry, tuple | list):
            if len(geometry) != 2:
                raise ValueError(f"geometry has {len(geometry)} entries, must be two: wi and wo")
            geometry = dict(zip(VECTORS, geometry, strict=True))
        missing, arrays = "geometry holds no directions", _arrays(geometry, "geometry")
    names = next((names for names in (VECTORS, ANGLES) if all(name in arrays for name in names)), None)
    if names is None:
        wanted = f"{' and '.join(VECTORS)}, or {', '.join(ANGLES)} in degrees"
        raise ValueError(f"{missing}: {wanted}")
    for name in names:
        least = 2 if names is VECTORS else 1
        if len(arrays[name].shape) < least or 0 in arrays[name].shape:
            raise ValueError(f"{arrays[name].name} ({name}) has shape {arrays[name].shape}, must be (N, 3) or (N,)")
    return {name: arrays[name] for name in names}


def _unit_vectors(directions: Mapping[str, Floats], used: Booleans, where: str) -> tuple[Floats, Floats]:
    """`wi` and `wo`, (block shape, N, 3), refused where one of a `used` texel is none, along the normal elsewhere."""
    if "wi" not in directions:
        for name in ("theta_i", "theta_o"):
            wrong = ((directions[name] < 0.0) | (directions[name] > 180.0)) & used[..., None]
            if wrong.any():
                first = np.broadcast_to(directions[name], wrong.shape)[wrong][0]
                raise ValueError(f"geometry: {name} is {first:g}, must be in [0, 180] degrees")
        pairs = {"wi": ("theta_i", "phi_i"), "wo": ("theta_o", "phi_o")}
        directions = {name: direction(*(directions[one] for one in angles)) for name, angles in pairs.items()}
    checked = []
    for name in VECTORS:
        vectors = np.broadcast_to(directions[name], (*used.shape, *directions[name].shape[-2:]))
        bad = ~(np.abs(np.linalg.norm(vectors, axis=-1) - 1.0) <= 1e-6)
        if np.any(wrong := bad & used[..., None]):
            raise ValueError(f"geometry: {name} is {vectors[wrong][0].tolist()}{where}, must be finite and of length 1")
        checked.append(np.where(bad[..., None], NORMAL, vectors))
    return checked[0], checked[1]


def block_words(block: Block) -> str:
    """A block as errors name it: [0:32, 64:96]."""
    return f"[{', '.join(f'{one.start}:{one.stop}' for one in block)}]"
