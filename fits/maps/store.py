"""The store of a fitted map: a zarr group that grows chunk by chunk, and is read as `FittedMap`.

A directory of zarr version 3 with the arrays ``values/NAME``, ``errors/NAME``, ``reduced_chi_square``, ``flags``,
``start``, ``at_bound``, ``readings`` and, where the transport has one, ``numerical_error``, all of the map's shape and
in chunks of the same texels. The flags of a chunk are written last: a texel whose flags are 0 is not there yet. Chunks
are not compressed and carry checksums (see `fits.maps.chunk_files`), and the same numbers are the same bytes.
"""

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fits._files import named, permissions, plain
from fits.maps import chunk_files
from fits.maps.chunk_files import PARTIAL, Block, block_at, grid

if TYPE_CHECKING:
    import zarr

KEY, KIND, FORMAT = "layerjax", "fitted map", 2
FLAGS = {
    "fitted": 1,
    "converged": 2,
    "at_bound": 4,
    "poor": 8,
    "restarted": 16,
    "masked": 32,
    "too_few_readings": 64,
    "failed": 128,
    "unidentified": 256,
}
"""Meaning and bit of what `flags` says of a texel; 0: it is not there yet."""

NO_START = -32768
"""In ``start``: the texel is not fitted. Others: -1 a neighbour's values, -2 random ones, else the start's number."""

MOST_NAMES = 64  # bits of at_bound


def arrays_of(names: Sequence[str], numerical: bool) -> dict[str, tuple[np.dtype, Any]]:
    """Path, type and fill value of every array of a store, the flags last."""
    number, places = np.dtype(np.float64), np.dtype(np.uint32 if len(names) <= 32 else np.uint64)
    return {
        **{f"{group}/{name}": (number, np.nan) for group in ("values", "errors") for name in names},
        "reduced_chi_square": (number, np.nan),
        **({"numerical_error": (number, np.nan)} if numerical else {}),
        "start": (np.dtype(np.int16), NO_START),
        "at_bound": (places, 0),
        "readings": (np.dtype(np.uint32), 0),
        "flags": (np.dtype(np.uint16), 0),
    }


def create(
    path: str | Path,
    *,
    names: Sequence[str],
    units: Mapping[str, str],
    shape: Sequence[int],
    chunk: Sequence[int],
    attributes: Mapping[str, Any],
    numerical: bool,
) -> "zarr.Group":
    """Make an empty store, whole or not at all.

    Args:
        path: directory to make.
        names: of the parameters, at most 64 (the bits of ``at_bound``).
        units: of each parameter, "1" for plain ratios.
        shape: of the map.
        chunk: texels along each axis of what is written at once; larger ones than the map become the map.
        attributes: what else the root says under the key "layerjax", such as how the map was fitted; numbers that are
            not finite become "nan", "inf", "-inf".
        numerical: whether there is an array ``numerical_error``.

    Raises:
        ValueError: there is something at `path`, or a field is not what it must be.
    """
    import zarr

    path = Path(path)
    chunk = _checked(path, names, shape, chunk)
    about = {"kind": KIND, "format": FORMAT, "names": list(names), "units": {name: units[name] for name in names}}
    about |= {"shape": list(shape), "chunk": list(chunk), "numerical_error": numerical}
    with named(path):
        new = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=PARTIAL, dir=path.resolve().parent))
    try:
        with named(path):
            root = zarr.create_group(new, attributes={KEY: plain({**attributes, **about})})
            for name, (dtype, fill) in arrays_of(names, numerical).items():
                root.create_array(
                    name,
                    shape=tuple(shape),
                    chunks=chunk,
                    dtype=dtype,
                    fill_value=fill,
                    compressors=chunk_files.codecs(),
                    dimension_names=dimensions(len(chunk)),
                    attributes=_described(name, units),
                )
            os.chmod(new, permissions(0o777))  # mkdtemp makes what only its owner can read
            os.rename(new, path)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    return zarr.open_group(path, mode="r+")


def _checked(path: Path, names: Sequence[str], shape: Sequence[int], chunk: Sequence[int]) -> tuple[int, ...]:
    """The chunk, no larger than the map; ValueError for what cannot be a store."""
    if os.path.lexists(path):
        raise ValueError(f"{path}: exists already")
    if not path.resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no directory {path.parent}")
    if not 0 < len(names) <= MOST_NAMES or len(set(names)) < len(names):
        raise ValueError(f"names: {len(names)} parameters given, must be 1 to {MOST_NAMES} and different")
    for field, sizes in (("shape", shape), ("chunk", chunk)):
        if not sizes or min(sizes) < 1:
            raise ValueError(f"{field}: {tuple(sizes)} given, must be one or more numbers >= 1")
    if len(chunk) != len(shape):
        raise ValueError(f"chunk: has {len(chunk)} axes, must be {len(shape)}, those of the map")
    return tuple(min(side, size) for side, size in zip(chunk, shape, strict=True))


