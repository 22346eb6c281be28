"""The store of a fitted map: a group of zarr that grows chunk by chunk, and whose map it is.

A directory of zarr version 3 with the arrays ``values/NAME``, ``errors/NAME``, ``reduced_chi_square``, ``flags``,
``start``, ``at_bound``, ``measurements`` and, where the transport has one, ``numerical_error``, all of the map's shape,
in chunks of the same texels, uncompressed and with zarr's checksums. The flags of a chunk are written last: a texel
whose flags are 0 is not there yet, whatever else is. One process at a time writes (it holds a lock); readers change
nothing.
"""

import asyncio
import functools
import glob
import itertools
import json
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import CodeType
from typing import Any

import jax
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec
from zarr.core.sync import sync

from fits._files import named, permissions, plain, require_there
from fits.maps.inputs import UNREADABLE, Block
from fits.problem.parameters import is_free
from fits.store import portable_repr

ROOT, KEY, KIND, FORMAT = "zarr.json", "layerjax", "fitted map", 3
PARTIAL = ".partial"
"""How names end, here and in zarr, of what has not been written to its end."""

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

NO_START = -32768
"""In ``start``: the texel is not fitted. Others: -1 a neighbour's values, -2 random ones, else the start's number."""

MOST_NAMES = 64  # bits of at_bound
CHECKSUM = (Crc32cCodec(),)


def arrays_of(names: Sequence[str], numerical: bool) -> dict[str, tuple[np.dtype, Any]]:
    """Path, type and fill value of every array of a store, the flags last."""
    number, places = np.dtype(np.float64), np.dtype(np.uint32 if len(names) <= 32 else np.uint64)
    return {
        **{f"{group}/{name}": (number, np.nan) for group in ("values", "errors") for name in names},
        "reduced_chi_square": (number, np.nan),
        **({"numerical_error": (number, np.nan)} if numerical else {}),
        "start": (np.dtype(np.int16), NO_START),
        "at_bound": (places, 0),
        "measurements": (np.dtype(np.uint32), 0),
        "flags": (np.dtype(np.uint16), 0),
    }


