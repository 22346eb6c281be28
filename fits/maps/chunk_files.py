"""Chunks of plain zarr arrays (version 3, no compression) as the files that they are: written whole, checked as read.

Zarr takes about a millisecond for every chunk of an array, most of it to get from one thread to the next; a plain chunk
is its numbers, little-endian and row by row, in the file ``c/0/1``, and their checksum, as zarr's codec ``crc32c`` has
it. Chunks at the edge of an array are filled up.
"""

import math
import os
import uuid
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np

from fits._files import named

PARTIAL = ".partial"
"""How names of files end, here and in zarr, that have not been written to their end."""

Block = tuple[slice, ...]

CHECKSUM = 4
"""Bytes of it, little-endian, behind the numbers."""


def codecs() -> list[Any]:
    """Of bytes, for arrays whose chunks are to be like these: no compression, and a checksum."""
    from zarr.codecs import Crc32cCodec

    return [Crc32cCodec()]


def checked(array: Any) -> np.ndarray:
    """A whole array of zarr. ValueError, on one line, that names it, where a chunk is damaged."""
    try:
        return np.asarray(array[...])
    except ValueError as error:
        raise ValueError(f"{array.store.root}/{array.path}: damaged, {' '.join(str(error).split())}") from None


def grid(shape: Sequence[int], chunk: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """The places of all chunks, last axis fastest."""
    return product(*(range(-(-size // side)) for size, side in zip(shape, chunk, strict=True)))


def block_at(place: Sequence[int], shape: Sequence[int], chunk: Sequence[int]) -> Block:
    """The part of an array that a chunk holds."""
    return tuple(
        slice(at * side, min((at + 1) * side, size)) for at, size, side in zip(place, shape, chunk, strict=True)
    )


def file_at(array: Path, place: Sequence[int]) -> Path:
    """The file of a chunk of the array in this directory."""
    return array.joinpath("c", *map(str, place))


def write(array: Path, place: Sequence[int], values: np.ndarray, chunk: Sequence[int], fill: Any) -> None:
    """Write one chunk, whole or not at all. values: as many as the array has there, in the array's type."""
    whole = values
    if values.shape != tuple(chunk):
        whole = np.full(chunk, fill, values.dtype)
        whole[tuple(map(slice, values.shape))] = values
    path = file_at(array, place)
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}{PARTIAL}")
    content = np.ascontiguousarray(whole, whole.dtype.newbyteorder("<")).tobytes()
    content += _checksum(content)
    with named(path):
        try:
            try:
                file = partial.open("wb", buffering=0)
            except FileNotFoundError:  # the first of its row; an array that has been removed is not made again
                os.stat(array)
                path.parent.mkdir(parents=True, exist_ok=True)
                file = partial.open("wb", buffering=0)
            with file:
                rest = memoryview(content)
                while rest:
                    rest = rest[file.write(rest) :]
            os.replace(partial, path)
        except BaseException:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            raise


def read(array: Path, place: Sequence[int], dtype: np.dtype, chunk: Sequence[int]) -> np.ndarray | None:
    """One chunk with what fills it up, or None where there is none. ValueError for a file that is damaged."""
    path = file_at(array, place)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    expected = math.prod(chunk) * dtype.itemsize + CHECKSUM
    if len(content) != expected:
        raise ValueError(f"{path}: damaged, holds {len(content)} bytes, must be {expected}")
    numbers = content[:-CHECKSUM]
    if _checksum(numbers) != content[-CHECKSUM:]:
        raise ValueError(f"{path}: damaged, its checksum is not that of its content")
    return np.frombuffer(numbers, dtype.newbyteorder("<")).reshape(chunk)


def is_whole(array: Path, place: Sequence[int], dtype: np.dtype, chunk: Sequence[int]) -> bool:
    """Whether the file of a chunk is there, undamaged."""
    try:
        return read(array, place, dtype, chunk) is not None
    except (ValueError, NotADirectoryError):
        return False


def _checksum(content: bytes) -> bytes:
    return int(google_crc32c.value(content)).to_bytes(CHECKSUM, "little")
