"""Arrays of a map, read by blocks: in memory, in a .npy file, a dataset of an HDF5 file or an array of a zarr store.

Nothing is loaded before it is asked for. Numbers come as float64; where a file names the number that stands for
"nothing was read" (the attribute `_FillValue`, as xarray writes it), that is NaN.
"""

import base64
import hashlib
import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fits._files import require_there
from fits.data.geometry import Floats

Block = tuple[slice, ...]
"""Of the leading axes of a map, the first ones of an array; what is left out is taken whole."""

HDF5, ZARR = (".h5", ".hdf5"), (".zarr",)
KINDS = ".npy, .h5, .hdf5 or .zarr"
NPY = b"\x93NUMPY"
"""How a .npy file begins."""

_INSIDE = re.compile(r"(?P<path>.+\.(?:h5|hdf5|zarr)):(?P<name>/.*)", re.IGNORECASE)
_ZARR_FILES = ("zarr.json", ".zarray", ".zgroup")

UNREADABLE = "?"
"""In the place of a fingerprint of what cannot be read."""

SLABS = 8  # blocks, at least, that an array which is hashed whole is cut into
WHOLE = 2**26  # bytes: an array up to this is hashed whole, of a longer one so many blocks
SAMPLES, RUN, MOST = 64, 64, 2**20  # blocks, texels a block along the last axis, bytes a block


class Place(NamedTuple):
    """Where another process finds an array: an absolute path, and a name in it ("" where the file is the array)."""

    path: str
    name: str


@dataclass(frozen=True, eq=False)
class Source:
    """One array, wherever it is.

    where: as errors name it. place: None if it is only in memory, or where another process does not reach. dims: names
    of its axes, where it has such. empty: the number that stands for nothing.
    """

    array: Any
    where: str
    place: Place | None = None
    dims: tuple[str, ...] = ()
    empty: float | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.array.shape)

    def read(self, block: Block = ()) -> Floats:
        """A block of it, float64, a copy.

        Raises:
            ValueError: it cannot be read, whatever the reason; it names file and block.
        """
        try:
            self._require_whole()
            found = np.array(self.array[(*block, ...)], dtype=np.float64)
        except MemoryError:
            raise
        except Exception as error:  # codecs raise what they like
            part = f"block {words(block)}" if block else "it"
            raise ValueError(f"{self.where}: {part} cannot be read: {_reason(error)}") from None
        if self.empty is not None:
            found[found == self.empty] = np.nan
        return found

    def ordered(self, dims: Sequence[str]) -> "Source":
        """The same with its named axes in this order, as far as it has them, and others last."""
        last = tuple(name for name in self.dims if name not in dims)
        own = (*(name for name in dims if name in self.dims), *last)
        return self if own == self.dims else replace(self, array=self.array.transpose(*own), dims=own)

    def digest(self, leading: int) -> str:
        """What tells it from another: hashes of shape and type, and of the blocks of its content; "?" for one that
        cannot be read, see `fits.maps.identity.alike`.

        Of arrays above 64 MiB (as float64) the content of 64 blocks enters, spread evenly, of up to 64 texels each:
        what changes between them is not seen. leading: how many axes are of the map.
        """
        kind = self.array.dtype
        found = [_hashed(f"{self.shape} {kind.kind}{kind.itemsize}".encode())]
        for block in _sampled(self.shape, leading):
            try:
                part = self.read(block)
            except ValueError:
                found.append(UNREADABLE)
                continue
            part[np.isnan(part)] = np.nan  # one of the many, and one zero of the two
            found.append(_hashed((part + 0.0).tobytes()))
        return ",".join(found)

    def _require_whole(self) -> None:
        """Refuse a mapped file that has been cut short: to read beyond its end would kill the process."""
        if isinstance(self.array, np.memmap) and self.array.filename is not None:
            needed, there = self.array.offset + self.array.nbytes, os.path.getsize(self.array.filename)
            if there < needed:
                raise ValueError(f"the file has {there:,} bytes, must have {needed:,} (truncated?)")