def dimensions(rank: int) -> list[str]:
    """Names of axes, by which xarray knows that arrays belong together."""
    return {1: ["texel"], 2: ["row", "column"]}.get(rank, [f"axis_{axis}" for axis in range(rank)])


def _described(name: str, units: Mapping[str, str]) -> dict[str, Any]:
    """Attributes of an array, by the CF conventions."""
    group, _, parameter = name.partition("/")
    if parameter:
        return {"units": units[parameter]}
    if group == "flags":
        return {"flag_masks": list(FLAGS.values()), "flag_meanings": " ".join(FLAGS)}
    words = {
        "reduced_chi_square": "chi-square per degree of freedom",
        "numerical_error": "numerical error of the model, in standard deviations of the readings",
        "start": f"start that the best end came from; -1: a neighbour's, -2: a random one, {NO_START}: none",
        "at_bound": "bit p: parameter p, in the order of the root's names, is at a bound",
        "readings": "how many readings entered",
    }
    return {"units": "1", "long_name": words[group]}


def write_chunk(group: "zarr.Group", block: Block, results: Mapping[str, np.ndarray]) -> None:
    """Write one chunk, its flags last. Where that fails, what there was of the chunk is taken away, if it can be.

    Args:
        group: a store as `create` made it.
        block: a whole chunk, or the part of one that the map has, as `left` gives it.
        results: by path, such as ``"values/base.albedo"``, the block's numbers of every array of the store.

    Raises:
        ValueError: a block that is no chunk, or results that are not of the store's arrays or of the block's shape.
        OSError: it names the store.
    """
    root, arrays, shape, chunk = _layout(group)
    place = tuple(one.start // side for one, side in zip(block, chunk, strict=True))
    if block_at(place, shape, chunk) != tuple(slice(one.start, one.stop) for one in block):
        raise ValueError(f"block: {block} is no chunk of a map of shape {shape} in chunks of {chunk}")
    if results.keys() != arrays.keys():
        raise ValueError(f"results: {sorted(results.keys() ^ arrays.keys())} are not both given and of the store")
    size = tuple(one.stop - one.start for one in block)
    for name, values in results.items():
        if np.shape(values) != size:
            raise ValueError(f"results: {name} has shape {np.shape(values)}, must be {size}, that of the block")
    try:
        with named(root):
            # of what is replaced: from here on the chunk is not there
            chunk_files.file_at(root / "flags", place).unlink(missing_ok=True)
            for name, (dtype, fill) in arrays.items():
                chunk_files.write(root / name, place, np.asarray(results[name], dtype), chunk, fill)
    except BaseException:
        for name in reversed(arrays):
            with suppress(OSError):
                chunk_files.file_at(root / name, place).unlink(missing_ok=True)
        raise


def left(group: "zarr.Group") -> list[Block]:
    """The chunks that are not there, in their order, see `flags_of`."""
    *_, shape, chunk = _layout(group)
    return [block for place in grid(shape, chunk) if flags_of(group, block := block_at(place, shape, chunk)) is None]


def flags_of(group: "zarr.Group", block: Block) -> NDArray[np.uint16] | None:
    """The flags of a chunk; None if it is not there whole: a flag is 0, or a file of an array lacks or is damaged."""
    root, arrays, _, chunk = _layout(group)
    place = tuple(one.start // side for one, side in zip(block, chunk, strict=True))
    if not all(chunk_files.is_whole(root / name, place, dtype, chunk) for name, (dtype, _) in arrays.items()):
        return None
    flags = chunk_files.read(root / "flags", place, arrays["flags"][0], chunk)
    if flags is None:
        return None
    flags = flags[tuple(slice(one.stop - one.start) for one in block)]
    return flags if flags.all() else None


def clean(path: str | Path) -> None:
    """Remove what writers that were killed left of files they had begun; none may be writing."""
    for folder, folders, files in os.walk(path):
        for name in [one for one in folders if one.endswith(PARTIAL)]:
            shutil.rmtree(os.path.join(folder, name), ignore_errors=True)
        for name in files:
            if name.endswith(PARTIAL):
                with suppress(FileNotFoundError):
                    os.unlink(os.path.join(folder, name))


def _layout(group: "zarr.Group") -> tuple[Path, dict[str, tuple[np.dtype, Any]], tuple[int, ...], tuple[int, ...]]:
    """Directory, arrays, shape and chunk of a store."""
    about: Any = group.metadata.attributes[KEY]
    root = Path(group.store.root) / group.path  # type: ignore[attr-defined]
    return root, arrays_of(about["names"], about["numerical_error"]), tuple(about["shape"]), tuple(about["chunk"])