def blocks_of(shape: Sequence[int], chunk: Sequence[int]) -> Iterator[Block]:
    """The parts of an array that its chunks hold, last axis fastest."""
    for place in itertools.product(*(range(-(-size // side)) for size, side in zip(shape, chunk, strict=True))):
        yield tuple(
            slice(at * side, min((at + 1) * side, size)) for at, size, side in zip(place, shape, chunk, strict=True)
        )


# ---- making, and what it says of itself ----


def create(
    path: Path,
    *,
    names: Sequence[str],
    units: Mapping[str, str],
    shape: Sequence[int],
    chunk: Sequence[int],
    attributes: Mapping[str, Any],
    numerical: bool,
) -> "Store":
    """Make an empty store, whole or not at all.

    Args:
        names, units: of the parameters, at most 64 (the bits of ``at_bound``); "1" for plain ratios.
        chunk: texels along each axis of what is written at once.
        attributes: what else the root says under the key "layerjax", such as how the map was fitted.
        numerical: whether there is an array ``numerical_error``.

    Raises:
        ValueError: there is something at `path`, or the names are too many.
    """
    if os.path.lexists(path):
        raise ValueError(f"{path}: exists already")
    if len(names) > MOST_NAMES:
        raise ValueError(f"names: {len(names)} parameters given, must be at most {MOST_NAMES}")
    about = {"kind": KIND, "format": FORMAT, "names": list(names), "units": {name: units[name] for name in names}}
    about |= {"shape": list(shape), "chunk": list(chunk), "numerical_error": numerical}
    axes = {1: ["texel"], 2: ["row", "column"]}.get(len(shape), [f"axis_{axis}" for axis in range(len(shape))])
    with named(path):
        new = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=PARTIAL, dir=path.resolve().parent))
    try:
        with named(path):
            root = zarr.create_group(new, attributes={KEY: plain({**attributes, **about})})
            for name, (dtype, fill) in arrays_of(names, numerical).items():
                root.create_array(
                    name,
                    shape=tuple(shape),
                    chunks=tuple(chunk),
                    dtype=dtype,
                    fill_value=fill,
                    compressors=CHECKSUM,
                    dimension_names=axes,
                    attributes=_described(name, units),
                )
            os.chmod(new, permissions(0o777))  # mkdtemp makes what only its owner can read
            os.rename(new, path)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    return Store(path)


def _described(name: str, units: Mapping[str, str]) -> dict[str, Any]:
    """Attributes of an array, by the CF conventions."""
    if "/" in name:
        return {"units": units[name.partition("/")[2]]}
    if name == "flags":
        return {"flag_masks": list(FLAGS.values()), "flag_meanings": " ".join(FLAGS)}
    words = {
        "reduced_chi_square": "chi-square per degree of freedom",
        "numerical_error": "numerical error of the model, in standard deviations of the data",
        "start": f"start of the best fit; -1: a neighbour's values, -2: random ones, {NO_START}: none",
        "at_bound": "bit p: parameter p, in the order of the root's names, is at a bound",
        "measurements": "how many measurements entered",
    }
    return {"units": "1", "long_name": words[name]}


def is_store(path: str | Path) -> bool:
    """Whether this is a directory of zarr, of whatever content."""
    return (Path(path) / ROOT).is_file()


def attributes_of(path: Path) -> dict[str, Any]:
    """What the root of a store says under our key; ValueError that says what `path` is instead."""
    must = f"must be the store of a {KIND}, as `layerjax fit-map` writes it"
    require_there(path, "no such file or directory")
    if not path.is_dir():
        raise ValueError(f"{path}: is a file, {must}")
    if not is_store(path):
        raise ValueError(f"{path}: is a directory without {ROOT}, {must}")
    try:
        described = json.loads((path / ROOT).read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path / ROOT}: damaged, not valid JSON: {error}") from None
    if not isinstance(described, dict) or described.get("node_type") != "group":
        raise ValueError(f"{path}: is no group of zarr arrays, {must}")
    attributes = described.get("attributes")
    found = attributes.get(KEY) if isinstance(attributes, dict) else None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: is a zarr group that is not ours, {must}")
    if found.get("kind") != KIND:
        raise ValueError(f"{path}: holds a {found.get('kind')}, must be a {KIND}")
    return found


# ---- reading and writing ----


class Store:
    """The arrays of a store, opened once in each process.

    Raises:
        ValueError: it is none, of another version, or its description is damaged.
    """

    def __init__(self, path: str | Path, mode: Any = "r+"):
        self.path, self.about = Path(path), attributes_of(Path(path))
        if self.about.get("format") != FORMAT:
            raise ValueError(f"{path}: is version {self.about.get('format')} of the format, must be {FORMAT}")
        try:
            self.names, self.units = tuple(self.about["names"]), dict(self.about["units"])
            self.shape, self.chunk = tuple(self.about["shape"]), tuple(self.about["chunk"])
            self.types = arrays_of(self.names, self.about["numerical_error"])
            self.root = zarr.open_group(self.path, mode=mode)
            for name, array in self.arrays.items():
                if array.shape != self.shape:
                    raise ValueError(f"{name} has shape {array.shape}, must be {self.shape}")
        except Exception as error:  # whatever a description that is none leads to
            raise ValueError(f"{path}: damaged, {type(error).__name__} {' '.join(str(error).split())}") from None

    @cached_property
    def arrays(self) -> dict[str, Any]:
        """Checksums by path."""
        return {name: self.root[name] for name in self.types}

    def write(self, block: Block, results: Mapping[str, np.ndarray]) -> None:
        """Write one chunk, its flags last. OSError: it names the store.

        results: by path, such as ``"values/base.albedo"``, the block's numbers of every array.
        """

        async def write(names: Iterable[str]) -> None:  # together, which takes half the time
            parts = {name: np.asarray(results[name], self.types[name][0]) for name in names}
            await asyncio.gather(*(self.arrays[name].async_array.setitem(block, part) for name, part in parts.items()))

        with named(self.path):
            os.stat(self.path)  # one that was removed is not made again
            sync(write(self.types.keys() - {"flags"}))
            sync(write(["flags"]))

    def flags(self, block: Block) -> NDArray[np.uint16] | None:
        """The flags of a part of the map; None if it is not whole: a flag is 0, an array is damaged or lacks values."""
        try:
            flags = np.asarray(self.arrays["flags"][block])
            if not flags.all():
                return None
            fitted = (flags & FLAGS["fitted"]) != 0
            for name, array in self.arrays.items():
                part = np.asarray(array[block])
                if name.startswith("values/") and not np.isfinite(part[fitted]).all():
                    return None
        except Exception:  # codecs raise what they like
            return None
        return flags

    def unfinished(self) -> list[Block]:
        """The chunks that are not there whole, in their order."""
        if self.flags(()) is not None:  # at once, much faster than one by one
            return []
        return [block for block in blocks_of(self.shape, self.chunk) if self.flags(block) is None]

    def clean(self, unfinished: Sequence[Block]) -> None:
        """Remove what writers that were killed left of these chunks and of files; none may be writing."""
        for block in unfinished:
            place = tuple(one.start // side for one, side in zip(block, self.chunk, strict=True))
            for name, array in self.arrays.items():
                (self.path / name / array.metadata.encode_chunk_key(place)).unlink(missing_ok=True)
        for path in list(self.path.rglob(f"*{PARTIAL}")):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)

    def save_group(
        self,
        name: str,
        arrays: Mapping[str, np.ndarray],
        about: Mapping[str, Any],
        attributes: Mapping[str, Mapping[str, Any]] | None = None,
        **options: Any,
    ) -> None:
        """Write a group of arrays, in place of what is there, that is whole once its attributes are. OSError: named.

        attributes: of the arrays. options: of all, as zarr takes them.
        """
        with named(self.path):
            shutil.rmtree(self.path / name, ignore_errors=True)
            group = self.root.create_group(name)
            for path, array in arrays.items():
                group.create_array(
                    path,
                    data=np.ascontiguousarray(array),
                    compressors=CHECKSUM,
                    attributes=dict((attributes or {}).get(path, {})),
                    **options,
                )
            group.attrs.update({KEY: {"arrays": list(arrays), **plain(about)}})

    def load_group(self, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """The arrays of a group and what it says of itself; None where it is not there whole, or damaged."""
        try:
            group: Any = self.root[name]
            about: Any = group.attrs[KEY]
            return {path: np.asarray(group[path][...]) for path in about["arrays"]}, about
        except Exception:  # codecs raise what they like
            return None


# ---- whose map it is ----


def require_folder(path: Path) -> None:
    """Refuse a place whose folder is not there, before any work."""
    if not path.resolve().parent.is_dir():
        raise ValueError(f"{path}: there is no directory {path.parent}")


def resume(path: Path, identity: Mapping[str, str], force: bool) -> Store | None:
    """The store that is there, if it is of the same fit, without what killed writers left; None: there is none, or one
    to `throw_away`.

    Args:
        identity: fingerprints of what makes this fit, by name.
        force: throw away a map of another fit, or a damaged one.

    Raises:
        ValueError: something else is there, or a map of another fit (it names what differs), or a damaged one.
    """
    for unfinished in path.resolve().parent.glob(f".{glob.escape(path.name)}.*{PARTIAL}"):
        shutil.rmtree(unfinished, ignore_errors=True)
    if not os.path.lexists(path):
        return None
    if not is_store(path):
        raise ValueError(f"{path}: is there, and is no fitted map; it must be the store of one, or not be there")
    attributes_of(path)  # what is not ours is never touched
    try:
        store = Store(path)
        stored = store.about.get("fingerprints", {})
        changed = [
            name
            for name in {**stored, **identity}
            if not same_but_numbers(stored.get(name, ""), identity.get(name, ""))
        ]
        if changed:
            raise ValueError(
                f"{path}: holds a map of another fit, different in {', '.join(changed)} "
                "(--force, or force=True, throws it away and begins anew)"
            )
    except ValueError:
        if force:
            return None
        raise
    store.clean(store.unfinished())
    return store


def throw_away(path: Path) -> None:
    """Remove the map that is there, if there is one; what is left of it where that is stopped `resume` takes away."""
    if is_store(path):
        old = path.with_name(f".{path.name}.{uuid.uuid4().hex}{PARTIAL}")
        os.rename(path, old)
        shutil.rmtree(old)


def same_but_numbers(one: str, other: str) -> bool:
    """Whether two fingerprints are the same, of which parts may be "?": of what could not be read at the time."""
    parts = [each.split(",") for each in (one, other)]
    same = all(a == b or UNREADABLE in (a, b) for a, b in zip(*parts, strict=False))
    return same and len(parts[0]) == len(parts[1])


def described(tree: Any, within: tuple[Any, ...] = ()) -> list[Any]:
    """A tree as `fits.store.fingerprint` tells it from others: its structure and its numbers, and of functions their
    names, what they do and what they hold; not what they find in global variables.

    within: functions that hold the tree, or may be in it themselves.
    """
    leaves, structure = jax.tree.flatten(tree, is_leaf=is_free)
    return [repr(structure), *(_function(leaf, within) if callable(leaf) else leaf for leaf in leaves)]


def _function(function: Any, within: tuple[Any, ...]) -> Any:
    if any(function is one for one in within):
        return "itself"
    within = (*within, function)
    if isinstance(function, functools.partial):
        return ["partial", described([function.func, function.args, function.keywords], within)]
    name = f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', portable_repr(function))}"
    if hasattr(function, "__code__"):
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        held = [cells, function.__defaults__, function.__kwdefaults__, getattr(function, "__self__", None)]
        return [name, _code(function.__code__), described(held, within)]
    return [name, _function(function.__wrapped__, within)] if hasattr(function, "__wrapped__") else name  # of jax.jit


def _code(code: CodeType) -> list[Any]:
    """Its instructions, and the names and constants that they are about."""
    constants = [
        _code(one) if isinstance(one, CodeType) else sorted(map(repr, one)) if isinstance(one, frozenset) else repr(one)
        for one in code.co_consts
    ]
    return [code.co_code, code.co_names, constants]