@dataclass(frozen=True, eq=False)
class Named:
    """Several arrays under their names: a group of a file, an xarray Dataset, or the coordinates of a DataArray."""

    group: Any
    where: str

    def __contains__(self, name: str) -> bool:
        return name in self.group if library(self.group) == "xarray" else name in self.names()

    def names(self) -> list[str]:
        """Of its arrays; without those along which others lie."""
        kind = library(self.group)
        if kind == "h5py":
            return [name for name, entry in self.group.items() if hasattr(entry, "dtype") and hasattr(entry, "shape")]
        return sorted(self.group.array_keys()) if kind == "zarr" else [str(name) for name in self.group]

    def source(self, name: str) -> Source:
        """The array of this name, which is there."""
        separator = ":/" if library(self.group) in ("h5py", "zarr") and ":/" not in self.where else "/"
        found = opened(self.group[name], f"{self.where.rstrip('/')}{separator}{name}")
        assert isinstance(found, Source)
        return found

    def one(self, wanted: str) -> Source:
        """The array of this name, or the only one that there is."""
        names = self.names()
        if wanted not in self and len(names) != 1:
            there = f"there are {', '.join(names[:9])}" if names else "there is none"
            raise ValueError(f"{self.where}: no array {wanted!r}, {there}; PATH:/NAME chooses another")
        return self.source(wanted if wanted in self else names[0])


def source(given: Any, wanted: str) -> Source:
    """The array that was given, or the one that stands under the wanted name where several are.

    Raises:
        ValueError: there is none, or not one of real numbers.
    """
    found = opened(given, wanted)
    return found.one(wanted) if isinstance(found, Named) else found


def opened(given: Any, where: str) -> Source | Named:
    """An array or several, from an object or a path; where: what errors call it if it has no name of its own."""
    if isinstance(given, Source | Named):
        return given
    if isinstance(given, Place):
        given = f"{given.path}:/{given.name}" if given.name else given.path
    if isinstance(given, str | os.PathLike):
        return _in_file(str(given))
    kind = library(given)
    if kind and not hasattr(given, "dtype"):
        return Named(given, where)
    if kind == "h5py":
        place = Place(os.path.abspath(given.file.filename), given.name.strip("/"))
        # one that is open for writing is locked against other processes
        return _numeric(given, where, place if given.file.mode == "r" and os.path.isfile(place.path) else None)
    if kind == "zarr":
        root = getattr(given.store, "root", None)
        return _numeric(given, where, Place(os.path.abspath(root), given.path) if isinstance(root, Path) else None)
    if kind == "xarray":
        return _numeric(given, where, None, tuple(map(str, given.dims)))
    if isinstance(given, np.ma.MaskedArray):
        return _numeric(np.ma.filled(given.astype(np.float64), np.nan), where, None)
    return _numeric(given if isinstance(given, np.ndarray) else np.asarray(given), where, _mapped(given))


def beside(one: Source) -> Named | None:
    """What lies beside an array: in its group, or as its coordinates; None where nothing can."""
    kind, array = library(one.array), one.array
    near = one.where.rpartition("/")[0].rstrip(":") or f"what is beside {one.where}"
    if kind == "xarray":
        return Named(array.coords, one.where)
    if kind == "h5py":
        return Named(array.parent, near)
    if kind == "zarr" and array.path:
        import zarr

        try:
            return Named(zarr.open_group(array.store, path=array.path.rpartition("/")[0], mode="r"), near)
        except Exception:  # an array that lies in no group
            return None
    return None


def is_arrays(path: str | Path) -> bool:
    """Whether a file is by its name one that holds arrays."""
    return Path(path).suffix.lower() in (".npy", *HDF5, *ZARR)


def library(given: Any) -> str:
    """The package that an object's class is of."""
    own = {kind.__module__.partition(".")[0] for kind in type(given).__mro__}
    return next((name for name in ("h5py", "zarr", "xarray") if name in own), "")


def words(block: Block) -> str:
    """A block as errors name it: [0:32, 64:96]."""
    return f"[{', '.join(f'{one.start}:{one.stop}' for one in block)}]"


def _in_file(given: str) -> Source | Named:
    inside = _INSIDE.fullmatch(given)
    path, name = (inside["path"], inside["name"].strip("/")) if inside else (given, "")
    suffix = Path(path).suffix.lower()
    require_there(path)
    is_store = suffix in ZARR or any(os.path.isfile(os.path.join(path, file)) for file in _ZARR_FILES)
    if os.path.isdir(path) and not is_store:
        raise ValueError(
            f"{path}: is a folder, a map is one array ({KINDS}); a folder of measurement files is for layerjax fit-many"
        )
    if suffix not in (".npy", *HDF5) and not is_store:
        raise ValueError(
            f"{path}: ends in {suffix!r}, a map is read from {KINDS}; readings of one material are for layerjax fit"
        )
    try:
        found = _in_npy(path) if suffix == ".npy" else _in_hdf5(path) if suffix in HDF5 else _in_zarr(path)
        found = found[name] if name else found
    except MemoryError:
        raise
    except KeyError:
        raise ValueError(f"{path}: holds no {name!r}") from None
    except Exception as error:
        raise ValueError(f"{path}: cannot be read: {_reason(error)}") from None
    return opened(found, given)


def _in_npy(path: str) -> Any:
    with open(path, "rb") as file:
        if file.read(len(NPY)) != NPY:
            raise ValueError("it is no .npy file")  # numpy takes it for a pickle, and tells how to load it unsafely
    return np.load(path, mmap_mode="r", allow_pickle=False)


def _in_hdf5(path: str) -> Any:
    import h5py

    return h5py.File(path, "r")


def _in_zarr(path: str) -> Any:
    import zarr

    return zarr.open(path, mode="r")


def _numeric(array: Any, where: str, place: Place | None, dims: tuple[str, ...] = ()) -> Source:
    """The array, if it holds real numbers or truth values, with what its attributes say of them."""
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{where} holds {array.dtype}, must hold real numbers")
    said = getattr(array, "attrs", {}) if library(array) in ("h5py", "zarr") else {}
    packed = [name for name in ("scale_factor", "add_offset") if name in said]
    if packed:
        raise ValueError(f"{where} is packed ({', '.join(packed)}); open it with xarray and give the DataArray")
    written_by_xarray = "_ARRAY_DIMENSIONS" in said  # which has its word for nothing elsewhere in zarr's format 2
    empty = array.fill_value if written_by_xarray else said.get("_FillValue")
    return Source(array, where, place, dims, _empty(empty))


def _empty(said: Any) -> float | None:
    """The number behind the attribute `_FillValue`; None if there is none, or it is NaN, which needs no word."""
    if isinstance(said, str):  # as xarray writes it to zarr
        said = np.frombuffer(base64.b64decode(said), "<f8")
    number = math.nan if said is None else float(np.ravel(said)[0])
    return None if math.isnan(number) else number


def _mapped(given: Any) -> Place | None:
    """The .npy file behind a mapped array, if that holds all of it and nothing else."""
    if not isinstance(given, np.memmap) or given.filename is None or given.mode not in ("r", "r+"):
        return None
    path = os.path.abspath(given.filename)
    try:
        again = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError):  # raw numbers without a header
        return None
    same = (again.shape, again.dtype, again.strides) == (given.shape, given.dtype, given.strides)
    return Place(path, "") if same else None


def _sampled(shape: tuple[int, ...], leading: int) -> Iterator[Block]:
    """Blocks to hash: all of it, slab by slab, or where it is too long for that some from all over it."""
    over = shape[:leading]
    texels, each = math.prod(over), 8 * math.prod(shape[leading:])
    if not over:
        yield ()
    elif texels * each <= WHOLE:
        rows = max(1, min(MOST // max(1, each * math.prod(over[1:])), over[0] // SLABS))
        yield from ((slice(row, min(row + rows, over[0])),) for row in range(0, over[0], rows))
    else:
        run = max(1, min(RUN, MOST // max(1, each)))
        for sample in range(SAMPLES):
            *rest, last = np.unravel_index(sample * (texels - 1) // (SAMPLES - 1), over)
            yield (*(slice(int(k), int(k) + 1) for k in rest), slice(int(last), min(int(last) + run, over[-1])))


def _hashed(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
